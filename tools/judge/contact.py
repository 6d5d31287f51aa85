"""What a hand feels when it pushes into a wall and draws back: run and bound, in virtual time.

W is the waiting level: what the open gap, the scene's least force and its standby leave without inertia. *Onset* is the
time from when the wall's force at the handle's place reaches W and 0.2 N until the kinetic force does; *short* is the
share of that force that the run then lacks. *RMS* is the kinetic force less the wall's until the hand turns, then less
W. *Held* is how long the handle is held back by more than W and 0.1 N while the hand draws it back. Where another force
or a wall is sent, the bound are the run's own motors, which only open once the hand pulls. The picture's band is
the just noticeable difference of force, 10 % (Jones 1989).
"""

import argparse
import math
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import numpy as np
from devices import SAMPLES, SECOND

from judge.frame import each
from judge.touching import (
    COUNTED_N,
    FREE_MM,
    HELD_N,
    MASS_KG,
    ONSET_N,
    Case,
    Touch,
    core_of,
    ideal,
    opened,
    reached_ms,
    rendered,
)
from tormag_lab.arrays import Json, Mask, rms
from tormag_lab.pages import subplots
from tormag_lab.told import lines

DEVICES = (*SAMPLES, "draw 100", "draw 103", SECOND)
HANDS_N_MM = (0.1, 0.3, 1.0)
TOUCHES = ((0.05, 60.0), (0.25, 10.0), (0.25, 30.0), (1.0, 30.0))
"Walls, N/mm, and pushes, mm/s."
ROUND_TRIPS_MS = (0.0, 100.0, 400.0)
MODES = ("force", "force_standby", "way", "way_standby", "law", "law_standby")
EARLY_TICKS = 20
"What is exceeded before the wall for no longer does not count."
LATER_MS, WORSE, WORSE_N = 40.0, 1.1, 0.015
"Bounds for 95 %: onset, unless no hand tells the difference, and RMS, against the bound's."
SWINGS_MM_S = 5.0
DRAWN = {
    "force": "Forces are sent",
    "way": "Another force is sent for withdrawing",
    "law": "The wall is sent",
    "law_standby": "The wall is sent, and the brake waits nearer",
}
FORCE_JND = 0.10


def cases() -> list[Case]:
    return [
        Case(device, hand, *touched, round_trip_ms, mode)
        for device, hand, touched, round_trip_ms, mode in product(DEVICES, HANDS_N_MM, TOUCHES, ROUND_TRIPS_MS, MODES)
    ]


def judged(case: Case) -> Json:
    core = core_of(case)
    run, bound, infinite = rendered(case, core), ideal(case), ideal(case, has_motors=False)
    free = infinite.depth_mm < -0.5 * FREE_MM
    waiting_N = float(infinite.kinetic_N[free & (infinite.time_s < infinite.time_s[-1] / 2.0)].mean())
    is_counted = case.wall_N_mm * infinite.depth_mm.max() >= waiting_N + COUNTED_N
    force = core.scene.force

    def lag_ms(touch: Touch) -> float | None:
        return reached_ms(touch, case.wall_N_mm, waiting_N + ONSET_N) if is_counted else None

    return {
        **{key: value for key, value in case._asdict().items() if key != "hand_N_mm"},
        "hand": case.hand_N_mm,
        "waiting_N": waiting_N,
        "onset_lag_ms": lag_ms(run),
        "onset_bound_ms": lag_ms(bound),
        "onset_short": onset_short(run, bound, waiting_N + ONSET_N) if is_counted else None,
        "rms_N": rms_N(run, case.wall_N_mm, waiting_N),
        "rms_bound_N": rms_N(bound, case.wall_N_mm, waiting_N),
        "felt_1_2_N_ms": reached_ms(run, case.wall_N_mm, 1.2),
        "felt_stiffness_ratio": felt_stiffness_ratio(run, case.wall_N_mm),
        "free_drag_N": free_drag_N(run),
        "standby_N": force.standby_N or None,
        "withdrawal_held_ms": held_ms(run, waiting_N),
        "withdrawal_bound_ms": held_ms(bound if case.mode.startswith("force") else opened(case, core), waiting_N),
        "tip_depth_mm": float(run.depth_mm.max()),
        "early_N": early_N(run, waiting_N),
        "swings": swings(run),
        "energy_error": energy_error(run),
        "most_N_exceeded": max(float(run.kinetic_N.max()) - force.most_N, 0.0),
        "faults": list(run.faults),
        "limits": list(run.limits),
    }


def onset_short(run: Touch, bound: Touch, onset_N: float) -> float | None:
    """Return the share of `onset_N` that the run lacks when the bound has it."""
    has_it = bound.kinetic_N >= onset_N
    return 1.0 - float(run.kinetic_N[has_it.argmax()]) / onset_N if has_it.any() else None


def free_drag_N(touch: Touch) -> float:
    return float(touch.force_N[(touch.depth_mm < -2.0) & (touch.depth_mm > -0.5 * FREE_MM) & pushing(touch)].mean())


def pushing(touch: Touch) -> Mask:
    return np.asarray(touch.time_s < touch.time_s[-1] / 2.0)


def rms_N(touch: Touch, wall_N_mm: float, waiting_N: float) -> float:
    begins = int((touch.depth_mm >= 0.0).argmax())
    wanted_N = np.where(pushing(touch), np.maximum(wall_N_mm * touch.depth_mm, waiting_N), waiting_N)
    return rms((touch.kinetic_N - wanted_N)[begins:])


def felt_stiffness_ratio(touch: Touch, wall_N_mm: float) -> float | None:
    """Return the slope of the felt force over the handle's place behind the wall, over the wall's."""
    inside = (touch.depth_mm > 0.0) & (touch.speed_mm_s > 1.0) & pushing(touch)
    if inside.sum() < 10:
        return None
    return float(np.polyfit(touch.depth_mm[inside], touch.force_N[inside], 1)[0] / wall_N_mm)


def held_ms(touch: Touch, waiting_N: float) -> float:
    """Return how long a brake with more than W holds the handle back while the hand draws it back."""
    held = np.minimum(-touch.force_N, touch.kinetic_N) > waiting_N + HELD_N
    return float(held[~pushing(touch)].sum())


def early_N(touch: Touch, waiting_N: float) -> float:
    """Return the excess over W before the wall for more than EARLY_TICKS."""
    before = touch.kinetic_N[: int((touch.depth_mm >= 0.0).argmax())]
    return float(np.sort(before)[-EARLY_TICKS - 1] - waiting_N)


def swings(touch: Touch) -> int:
    """Return how often the handle turns besides the hand's own turn; a held one turns twice on its bristles."""
    moving = touch.speed_mm_s[np.abs(touch.speed_mm_s) > SWINGS_MM_S]
    return max(int((np.diff(np.sign(moving)) != 0.0).sum()) - 1, 0)


def energy_error(touch: Touch) -> float:
    """Return the share of the hand's work that neither moves the handle nor is taken by the brake."""
    travel_mm = np.diff(touch.depth_mm)
    given = float(((touch.hand_N - touch.force_N)[1:] * travel_mm).sum())
    first_mm_s, last_mm_s = touch.speed_mm_s[[0, -1]]
    moving = 0.5e-3 * MASS_KG * float(last_mm_s**2 - first_mm_s**2)
    return abs(given - moving) / float(np.abs(touch.hand_N[1:] * travel_mm).sum())


def kept(rows: list[Json]) -> Json:
    found: Json = {}
    for mode in dict.fromkeys(row["mode"] for row in rows):
        of_mode = [row for row in rows if row["mode"] == mode]
        late = [
            row["onset_lag_ms"] - row["onset_bound_ms"]
            for row in of_mode
            if row["onset_lag_ms"] is not None and row["onset_bound_ms"] is not None
        ]
        worse = [row["rms_N"] - WORSE * row["rms_bound_N"] - WORSE_N for row in of_mode]
        found[mode] = {
            "cases": len(of_mode),
            "counted": len(late),
            "late_ms": spread(late),
            "short": spread([row["onset_short"] for row in of_mode if row["onset_short"] is not None]),
            "rms_kept": float(np.mean([each <= 0.0 for each in worse])),
            "rms_over_N": float(np.quantile(worse, 0.95)),
            "held_ms": spread([row["withdrawal_held_ms"] - row["withdrawal_bound_ms"] for row in of_mode]),
            "early_N": spread([row["early_N"] for row in of_mode]),
            "over_most_N": max(row["most_N_exceeded"] for row in of_mode),
            "swings": max(row["swings"] for row in of_mode),
            "faults": sum(bool(row["faults"]) for row in of_mode),
        }
    return found


def spread(values: list[float]) -> Json:
    shares = {"p50": 0.5, "p95": 0.95, "worst": 1.0}
    return {name: float(np.quantile(values or [math.nan], share)) for name, share in shares.items()}


def draw(picture: Path) -> None:
    figure, axes = subplots((11.0, 7.0), 2, 2, sharex=True, sharey=True)
    figure.suptitle("A wall of 0.25 N/mm, pushed at 30 mm/s over 100 ms, sample 2", fontsize=13)
    for axis, (mode, title) in zip(axes.flat, DRAWN.items(), strict=True):
        case = Case("sample_2", 0.3, 0.25, 30.0, 100.0, mode)
        run, bound = rendered(case, core_of(case)), ideal(case)
        wall_N = case.wall_N_mm * np.maximum(run.depth_mm, 0.0)
        low_N, high_N = (1.0 - FORCE_JND) * wall_N, (1.0 + FORCE_JND) * wall_N
        axis.fill_between(run.time_s, low_N, high_N, color="#c9d6df", label="the wall, +- 10 %")
        axis.plot(bound.time_s, bound.kinetic_N, "--", color="#2a6f97", label="what carriages of this speed could do")
        axis.plot(run.time_s, run.kinetic_N, color="#d1495b", label="what resists a hand that moves")
        axis.plot(run.time_s, run.force_N, ":", color="#222222", label="what the hand feels: < 0 holds it back")
        axis.set_title(title, loc="left", fontsize=10.5)
        axis.set_ylabel("force, N")
        axis.spines[["top", "right"]].set_visible(False)
    axes[0, 1].legend(frameon=False, fontsize=8.5)
    for axis in axes[1]:
        axis.set_xlabel("time, s")
    figure.savefig(picture)


OPTIONS = {"--picture": {"type": Path, "metavar": "FILE.png"}}


def measure(options: argparse.Namespace) -> Json:
    rows = each(judged, "touches", cases())
    if options.picture:
        draw(options.picture)
    of_modes = kept(rows)
    is_kept = all(
        (row["late_ms"]["p95"] <= LATER_MS or row["short"]["p95"] <= FORCE_JND)
        and row["rms_kept"] >= 0.95
        and not row["faults"]
        for row in of_modes.values()
    )
    worst = max(row["energy_error"] for row in rows)
    return {"cases": rows, "kept": of_modes, "energy_error": worst, "passed": is_kept}


def shown(figures: Json) -> Iterator[str]:
    return lines(figures["kept"])
