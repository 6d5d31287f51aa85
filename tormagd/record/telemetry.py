"""The record of a control tick, and the telemetry message of the newest one."""

import time
from functools import lru_cache

from firmware_protocol.codec import DeviceFault, DeviceMode, DriveMode, Switches
from tormagd.control.core import Stepper
from tormagd.control.records import Duty, Plan
from tormagd.control.safety.operating_state import SafetyState
from tormagd.hardware.measurement import Measurement
from tormagd_client.messages import VERSION, BeliefReport, Mark, Telemetry, Tick, TickRecord, Verdict


def tick_record(
    stepper: Stepper,
    output: Duty,
    plan: Plan,
    measurement: Measurement | None,
    lateness_us: float,
    exec_us: float,
    number: int = 0,
) -> TickRecord:
    measured, safety, reference = stepper.measured, stepper.safety, stepper.move.reference
    is_placed = measured is not None and measured.is_homed
    link = None if measurement is None else measurement.link
    return TickRecord(
        time.time_ns(),
        stepper.time_s,
        plan.number,
        plan.setpoint_N,
        plan.setpoint_age_s,
        plan.governed_N if safety.is_driven else None,
        plan.governed_N,
        plan.predicted_N,
        plan.field_mT,
        plan.gap_mm,
        plan.gap_speed_mm_s,
        plan.gap_acceleration_mm_s2,
        plan.min_gap_mm,
        plan.limits,
        tuple(f"{each.quantity} {each.asked!r} {each.used!r}" for each in plan.outside) if plan.outside else (),
        plan.sensor_doubted_s,
        plan.foresight,
        plan.time_s,
        plan.confidence,
        plan.trim,
        None if measurement is None else measurement.number,
        None if measurement is None else measurement.received_s,
        None if measurement is None else measurement.delay_s,
        None if measurement is None else measurement.sensed_s,
        None if measurement is None else measurement.reported_s,
        None if link is None else link.unanswered,
        None if link is None else link.damaged,
        None if link is None else link.unsent,
        None if link is None else link.round_trip_s,
        None if link is None else link.clock_drift,
        None if measurement is None else measurement.device_time_s,
        None if measurement is None else measurement.left_mm,
        None if measurement is None else measurement.right_mm,
        None if measurement is None else measurement.handle_mm,
        None if measurement is None else measurement.force_N,
        None if measurement is None else _MODES[measurement.mode],
        () if measurement is None else _names(measurement.switches),
        () if measurement is None else _names(measurement.faults),
        None if measurement is None else measurement.temperature_C,
        None if measurement is None else measurement.left_current_A,
        None if measurement is None else measurement.right_current_A,
        None if measurement is None else measurement.supply_V,
        None if reference is None else reference.gap_mm,
        None if measured is None else measured.force_N,
        measured.left_mm if measured is not None and is_placed else None,
        measured.right_mm if measured is not None and is_placed else None,
        None if measured is None else measured.handle_mm,
        None if measured is None else measured.handle.rate_mm_s,
        safety.operating_state,
        limits_held(safety, output, plan),
        output.limits,
        safety.faults,
        _DRIVE_MODES[output.mode],
        output.left_duty,
        output.right_duty,
        output.request,
        output.request_number,
        lateness_us,
        exec_us,
        number,
        plan.search_age_s,
    )


_MODES = {mode: mode.name for mode in DeviceMode}
_DRIVE_MODES = {mode: mode.name for mode in DriveMode}


# typed: a switch and a fault of the same bits are equal
@lru_cache(maxsize=None, typed=True)
def _names(bits: Switches | DeviceFault) -> tuple[str, ...]:
    return tuple(str(bit.name) for bit in type(bits) if bit in bits)


def limits_held(safety: SafetyState, output: Duty, plan: Plan) -> tuple[str, ...]:
    """Return the limits that hold the force back; none while the device is not driven."""
    return tuple(dict.fromkeys((*plan.limits, *output.limits))) if safety.is_driven else ()


def snapshot(
    tick: TickRecord,
    sequence: int,
    is_homed: bool,
    is_busy: bool,
    age_s: float | None,
    belief: dict[str, BeliefReport],
    handle: tuple[float, float] | None = None,
    verdict: Verdict | None = None,
    mark: Mark | None = None,
    beside: tuple[str, ...] = (),
) -> Telemetry:
    known = tick.left_mm is not None and tick.right_mm is not None
    left, right = tick.left_mm or 0.0, tick.right_mm or 0.0
    return Telemetry(
        v=VERSION,
        t_ns=tick.t_ns,
        seq=sequence,
        operating_state=tick.operating_state,
        is_homed=is_homed,
        is_busy=is_busy,
        setpoint_cf=tick.setpoint_cf,
        governed_cf=tick.governed_cf,
        measured_cf=tick.measured_cf,
        predicted_cf=tick.predicted_cf,
        # no field is planned for a gap that is open or opening
        field_mT=None if tick.governed_cf is None else tick.field_mT,
        gap_mm=left + right if known else None,
        gap_setpoint_mm=tick.reference_gap_mm,
        measured_jp=(left, right) if known else None,
        skew_mm=left - right if known else None,
        duty=(tick.left_duty, tick.right_duty),
        limits=tick.limits + beside,
        faults=tick.faults,
        setpoint_age_ms=None if age_s is None else age_s * 1e3,
        confidence=tick.confidence,
        tick=Tick(lateness_us=tick.lateness_us, exec_us=tick.exec_us),
        belief=belief,
        search_age_ms=tick.search_age_s * 1e3,
        handle_mm=None if handle is None else handle[0],
        handle_mm_s=None if handle is None else handle[1],
        verdict=verdict,
        mark=mark,
    )
