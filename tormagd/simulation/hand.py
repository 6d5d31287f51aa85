"""The hand at the device: where the roller's surface is at a time, or how deep a finger is in the pad."""

import bisect
import math
from collections.abc import Callable
from pathlib import Path
from typing import Final, Protocol, final

from firmware_protocol.value import Value
from tormagd.ground.force_file import read_motion

ROLLER_RADIUS_MM: Final = 20.0
DEFAULT_RPM: Final = 20.0
DEFAULT_PERIOD_S: Final = 4.0
REVERSING_TRAVEL_MM: Final = 30.0
DEFAULT_DEPTH_MM: Final = 2.0
PRESSES_AT_S: Final = 10.0
PRESSING_MM_S: Final = 1.0
EXACT_N: Final = 1e-9
ROUNDS: Final = 100
"How exactly, and in how many rounds at most, a felt step is solved."
KNOWN = (
    "steady[=RPM], reversing[=PERIOD_S], pressing[=DEPTH_MM], felt[=KEY=VALUE,...], "
    "or a FILE.csv with the columns t_s,position_mm"
)


class HandError(ValueError):
    """A hand specification that cannot be used."""


class Hand(Protocol):
    """Prescribed motion of the roller's surface, or of a finger into a pad."""

    def position_mm(self, time_s: float) -> float:
        """Return the travel of the roller's surface, or the finger's depth."""


@final
class SteadyHand(Value):
    """A hand that turns at a constant speed, by default the thesis's 20 rpm."""

    def __init__(self, rpm: float = DEFAULT_RPM) -> None:
        self.rpm: Final = rpm

    def position_mm(self, time_s: float) -> float:
        return time_s * self.rpm / 60.0 * math.tau * ROLLER_RADIUS_MM


@final
class ReversingHand(Value):
    """A hand that goes forth, rests, goes back and rests, in smooth strokes."""

    def __init__(self, period_s: float = DEFAULT_PERIOD_S) -> None:
        self.period_s: Final = period_s

    def position_mm(self, time_s: float) -> float:
        phase = math.fmod(time_s, self.period_s) / self.period_s
        half, back = (phase, False) if phase < 0.5 else (phase - 0.5, True)
        share = min(half / 0.35, 1.0)
        stroke = REVERSING_TRAVEL_MM * share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
        return REVERSING_TRAVEL_MM - stroke if back else stroke


@final
class RecordedHand(Value):
    """Recorded motion, linear between its points, standing before and after them."""

    def __init__(self, times_s: tuple[float, ...], positions_mm: tuple[float, ...]) -> None:
        self.times_s: Final = times_s
        self.positions_mm: Final = positions_mm

    def position_mm(self, time_s: float) -> float:
        after = bisect.bisect_right(self.times_s, time_s)
        if after == 0:
            return self.positions_mm[0]
        if after == len(self.times_s):
            return self.positions_mm[-1]
        start_s, end_s = self.times_s[after - 1], self.times_s[after]
        start_mm, end_mm = self.positions_mm[after - 1], self.positions_mm[after]
        return start_mm + (end_mm - start_mm) * (time_s - start_s) / (end_s - start_s)


@final
class StrokingHand(Value):
    """A hand that rests until the device is homed, then pushes, rests, withdraws, rests, and so on."""

    def __init__(self, push_mm_s: float, reach_mm: float, rest_s: float) -> None:
        self.push_mm_s: Final = push_mm_s
        self.reach_mm: Final = reach_mm
        self.rest_s: Final = rest_s

    def position_mm(self, time_s: float) -> float:
        half_s = self.reach_mm / self.push_mm_s + self.rest_s
        phase_s = math.fmod(max(time_s - PRESSES_AT_S, 0.0), 2.0 * half_s)
        pushed_mm, withdrawn_mm = self.push_mm_s * phase_s, max(self.push_mm_s * (phase_s - half_s), 0.0)
        return max(min(pushed_mm, self.reach_mm) - withdrawn_mm, 0.0)


def pressing(depth_mm: float = DEFAULT_DEPTH_MM) -> StrokingHand:
    """Return the finger of the thesis's pulse experiment, which presses into the pad at 1 mm/s and stays there."""
    return StrokingHand(PRESSING_MM_S, depth_mm, math.inf)


@final
class Impedance(Value):
    """The mass that moves with the handle, and the hand's spring and damper behind it."""

    def __init__(self, mass_kg: float, stiffness_N_mm: float, damping_N_s_mm: float) -> None:
        self.mass_kg: Final = mass_kg
        self.stiffness_N_mm: Final = stiffness_N_mm
        self.damping_N_s_mm: Final = damping_N_s_mm


@final
class FeltHand:
    """A hand that feels: spring and damper draw its mass towards an intended motion, while friction resists."""

    def __init__(self, intended: Hand, impedance: Impedance, lets_go_s: float = math.inf) -> None:
        self._intended = intended
        self._impedance = impedance
        self._lets_go_s = lets_go_s
        self._time_s = 0.0
        self._place_mm = intended.position_mm(0.0)
        self.speed_mm_s = 0.0
        self.force_N = 0.0
        "Mean force of spring and damper in the last step."

    def position_mm(self, time_s: float) -> float:
        """Return the intended place; `moved_mm` gives the real one."""
        return self._intended.position_mm(time_s)

    def moved_mm(self, time_s: float, resisting_N: Callable[[float], float]) -> float:
        """Advance the hand to `time_s`, and return its place then."""
        dt_s, speed_mm_s, impedance = time_s - self._time_s, self.speed_mm_s, self._impedance
        if dt_s <= 0.0:
            raise ValueError(f"time_s = {time_s}: allowed is after {self._time_s}, where the hand has been")
        from_mm, to_mm = self._intended.position_mm(self._time_s), self._intended.position_mm(time_s)
        held = 1.0 if time_s <= self._lets_go_s else 0.0
        stiffness_N_mm, damping_N_s_mm = held * impedance.stiffness_N_mm, held * impedance.damping_N_s_mm
        inertia_N_s_mm = 2e-3 * impedance.mass_kg / dt_s
        # what pushes at the speed v is start_N - hold_N_s_mm * v
        start_N = (
            stiffness_N_mm * (0.5 * (from_mm + to_mm) - self._place_mm) + damping_N_s_mm * (to_mm - from_mm) / dt_s
        )
        hold_N_s_mm = 0.5 * dt_s * stiffness_N_mm + damping_N_s_mm

        def over_N(mean_mm_s: float) -> float:
            pushing_N = start_N - hold_N_s_mm * mean_mm_s
            return inertia_N_s_mm * (mean_mm_s - speed_mm_s) + resisting_N(mean_mm_s) - pushing_N

        mean_mm_s = _root(over_N, speed_mm_s, inertia_N_s_mm + hold_N_s_mm)
        self.force_N = start_N - hold_N_s_mm * mean_mm_s
        self.speed_mm_s = 2.0 * mean_mm_s - speed_mm_s
        self._time_s, self._place_mm = time_s, self._place_mm + dt_s * mean_mm_s
        return self._place_mm


def _root(function: Callable[[float], float], start: float, slope: float) -> float:
    """Return a zero of a function that rises far out."""
    near, at_near = start, function(start)
    step = -at_near / slope
    far = near + step
    at_far = function(far)
    while at_near * at_far > 0.0:
        step *= 2.0
        near, at_near, far = far, at_far, far + step
        at_far = function(far)
    for _ in range(ROUNDS):
        if abs(at_far) <= EXACT_N:
            break
        middle = (near * at_far - far * at_near) / (at_far - at_near)
        at_middle = function(middle)
        if at_middle * at_far < 0.0:
            near, at_near = far, at_far
        else:
            at_near *= 0.5
        far, at_far = middle, at_middle
    return far


_SIZED: dict[str, tuple[Callable[..., Hand], float, float]] = {
    "steady": (SteadyHand, -300.0, 300.0),
    "reversing": (ReversingHand, 0.1, 1000.0),
    "pressing": (pressing, 0.1, 6.0),
}
"What makes it, and the least and greatest size."
_FELT: dict[str, tuple[float, float, float]] = {
    "mass_kg": (0.1, 0.001, 20.0),
    "stiffness_N_mm": (0.4, 0.0, 100.0),
    "damping_N_s_mm": (0.006, 0.0, 10.0),
    "push_mm_s": (20.0, 0.1, 300.0),
    "reach_mm": (20.0, 0.1, 1000.0),
    "rest_s": (1.0, 0.0, 1000.0),
}
"Default, least and greatest size."


def parse_hand(spec: str) -> Hand:
    """Return the hand that the command-line word `spec` stands for. Raises HandError or TableError."""
    name, _, value = spec.partition("=")
    if name in _SIZED:
        hand, low, high = _SIZED[name]
        return hand(_number(spec, value, low, high)) if value else hand()
    if name == "felt":
        return _felt(spec, value)
    if spec.endswith(".csv"):
        times_s, positions_mm = read_motion(Path(spec))
        return RecordedHand(tuple(times_s), tuple(positions_mm))
    raise HandError(f"hand {spec!r}: allowed are {KNOWN}")


def _felt(spec: str, text: str) -> FeltHand:
    sizes = {key: usual for key, (usual, _, _) in _FELT.items()}
    for word in filter(None, text.split(",")):
        key, _, value = word.partition("=")
        if key not in _FELT:
            raise HandError(f"hand {spec!r}: {key!r} is none of {', '.join(_FELT)}")
        _, low, high = _FELT[key]
        sizes[key] = _number(f"felt={word}", value, low, high)
    given = list(sizes.values())
    return FeltHand(StrokingHand(*given[3:]), Impedance(*given[:3]))


def _number(spec: str, text: str, low: float, high: float) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not low <= number <= high:
        raise HandError(f"hand {spec!r}: allowed are numbers from {low:g} to {high:g}")
    return number
