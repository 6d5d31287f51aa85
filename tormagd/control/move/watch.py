"""The watch on a device: what shows that the device, its positions, link, force or motion is wrong."""

import math
from typing import Final, final

from firmware_protocol.codec import DeviceMode
from tormagd.config import Config
from tormagd.control.believe.strength import SCALE_SD
from tormagd.control.measure import Leap, Sight, is_contradicted, is_outside, unsensed_s
from tormagd.control.move.actuator import Reference
from tormagd.control.move.motor import delay_margin_s
from tormagd.control.records import Measured
from tormagd.control.safety.codes import Fault, Limit, device_faults
from tormagd.control.safety.operating_state import Conditions, SafetyState
from tormagd.hardware.measurement import Measurement
from tormagd.scenes.scene import Scene

STARTING_S: Final = 0.15
"The device may take this long to report that it runs."
STILL_MM_S: Final = 0.5
"A slower carriage stands still: half an encoder count per millisecond, filtered."
STARTS_OVER: Final = 1.25
"Static over kinetic friction: a start from rest may take this many times the greatest force."
OVER_N: Final = 0.1
"An allowance for the sensor's error."
OVER_HELD_S: Final = 0.03
OVER_FAULT_S: Final = 0.1
"A force over the ceiling opens the gap after the first, and is a fault after the second."
OVER_FADES: Final = 0.25
"The time over the ceiling falls by this much per second while the force is below."
SENSOR_FAULT_S: Final = 2.0
"A sensor that is not believed for this long of sliding leaves forces only as good as the model."
SENSE_FAULT_S: Final = 0.1
STATUS_FAULT_S: Final = 0.1
"Status comes every 20 ms, Sense with every State."
OPPOSED_S: Final = 0.1
"A carriage that brakes moves against its duty for 0.06 s at most."
WENT_AGAINST_S: Final = 0.015
"Carriages that come apart or stop are wired wrong if one has moved against its duty for this long."
SLOW_SHARE: Final = 0.4
TOO_SLOW_SHARE: Final = 0.8
"Shares of the delay that the position loop bears besides its period: a limit, and a fault."
CLOCK_OFF: Final = 0.01
CLOCK_FAULT: Final = 0.1
STALL_SHARE: Final = 0.8
"Of the device's timeout: a shorter stall of the host did not let it expire."

_DEVICE_RUN: Final = DeviceMode.RUN


def ceiling_N(scene: Scene) -> float:
    """Return the greatest force that the sensor may show in `scene`."""
    return STARTS_OVER * scene.force.most_N + OVER_N


@final
class Watch:
    """The watch on one device: counts how long it misbehaves, and tells its faults and limits."""

    enabled_s: float = math.inf
    "inf while the device is not enabled."
    straying_s: float = 0.0
    "How long the gap has been too far from its reference."
    still_s: float = 0.0
    "How long a carriage has been driven without moving."
    opposed_s: float = 0.0
    "How long a carriage has moved against its duty."
    over_s: float = 0.0
    "How long the force has been over the ceiling of late while the handle moved."
    is_over: bool = False
    "Whether the gap has to open, because the force has been over the ceiling for too long."
    left_duty: float = 0.0
    right_duty: float = 0.0

    def __init__(self, config: Config, scene: Scene) -> None:
        limits, period_s = config.limits, 1.0 / config.rates.control_hz
        bears_s = delay_margin_s(config.motor, config.position, period_s)
        self._skew_fault_mm: Final = limits.skew_fault_mm
        self._skew_warning_mm: Final = limits.skew_warning_mm
        self._following_error_mm: Final = limits.following_error_mm
        self._following_time_s: Final = limits.following_time_s
        self._no_motion_duty: Final = limits.no_motion_duty
        self._no_motion_time_s: Final = limits.no_motion_time_s
        self._max_round_trip_s: Final = period_s + TOO_SLOW_SHARE * bears_s
        self._slow_s: Final = period_s + SLOW_SHARE * bears_s
        self._period_s: Final = period_s
        self._unsensed_s: Final = unsensed_s(period_s)
        self._measurement_timeout_s: Final = config.device.measurement_timeout_ms * 1e-3
        self._longest_own_stall_s: Final = STALL_SHARE * config.device.command_timeout_ms * 1e-3
        self._range_mm: Final = (scene.insert.gap_closed_mm, scene.insert.gap_open_mm)
        self._slides: Final = scene.element == "torque"
        # devices not yet seen differ by SCALE_SD: a scene that tolerates that does without the sensor
        needs_sensor = scene.force.tolerance_rms_N < SCALE_SD * scene.force.most_N
        self._sense_fault_s: Final = SENSE_FAULT_S if needs_sensor else math.inf
        self._sensor_fault_s: Final = SENSOR_FAULT_S if needs_sensor else math.inf
        self._ceiling_N: Final = ceiling_N(scene)

    def command_conditions(self, conditions: Conditions, measured: Measured | None) -> Conditions:
        """Return `conditions` with the carriages' skew and what a command allows."""
        return conditions.replaced(
            fresh=conditions.fresh and measured is not None,
            apart_mm=math.inf if measured is None else abs(measured.skew_mm),
            most_apart_mm=self._skew_fault_mm,
            most_round_trip_s=self._max_round_trip_s,
            most_clock_drift=CLOCK_FAULT,
        )

    def begin(self, enabled_s: float) -> None:
        """Restart all counts for a device enabled at `enabled_s`."""
        self.enabled_s = enabled_s
        self.straying_s = self.still_s = self.opposed_s = self.over_s = 0.0
        self.is_over = False

    def faults(
        self,
        now_s: float,
        safety: SafetyState,
        measurement: Measurement,
        measured: Measured,
        sight: Sight,
        leap: Leap | None,
        sensor_doubted_s: float,
    ) -> tuple[Fault, ...]:
        shown = self._of_device(now_s, safety, measurement, sight)
        if leap is not None:
            # the device was not reset in between: its Status would say so
            shown += (Fault.ENCODER,) if measurement.reported_s > leap.seen_s else ()
        elif not safety.needs_homing and self._is_misplaced(measurement, measured, sight):
            shown += (Fault.OUT_OF_STROKE,)
        if not safety.is_driven:
            return shown
        shown += self._of_link(now_s, measurement, sight)
        if leap is not None:  # after it positions say nothing about the motion
            return shown
        shown += self._of_motion(measured, sensor_doubted_s)
        is_running = measurement.mode is _DEVICE_RUN or now_s - self.enabled_s <= STARTING_S
        return shown if shown or is_running else (Fault.DEVICE_NOT_RUNNING,)

    def limits(self, now_s: float, measurement: Measurement, measured: Measured, sight: Sight) -> tuple[Limit, ...]:
        link = measurement.link
        return (
            ((Limit.SKEW,) if abs(measured.skew_mm) > self._skew_warning_mm else ())
            + ((Limit.HOST_STALL,) if sight.has_stalled(now_s) else ())
            + ((Limit.SENSE_STALE,) if now_s - measurement.sensed_s > self._unsensed_s else ())
            + ((Limit.LINK_DEGRADED,) if link.is_lossy or link.round_trip_s > self._slow_s else ())
            + ((Limit.CLOCK,) if abs(link.clock_drift) > CLOCK_OFF else ())
        )

    def update(
        self, dt_s: float, measured: Measured, reference: Reference | None, left_duty: float, right_duty: float
    ) -> None:
        """Count one tick of driving with these duties towards `reference`."""
        off_mm = 0.0 if reference is None else abs(reference.gap_mm - measured.gap_mm)
        self.straying_s = self.straying_s + dt_s if off_mm > self._following_error_mm else 0.0
        is_felt = not self._slides or abs(measured.handle.rate_mm_s) > STILL_MM_S
        is_over = measured.force_N > self._ceiling_N and is_felt
        self.over_s = self.over_s + dt_s if is_over else max(self.over_s - OVER_FADES * dt_s, 0.0)
        self.is_over = is_over and self.over_s > OVER_HELD_S
        self.still_s = self.still_s + dt_s if self._is_still(measured, left_duty, right_duty) else 0.0
        self._judge_direction(dt_s, measured, left_duty, right_duty)
        self.left_duty, self.right_duty = left_duty, right_duty

    def rest(self) -> None:
        """Count one tick without duties."""
        self.left_duty = self.right_duty = 0.0

    def _of_device(
        self, now_s: float, safety: SafetyState, measurement: Measurement, sight: Sight
    ) -> tuple[Fault, ...]:
        """Return the faults that the device reports, except while they are being cleared."""
        shown: int = measurement.faults
        if not shown or now_s < safety.clearing_until_s:
            return ()
        is_ours = Fault.HOST_STALL in safety.faults or (
            sight.has_stalled(now_s) and sight.stall_s > self._longest_own_stall_s
        )
        return device_faults(measurement.faults, is_host_stall=is_ours)

    def _is_misplaced(self, measurement: Measurement, measured: Measured, sight: Sight) -> bool:
        # switches come with Status: with an older Status or State they are of another place
        is_told = not sight.is_blind and measurement.reported_s >= measurement.received_s
        closed_mm, open_mm = self._range_mm
        switches: int = measurement.switches
        is_elsewhere = is_told and is_contradicted(measured, switches, closed_mm, open_mm)
        return measured.is_homed and (is_elsewhere or is_outside(measured, closed_mm, open_mm))

    def _of_link(self, now_s: float, measurement: Measurement, sight: Sight) -> tuple[Fault, ...]:
        # the next tick could be a period late; after a stall the answer may still be on its way
        at_s = -math.inf if sight.is_waiting(now_s) else now_s + self._period_s / 2.0
        # a State that has just come over a slow line is old too, and a loop around such a delay would swing
        old_s, link = at_s - measurement.received_s + measurement.delay_s, measurement.link
        return (
            ((Fault.MEASUREMENT_STALE,) if old_s > self._measurement_timeout_s else ())
            + ((Fault.SENSE_STALE,) if at_s - measurement.sensed_s > self._sense_fault_s else ())
            + ((Fault.STATUS_STALE,) if at_s - measurement.reported_s > STATUS_FAULT_S else ())
            + ((Fault.LINK_DEGRADED,) if link.round_trip_s > self._max_round_trip_s else ())
            + ((Fault.CLOCK,) if abs(link.clock_drift) > CLOCK_FAULT else ())
        )

    def _of_motion(self, measured: Measured, sensor_doubted_s: float) -> tuple[Fault, ...]:
        is_skewed, is_still = abs(measured.skew_mm) > self._skew_fault_mm, self.still_s > self._no_motion_time_s
        opposed_s = WENT_AGAINST_S if is_skewed or is_still else OPPOSED_S
        # on a pad the finger itself may press hard
        over_s = self.over_s if self._slides else 0.0
        return (
            ((Fault.WRONG_DIRECTION,) if self.opposed_s > opposed_s else ())
            + ((Fault.SKEW,) if is_skewed else ())
            + ((Fault.FOLLOWING_ERROR,) if self.straying_s > self._following_time_s else ())
            + ((Fault.OVER_FORCE,) if over_s > OVER_FAULT_S else ())
            + ((Fault.SENSOR,) if sensor_doubted_s > self._sensor_fault_s else ())
            + ((Fault.NO_MOTION,) if is_still else ())
        )

    def _is_still(self, measured: Measured, left_duty: float, right_duty: float) -> bool:
        """Tell whether a carriage stands still although it is driven the same way as a step before."""
        # a duty that reverses before the carriage could move drives it nowhere
        left, right = left_duty * math.copysign(1.0, self.left_duty), right_duty * math.copysign(1.0, self.right_duty)
        least = self._no_motion_duty
        is_left_still = left > least and abs(measured.left_mm_s) < STILL_MM_S
        return is_left_still or (right > least and abs(measured.right_mm_s) < STILL_MM_S)

    def _judge_direction(self, dt_s: float, measured: Measured, left_duty: float, right_duty: float) -> None:
        least = self._no_motion_duty
        left_mm_s = measured.left_mm_s * math.copysign(1.0, left_duty) if abs(left_duty) > least else 0.0
        right_mm_s = measured.right_mm_s * math.copysign(1.0, right_duty) if abs(right_duty) > least else 0.0
        if min(left_mm_s, right_mm_s) < -STILL_MM_S:
            self.opposed_s += dt_s
        elif max(left_mm_s, right_mm_s) > STILL_MM_S or max(abs(left_duty), abs(right_duty)) <= least:
            self.opposed_s = 0.0
