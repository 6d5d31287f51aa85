"""The records between the stages, in the order in which they flow. Every record is immutable.

Forces are in N against the motion of the handle, gaps and positions in mm, and opening is positive.
"""

import math
from typing import Final, final

from firmware_protocol.codec import DriveMode
from firmware_protocol.value import Value
from tormagd.control.believe.strength import DeviceFit
from tormagd.control.safety.codes import Limit
from tormagd.element.model.displacement import MOVING_MM_S, Turn
from tormagd.element.model.features import LARGEST, require_number
from tormagd.element.physics.errors import DomainError
from tormagd.hardware.measurement import DeviceRequest

# compiled, a constant of this module is a plain float
_LARGEST: Final[float] = LARGEST
_LEAST_STEP_S: Final[float] = 1e-4
"Of a preview: no loop runs faster, and a closer one has a slope without measure."


@final
class Wall(Value):
    """An elastic wall on the handle's way. A handle that pushes on in front of it feels `friction_N`.
    `stiffness_share` is the stiffness's standard deviation as a share of it.
    """

    def __init__(
        self,
        place_mm: float,
        stiffness_N_mm: float,
        friction_N: float = 0.0,
        place_sd_mm: float = 0.0,
        stiffness_share: float = 0.0,
    ) -> None:
        self.place_mm: Final = place_mm
        self.stiffness_N_mm: Final = stiffness_N_mm
        self.friction_N: Final = friction_N
        self.place_sd_mm: Final = place_sd_mm
        self.stiffness_share: Final = stiffness_share

    def force_N(self, handle_mm: float) -> float:
        return self.friction_N + self.stiffness_N_mm * max(handle_mm - self.place_mm, 0.0)

    def most_N(self, handle_mm: float) -> float:
        """Return the force of a wall that is nearer and stiffer by a standard deviation."""
        stiffness_N_mm = self.stiffness_N_mm * (1.0 + self.stiffness_share)
        return self.friction_N + stiffness_N_mm * max(handle_mm - self.place_mm + self.place_sd_mm, 0.0)


@final
class TimedSetpoint(Value):
    """A publisher's newest valid setpoint, stamped on the clock of `now_s`; `playout_s` delays it against jitter. A
    handle that draws back gets `withdraw_N`, or else the wall's friction or `force_N`.
    """

    def __init__(
        self,
        force_N: float,
        stamp_s: float,
        valid_for_s: float,
        displacement_mm: float | None = None,
        rate_mm_s: float | None = None,
        preview_N: tuple[float, ...] = (),
        preview_dt_s: float = 0.0,
        holder: int = 0,
        limits: tuple[Limit, ...] = (),
        withdraw_N: float | None = None,
        wall: Wall | None = None,
    ) -> None:
        self.force_N: Final = force_N
        self.stamp_s: Final = stamp_s
        self.valid_for_s: Final = valid_for_s
        self.displacement_mm: Final = displacement_mm
        self.rate_mm_s: Final = rate_mm_s
        self.preview_N: Final = preview_N
        self.preview_dt_s: Final = preview_dt_s
        self.holder: Final = holder
        self.limits: Final = limits
        self.withdraw_N: Final = withdraw_N
        self.wall: Final = wall

    def asked_N(self, travel: "Travel") -> float:
        if not travel.is_pushing and self.withdraw_N is not None:
            return self.withdraw_N
        if self.wall is None:
            return self.force_N
        return self.wall.force_N(travel.place_mm) if travel.is_pushing else self.wall.friction_N

    def lets_go(self, travel: "Travel") -> bool:
        """Tell whether a hand that draws back has a force of its own."""
        return not travel.is_pushing and (self.wall is not None or self.withdraw_N is not None)

    def require_numbers(self) -> None:
        """Raise DomainError, naming the field, unless all numbers are finite and within LARGEST."""
        wall, preview_N = self.wall, self.preview_N
        # one sum finds NaN and infinity anywhere
        size = abs(self.force_N) + abs(self.stamp_s) + abs(self.valid_for_s)
        size += abs(self.displacement_mm or 0.0) + abs(self.rate_mm_s or 0.0) + abs(self.withdraw_N or 0.0)
        if wall is not None:
            size += abs(wall.place_mm) + abs(wall.stiffness_N_mm) + abs(wall.friction_N)
            size += abs(wall.place_sd_mm) + abs(wall.stiffness_share)
        if preview_N:
            size += sum(map(abs, preview_N))
            if not _LEAST_STEP_S <= self.preview_dt_s <= _LARGEST:
                raise DomainError("preview_dt_s", self.preview_dt_s, f"at least {_LEAST_STEP_S:g} s")
        if not size <= _LARGEST:
            self._name_odd()

    def _name_odd(self) -> None:
        fields = [(name, getattr(of, name)) for of in (self, self.wall) if of is not None for name in of.__match_args__]
        for name, field in [*fields, *[("preview_N", force_N) for force_N in self.preview_N]]:
            if isinstance(field, (int, float)):
                require_number(name, field)

    @property
    def is_told(self) -> bool:
        """Whether the publisher says what comes."""
        return self.wall is not None or self.preview_N != ()

    @property
    def preview_s(self) -> float:
        return self.preview_dt_s * len(self.preview_N)


@final
class Travel(Value):
    """The handle's place and rate, positive when it pushes on. A handle that is pulled back withdraws even while it is
    held.
    """

    def __init__(self, place_mm: float, rate_mm_s: float, is_pushing: bool = True) -> None:
        self.place_mm: Final = place_mm
        self.rate_mm_s: Final = rate_mm_s
        self.is_pushing: Final = is_pushing


AT_REST: Final = Travel(0.0, 0.0)


@final
class Handle(Value):
    """The motion of a handle since its last turn, or of a finger in the pad. Friction has the level of `sliding_mm_s`,
    a mean over travel; `quick_mm_s` shows a stop sooner.
    """

    def __init__(
        self,
        displacement_mm: float,
        rate_mm_s: float,
        turn: Turn,
        sliding_mm_s: float = MOVING_MM_S,
        quick_mm_s: float | None = None,
    ) -> None:
        self.displacement_mm: Final = displacement_mm
        self.rate_mm_s: Final = rate_mm_s
        self.turn: Final = turn
        self.sliding_mm_s: Final = sliding_mm_s
        self.quick_mm_s: Final = rate_mm_s if quick_mm_s is None else quick_mm_s


@final
class Measured(Value):
    """What is measured of the carriages and the handle; places mean nothing unless `is_homed`. `sensed_s` is on the
    host's clock, `handle_time_s` on the device's.
    """

    def __init__(
        self,
        number: int,
        is_homed: bool,
        device_time_s: float,
        left_mm: float,
        right_mm: float,
        left_mm_s: float,
        right_mm_s: float,
        force_N: float,
        handle: Handle,
        handle_mm: float,
        sensed_s: float,
        handle_time_s: float,
    ) -> None:
        self.number: Final = number
        self.is_homed: Final = is_homed
        self.device_time_s: Final = device_time_s
        self.left_mm: Final = left_mm
        self.right_mm: Final = right_mm
        self.left_mm_s: Final = left_mm_s
        self.right_mm_s: Final = right_mm_s
        self.force_N: Final = force_N
        self.handle: Final = handle
        self.handle_mm: Final = handle_mm
        self.sensed_s: Final = sensed_s
        self.handle_time_s: Final = handle_time_s

    @property
    def gap_mm(self) -> float:
        return self.left_mm + self.right_mm

    @property
    def gap_speed_mm_s(self) -> float:
        return self.left_mm_s + self.right_mm_s

    @property
    def skew_mm(self) -> float:
        return self.left_mm - self.right_mm

    def along(self, push_sign: float) -> tuple[float, float]:
        return push_sign * self.handle_mm, push_sign * self.handle.turn.direction * self.handle.quick_mm_s


@final
class GapSpeeds(Value):
    """The gap's greatest speeds, the closing that is counted on, and that of motors without load."""

    def __init__(
        self, closing_mm_s: float, opening_mm_s: float, sure_mm_s: float, no_load_mm_s: float = math.inf
    ) -> None:
        self.closing_mm_s: Final = closing_mm_s
        self.opening_mm_s: Final = opening_mm_s
        self.sure_mm_s: Final = sure_mm_s
        self.no_load_mm_s: Final = no_load_mm_s

    def reach_mm(self, passed_s: float) -> tuple[float, float]:
        """Return how far the gap closes and opens."""
        return self.closing_mm_s * passed_s, self.opening_mm_s * passed_s


@final
class Belief(Value):
    """What is believed of the device at a plan: at the handle's rate (`device`), at speed, and, until it is known from
    today, as any device may be (`unseen`).
    """

    def __init__(
        self,
        device: DeviceFit,
        at_speed: DeviceFit,
        unseen: DeviceFit | None,
        lag_s: float,
        predicted_N: float | None,
        limits: tuple[Limit, ...],
        sensor_doubted_s: float,
        anchor_N: float = math.inf,
    ) -> None:
        self.device: Final = device
        self.at_speed: Final = at_speed
        self.unseen: Final = unseen
        self.lag_s: Final = lag_s
        self.predicted_N: Final = predicted_N
        self.limits: Final = limits
        self.sensor_doubted_s: Final = sensor_doubted_s
        self.anchor_N: Final = anchor_N


@final
class Ask(Value):
    """The force to render now and along `path.PATH_S`. `foresight` is 1 with a preview, 0 where the force is
    extrapolated; `asked_N` is None where no setpoint is followed.
    """

    def __init__(
        self,
        force_N: float,
        path_N: list[float],
        age_s: float | None,
        limits: tuple[Limit, ...],
        foresight: float = 0.0,
        asked_N: float | None = None,
    ) -> None:
        self.force_N: Final = force_N
        self.path_N: Final = path_N
        self.age_s: Final = age_s
        self.limits: Final = limits
        self.foresight: Final = foresight
        self.asked_N: Final = asked_N


@final
class Outside(Value):
    """A quantity outside what the model knows."""

    def __init__(self, quantity: str, asked: float, used: float) -> None:
        self.quantity: Final = quantity
        self.asked: Final = asked
        self.used: Final = used


@final
class Plan(Value):
    """Where the gap should go, and why."""

    def __init__(
        self,
        number: int,
        time_s: float,
        setpoint_N: float | None,
        setpoint_age_s: float | None,
        governed_N: float,
        predicted_N: float | None,
        field_mT: float,
        gap_mm: float,
        gap_speed_mm_s: float,
        confidence: float,
        limits: tuple[Limit, ...],
        gap_acceleration_mm_s2: float = 0.0,
        foresight: float = 0.0,
        min_gap_mm: float = 0.0,
        outside: tuple[Outside, ...] = (),
        sensor_doubted_s: float = 0.0,
        trim: float = 1.0,
        stamp_s: float = -math.inf,
        search_age_s: float = 0.0,
    ) -> None:
        self.number: Final = number
        self.time_s: Final = time_s
        self.setpoint_N: Final = setpoint_N
        self.setpoint_age_s: Final = setpoint_age_s
        self.governed_N: Final = governed_N
        self.predicted_N: Final = predicted_N
        self.field_mT: Final = field_mT
        self.gap_mm: Final = gap_mm
        self.gap_speed_mm_s: Final = gap_speed_mm_s
        self.confidence: Final = confidence
        self.limits: Final = limits
        self.gap_acceleration_mm_s2: Final = gap_acceleration_mm_s2
        self.foresight: Final = foresight
        self.min_gap_mm: Final = min_gap_mm
        self.outside: Final = outside
        self.sensor_doubted_s: Final = sensor_doubted_s
        self.trim: Final = trim
        self.stamp_s: Final = stamp_s
        self.search_age_s: Final = search_age_s


@final
class Duty(Value):
    """What goes to the device in one tick."""

    def __init__(
        self,
        mode: DriveMode,
        left_duty: float,
        right_duty: float,
        request: DeviceRequest,
        request_number: int,
        limits: tuple[Limit, ...],
    ) -> None:
        self.mode: Final = mode
        self.left_duty: Final = left_duty
        self.right_duty: Final = right_duty
        self.request: Final = request
        self.request_number: Final = request_number
        self.limits: Final = limits
