"""The firmware's own motions: opening at a bounded speed, and homing. Positive is opening.

Both move each carriage along a position ramp and let the drive duty follow it. The ramp's speed is the feed-forward,
the distance to the ramp the integral part. The duty is bounded too; through the motor's back-EMF that bounds the speed
of a carriage whose encoder is dead.
"""

from enum import Enum, auto
from typing import Final, final

from firmware_protocol.value import Value

RAMP_GAIN_PER_MM: Final = 1.0  # the motor follows a duty with 15 ms: crossover at 20 rad/s leaves 70 degrees
RAMP_LEAD_MM: Final = 1.0  # the ramp waits for a carriage that cannot follow
DUTY_LIMIT: Final = 0.85
NO_LOAD_REV_S: Final = 2.5  # 150 rpm at full duty, for the feed-forward
TAPER_PER_S: Final = 8.0  # speed over distance to the open end
CREEP_MM_S: Final = 1.0  # final approach to the switches
BACK_OFF_MM: Final = 1.0
BACK_OFF_LIMIT_S: Final = 0.4  # three times what it takes; without an encoder it must not go on towards closed
SETTLE_S: Final = 0.05  # braked at the switch before the drives go off: three motor time constants
PROGRESS_MM: Final = 0.05
PATIENCE_S: Final = 0.3
DEAD_CURRENT_A: Final = 0.02  # a connected motor draws ten times this at the duty that stands for no progress
WRONG_WAY_MM: Final = 1.0  # back, while homing drives the carriage open: its motor or its encoder is reversed
TIME_LIMIT_S: Final = 8.0  # the whole stroke at homing speed takes under 4 s
SEARCH_SHARE: Final = 0.5  # of the speed of opening: about that of homing, from which it brakes at a switch
STROKE_MM: Final = 25.5  # of a carriage, between its stops
MIN_SHARE: Final = 0.6  # of the speed of opening: what the weakest motors reach on the lowest supply
LATE_S: Final = 0.5  # to turn round, to taper, to settle at the switch


@final
class Carriage(Value):
    def __init__(self, position_mm: float, at_open_end: bool, current_A: float) -> None:
        self.position_mm: Final = position_mm
        self.at_open_end: Final = at_open_end
        self.current_A: Final = current_A


class Outcome(Enum):
    MOVING = auto()
    DONE = auto()
    FAILED = auto()
    REVERSED = auto()


@final
class Ramp:
    """A position ramp that leads one carriage, and the duty that follows it."""

    def __init__(self, position_mm: float, lead_mm_rev: float) -> None:
        self._reference_mm = position_mm
        self._full_speed_mm_s = NO_LOAD_REV_S * lead_mm_rev

    def duty(self, position_mm: float, speed_mm_s: float, dt_s: float) -> float:
        reference_mm = self._reference_mm + speed_mm_s * dt_s
        self._reference_mm = min(max(reference_mm, position_mm - RAMP_LEAD_MM), position_mm + RAMP_LEAD_MM)
        duty = speed_mm_s / self._full_speed_mm_s + RAMP_GAIN_PER_MM * (self._reference_mm - position_mm)
        return min(max(duty, -DUTY_LIMIT), DUTY_LIMIT)


@final
class CarriageOpening:
    """Brings one carriage to its open switch and brakes it there."""

    def __init__(self, time_s: float, carriage: Carriage, lead_mm_rev: float, stall_A: float) -> None:
        self._ramp = Ramp(carriage.position_mm, lead_mm_rev)
        self._stall_A = stall_A
        self._progress_mm = carriage.position_mm
        self._progress_s = time_s
        self._arrived_s: float | None = None
        self.duty = 0.0
        self.outcome = Outcome.MOVING

    def step(self, time_s: float, dt_s: float, carriage: Carriage, speed_mm_s: float) -> None:
        if self.outcome is Outcome.FAILED:
            return
        if carriage.at_open_end:
            self.duty = 0.0
            if self._arrived_s is None:
                self._arrived_s = time_s
            self.outcome = Outcome.DONE if time_s - self._arrived_s >= SETTLE_S else Outcome.MOVING
            return
        self._arrived_s = None
        self.outcome = Outcome.MOVING
        self.duty = self._ramp.duty(carriage.position_mm, speed_mm_s, dt_s)
        if carriage.position_mm > self._progress_mm + PROGRESS_MM:
            self._progress_mm, self._progress_s = carriage.position_mm, time_s
        elif time_s - self._progress_s > PATIENCE_S and not DEAD_CURRENT_A < abs(carriage.current_A) < self._stall_A:
            self.duty = 0.0
            self.outcome = Outcome.FAILED

    def went_back(self, carriage: Carriage) -> bool:
        """Tell whether the carriage moved towards closed while it was driven open."""
        return carriage.position_mm < self._progress_mm - WRONG_WAY_MM


@final
class Retraction:
    """Brings both carriages to their open switches, each as far as it comes."""

    def __init__(
        self,
        time_s: float,
        carriages: tuple[Carriage, Carriage],
        *,
        lead_mm_rev: float,
        stall_A: float,
        speed_mm_s: float,
        tapered: bool,
    ) -> None:
        self._deadline_s = time_s + TIME_LIMIT_S
        self._late_s = time_s + STROKE_MM / (MIN_SHARE * speed_mm_s) + LATE_S
        self._speed_mm_s = speed_mm_s
        self._tapered = tapered
        self._openings = [CarriageOpening(time_s, carriage, lead_mm_rev, stall_A) for carriage in carriages]

    @property
    def duties(self) -> tuple[float, float]:
        left, right = self._openings
        return left.duty, right.duty

    @property
    def blocked(self) -> bool:
        return Outcome.FAILED in [opening.outcome for opening in self._openings]

    def is_late(self, time_s: float) -> bool:
        """Tell whether the motion takes longer than the whole stroke takes a device that can open."""
        return time_s > self._late_s

    def is_reversed(self, carriages: tuple[Carriage, Carriage]) -> bool:
        return True in [opening.went_back(each) for opening, each in zip(self._openings, carriages, strict=True)]

    def step(self, time_s: float, dt_s: float, carriages: tuple[Carriage, Carriage]) -> Outcome:
        for opening, carriage in zip(self._openings, carriages, strict=True):
            opening.step(time_s, dt_s, carriage, self._bounded_mm_s(carriage))
        outcomes = [opening.outcome for opening in self._openings]
        if time_s < self._deadline_s and Outcome.MOVING in outcomes:
            return Outcome.MOVING
        return Outcome.DONE if outcomes == [Outcome.DONE, Outcome.DONE] else Outcome.FAILED

    def _bounded_mm_s(self, carriage: Carriage) -> float:
        if not self._tapered:
            return self._speed_mm_s
        # beyond where its switch should have been the zero is wrong: it searches there
        most_mm_s = self._speed_mm_s if carriage.position_mm < 0.0 else SEARCH_SHARE * self._speed_mm_s
        return min(most_mm_s, CREEP_MM_S + TAPER_PER_S * abs(carriage.position_mm))


@final
class HomingMotion:
    """Finds both open switches twice: at speed, then creeping after a back-off, so that the zero repeats."""

    def __init__(
        self,
        time_s: float,
        carriages: tuple[Carriage, Carriage],
        *,
        lead_mm_rev: float,
        stall_A: float,
        speed_mm_s: float,
    ) -> None:
        self._deadline_s = time_s + TIME_LIMIT_S
        self._lead_mm_rev = lead_mm_rev
        self._stall_A = stall_A
        self._speed_mm_s = speed_mm_s
        self._backed_off = False
        self._reversed_s: float | None = None
        self._edges_mm: list[float | None] = [None, None]
        self.duties = (0.0, 0.0)
        self._search: Retraction | None = self._outward(time_s, carriages, speed_mm_s)

    @property
    def zeros_mm(self) -> tuple[float, float]:
        """Where the open switches closed; 0 for one that was not found."""
        left_mm, right_mm = self._edges_mm
        return left_mm or 0.0, right_mm or 0.0

    def step(self, time_s: float, dt_s: float, carriages: tuple[Carriage, Carriage]) -> Outcome:
        if time_s >= self._deadline_s:
            return Outcome.FAILED
        if self._search is None:
            return self._back_off(time_s, dt_s, carriages)
        if self._reversed_s is None and self._search.is_reversed(carriages):
            self._reversed_s = time_s
        if self._reversed_s is not None:
            self.duties = (0.0, 0.0)
            return Outcome.REVERSED if time_s - self._reversed_s >= SETTLE_S else Outcome.MOVING
        if self._backed_off:
            for side, carriage in enumerate(carriages):
                if carriage.at_open_end and self._edges_mm[side] is None:
                    self._edges_mm[side] = carriage.position_mm
        outcome = self._search.step(time_s, dt_s, carriages)
        self.duties = self._search.duties
        if outcome is not Outcome.DONE or self._backed_off:
            return outcome
        self._search = None
        self._begin_back_off(time_s, carriages)
        return Outcome.MOVING

    def _begin_back_off(self, time_s: float, carriages: tuple[Carriage, Carriage]) -> None:
        self._back_off_since_s = time_s
        self._starts_mm = [carriage.position_mm for carriage in carriages]
        self._ramps = [Ramp(carriage.position_mm, self._lead_mm_rev) for carriage in carriages]

    def _back_off(self, time_s: float, dt_s: float, carriages: tuple[Carriage, Carriage]) -> Outcome:
        """Drive both carriages off their open switches for one tick."""
        if time_s - self._back_off_since_s > BACK_OFF_LIMIT_S:
            return Outcome.FAILED
        sides = zip(carriages, self._ramps, self._starts_mm, strict=True)
        left_duty, right_duty = [self._inward_duty(carriage, ramp, mm, dt_s) for carriage, ramp, mm in sides]
        self.duties = left_duty, right_duty
        if left_duty == 0.0 and right_duty == 0.0:
            self._backed_off = True
            self._search = self._outward(time_s, carriages, CREEP_MM_S)
        return Outcome.MOVING

    def _inward_duty(self, carriage: Carriage, ramp: Ramp, start_mm: float, dt_s: float) -> float:
        clear = carriage.position_mm <= start_mm - BACK_OFF_MM and not carriage.at_open_end
        return 0.0 if clear else ramp.duty(carriage.position_mm, -self._speed_mm_s, dt_s)

    def _outward(self, time_s: float, carriages: tuple[Carriage, Carriage], speed_mm_s: float) -> Retraction:
        return Retraction(
            time_s,
            carriages,
            lead_mm_rev=self._lead_mm_rev,
            stall_A=self._stall_A,
            speed_mm_s=speed_mm_s,
            tapered=False,
        )
