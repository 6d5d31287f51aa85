"""Who is wrong, the sensor or what is believed of the device? Lies of the sensor, friction that changes, and honest
sensors, drawn for each device by its name: how far the true force is over or under what was asked.

A force has arrived ARRIVES_S after a step, and counts while the handle has slid one way for SLID_S.
"""

import math
import random
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rendering.device_draws import device
from rendering.following import VALID_S, Levels, armed_at_rest, asked_at
from rendering.hands import Legs
from tormagd.closed_loop import ClosedLoop
from tormagd.control.records import TimedSetpoint
from tormagd.lab.arrays import Array, Json
from tormagd.safety.codes import Limit
from tormagd.simulation.element import Element

Flags = npt.NDArray[np.bool_]
Lie = Callable[[float, float], float]
"From the time since it began, s, and the true reading, N, to the shown one."

LIES = ("freeze", "dropout", "tenfold", "inverted", "offset", "low-pass", "drift")
LIES_EACH, RUN_S, BEGINS_S = 6, 30.0, 14.0
LASTS_S = (0.02, 0.05, 0.08, 0.2, 0.5, 1.5, 5.0, math.inf)
NOISES_N, STEPS_N, RATES_HZ = (0.0, 0.002, 0.005, 0.01), (0.001, 0.005, 0.01, 0.02), (1000, 500, 200, 100, 50)
FRICTION = (0.8, 1.2)
CONFIRMED_S = 2.5
"After so long of a changed friction the operator says that the device has changed."
ARRIVES_S, SLID_S, FOLLOWED_S = 1.2, 0.3, 2.0
SLIDES_MM_S, OPEN_MM = 5.0, 94.0
OVER_N, UNDER_N = 0.15, 0.3
NAMED = {Limit.SENSOR, Limit.DEVICE_OR_SENSOR}


class LyingSensor:
    """A sensor with noise, steps and a rate of its own, which lies from `begins_s` to `ends_s` of the device's time."""

    begins_s = ends_s = math.inf

    def __init__(self, noise: random.Random, noise_N: float, step_N: float, rate_Hz: float, lie: Lie) -> None:
        self._noise, self._noise_N, self._step_N = noise, noise_N, step_N
        self._period_s, self._due_s, self._lie = 1.0 / rate_Hz, 0.0, lie
        self.reading_N = 0.0

    def advance(self, time_s: float, force_N: float) -> None:
        """See `simulation.plant.ForceSensor`."""
        if time_s < self._due_s - 5e-4:
            return
        self._due_s += self._period_s
        shown_N = round((force_N + self._noise.gauss(0.0, self._noise_N)) / self._step_N) * self._step_N
        if self.begins_s <= time_s < self.ends_s:
            shown_N = self._lie(time_s - self.begins_s, shown_N)
        self.reading_N = min(max(shown_N, -20.0), 20.0)


def lie_of(kind: str, draw: random.Random) -> Lie:
    """One of LIES, of a size that is drawn."""
    size, way = draw.random(), draw.choice((-1.0, 1.0))
    first: list[float] = []

    def freeze(since_s: float, true_N: float) -> float:
        first[:] = first or [true_N]
        return first[0]

    def low_pass(since_s: float, true_N: float) -> float:
        first[:] = [first[0] + (true_N - first[0]) * 1e-3 / (0.2 + 3.0 * size)] if first else [true_N]
        return first[0]

    kinds: dict[str, Lie] = {
        "freeze": freeze,
        "dropout": lambda since_s, true_N: 0.0,
        "tenfold": lambda since_s, true_N: 10.0 * true_N,
        "inverted": lambda since_s, true_N: -true_N,
        "offset": lambda since_s, true_N: true_N + way * (0.1 + 0.9 * size),
        "low-pass": low_pass,
        "drift": lambda since_s, true_N: true_N + way * 0.5 * 10.0 ** (-2.0 * size) * since_s,
    }
    return kinds[kind]


def legs_of(draw: random.Random) -> Legs:
    """A handle that goes one way, turns, or stops and goes, at speeds that are drawn."""
    way, is_turning, is_stopping = draw.choice(((1.0, False, False), (1.0, True, False), (-1.0, False, True)))
    legs, time_s = [(1.0, 0.0)], 0.0
    while time_s < RUN_S:
        lasts_s = draw.uniform(2.0, 8.0) if is_turning or is_stopping else RUN_S
        legs.append((lasts_s, way * math.exp(draw.uniform(math.log(8.0), math.log(80.0)))))
        if is_stopping:
            legs.append((draw.uniform(0.3, 2.0), 0.0))
        way, time_s = -way if is_turning else way, time_s + lasts_s
    return legs


class Run(NamedTuple):
    """A row for each tick: time, s, force over what was asked, N, whether it counts, for how long the setpoint has been
    the same, s, and whether the readings were named; and whether a fault ended it."""

    time_s: Array
    over_N: Array
    counts: Flags
    same_s: Array
    is_named: Flags
    is_faulty: bool

    def over(self, since_s: float, but_s: float = 0.0) -> float:
        """The most over what was asked, of what counts from then on."""
        return float(np.where(self.counts & (self.time_s >= since_s + but_s), self.over_N, 0.0).max())

    def off(self, since_s: float) -> float:
        """The most over or under."""
        return float(np.abs(np.where(self.counts & (self.time_s >= since_s), self.over_N, 0.0)).max())

    def longest_s(self, is_so: Flags) -> float:
        """For how long it is so at most, without a break."""
        edges = np.flatnonzero(np.diff(np.concatenate(([0], is_so.astype(int), [0]))))
        return 1e-3 * float((edges[1::2] - edges[::2]).max(initial=0))


def run(name: str, draw: random.Random, lie: Lie | None = None, friction: float = 1.0) -> Run:
    """One device and sensor, drawn: with a lie, or with so many times the friction, from BEGINS_S on."""
    levels: Levels = [(draw.uniform(4.0, 12.0), draw.uniform(0.6, 2.0)) for _ in range(8)]
    loop, asked_N = armed_at_rest(device(name), legs_of(draw)), asked_at(levels)
    sensor = LyingSensor(
        random.Random(draw.random()),
        draw.choice(NOISES_N),
        draw.choice(STEPS_N),
        draw.choice(RATES_HZ),
        lie or (lambda since_s, true_N: true_N),
    )
    plant, began_s = loop.simulated.plant, loop.now_s
    plant.force_sensor = sensor
    sensor.begins_s = plant.time_s + BEGINS_S
    sensor.ends_s = sensor.begins_s + (draw.choice(LASTS_S) if lie is not None else math.inf)
    rows = list(_rows(loop, began_s, asked_N, friction))
    time_s, over_N, slid_s, same_s, is_named = np.array(rows).T
    counts = (slid_s > SLID_S) & (same_s > ARRIVES_S)
    return Run(time_s, over_N, counts, same_s, is_named > 0.0, bool(loop.stepper.safety.faults))


def _rows(
    loop: ClosedLoop, began_s: float, asked_N: Callable[[float], float], friction: float
) -> Iterator[tuple[float, ...]]:
    slid_s, changed_s, before_N, way = 0.0, 0.0, 0.0, 0.0
    is_changed = is_confirmed = friction == 1.0
    for sample in loop.run(RUN_S, lambda now_s: TimedSetpoint(asked_N(now_s - began_s), now_s, VALID_S)):
        since_s, truth = sample.time_s - began_s, sample.truth
        wanted_N = asked_N(since_s)
        changed_s, before_N = (changed_s if wanted_N == before_N else since_s), wanted_N
        goes_on = abs(truth.handle_mm_s) > SLIDES_MM_S and truth.handle_mm_s * way >= 0.0
        slid_s, way = slid_s + 1e-3 if goes_on else 0.0, truth.handle_mm_s
        if not is_changed and since_s >= BEGINS_S:
            is_changed, element = True, loop.simulated.plant.element
            assert isinstance(element, Element)
            element._force._values[:] = [friction * force_N for force_N in element._force._values]
        if not is_confirmed and since_s >= BEGINS_S + CONFIRMED_S and loop.planner is not None:
            is_confirmed = True
            loop.planner.confirm("device")
        along_N = math.copysign(1.0, truth.handle_mm_s) * truth.force_N
        over_N = 0.0 if truth.gap_mm > OPEN_MM and along_N > wanted_N else along_N - wanted_N
        yield since_s, over_N, slid_s, since_s - changed_s, float(bool(NAMED & set(sample.plan.limits)))
        if sample.safety.faults:
            return


def doubts(name: str) -> Json:
    """Of one device: LIES_EACH lies, an honest sensor, and, where it has that element, friction less and more by a
    fifth. Over and under are in N; a lie is named from BEGINS_S on, an honest sensor never."""
    draw = random.Random(name)
    lying = [run(name, draw, lie_of(draw.choice(LIES), draw)) for _ in range(LIES_EACH)]
    honest = run(name, draw)
    found: Json = {
        "lies: over": max(each.over(BEGINS_S) for each in lying),
        "lies: s over by 0.15 N": max(each.longest_s(each.counts & (each.over_N > OVER_N)) for each in lying),
        "lies: s under by 0.3 N and not named": max(
            each.longest_s(each.counts & (each.over_N < -UNDER_N) & ~each.is_named) for each in lying
        ),
        "honest: named": float(honest.is_named.any()),
        "honest: off after 2 s": _followed(honest),
        "honest: faults": float(honest.is_faulty),
    }
    if device(name).second is None:
        less, more = (run(name, draw, friction=friction) for friction in FRICTION)
        found |= {
            "friction less: over": less.over(BEGINS_S),
            "friction less: off after it is confirmed": less.off(BEGINS_S + CONFIRMED_S + FOLLOWED_S),
            "friction more: over after 0.1 s": more.over(BEGINS_S, 0.1),
            "friction more: off after 2 s": more.off(BEGINS_S + FOLLOWED_S),
            "friction: faults": float(less.is_faulty or more.is_faulty),
        }
    return found


def _followed(honest: Run) -> float:
    is_late = honest.counts & (honest.same_s > FOLLOWED_S)
    return float(np.abs(np.where(is_late, honest.over_N, 0.0)).max())
