"""`step`: safety, reference, two PIDs, duty. Pure: no clock, no I/O, explicit state, the same result every time."""

import math
from typing import Final, final

from firmware_protocol.codec import DeviceMode, DriveMode
from firmware_protocol.value import Value
from tormagd.config import Config
from tormagd.control.device_fit import SCALE_SD
from tormagd.control.estimate import Estimate, first_estimate, update
from tormagd.control.homing import Homing, watch
from tormagd.control.motor import delay_margin_s, electrical_time_s, full_speed_mm_s, mechanical_time_s, pull_V
from tormagd.control.pid import Error, Gains, PidState, pid, rested
from tormagd.control.plan import Plan
from tormagd.control.plausible import Leap, is_outside, leap_between
from tormagd.control.sight import UNSEEING, Sight, look, unsensed_s
from tormagd.control.trajectory import Expected, Reference, Speeds, expect, follow
from tormagd.hardware.measurement import Measurement
from tormagd.safety.codes import Fault, Limit, device_faults
from tormagd.safety.operating_state import (
    Conditions,
    DeviceRequest,
    OperatingState,
    SafetyState,
    command,
    homed_again,
    latch,
)
from tormagd.scenes.scene import Scene, terms_of

CARRY_S: Final = 0.012
"A plan's gap is carried forward along its speed by no more than three inference periods."
WEAK_MM: Final = 1.0
"Carriages further behind than this have reached the top speed of motors that are weaker than they are believed to be."
STARTING_S: Final = 0.15
"After enabling, the device may take this long to report that it runs."
EXCHANGE_S: Final = 0.0015
"From a duty to its effect as the encoders report it: a period in the exchange, half a period that it is held."
COULOMB_SPEED_MM_S: Final = 0.5
"Below this reference speed the friction feed-forward fades, so that a resting carriage is not pushed to and fro."
RESTING_MM_S: Final = 0.02
"A slower reference has arrived: it comes in exponentially, and what a second of it moves is a few encoder counts."
STILL_MM_S: Final = 0.5
"Slower than this a carriage does not move: half an encoder count a millisecond and filtered."
STARTS_OVER: Final = 1.25
"Static over kinetic friction at most: a start from rest may take so many times the greatest force."
OVER_N: Final = 0.1
"What the sensor may be off besides."
OVER_HELD_S: Final = 0.01
OVER_FAULT_S: Final = 0.04
"A force over the ceiling opens the gap after the first, and is a fault after the second."
SENSOR_FAULT_S: Final = 2.0
"A sensor that has not been believed for so long of sliding is a fault: forces are then only as good as the model."
SENSE_FAULT_S: Final = 0.1
STATUS_FAULT_S: Final = 0.1
"Without a Sense, and without a Status, for so long: Status comes every 20 ms, Sense with every State."
OPPOSED_S: Final = 0.1
"A carriage that moves against its duty for so long does not brake: it brakes from full speed within 0.06 s."
WENT_AGAINST_S: Final = 0.015
"Carriages that come apart, or to a stop, after one of them has gone against its duty for so long do so for that."
# looking a member up takes longer than comparing it
_DRIVEN: Final = OperatingState.ENABLED, OperatingState.PAUSED
_PAUSED: Final = OperatingState.PAUSED
_RUN: Final = DriveMode.RUN
_DEVICE_RUN: Final = DeviceMode.RUN
SLOW_SHARE: Final = 0.4
TOO_SLOW_SHARE: Final = 0.8
"""Of the delay that the position loop bears besides its own period: from the first on a round trip is a limit, from the
second on a fault, and no enabling: carriages swing from about the whole on."""
CLOCK_OFF: Final = 0.01
CLOCK_FAULT: Final = 0.1
"A clock that is off by a greater share is a limit, and a fault."
STALL_SHARE: Final = 0.8
"Of the device's timeout: a shorter stall of ours did not make it run out."
LIVELIEST: Final = 2.0
"No more is asked of lively motors, times what is asked of all; the liveliest of the plant card do 2.4 times as much."
LIVELIER_BY_MM: Final = 100.0
"""For each mm that carriages are ahead of what is expected while they gain speed as fast as they are let, so much more
is asked of them in a second of it: two or three beats of a pulse show what a device can."""
LAGGING_MM: Final = 0.1
"The speed limit is reported as RATE only where it leaves the reference this far behind its target."

DISARMED: Final = SafetyState()
EMPTY: Final = PidState()
NO_LIMITS: Final[tuple[Limit, ...]] = ()


@final
class Acted(Value):
    """In how many steps each stage of the output has acted, in the order in which they stand: the speed and then the
    acceleration of the gap's reference were limited, a number was not finite, a duty was out of its range.

    Duties have no slew limit: the reference's acceleration bounds what is asked of the motors, their windings smooth
    the rest within `motor.inductance`, and a limit in between would only take phase away from the position loop.
    """

    def __init__(self, rate: int = 0, slew: int = 0, not_finite: int = 0, range: int = 0) -> None:
        self.rate: Final = rate
        self.slew: Final = slew
        self.not_finite: Final = not_finite
        self.range: Final = range


NEVER: Final = Acted()


@final
class StepState(Value):
    """What a step remembers."""

    def __init__(
        self,
        time_s: float,
        safety: SafetyState = DISARMED,
        estimate: Estimate | None = None,
        reference: Reference | None = None,
        expected: Expected | None = None,
        left: PidState = EMPTY,
        right: PidState = EMPTY,
        duties: tuple[float, float] = (0.0, 0.0),
        enabled_s: float = math.inf,
        straying_s: float = 0.0,
        still_s: float = 0.0,
        over_s: float = 0.0,
        sight: Sight = UNSEEING,
        opposed_s: float = 0.0,
        leap: Leap | None = None,
        homing: Homing | None = None,
        acted: Acted = NEVER,
        liveliness: float = 1.0,
    ) -> None:
        self.time_s: Final = time_s
        self.safety: Final = safety
        self.estimate: Final = estimate
        self.reference: Final = reference
        self.expected: Final = expected
        self.left: Final = left
        self.right: Final = right
        self.duties: Final = duties
        "Of the step before, left and right."
        self.enabled_s: Final = enabled_s
        self.straying_s: Final = straying_s
        "For how long the gap has been too far from its reference, in periods: a process that stood still saw nothing."
        self.still_s: Final = still_s
        "For how long a carriage has been driven without moving, counted alike."
        self.over_s: Final = over_s
        "For how long the measured force has been over the ceiling while the handle moved, counted alike."
        self.sight: Final = sight
        self.opposed_s: Final = opposed_s
        "For how long a carriage has moved against its duty, counted alike."
        self.leap: Final = leap
        "Of the encoders, until the device has said whether it was reset."
        self.homing: Final = homing
        "The newest."
        self.acted: Final = acted
        self.liveliness: Final = liveliness
        "How fast the carriages have shown to gain speed, times `position.gap_acceleration_mm_s2`: 1 to LIVELIEST."


@final
class StepOutput(Value):
    """What goes to the device, and what holds it back."""

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


@final
class Stepper:
    """The constants of a step. Its methods change nothing."""

    def __init__(self, config: Config, scene: Scene) -> None:
        position, limits, motor = config.position, config.limits, config.motor
        # what a step reads is read from the configuration once
        self._gains = Gains.of(position)
        self._gap_acceleration_mm_s2 = position.gap_acceleration_mm_s2
        self._gap_speed_mm_s = position.gap_speed_mm_s
        self._derivative_filter_s = position.derivative_filter_s
        self._synchronisation = position.synchronisation
        self._skew_warning_mm, self._skew_fault_mm = limits.skew_warning_mm, limits.skew_fault_mm
        self._following_error_mm, self._following_time_s = limits.following_error_mm, limits.following_time_s
        self._no_motion_duty, self._no_motion_time_s = limits.no_motion_duty, limits.no_motion_time_s
        self._measurement_timeout_s = config.device.measurement_timeout_ms * 1e-3
        self._longest_own_stall_s = STALL_SHARE * config.device.command_timeout_ms * 1e-3
        self._nominal_dt_s = 1.0 / config.rates.control_hz
        self._unsensed_s = unsensed_s(self._nominal_dt_s)
        bears_s = delay_margin_s(config.motor, position, self._nominal_dt_s)
        self._slow_s = self._nominal_dt_s + SLOW_SHARE * bears_s
        self._too_slow_s = self._nominal_dt_s + TOO_SLOW_SHARE * bears_s
        self._closed_mm, self._open_mm = scene.insert.gap_closed_mm, scene.insert.gap_open_mm
        self._home_mm = self._open_mm / 2.0
        self._slides = scene.element == "torque"
        # devices not yet seen differ by SCALE_SD: a scene that tolerates that does without the sensor
        self._needs_sensor = scene.force.tolerance_rms_N < SCALE_SD * scene.force.most_N
        self._ceiling_N = STARTS_OVER * scene.force.most_N + OVER_N
        self._pull_V, self._supply_V = motor.pull_V, motor.supply_V
        self._full_speed_mm_s = full_speed_mm_s(motor)
        self._no_load_mm_s = 2.0 * self._full_speed_mm_s
        self._mechanical_time_s = mechanical_time_s(motor)
        self._lag_s = electrical_time_s(motor) + EXCHANGE_S
        self._gear_loss = 1.0 - motor.gear_efficiency
        self._coulomb = motor.coulomb_V / motor.supply_V
        self._has_motor = terms_of(scene).motor

    def start(self, now_s: float) -> StepState:
        """The state before the first step: disabled."""
        return StepState(now_s)

    def command(self, state: StepState, name: str, now_s: float, conditions: Conditions) -> StepState:
        """The state after an operator's command. Raises RefusedError."""
        estimate = state.estimate
        known = conditions.replaced(
            fresh=conditions.fresh and estimate is not None,
            apart_mm=math.inf if estimate is None else abs(estimate.skew_mm),
            most_apart_mm=self._skew_fault_mm,
            most_round_trip_s=self._too_slow_s,
            most_clock_drift=CLOCK_FAULT,
        )
        safety = command(state.safety, name, now_s, known)
        if safety.operating_state is OperatingState.ENABLED and state.safety.operating_state is OperatingState.DISABLED:
            assert estimate is not None, "nothing is fresh without one"
            # bumpless: from where the gap is, at rest, with empty integrators
            return state.replaced(
                safety=safety,
                reference=Reference(estimate.gap_mm),
                expected=Expected(estimate.gap_mm),
                left=EMPTY,
                right=EMPTY,
                enabled_s=now_s,
                straying_s=0.0,
                still_s=0.0,
                over_s=0.0,
                opposed_s=0.0,
            )
        return state.replaced(safety=safety)

    def lose_link(self, state: StepState) -> StepState:
        """The state after the link broke: a fault where the device was driven, otherwise only a forgotten device."""
        safety = state.safety
        if safety.operating_state in _DRIVEN:
            safety = latch(safety, (Fault.LINK_LOST,))
        return state.replaced(safety=safety, estimate=None, liveliness=1.0)  # another device may come

    def step(
        self, state: StepState, now_s: float, measurement: Measurement | None, plan: Plan
    ) -> tuple[StepState, StepOutput]:
        """One control period. With no measurement the link is lost, and the device is told nothing but OFF."""
        if measurement is None:
            state = self.lose_link(state).replaced(time_s=now_s)
            return state, self._off(state.safety, NO_LIMITS)
        is_new = state.estimate is None or measurement.number != state.estimate.number
        was_blind, sight = state.sight.is_blind, look(state.sight, state.time_s, now_s, self._nominal_dt_s, is_new)
        estimate = update(state.estimate, measurement, self._home_mm, self._derivative_filter_s, self._slides)
        leap = state.leap
        if leap is not None:
            # it was reset, which it says itself; or it was a burst on a line, and the counts are right again
            is_over = state.safety.needs_homing or not measurement.is_homed
            if is_over or leap.has_come_back(estimate, self._full_speed_mm_s, now_s):
                leap = None
        elif is_new and state.estimate is not None and state.estimate.is_homed and measurement.is_homed:
            leap = leap_between(state.estimate, estimate, self._full_speed_mm_s, now_s, state.sight.seen_s)
        homing = watch(state.homing, now_s, measurement, self._ceiling_N)
        safety = latch(state.safety, self._watch(state, estimate, now_s, measurement, plan, sight, leap, homing))
        if safety.needs_homing:
            safety, estimate = homed_again(safety, measurement.is_homed), estimate.replaced(is_homed=False)
        if safety.operating_state not in _DRIVEN:
            if measurement.is_busy:  # homing moves the origin: what was learned about motion before it is void
                estimate = first_estimate(measurement, self._home_mm)
            state = state.replaced(
                time_s=now_s,
                safety=safety,
                estimate=estimate,
                reference=None,
                expected=None,
                sight=sight,
                leap=leap,
                homing=homing,
            )
            return state, self._off(safety, NO_LIMITS)
        if sight.is_blind or leap is not None:
            return self._hold(state.replaced(time_s=now_s, safety=safety, estimate=estimate, sight=sight, leap=leap))
        if was_blind:
            state = self._from_where_it_is(state, estimate)
        return self._drive(state, safety, now_s, measurement, estimate, plan, sight)

    def _hold(self, state: StepState) -> tuple[StepState, StepOutput]:
        """Asks the device for an answer without moving anything: friction holds the gap. Nothing is learned from it."""
        limit = Limit.HOST_STALL if state.sight.has_stalled(state.time_s) else Limit.DEVICE_SILENT
        if state.leap is not None:
            limit = Limit.ENCODER
        safety = state.safety
        output = StepOutput(_RUN, 0.0, 0.0, safety.request, safety.request_number, (limit,))
        return state.replaced(duties=(0.0, 0.0)), output

    def _from_where_it_is(self, state: StepState, estimate: Estimate) -> StepState:
        """The device went on with its last duty, unseen: the reference goes on from what came of it, without a leap."""
        most_mm_s = self._no_load_mm_s
        speed_mm_s = min(max(estimate.left_mm_s + estimate.right_mm_s, -most_mm_s), most_mm_s)
        reference = Reference(estimate.gap_mm, speed_mm_s)
        return state.replaced(reference=reference, expected=Expected(estimate.gap_mm, speed_mm_s, speed_mm_s))

    def _drive(
        self,
        state: StepState,
        safety: SafetyState,
        now_s: float,
        measurement: Measurement,
        estimate: Estimate,
        plan: Plan,
        sight: Sight,
    ) -> tuple[StepState, StepOutput]:
        dt_s = now_s - state.time_s
        if not 0.0 < dt_s < 10.0 * self._nominal_dt_s:
            dt_s = self._nominal_dt_s  # a clock that stood still gives no period
        reference = state.reference or Reference(estimate.gap_mm)
        expected = state.expected or Expected(estimate.gap_mm)
        expected = expect(expected, reference, dt_s, self._lag_s, self._derivative_filter_s)
        # a homed carriage that is found beyond the closed end has to come back from there
        pull = 0.0
        if self._has_motor:
            pull = pull_V(self._pull_V, max(reference.gap_mm, self._closed_mm)) / self._supply_V
        speeds = self._speeds(pull, expected, estimate)
        most_mm_s2 = state.liveliness * self._gap_acceleration_mm_s2
        limits: list[Limit] = []
        if safety.operating_state is _PAUSED:
            target = Reference(reference.gap_mm)
            reference, is_limited, is_slewed = follow(most_mm_s2, reference, target, dt_s, speeds, self._closed_mm)
        else:
            floor_mm = max(self._closed_mm, plan.least_gap_mm)
            target = self._target(plan, now_s, floor_mm)
            if state.over_s > OVER_HELD_S:
                target = Reference(self._open_mm)
                limits.append(Limit.OVER_FORCE)
            reference, is_limited, is_slewed = follow(most_mm_s2, reference, target, dt_s, speeds, floor_mm)
            if is_limited and abs(target.gap_mm - reference.gap_mm) > LAGGING_MM:
                limits.append(Limit.RATE)
        left_error, right_error = self._errors(expected, estimate)
        liveliness = state.liveliness
        if is_slewed:
            liveliness = self._liveliness(liveliness, reference, left_error, right_error, dt_s)
        ahead = self._feed_forward(reference, pull)
        left_state, right_state = state.left, state.right
        if abs(reference.speed_mm_s) < RESTING_MM_S:
            left_state = rested(self._gains, left_state, left_error, dt_s)
            right_state = rested(self._gains, right_state, right_error, dt_s)
        # the firmware gives a carriage at its open switch no opening duty: nothing may be learned or concluded there
        is_left_blocked, is_right_blocked = measurement.is_left_open, measurement.is_right_open
        left_state, left = pid(self._gains, left_state, left_error, ahead, dt_s, is_blocked=is_left_blocked)
        right_state, right = pid(self._gains, right_state, right_error, ahead, dt_s, is_blocked=is_right_blocked)
        total = left.duty + right.duty + measurement.supply_V
        if not -math.inf < total < math.inf:  # a sum is finite only if all of it is
            safety, acted = latch(safety, (Fault.NOT_FINITE,)), state.acted
            acted = acted.replaced(not_finite=acted.not_finite + 1)
            return self.start(now_s).replaced(safety=safety, acted=acted), self._off(safety, NO_LIMITS)
        if left.is_saturated or right.is_saturated:
            limits.append(Limit.SATURATED)
        if abs(estimate.skew_mm) > self._skew_warning_mm:
            limits.append(Limit.SKEW)
        if sight.has_stalled(now_s):
            limits.append(Limit.HOST_STALL)
        if now_s - measurement.sensed_s > self._unsensed_s:
            limits.append(Limit.SENSE_STALE)
        link = measurement.link
        if link.is_lossy or link.round_trip_s > self._slow_s:
            limits.append(Limit.LINK_DEGRADED)
        if abs(link.clock_drift) > CLOCK_OFF:
            limits.append(Limit.CLOCK)
        # the bridges switch the device's real supply: the same volts take less duty of a higher one
        scale = self._supply_V / max(measurement.supply_V, 0.5 * self._supply_V)
        most = self._gains.duty_limit
        left_duty, right_duty = left.duty * scale, right.duty * scale
        is_out = left.is_saturated or right.is_saturated or max(abs(left_duty), abs(right_duty)) > most
        acted = state.acted
        if is_limited or is_slewed or is_out:
            acted = Acted(acted.rate + is_limited, acted.slew + is_slewed, acted.not_finite, acted.range + is_out)
        state = StepState(
            time_s=now_s,
            safety=safety,
            estimate=estimate,
            reference=reference,
            expected=expected,
            left=left_state,
            right=right_state,
            duties=(left.duty, right.duty),
            enabled_s=state.enabled_s,
            straying_s=state.straying_s + dt_s if self._is_astray(reference, estimate) else 0.0,
            over_s=state.over_s + dt_s if self._is_over(estimate) else 0.0,
            still_s=state.still_s + dt_s if self._is_still(state, estimate, left.duty, right.duty) else 0.0,
            sight=sight,
            opposed_s=self._opposed_s(state, estimate, left.duty, right.duty, dt_s),
            homing=state.homing,
            acted=acted,
            liveliness=liveliness,
        )
        output = StepOutput(
            _RUN,
            min(max(left_duty, -most), most),
            min(max(right_duty, -most), most),
            safety.request,
            safety.request_number,
            tuple(limits),
        )
        return state, output

    def _target(self, plan: Plan, now_s: float, floor_mm: float) -> Reference:
        """Where the plan leads by when a duty of now shows. The least gap, `floor_mm`, or the greatest, where it acts,
        also ends the motion towards it."""
        age_s = min(max(now_s - plan.time_s, 0.0), CARRY_S) + self._lag_s
        gap_mm = plan.gap_mm + age_s * (plan.gap_speed_mm_s + age_s * plan.gap_acceleration_mm_s2 / 2.0)
        speed_mm_s = plan.gap_speed_mm_s + age_s * plan.gap_acceleration_mm_s2
        acceleration_mm_s2 = plan.gap_acceleration_mm_s2
        if gap_mm < floor_mm:
            gap_mm, speed_mm_s, acceleration_mm_s2 = floor_mm, max(speed_mm_s, 0.0), max(acceleration_mm_s2, 0.0)
        if gap_mm > self._open_mm:
            gap_mm, speed_mm_s, acceleration_mm_s2 = self._open_mm, min(speed_mm_s, 0.0), min(acceleration_mm_s2, 0.0)
        return Reference(gap_mm, speed_mm_s, acceleration_mm_s2)

    def _speeds(self, pull: float, expected: Expected, estimate: Estimate) -> Speeds:
        """The motors' and the configured one, or what the carriages show where they fall behind; not below half, so
        that carriages that are held still are found out by their following error.
        """
        motors_mm_s = self._no_load_mm_s
        if abs(expected.gap_mm - estimate.gap_mm) > WEAK_MM:
            shown_mm_s = abs(estimate.left_mm_s + estimate.right_mm_s)
            motors_mm_s = min(max(shown_mm_s, motors_mm_s / 2.0), motors_mm_s)
        closing_mm_s = min(motors_mm_s, self._gap_speed_mm_s)
        # the magnets' pull helps to close, but a reserve is worth more there than a little speed
        opening_mm_s = self._no_load_mm_s * (self._gains.duty_limit - self._coulomb - pull)
        return Speeds(motors_mm_s, min(closing_mm_s, opening_mm_s), closing_mm_s)

    def _liveliness(self, shown: float, reference: Reference, left: Error, right: Error, dt_s: float) -> float:
        """After a period in which the limit of its acceleration held the reference back: carriages whose motors are
        livelier than believed get ahead of what is expected then, and the feedback holds them back. Of weaker ones no
        less is asked: they turn too late where they are spared."""
        if reference.acceleration_mm_s2 * reference.speed_mm_s <= 0.0:
            return shown
        # a carriage that did not get as far as it should is not ahead because it need not come back as far
        lead_s = self._gains.derivative_time_s
        behind_mm = left.position_mm + right.position_mm + lead_s * (left.speed_mm_s + right.speed_mm_s)
        ahead_mm = -math.copysign(1.0, reference.speed_mm_s) * behind_mm
        return min(max(shown + LIVELIER_BY_MM * ahead_mm * dt_s, 1.0), LIVELIEST)

    def _errors(self, expected: Expected, estimate: Estimate) -> tuple[Error, Error]:
        """Both carriages' errors; either also takes half of the skew, so that the faster waits for the slower."""
        half_mm, half_mm_s = expected.gap_mm / 2.0, expected.filtered_mm_s / 2.0
        skew = self._synchronisation * estimate.skew_mm / 2.0
        return (
            Error(half_mm - estimate.left_mm - skew, half_mm_s - estimate.left_mm_s),
            Error(half_mm - estimate.right_mm + skew, half_mm_s - estimate.right_mm_s),
        )

    def _feed_forward(self, reference: Reference, pull: float) -> float:
        if not self._has_motor:
            return 0.0
        speed, acceleration = reference.speed_mm_s / 2.0, reference.acceleration_mm_s2 / 2.0
        moving = min(max(speed / COULOMB_SPEED_MM_S, -1.0), 1.0)
        # to close, the pull helps a fifth as much: the screw's friction eats the rest
        resisting = self._coulomb + (pull if moving > 0.0 else 0.0)
        # what the gears lose has to be added to speed up, and helps to brake
        loss = math.copysign(self._gear_loss, acceleration * speed)
        inertia = acceleration * self._mechanical_time_s / (1.0 - loss)
        return (speed + inertia) / self._full_speed_mm_s + resisting * moving

    def _watch(
        self,
        state: StepState,
        estimate: Estimate,
        now_s: float,
        measurement: Measurement,
        plan: Plan,
        sight: Sight,
        leap: Leap | None,
        homing: Homing | None,
    ) -> tuple[Fault, ...]:
        """All that show now; `latch` names them in the order of their table."""
        faults: list[Fault] = []
        if homing is not None and homing.faults:
            faults.extend(homing.faults)
        shown: int = measurement.faults
        if shown and now_s >= state.safety.clearing_until_s:
            is_ours = Fault.HOST_STALL in state.safety.faults or (
                sight.has_stalled(now_s) and sight.stall_s > self._longest_own_stall_s
            )
            faults.extend(device_faults(measurement.faults, is_host_stall=is_ours))
        if leap is not None:
            if measurement.reported_s > leap.seen_s:  # so it was not reset in between
                faults.append(Fault.ENCODER)
        elif estimate.is_homed and not state.safety.needs_homing:
            # switches come with Status: without a State, positions are older than they are
            is_left_open = not sight.is_blind and measurement.is_left_open
            is_right_open = not sight.is_blind and measurement.is_right_open
            if is_outside(estimate, self._closed_mm, self._open_mm, is_left_open, is_right_open):
                faults.append(Fault.OUT_OF_STROKE)
        if state.safety.operating_state not in _DRIVEN:
            return tuple(faults)
        # the tick that is nearest to a time's end judges it: the next one would be a period late
        at_s = now_s + self._nominal_dt_s / 2.0
        # what has just come over a slow line is old too, and a loop around it would swing
        is_old = at_s - measurement.received_s + measurement.delay_s > self._measurement_timeout_s
        if not sight.is_waiting(now_s, self._nominal_dt_s):
            if is_old:
                faults.append(Fault.MEASUREMENT_STALE)
            if self._needs_sensor and at_s - measurement.sensed_s > SENSE_FAULT_S:
                faults.append(Fault.SENSE_STALE)
            if at_s - measurement.reported_s > STATUS_FAULT_S:
                faults.append(Fault.STATUS_STALE)
        if measurement.link.round_trip_s > self._too_slow_s:
            faults.append(Fault.LINK_DEGRADED)
        if abs(measurement.link.clock_drift) > CLOCK_FAULT:
            faults.append(Fault.CLOCK)
        if leap is not None:
            return tuple(faults)  # what follows from positions says nothing now
        is_skewed = abs(estimate.skew_mm) > self._skew_fault_mm
        is_still = state.still_s > self._no_motion_time_s
        if state.opposed_s > (WENT_AGAINST_S if is_skewed or is_still else OPPOSED_S):
            faults.append(Fault.WRONG_DIRECTION)
        if is_skewed:
            faults.append(Fault.SKEW)
        if state.straying_s > self._following_time_s:
            faults.append(Fault.FOLLOWING_ERROR)
        if state.over_s > OVER_FAULT_S and self._slides:  # of a pad it is the finger that presses so hard
            faults.append(Fault.OVER_FORCE)
        if self._needs_sensor and plan.sensor_doubted_s > SENSOR_FAULT_S:
            faults.append(Fault.SENSOR)
        if is_still:
            faults.append(Fault.NO_MOTION)
        if measurement.mode is not _DEVICE_RUN and not faults and now_s - state.enabled_s > STARTING_S:
            faults.append(Fault.DEVICE_NOT_RUNNING)
        return tuple(faults)

    def _is_over(self, estimate: Estimate) -> bool:
        is_felt = not self._slides or abs(estimate.handle.rate_mm_s) > STILL_MM_S
        return estimate.force_N > self._ceiling_N and is_felt

    def _is_astray(self, reference: Reference, estimate: Estimate) -> bool:
        return abs(reference.gap_mm - estimate.gap_mm) > self._following_error_mm

    def _is_still(self, state: StepState, estimate: Estimate, left_duty: float, right_duty: float) -> bool:
        least = self._no_motion_duty
        # a duty that turns round before the carriage could move drives it nowhere
        is_left_driven = left_duty * math.copysign(1.0, state.duties[0]) > least
        is_right_driven = right_duty * math.copysign(1.0, state.duties[1]) > least
        is_left_still = is_left_driven and abs(estimate.left_mm_s) < STILL_MM_S
        is_right_still = is_right_driven and abs(estimate.right_mm_s) < STILL_MM_S
        return is_left_still or is_right_still

    def _opposed_s(
        self, state: StepState, estimate: Estimate, left_duty: float, right_duty: float, dt_s: float
    ) -> float:
        """For how long a carriage that is driven well has moved the other way; one that comes to a stop there, did."""
        least, left_mm_s, right_mm_s = self._no_motion_duty, 0.0, 0.0
        if abs(left_duty) > least:
            left_mm_s = estimate.left_mm_s * math.copysign(1.0, left_duty)
        if abs(right_duty) > least:
            right_mm_s = estimate.right_mm_s * math.copysign(1.0, right_duty)
        if left_mm_s < -STILL_MM_S or right_mm_s < -STILL_MM_S:
            return state.opposed_s + dt_s
        is_driven = abs(left_duty) > least or abs(right_duty) > least
        is_forward = left_mm_s > STILL_MM_S or right_mm_s > STILL_MM_S
        return state.opposed_s if is_driven and not is_forward else 0.0

    @staticmethod
    def _off(safety: SafetyState, limits: tuple[Limit, ...]) -> StepOutput:
        return StepOutput(DriveMode.OFF, 0.0, 0.0, safety.request, safety.request_number, limits)
