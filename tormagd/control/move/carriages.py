"""The carriages as the actuator: from a gap with its speed and acceleration to two duties.

target     where the plan leads by the time that a duty given now takes effect; never beyond a bound of the gap
reference  follows the target at the speed and acceleration of the motors
expected   the reference behind the windings' lag
duty       of each carriage: PID on expected minus measured, plus what speed, acceleration, friction and pull take
"""

import math
from typing import Final, final

from tormagd.config import Config
from tormagd.control.interpolation import low_pass
from tormagd.control.move.actuator import Actuator, Drive, Reference, target_of
from tormagd.control.move.motor import electrical_time_s, full_speed_mm_s, gap_speeds, mechanical_time_s, pull_V
from tormagd.control.move.pid import Pid
from tormagd.control.records import GapSpeeds, Measured, Plan
from tormagd.control.safety.codes import Limit
from tormagd.hardware.measurement import Measurement
from tormagd.scenes.scene import Scene

WEAK_MM: Final = 1.0
"Carriages that are further behind have weaker motors than believed."
EXCHANGE_S: Final = 0.0015
"A duty shows in the encoders' report after one period of exchange and half a period of holding."
COULOMB_SPEED_MM_S: Final = 0.5
"The friction feed-forward fades below this reference speed."
RESTING_MM_S: Final = 0.02
"A slower reference has arrived."
MAX_ACCELERATION_SCALE: Final = 2.0
"The liveliest motors of the plant card reach 2.4."
SCALE_PER_MM_S: Final = 100.0
"Growth per second and mm that carriages are ahead while acceleration limits them."
LAGGING_MM: Final = 0.1
"The speed limit is reported as RATE where the reference is this far behind its target."
APPROACH_S: Final = 0.01
"With less the reference would chase every quantum of its target."
MIN_BRAKING: Final = 0.2
"Share of the acceleration that is left to brake with, however hard the target turns."


def follow(
    acceleration_mm_s2: float,
    reference: Reference,
    target: Reference,
    dt_s: float,
    speeds: GapSpeeds,
    floor_mm: float = -math.inf,
) -> tuple[Reference, bool, bool]:
    """Return the reference `dt_s` later, and whether its speed and its acceleration held it back."""
    distance = target.gap_mm - reference.gap_mm
    relative = acceleration_mm_s2 + math.copysign(1.0, distance) * target.acceleration_mm_s2
    relative = max(relative, MIN_BRAKING * acceleration_mm_s2)
    closing = math.copysign(_stopping_mm_s(abs(distance), relative, dt_s), distance)
    wanted = target.speed_mm_s + closing
    wanted = max(wanted, -_stopping_mm_s(max(reference.gap_mm - floor_mm, 0.0), acceleration_mm_s2, dt_s))
    bounded = min(max(wanted, -speeds.sure_mm_s), speeds.opening_mm_s)
    share = min(abs(reference.speed_mm_s) / speeds.no_load_mm_s, 1.0)
    speeding_up = acceleration_mm_s2 * (1.0 - share)
    braking = acceleration_mm_s2 * (1.0 + share if reference.speed_mm_s * distance < 0.0 else 1.0)
    up, down = (speeding_up, braking) if reference.speed_mm_s > 0.0 else (braking, speeding_up)
    asked = (bounded - reference.speed_mm_s) / dt_s
    chosen = min(max(asked, -down), up)
    speed = reference.speed_mm_s + chosen * dt_s
    return Reference(reference.gap_mm + speed * dt_s, speed, chosen), bounded != wanted, chosen != asked


def _stopping_mm_s(distance_mm: float, braking_mm_s2: float, dt_s: float) -> float:
    """Return the greatest speed from which `distance_mm` suffices to stop in steps of `dt_s`."""
    change = braking_mm_s2 * dt_s
    fastest = (math.sqrt(change * change + 8.0 * braking_mm_s2 * distance_mm) - change) / 2.0
    return min(fastest, distance_mm / max(APPROACH_S, dt_s))


@final
class Expected:
    """Where the carriages are expected: the reference with its jerk limited."""

    gap_mm: float = 0.0
    speed_mm_s: float = 0.0
    filtered_mm_s: float = 0.0
    "Filtered like the measured speeds."

    def begin(self, gap_mm: float, speed_mm_s: float = 0.0) -> None:
        self.gap_mm, self.speed_mm_s, self.filtered_mm_s = gap_mm, speed_mm_s, speed_mm_s

    def update(self, reference: Reference, dt_s: float, lag_s: float, filter_s: float) -> None:
        self.speed_mm_s = low_pass(self.speed_mm_s, reference.speed_mm_s, dt_s, lag_s)
        self.gap_mm = low_pass(self.gap_mm, reference.gap_mm, dt_s, lag_s)
        self.filtered_mm_s = low_pass(self.filtered_mm_s, self.speed_mm_s, dt_s, filter_s)


@final
class Carriages(Actuator):
    def __init__(self, config: Config, scene: Scene) -> None:
        super().__init__()
        position, motor = config.position, config.motor
        self.expected = Expected()
        self.left, self.right = Pid(position), Pid(position)
        self._position: Final = position
        self._duty_limit: Final = position.duty_limit
        self._derivative_filter_s: Final = position.derivative_filter_s
        self._synchronisation: Final = position.synchronisation
        self._gap_acceleration_mm_s2: Final = position.gap_acceleration_mm_s2
        self._gap_speeds: Final = gap_speeds(config)
        self._closed_mm: Final = scene.insert.gap_closed_mm
        self._open_mm: Final = scene.insert.gap_open_mm
        self._pull_V: Final = motor.pull_V
        self._supply_V: Final = motor.supply_V
        self._full_speed_mm_s: Final = full_speed_mm_s(motor)
        self._mechanical_time_s: Final = mechanical_time_s(motor)
        self._lag_s: Final = electrical_time_s(motor) + EXCHANGE_S
        self._gear_loss: Final = 1.0 - motor.gear_efficiency
        self._coulomb: Final = motor.coulomb_V / motor.supply_V
        self._has_motor: Final = scene.terms.motor
        self._learns: Final = scene.terms.learning

    def begin(self, gap_mm: float) -> None:
        """Begin at the gap `gap_mm`, at rest and with empty integrals, so that no duty jumps."""
        self.reference = Reference(gap_mm)
        self.expected.begin(gap_mm)
        self.left, self.right = Pid(self._position), Pid(self._position)

    def resume(self, measured: Measured) -> None:
        """Go on from the measured gap and speed, because the device kept its last duty in the blind time."""
        self.reference = self._begun_at(measured)

    def update(
        self,
        now_s: float,
        dt_s: float,
        plan: Plan | None,
        measurement: Measurement,
        measured: Measured,
        is_over: bool,
    ) -> Drive:
        assert self.reference is not None, "enabling begins one"
        self.expected.update(self.reference, dt_s, self._lag_s, self._derivative_filter_s)
        # a homed carriage may be found beyond the closed end
        nearest_mm = max(self.reference.gap_mm, self._closed_mm)
        pull = pull_V(self._pull_V, nearest_mm) / self._supply_V if self._has_motor else 0.0
        reference, is_late, is_slewed = self._follow(
            self.reference, now_s, dt_s, plan, self._speeds(pull, measured), measured, is_over
        )
        self.reference = reference
        # each carriage also takes half of the skew as an error, so that the faster one waits
        skew_mm = self._synchronisation * measured.skew_mm / 2.0
        half_mm, half_mm_s = self.expected.gap_mm / 2.0, self.expected.filtered_mm_s / 2.0
        left_mm, right_mm = half_mm - measured.left_mm - skew_mm, half_mm - measured.right_mm + skew_mm
        left_mm_s, right_mm_s = half_mm_s - measured.left_mm_s, half_mm_s - measured.right_mm_s
        if is_slewed and self._learns:
            self._learn_acceleration(reference, left_mm + right_mm, left_mm_s + right_mm_s, dt_s)
        ahead = self._feed_forward(reference, pull)
        if abs(reference.speed_mm_s) < RESTING_MM_S:
            self.left.rest(left_mm, dt_s)
            self.right.rest(right_mm, dt_s)
        # at its open switch the firmware gives a carriage no opening duty: the loop must neither wind up nor saturate
        left = self.left.update(left_mm, left_mm_s, ahead, dt_s, measurement.is_left_open)
        right = self.right.update(right_mm, right_mm_s, ahead, dt_s, measurement.is_right_open)
        held = ((Limit.OVER_FORCE,) if is_over else ()) + ((Limit.RATE,) if is_late else ())
        return self._drive(left, right, measurement.supply_V, held)

    def _follow(
        self,
        reference: Reference,
        now_s: float,
        dt_s: float,
        plan: Plan | None,
        speeds: GapSpeeds,
        measured: Measured,
        is_over: bool,
    ) -> tuple[Reference, bool, bool]:
        """Return the reference `dt_s` later, whether its speed limit keeps it behind, and whether that of its
        acceleration acted.
        """
        floor_mm, target = self._closed_mm, Reference(reference.gap_mm)
        if plan is not None:
            floor_mm = max(floor_mm, plan.min_gap_mm)
            target = target_of(plan, now_s, self._lag_s, floor_mm, self._open_mm)
        if is_over:
            target = Reference(self._open_mm)
        ahead_mm, wanted_mm = self.expected.gap_mm - measured.gap_mm, target.gap_mm - measured.gap_mm
        is_wrong_way = reference.speed_mm_s * wanted_mm < 0.0
        if is_wrong_way and ahead_mm * wanted_mm < 0.0 and abs(ahead_mm) > LAGGING_MM:
            reference = self._begun_at(measured)
        max_mm_s2 = self.acceleration_scale * self._gap_acceleration_mm_s2
        reference, is_limited, is_slewed = follow(max_mm_s2, reference, target, dt_s, speeds, floor_mm)
        is_late = plan is not None and is_limited and abs(target.gap_mm - reference.gap_mm) > LAGGING_MM
        self.acted.rate += is_limited
        self.acted.slew += is_slewed
        return reference, is_late, is_slewed

    def _begun_at(self, measured: Measured) -> Reference:
        most_mm_s = self._gap_speeds.no_load_mm_s
        speed_mm_s = min(max(measured.gap_speed_mm_s, -most_mm_s), most_mm_s)
        self.expected.begin(measured.gap_mm, speed_mm_s)
        return Reference(measured.gap_mm, speed_mm_s)

    def _speeds(self, pull: float, measured: Measured) -> GapSpeeds:
        """Return the gap's speeds with these motors, and with this share of the supply against the magnets' pull."""
        most = self._gap_speeds
        motors_mm_s = most.no_load_mm_s
        if abs(self.expected.gap_mm - measured.gap_mm) > WEAK_MM:
            motors_mm_s = min(max(abs(measured.gap_speed_mm_s), motors_mm_s / 2.0), motors_mm_s)
        # the pull helps to close, but a reserve of duty is worth more there than a little speed
        opening_mm_s = most.no_load_mm_s * (self._duty_limit - self._coulomb - pull)
        # compiled, min() of three makes objects
        opening_mm_s = min(min(motors_mm_s, most.opening_mm_s), opening_mm_s)
        return GapSpeeds(most.closing_mm_s, opening_mm_s, min(motors_mm_s, most.sure_mm_s), motors_mm_s)

    def _learn_acceleration(self, reference: Reference, error_mm: float, error_mm_s: float, dt_s: float) -> None:
        if reference.acceleration_mm_s2 * reference.speed_mm_s <= 0.0:
            return
        # a carriage that did not get as far as it should is not ahead because it need not come back as far
        behind_mm = error_mm + self._position.derivative_time_s * error_mm_s
        ahead_mm = -math.copysign(1.0, reference.speed_mm_s) * behind_mm
        scale = self.acceleration_scale + SCALE_PER_MM_S * ahead_mm * dt_s
        self.acceleration_scale = min(max(scale, 1.0), MAX_ACCELERATION_SCALE)

    def _feed_forward(self, reference: Reference, pull: float) -> float:
        """Return one carriage's duty at the nominal supply, positive to open."""
        if not self._has_motor:
            return 0.0
        speed, acceleration = reference.speed_mm_s / 2.0, reference.acceleration_mm_s2 / 2.0
        moving = min(max(speed / COULOMB_SPEED_MM_S, -1.0), 1.0)
        # the pull helps to close by a fifth only: the screw's friction takes the rest
        resisting = self._coulomb + (pull if moving > 0.0 else 0.0)
        # the gears' loss has to be added to speed up, and helps to brake
        loss = math.copysign(self._gear_loss, acceleration * speed)
        inertia = acceleration * self._mechanical_time_s / (1.0 - loss)
        return (speed + inertia) / self._full_speed_mm_s + resisting * moving

    def _drive(self, left: float, right: float, supply_V: float, held: tuple[Limit, ...]) -> Drive:
        is_saturated = self.left.is_saturated or self.right.is_saturated
        scale, limit = self._supply_V / max(supply_V, 0.5 * self._supply_V), self._duty_limit
        left_duty, right_duty = left * scale, right * scale
        self.acted.range += is_saturated or max(abs(left_duty), abs(right_duty)) > limit
        left_duty, right_duty = min(max(left_duty, -limit), limit), min(max(right_duty, -limit), limit)
        return Drive(left_duty, right_duty, left, right, held + ((Limit.SATURATED,) if is_saturated else ()))
