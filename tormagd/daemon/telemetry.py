"""Snapshots of the running daemon, built once per telemetry period; status answers and watchers all read the same."""

import time
from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from tormagd.control.plan import Plan
from tormagd.control.step import StepOutput, StepState
from tormagd.hardware.measurement import Measurement
from tormagd.messages import VERSION, Telemetry, Tick
from tormagd.safety.codes import Explanation, Fault, Limit
from tormagd.safety.operating_state import OperatingState


class TickRow(NamedTuple):
    """One control tick as it is recorded, in the units of `Telemetry`. Times are in ns and s.

    `received_s` (of the clock of `monotonic_s`) and `delay_s` are the measurement's: from them a step decides how old
    it is.
    """

    t_ns: int
    monotonic_s: float
    plan: int
    setpoint_cf: float | None
    governed_cf: float | None
    predicted_cf: float | None
    field_mT: float
    plan_gap_mm: float
    plan_gap_speed_mm_s: float
    plan_gap_acceleration_mm_s2: float
    foresight: float
    plan_time_s: float
    confidence: float
    trim: float
    reference_gap_mm: float | None
    measured_cf: float | None
    left_mm: float | None
    right_mm: float | None
    handle_mm: float | None
    handle_rate_mm_s: float | None
    left_duty: float
    right_duty: float
    left_current_A: float | None
    right_current_A: float | None
    supply_V: float | None
    device_time_s: float | None
    received_s: float | None
    delay_s: float | None
    operating_state: str
    limits: tuple[str, ...]
    faults: tuple[str, ...]
    lateness_us: float
    exec_us: float


def tick_row(
    now_s: float,
    state: StepState,
    output: StepOutput,
    plan: Plan,
    trim: float,
    measurement: Measurement | None,
    lateness_us: float,
    exec_us: float,
) -> TickRow:
    """The row of one tick."""
    estimate = state.estimate
    return TickRow(
        t_ns=time.time_ns(),
        monotonic_s=now_s,
        plan=plan.number,
        setpoint_cf=plan.setpoint_N,
        governed_cf=plan.governed_N if is_driven(state) else None,
        predicted_cf=plan.predicted_N,
        field_mT=plan.field_mT,
        plan_gap_mm=plan.gap_mm,
        plan_gap_speed_mm_s=plan.gap_speed_mm_s,
        plan_gap_acceleration_mm_s2=plan.gap_acceleration_mm_s2,
        foresight=plan.foresight,
        plan_time_s=plan.time_s,
        confidence=plan.confidence,
        trim=trim,
        reference_gap_mm=None if state.reference is None else state.reference.gap_mm,
        measured_cf=None if estimate is None else estimate.force_N,
        left_mm=None if estimate is None or not estimate.is_homed else estimate.left_mm,
        right_mm=None if estimate is None or not estimate.is_homed else estimate.right_mm,
        handle_mm=None if estimate is None else estimate.handle_mm,
        handle_rate_mm_s=None if estimate is None else estimate.handle.rate_mm_s,
        left_duty=output.left_duty,
        right_duty=output.right_duty,
        left_current_A=None if measurement is None else measurement.left_current_A,
        right_current_A=None if measurement is None else measurement.right_current_A,
        supply_V=None if measurement is None else measurement.supply_V,
        device_time_s=None if measurement is None else measurement.device_time_s,
        received_s=None if measurement is None else measurement.received_s,
        delay_s=None if measurement is None else measurement.delay_s,
        operating_state=state.safety.operating_state,
        limits=limits_held(state, output, plan),
        faults=tuple(state.safety.faults),
        lateness_us=lateness_us,
        exec_us=exec_us,
    )


def is_driven(state: StepState) -> bool:
    """Whether the device follows the plan, or holds what it followed last."""
    return state.safety.operating_state in (OperatingState.ENABLED, OperatingState.PAUSED)


def limits_held(state: StepState, output: StepOutput, plan: Plan) -> tuple[str, ...]:
    """What holds the force back now; nothing does while the device is not driven."""
    if not is_driven(state):
        return ()
    return tuple(dict.fromkeys((*plan.limits, *output.limits)))


def snapshot(row: TickRow, sequence: int, is_homed: bool, is_busy: bool, age_s: float | None) -> Telemetry:
    """The telemetry of the newest tick."""
    known = row.left_mm is not None and row.right_mm is not None
    left, right = row.left_mm or 0.0, row.right_mm or 0.0
    return Telemetry(
        v=VERSION,
        t_ns=row.t_ns,
        seq=sequence,
        operating_state=row.operating_state,
        is_homed=is_homed,
        is_busy=is_busy,
        setpoint_cf=row.setpoint_cf,
        governed_cf=row.governed_cf,
        measured_cf=row.measured_cf,
        predicted_cf=row.predicted_cf,
        field_mT=row.field_mT,
        gap_mm=left + right if known else None,
        gap_setpoint_mm=row.reference_gap_mm,
        measured_jp=(left, right) if known else None,
        skew_mm=left - right if known else None,
        duty=(row.left_duty, row.right_duty),
        limits=row.limits,
        faults=row.faults,
        setpoint_age_ms=None if age_s is None else age_s * 1e3,
        confidence=row.confidence,
        tick=Tick(lateness_us=row.lateness_us, exec_us=row.exec_us),
    )


class Stall(NamedTuple):
    """The newest stall of the control loop: how long it stood still, and who is to blame for most of that."""

    took_s: float
    culprit: str

    def __str__(self) -> str:
        return f"the control loop stood still for {self.took_s * 1e3:.0f} ms ({self.culprit})"


def explanations(
    codes: Iterable[str], table: Mapping[Any, Explanation], told: Mapping[str, str] = MappingProxyType({})
) -> list[dict[str, str]]:
    """Each code with its cause and remedy; `told` has causes with the figures of this very time."""
    kind = Fault if Fault.STOPPED in table else Limit
    known = [{"code": str(code), **table[kind(code)]._asdict()} for code in codes]
    return [entry | {"cause": told.get(entry["code"], entry["cause"])} for entry in known]
