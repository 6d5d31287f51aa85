"""A force followed in virtual time: who publishes it, and what the device truly rendered."""

from collections import Counter
from collections.abc import Callable
from typing import NamedTuple

import msgspec
import numpy as np
from devices import device as device_of

from judge.hands import Legs, WaitingHand
from tormag_lab.arrays import Array, rms
from tormagd.config import Config
from tormagd.control.assembly.build import Core, build_core
from tormagd.control.believe.believe import NOTHING_LEARNED, Believe, Learned
from tormagd.control.records import TimedSetpoint
from tormagd.scenes.scene import load_scene
from tormagd.simulation.closed_loop import ClosedLoop, stream
from tormagd.simulation.device import FirmwareKind, VirtualDevice
from tormagd.simulation.firmware import Firmware
from tormagd.simulation.hand import Hand, parse_hand
from tormagd.simulation.parameters import PlantParameters

Levels = list[tuple[float, float]]
"How long, s, and how much, N."
Publisher = Callable[[float], TimedSetpoint | None]

RATE_HZ = 500
PULSE_N = (1.4, 1.7)
PREVIEW_S = 0.07
FILE_PREVIEW_S = 0.4
VALID_S = 0.25
MEAN_S = 0.05
LEAD_IN_S = 0.2


class Tracking(NamedTuple):
    """Tracking of one signal. `variance_accounted_for` is 1 - sum(e^2) / sum((ref - mean(ref))^2)."""

    rms_N: float
    variance_accounted_for: float
    worst_N: float
    reference_sd_N: float


def tracking(reference_N: Array, rendered_N: Array) -> Tracking:
    """Compare two signals of one length, sample by sample, without removing a mean or a delay."""
    error = rendered_N - reference_N
    deviation = reference_N - reference_N.mean()
    return Tracking(
        rms_N=rms(error),
        variance_accounted_for=float(1.0 - np.sum(error**2) / np.sum(deviation**2)),
        worst_N=float(np.abs(error).max()),
        reference_sd_N=float(deviation.std()),
    )


class Followed(NamedTuple):
    """What a run showed, a row for each control tick. Forces are signed as the handle moves."""

    time_s: Array
    asked_N: Array
    rendered_N: Array
    handle_mm: Array
    handle_mm_s: Array
    limits: dict[str, float]
    faults: tuple[str, ...] = ()
    shown: Learned = NOTHING_LEARNED

    @property
    def along_N(self) -> Array:
        return np.where(self.handle_mm_s >= 0.0, self.rendered_N, -self.rendered_N)

    @property
    def error_N(self) -> Array:
        return self.along_N - self.asked_N

    def since(self, start_s: float) -> Tracking:
        inside = self.time_s >= start_s
        return tracking(self.asked_N[inside], self.rendered_N[inside])

    def mean_N(self, begins_s: float) -> float:
        return float(self.error_N[(self.time_s >= begins_s) & (self.time_s < begins_s + MEAN_S)].mean())

    def worst_N(self, begins_s: float, ends_s: float) -> float:
        return max(abs(self.mean_N(at_s)) for at_s in np.arange(begins_s, ends_s - MEAN_S, MEAN_S))


def armed(
    core: Core,
    plant: PlantParameters,
    hand: Hand,
    shown: Learned = NOTHING_LEARNED,
    *,
    boot: FirmwareKind = Firmware,
) -> ClosedLoop:
    """Return a loop that was homed and enabled, with a device that has `shown` so much of itself."""
    device = VirtualDevice(plant, hand, seed=1, boot=boot)
    loop = ClosedLoop(core.config, core.stepper(), core.planner(), device)
    taught(loop).teach(shown)
    loop.arm()
    return loop


def armed_at_rest(plant: PlantParameters, legs: Legs, shown: Learned = NOTHING_LEARNED) -> ClosedLoop:
    """Return the same in the scene `coronary`, with a hand that stood meanwhile and now goes along its legs."""
    hand = WaitingHand()
    loop = armed(build_core(Config(scene="coronary")), plant, hand, shown)
    hand.begin(legs, loop.now_s)
    return loop


def follow(loop: ClosedLoop, publish: Publisher, lasts_s: float, start_s: float, lead_s: float = 0.0) -> Followed:
    """Play what is published for so long, or until a fault; rows count from `lead_s` after `start_s`."""
    rows: list[tuple[float, ...]] = []
    held: Counter[str] = Counter()
    asked_N: list[float] = []

    def newest(now_s: float) -> TimedSetpoint | None:
        setpoint = publish(now_s)
        asked_N.append(0.0 if setpoint is None else setpoint.force_N)
        return setpoint

    for sample in loop.run(lasts_s, newest):
        truth = sample.truth
        since_s = truth.time_s - start_s - lead_s
        if since_s >= 0.0:
            rows.append((since_s, asked_N[-1], truth.force_N, truth.handle_mm, truth.handle_mm_s))
            held.update({str(limit) for limit in (*sample.plan.limits, *sample.output.limits)})
        if sample.safety.faults:
            break
    shares = {limit: count / len(rows) for limit, count in sorted(held.items())}
    faults = tuple(map(str, loop.stepper.safety.faults))
    time_s, asked, rendered, handle, speed = np.array(rows).reshape(-1, 5).T
    return Followed(time_s, asked, rendered, handle, speed, shares, faults, taught(loop).learned())


def taught(loop: ClosedLoop) -> Believe:
    assert loop.planner is not None, "this loop plans"
    return loop.planner.believe


def asked_at(levels: Levels) -> Callable[[float], float]:
    ends = np.cumsum([lasts_s for lasts_s, _ in levels]).tolist()

    def force_N(time_s: float) -> float:
        return next((level for end, (_, level) in zip(ends, levels, strict=True) if time_s < end), levels[-1][1])

    return force_N


def publisher(times_s: Array, forces_N: Array, preview_s: float) -> Publisher:
    """Publish each force at its time, with what follows up to `preview_s` in even steps."""
    live = stream(times_s, forces_N)
    period_s = 1.0 / RATE_HZ
    ahead_s = period_s * np.arange(1, round(preview_s / period_s) + 1)
    if not ahead_s.size:
        return live

    def newest(now_s: float) -> TimedSetpoint | None:
        setpoint = live(now_s)
        if setpoint is None:
            return None
        preview = np.interp(setpoint.stamp_s + ahead_s, times_s, forces_N)
        return setpoint.replaced(preview_N=tuple(preview.tolist()), preview_dt_s=period_s)

    return newest


def with_approach(times_s: Array, forces_N: Array, start_N: float, ramp_s: float, hold_s: float) -> tuple[Array, Array]:
    """Return the signal after a ramp to its first force, and a hold there."""
    period_s = float(times_s[1] - times_s[0])
    ramp = np.linspace(start_N, forces_N[0], round(ramp_s / period_s), endpoint=False)
    forces = np.concatenate([ramp, np.full(round(hold_s / period_s), forces_N[0]), forces_N])
    return np.arange(len(forces), dtype=np.float64) * period_s, forces


def played(
    loop: ClosedLoop,
    times_s: Array,
    forces_N: Array,
    preview_s: float = 0.0,
    *,
    wait_s: float = 0.0,
    lead_s: float = 0.0,
) -> Followed:
    """Follow a signal from `wait_s` on; raise RuntimeError at a fault."""
    start_s = loop.now_s + wait_s
    publish = publisher(times_s + start_s, forces_N, preview_s)
    found = follow(loop, publish, wait_s + float(times_s[-1]), start_s, lead_s)
    if found.faults:
        raise RuntimeError(f"{', '.join(found.faults)} at {loop.now_s:.3f} s")
    return found


class Case(NamedTuple):
    """A rehearsal of `make run`: a plant, a hand, and the gap speed of the controller (None: the configured one)."""

    label: str
    plant: str = "sample_1"
    hand: str = "steady"
    gap_speed_mm_s: float | None = None


Rehearsals = dict[Case, Followed]


def rehearse(config: Config, case: Case, times_s: Array, forces_N: Array, boot: FirmwareKind = Firmware) -> Followed:
    if case.gap_speed_mm_s is not None:
        both = {"gap_speed_mm_s": case.gap_speed_mm_s, "closing_mm_s": case.gap_speed_mm_s}
        config = msgspec.structs.replace(config, position=msgspec.structs.replace(config.position, **both))
    # what is played is not the scene's own signal, which the daemon refuses if the gap is too slow for it
    scene = msgspec.structs.replace(load_scene(config.scene), signal=None)
    loop = armed(build_core(config, scene), device_of(case.plant), parse_hand(case.hand), boot=boot)
    found = played(loop, times_s, forces_N, wait_s=LEAD_IN_S)
    return found._replace(asked_N=np.interp(found.time_s, times_s, forces_N))
