"""How well a force can be followed at all: the error that is left to the ideal carriages of a device.

    bound.py FORCE.csv [--plant sample_1] [--held] [--json]

The CSV has the columns `t_s,force_N`. The device is known exactly (`tools/rendering/ideal_carriage.py`): its motors'
torque-speed line, current limit, friction and pull, the field of its gap with the lag that remanence gives it, the
relaxation of its insert, the friction of a handle that slides at one speed. The force asked is clipped to what the open
gap brakes and to the scene's greatest; all of it in steps of a millisecond or less.

*Without delay*: a step knows the force asked at its end, and how fast it changes, but nothing of what follows. The
carriages close up to it as fast as they can while they still can brake in time. For what repeats itself or is noise
that is no bound: a forecast that is right misses less, down to what foresight does, and so may a gap that stands still.

*With foresight* the whole signal is known, and the RMS error is the least that the drive allows; at what gap and speed
the carriages begin is free. The optimum is found by sequential quadratic programmes (Gauss-Newton, each solved by
Clarabel), to 2 %: carried on, the rounds found nothing better than that. Without the field's lag a search of everything
agrees to 0.4 % (`tests/tools/test_bound.py`).
"""

import argparse
import json
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import clarabel
import numpy as np
import numpy.typing as npt
from rendering.ideal_carriage import Brake, Drive, brake_of, drive_of
from scipy import sparse
from tqdm import tqdm

from tormagd.force_file import ForceFileError
from tormagd.lab.design.recorded_task import read_task
from tormagd.physics.errors import DomainError, require
from tormagd.simulation.parameters import PlantError, PlantParameters, load_plant

Array = npt.NDArray[np.float64]
Json = dict[str, Any]

STEP_S = 1e-3
MOST_N = 2.0
"The greatest force of the scenes."
HAND_MM_S = 42.0
"The roller's surface at the thesis's 20 rpm."
MOST_STEPS = 300_000
ROUNDS = 30
SETTLED = 1e-3
"Relative change of the RMS error from round to round, below which nothing is left to be found."
EXACT_N = 1e-6
SECANT_MM_S = 5.0
"Over which a limit is taken to be straight: turning round, it has a kink, and the carriages turn elsewhere next round."
LEAST_BRAKING_MM_S2 = 50.0
MOST_ITERATIONS = 1_000
"""Of one programme: where the rounds go a little way only, the limits leave little room about the last round's way, and
the solver takes ten times as many as at first."""
SOLVED = ("Solved", "AlmostSolved")


class Asked(NamedTuple):
    """A force in even steps, clipped to what can be asked for, and the strength of the field that brakes that much.

    `scale`, `offset_N` and `relaxed_N` turn the fresh insert's force into the rendered one.
    """

    force_N: Array
    strength_Tm: Array
    relaxed_N: Array
    scale: float
    offset_N: float

    def rendered_N(self, brake: Brake, gap_mm: Array) -> Array:
        """The force along a way of the gap that begins with it open."""
        moment_Tm = np.interp(gap_mm, brake.gap_mm, brake.moment_Tm)
        fresh_N = np.interp(moment_Tm + brake.lags_Tm(moment_Tm), brake.strength_Tm, brake.fresh_N)
        rendered: Array = self.scale * (fresh_N - self.relaxed_N) + self.offset_N
        return rendered


class Bound(NamedTuple):
    """The force asked, clipped, and what the ideal carriages render of it without delay and with foresight."""

    time_s: Array
    asked_N: Array
    no_delay_N: Array
    foresight_N: Array

    def figures(self, start_s: float = -math.inf) -> Json:
        """Of the times from `start_s` on."""
        inside = self.time_s >= start_s
        asked_N = self.asked_N[inside]
        return {
            "sd_N": float(asked_N.std()),
            "no_delay_rms_N": rms(self.no_delay_N[inside] - asked_N),
            "foresight_rms_N": rms(self.foresight_N[inside] - asked_N),
        }


def bound(
    plant: PlantParameters,
    time_s: Array,
    force_N: Array,
    *,
    is_held: bool = False,
    most_N: float = MOST_N,
    hand_mm_s: float = HAND_MM_S,
    step_s: float = STEP_S,
    shows: bool = False,
) -> Bound:
    """The bound for forces at rising times, linear in between, or held until the next. Raises `DomainError`."""
    require("step_s", step_s, 1e-5, STEP_S)
    require("hand_mm_s", hand_mm_s, 0.5, 300.0)
    require("most_N", most_N, 0.1, 10.0)
    steps = (time_s[-1] - time_s[0]) / step_s
    if not 2.0 <= steps <= MOST_STEPS:
        raise DomainError("t_s", f"{time_s[0]} .. {time_s[-1]}", f"2 to {MOST_STEPS} steps of {step_s:g} s")
    axis_s = time_s[0] + step_s * np.arange(math.floor(steps + 1e-6) + 1)
    wanted_N = np.interp(axis_s, time_s, force_N)
    if is_held:
        wanted_N = force_N[np.searchsorted(time_s, axis_s + 1e-9, side="right") - 1]
    brake, drive = brake_of(plant), drive_of(plant)
    asked = asked_of(brake, wanted_N, most_N=most_N, hand_mm_s=hand_mm_s, step_s=step_s)
    greedy_mm = no_delay_mm(drive, brake, asked, step_s)
    best_mm = foresight_mm(drive, brake, asked, step_s, shows=shows)
    return Bound(axis_s, asked.force_N, asked.rendered_N(brake, greedy_mm), asked.rendered_N(brake, best_mm))


def asked_of(brake: Brake, force_N: Array, *, most_N: float, hand_mm_s: float, step_s: float) -> Asked:
    """The force within the device's range; the insert relaxes as it does while that force is rendered exactly."""
    offset_N = brake.sliding_N(0.0, hand_mm_s)
    scale = brake.sliding_N(1.0, hand_mm_s) - offset_N
    # a gap that has been opened brakes a little more than one that was never closed
    least_N = brake.fresh_at_N(float(brake.moment_Tm[-1]), brake.branch_Tm)
    greatest_N = brake.fresh_at_N(float(brake.moment_Tm[0]), -brake.branch_Tm)
    series = brake.relaxation
    rested_Tm = float(np.interp(brake.rested_mm, brake.gap_mm, brake.moment_Tm))
    relax, memory = series.discretise(step_s), series.relaxed(brake.fresh_at_N(rested_Tm))
    relaxed_N = sum(series.fractions, 0.0) * memory[0]
    rendered, relaxed = [], []
    for wanted_N in force_N.tolist():
        fresh_N = min(max((min(wanted_N, most_N) - offset_N) / scale + relaxed_N, least_N), greatest_N)
        kinetic_N, memory = relax.advance(memory, fresh_N)
        relaxed_N = fresh_N - kinetic_N
        relaxed.append(relaxed_N)
        rendered.append(scale * kinetic_N + offset_N)
    fresh = (np.array(rendered) - offset_N) / scale + np.array(relaxed)
    return Asked(
        np.array(rendered), np.interp(fresh, brake.fresh_N, brake.strength_Tm), np.array(relaxed), scale, offset_N
    )


def no_delay_mm(drive: Drive, brake: Brake, asked: Asked, step_s: float) -> Array:
    """The gap that follows a force without delay or foresight, beginning on it at rest."""
    gaps_mm, moments_Tm = brake.gap_mm[::-1], brake.moment_Tm[::-1]
    moment_Tm, lag_Tm = float(brake.moment_Tm[-1]), brake.branch_Tm

    def wanted_mm(strength_Tm: float) -> float:
        return float(np.interp(brake.moment_for_Tm(strength_Tm, moment_Tm, lag_Tm), moments_Tm, gaps_mm))

    strengths_Tm = asked.strength_Tm.tolist()
    before_Tm, gap_mm, speed_mm_s = strengths_Tm[0], wanted_mm(strengths_Tm[0]), 0.0
    found: list[float] = []
    for now_Tm in strengths_Tm:
        if found:
            highest = drive.highest_mm_s(gap_mm, speed_mm_s, step_s)
            lowest = drive.lowest_mm_s(gap_mm, speed_mm_s, step_s)
            target_mm = wanted_mm(before_Tm)
            moves_mm_s, behind_mm = (wanted_mm(now_Tm) - target_mm) / step_s, target_mm - gap_mm
            # the largest speed of approach from which the way that is left suffices to fall back to the target's own
            towards = math.copysign(1.0, behind_mm)
            faster_mm_s = min(max(moves_mm_s, lowest), highest) + towards * SECANT_MM_S
            slowed = drive.lowest_mm_s if behind_mm > 0.0 else drive.highest_mm_s
            braking = towards * (faster_mm_s - slowed(gap_mm, faster_mm_s, step_s)) / step_s
            change = max(braking, LEAST_BRAKING_MM_S2) * step_s
            closing = (math.sqrt(change * change + 8.0 * change * abs(behind_mm) / step_s) - change) / 2.0
            wanted_mm_s = moves_mm_s + towards * min(closing, abs(behind_mm) / step_s)
            speed_mm_s = min(max(wanted_mm_s, lowest), highest)
            gap_mm += speed_mm_s * step_s
        found.append(gap_mm)
        arrived_Tm = float(np.interp(gap_mm, brake.gap_mm, brake.moment_Tm))
        if arrived_Tm != moment_Tm:
            lag_Tm = brake.lag_after_Tm(lag_Tm, arrived_Tm - moment_Tm)
        moment_Tm, before_Tm = arrived_Tm, now_Tm
    return np.array(found)


def foresight_mm(drive: Drive, brake: Brake, asked: Asked, step_s: float, *, shows: bool = False) -> Array:
    """The gap over the steps with the least RMS error of force that the drive allows.

    A round takes for straight, about the gap of the last round, what is not: the force over the gap, the field's lag,
    and the speeds that a step reaches over the speed before. It solves the quadratic programme that this makes, whose
    unknowns are the gaps and the lags. Nothing says that this is convex, so that it ends at the optimum is tested:
    against a search of everything (`tests/tools/test_bound.py`).
    Raises RuntimeError where the rounds come to no end.
    """
    steps = len(asked.force_N)
    slope_Tm_mm = np.gradient(brake.moment_Tm, brake.gap_mm)
    slope_N_Tm = asked.scale * np.gradient(brake.fresh_N, brake.strength_Tm)
    gap_mm = np.full(steps, float(np.interp(-asked.strength_Tm.mean(), -brake.moment_Tm, brake.gap_mm)))
    no_load_mm_s = drive.stall_mm_s2 / drive.per_s
    differ = sparse.diags([-1.0, 1.0], [0, 1], shape=(steps - 1, steps), format="csr")
    earlier, later, gaps = differ[:-1], differ[1:], sparse.identity(steps, format="csr")
    last_N, radius_mm = math.inf, float(np.ptp(brake.gap_mm))
    rounds = tqdm(range(ROUNDS), desc="foresight", unit="round", disable=not (shows and sys.stderr.isatty()))
    for _ in rounds:
        speeds_mm_s = np.diff(gap_mm) / step_s
        highest, highest_slope = _reached(drive.highest_mm_s, gap_mm, speeds_mm_s, step_s)
        lowest, lowest_slope = _reached(drive.lowest_mm_s, gap_mm, speeds_mm_s, step_s)
        limits = [
            (later - sparse.diags(highest_slope) @ earlier, (highest - speeds_mm_s[1:]) * step_s),
            (sparse.diags(lowest_slope) @ earlier - later, (speeds_mm_s[1:] - lowest) * step_s),
            # the first speed has none before it
            (differ[:1], (no_load_mm_s - speeds_mm_s[:1]) * step_s),
            (-differ[:1], (no_load_mm_s + speeds_mm_s[:1]) * step_s),
            (gaps, np.minimum(brake.gap_mm[-1] - gap_mm, radius_mm)),
            (-gaps, np.minimum(gap_mm - brake.gap_mm[0], radius_mm)),
        ]
        moment_Tm = np.interp(gap_mm, brake.gap_mm, brake.moment_Tm)
        lag_Tm = brake.lags_Tm(moment_Tm)
        turned = np.interp(gap_mm, brake.gap_mm, slope_Tm_mm)
        felt = np.interp(moment_Tm + lag_Tm, brake.strength_Tm, slope_N_Tm)
        # lags counted in millimetres of gap, as which they weigh as much as these
        unit_Tm = float(np.abs(turned).max())
        error_N = asked.rendered_N(brake, gap_mm) - asked.force_N
        sensed = sparse.hstack([sparse.diags(felt * turned), sparse.diags(felt * unit_Tm)], format="csc")
        followed = sparse.hstack([*_lagging(brake, moment_Tm, lag_Tm, turned / unit_Tm)], format="csc")
        moved_mm = _least_squares(sensed, error_N, followed, limits)[:steps]
        gap_mm = gap_mm + moved_mm
        now_N = rms(asked.rendered_N(brake, gap_mm) - asked.force_N)
        rounds.set_postfix_str(f"{now_N * 1e3:.2f} mN")
        if abs(now_N - last_N) <= SETTLED * now_N + EXACT_N:
            rounds.close()
            return gap_mm
        if now_N > last_N:
            # where the gap turns, one round may undo the other: each goes less far then
            radius_mm = 0.5 * float(np.abs(moved_mm).max())
        last_N = now_N
    raise RuntimeError(f"foresight: no end after {ROUNDS} rounds, {last_N * 1e3:.2f} mN")


def rms(error_N: Array) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(error_N**2)))


def _reached(
    limit_mm_s: Callable[[float, float, float], float], gap_mm: Array, speeds_mm_s: Array, step_s: float
) -> tuple[Array, Array]:
    """The limit of the speed after every step but the first, and how it changes with the speed before."""
    found = []
    for gap, speed in zip(gap_mm[1:-1].tolist(), speeds_mm_s[:-1].tolist(), strict=True):
        more, less = limit_mm_s(gap, speed + SECANT_MM_S, step_s), limit_mm_s(gap, speed - SECANT_MM_S, step_s)
        found.append((limit_mm_s(gap, speed, step_s), (more - less) / (2.0 * SECANT_MM_S)))
    reached, slope = np.array(found).T
    return reached, slope


def _lagging(brake: Brake, moment_Tm: Array, lag_Tm: Array, turned: Array) -> tuple[sparse.spmatrix, sparse.spmatrix]:
    """Two matrices, for the changes of the gaps and of the lags, whose products with them add up to nothing."""
    steps = len(moment_Tm)
    change_Tm = np.diff(moment_Tm)
    kept = np.exp(-np.abs(change_Tm) / brake.turn_Tm)
    pulled = np.sign(change_Tm) * (lag_Tm[:-1] + np.sign(change_Tm) * brake.branch_Tm) / brake.turn_Tm * kept
    # the first lag is what it is
    of_gaps = sparse.diags(
        [np.concatenate([[0.0], pulled]) * turned, -pulled * turned[:-1]], [0, -1], shape=(steps, steps)
    )
    of_lags = sparse.diags([np.ones(steps), -kept], [0, -1], shape=(steps, steps))
    return of_gaps, of_lags


def _least_squares(
    matrix: sparse.spmatrix, error: Array, nothing: sparse.spmatrix, limits: list[tuple[sparse.spmatrix, Array]]
) -> Array:
    """The x with the least |matrix x + error| for which `nothing` x is zero, and limits hold: a matrix times the first
    elements of x is at most its bounds.
    """
    unit = float(np.abs(matrix).max())
    below = sparse.vstack([limit for limit, _ in limits], format="csc")
    below.resize(below.shape[0], matrix.shape[1])
    bounds = np.concatenate([bound for _, bound in limits])
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_iter = MOST_ITERATIONS
    solver = clarabel.DefaultSolver(
        sparse.triu(matrix.T @ matrix / unit**2, format="csc"),
        matrix.T @ error / unit**2,
        sparse.vstack([nothing, below], format="csc"),
        np.concatenate([np.zeros(nothing.shape[0]), bounds]),
        [clarabel.ZeroConeT(nothing.shape[0]), clarabel.NonnegativeConeT(len(bounds))],
        settings,
    )
    solution = solver.solve()
    if str(solution.status) not in SOLVED:
        raise RuntimeError(f"foresight: the quadratic programme ended with {solution.status}")
    return np.array(solution.x)


def main() -> int:
    """Prints the bound; 0, 1 where no optimum was found, or 2 for what cannot be used."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("force", type=Path, metavar="FORCE.csv", help="columns t_s,force_N")
    parser.add_argument("--plant", default="sample_1", help="plant file or the name of a committed sample (sample_1)")
    parser.add_argument("--held", action="store_true", help="each force holds until the next (linear in between)")
    parser.add_argument("--most-N", type=float, default=MOST_N, help=f"greatest force of the scene ({MOST_N:g})")
    parser.add_argument("--hand-mm-s", type=float, default=HAND_MM_S, help=f"speed of the handle ({HAND_MM_S:g})")
    parser.add_argument("--step-ms", type=float, default=STEP_S * 1e3, help=f"at most {STEP_S * 1e3:g}")
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args()
    try:
        task = read_task(options.force)
        found = bound(
            load_plant(options.plant),
            task.time_s,
            task.force_N,
            is_held=options.held,
            most_N=options.most_N,
            hand_mm_s=options.hand_mm_s,
            step_s=options.step_ms * 1e-3,
            shows=True,
        )
    except (DomainError, ForceFileError, PlantError) as error:
        print(f"bound: {error}", file=sys.stderr)
        return 2
    except RuntimeError as error:
        print(f"bound: {error}", file=sys.stderr)
        return 1
    result = found.figures()
    if options.json:
        print(json.dumps(result))
        return 0
    print(
        f"{options.plant} (synthetic): {found.asked_N.min():.2f}..{found.asked_N.max():.2f} N, "
        f"{len(found.time_s)} steps\n"
        f"standard deviation  {result['sd_N'] * 1e3:7.1f} mN\n"
        f"without delay       {result['no_delay_rms_N'] * 1e3:7.1f} mN\n"
        f"with foresight      {result['foresight_rms_N'] * 1e3:7.1f} mN"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
