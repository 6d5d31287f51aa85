"""The stream: what the core got and made, tick by tick.

    row       what a step concluded, and then every field of plan, duty, measurement and link, in their own order
    COLUMNS   the fields' names: a field that a record gets is a column without another word
    Journal   all inputs of the core, in their order: a replay runs the core again from them and a snapshot

Black box, recording, replay and telemetry read these; docs/reference/ticks.md lists the columns. `plan` and `step` are
deterministic, and so is the conversation with the device, given what was read and when. Their results stand in the
journal for comparison only.
"""

import hashlib
import math
import time
from collections.abc import Mapping
from functools import lru_cache
from operator import attrgetter
from typing import Any, Final, final

import msgspec

from firmware_protocol.codec import DeviceFault, DeviceMode, Identity, Sense, State, Status, Switches
from firmware_protocol.framing import Frame, FramingStatistics
from firmware_protocol.value import Value
from tormagd.config import Config
from tormagd.control.ask.forecast import Skill
from tormagd.control.believe.believe import MIN_FORESIGHT, Learned
from tormagd.control.believe.sensor_zero import Level
from tormagd.control.believe.strength import DeviceFit
from tormagd.control.core import Planner, Stepper
from tormagd.control.measure import Leap
from tormagd.control.move.actuator import Reference
from tormagd.control.records import Duty, Handle, Measured, Outside, Plan, TimedSetpoint, Travel, Wall
from tormagd.control.safety.codes import Fault, Limit
from tormagd.control.safety.operating_state import Conditions, OperatingState, SafetyState
from tormagd.element.inverse.solution import Answer, FieldSolution, Question, Reach
from tormagd.element.model.displacement import Turn
from tormagd.ground.plain_values import kinds, plain
from tormagd.hardware.link import LinkState
from tormagd.hardware.link_statistics import LinkQuality
from tormagd.hardware.measurement import DeviceRequest, Measurement
from tormagd.scenes.scene import Scene, Terms
from tormagd_client.messages import VERSION, BeliefReport, Telemetry, Tick

FORMAT = 25
"Version of entries, states and times: raised when one comes, goes or changes its meaning. No other is rerun."
KNOWN = kinds(
    *(SafetyState, OperatingState, DeviceRequest, Fault, Limit, Conditions, DeviceMode, Switches, DeviceFault),
    *(Measured, Handle, Travel, Turn, TimedSetpoint, Wall, Leap, Reference, Plan, Outside),
    *(DeviceFit, Level, Learned, Skill, Question, Answer, FieldSolution, Reach),
    *(LinkState, LinkQuality, Identity, State, Sense, Status, Frame, FramingStatistics),
)
"All types that `plain_values` reads back."
STEP = "step"
"A step is about to run; its inputs are in the tick that follows."
PLAN, FORESEE, AFRESH = "plan", "foresee", "afresh"
"`[PLAN, now_s, setpoint]`, `[FORESEE]`; `[AFRESH, now_s]` where one of them failed, and planning began anew."
TEACH, CONFIRM, ANSWER = "teach", "confirm", "answer"
"What is known from another day, an operator's word in a dispute, and what a search beside the plans found."
COMMAND, LATCH, LOSE_LINK = "command", "latch", "lose_link"
"`[COMMAND, name, now_s, is_refused, conditions]`, `[LATCH, fault]`, `[LOSE_LINK]`."
TOLD, MISSING = "told", "missing"
"No inputs of the core, as what `Connection.traffic` hears: a snapshot as published, and that other entries were lost."
STATE = "state"
"`[STATE, stepper, planner, connection, core_hash]`: a replay may begin here."
MAX_ENTRIES = 4_096
"When this many entries were not taken, MISSING takes their place."


def core_hash(config: Config, scene: Scene, model: str) -> str:
    """Return what tells one core from another."""
    return hashlib.sha256(msgspec.json.encode((config, scene, model))).hexdigest()


class Journal:
    """The core's inputs since the last `take`, as entries: a tick, or a name and what belongs to it."""

    def __init__(self, *, is_kept: bool = True) -> None:
        self.is_kept = is_kept
        self._entries: list[Any] = []

    def note(self, name: str, *what: Any) -> None:
        self.add((name, *what))

    def take(self) -> list[Any]:
        """Return and remove all entries, ticks as rows: a row after others takes a quarter."""
        entries, self._entries = self._entries, []
        return [each.row() if isinstance(each, Moment) else each for each in entries]

    def lose(self) -> None:
        """Forget all; MISSING takes their place."""
        self._entries = [(MISSING,)] if self.is_kept else []

    def add(self, entry: Any) -> None:
        if not self.is_kept:
            return
        if len(self._entries) >= MAX_ENTRIES:
            self.lose()
        self._entries.append(entry)


def _of_value(thing: Any) -> Any:
    if type(thing) is TimedSetpoint:
        return [getattr(thing, name) for name in thing.__match_args__]
    return plain(thing)


packed = msgspec.msgpack.Encoder(enc_hook=_of_value).encode
TIME_COLUMN = "t_ns"


def _columns(record: type[Value], prefix: str, without: str, named: Mapping[str, str]) -> tuple[tuple[str, ...], Any]:
    """Return a record's columns, and what reads them."""
    fields = [name for name in record.__match_args__ if name not in without.split()]
    return tuple([named.get(name, prefix + name) for name in fields]), attrgetter(*fields)


CONCLUDED = (
    *("governed_cf", "reference_gap_mm", "measured_cf", "left_mm", "right_mm", "handle_mm", "handle_rate_mm_s"),
    *("operating_state", "faults", "limits", "plan_outside", "drive_mode"),
    *("device_mode", "device_switches", "device_faults", "tick", "lateness_us", "exec_us"),
)
"What is no number in its record, or in none."
OF_PLAN, _of_plan = _columns(
    *(Plan, "plan_", "outside"),
    {name: name for name in ("field_mT", "foresight", "confidence", "trim", "search_age_s")}
    | {"number": "plan", "setpoint_N": "setpoint_cf", "governed_N": "plan_governed_cf"}
    | {"predicted_N": "predicted_cf", "min_gap_mm": "plan_least_gap_mm"},
)
OF_DUTY, _of_duty = _columns(Duty, "", "mode", {"limits": "step_limits"})
OF_MEASUREMENT, _of_measurement = _columns(
    *(Measurement, "", "mode switches faults link"),
    {name: f"device_{name}" for name in ("left_mm", "right_mm", "force_N", "handle_mm", "temperature_C")}
    | {"number": "measurement"},
)
OF_LINK, _of_link = _columns(LinkQuality, "link_", "", {"clock_drift": "device_clock_drift"})
COLUMNS = (TIME_COLUMN, "monotonic_s", *OF_PLAN, *CONCLUDED, *OF_DUTY, *OF_MEASUREMENT, *OF_LINK)
_UNKNOWN = (None,) * len(OF_MEASUREMENT + OF_LINK)


def kind_of(column: str) -> Any:
    """Return the type of a column's values by its name."""
    if column.endswith(("limits", "faults", "switches", "outside")):
        return tuple[str, ...]
    if column in ("request", "operating_state", "drive_mode", "device_mode"):
        return str | None
    return {TIME_COLUMN: int, "monotonic_s": float}.get(column, float | int | None)


TickRecord: Any = msgspec.defstruct(
    "TickRecord",
    [(name, kind_of(name)) for name in COLUMNS],
    array_like=True,
    frozen=True,
    gc=False,
    forbid_unknown_fields=True,
)
"A row whose values have their columns' names."


@final
class Moment:
    """A tick by reference, until its row is read."""

    def __init__(
        self,
        stepper: Stepper,
        output: Duty,
        plan: Plan,
        measurement: Measurement | None,
        lateness_us: float,
        exec_us: float,
        number: int = 0,
    ) -> None:
        self.time_s: Final = stepper.time_s
        self._of_core: Final = stepper.measured, stepper.safety, stepper.move.reference, output, plan, measurement
        self._of_tick: Final = time.time_ns(), (number, lateness_us, exec_us)

    def row(self) -> Any:
        (measured, safety, reference, output, plan, measurement), (time_ns, timing) = self._of_core, self._of_tick
        return TickRecord(
            *(time_ns, self.time_s),
            *_of_plan(plan),
            plan.governed_N if safety.is_driven else None,
            None if reference is None else reference.gap_mm,
            None if measured is None else measured.force_N,
            measured.left_mm if measured is not None and measured.is_homed else None,
            measured.right_mm if measured is not None and measured.is_homed else None,
            None if measured is None else measured.handle_mm,
            None if measured is None else measured.handle.rate_mm_s,
            *(safety.operating_state, safety.faults, limits_held(safety, output, plan)),
            tuple([f"{each.quantity} {each.asked!r} {each.used!r}" for each in plan.outside]) if plan.outside else (),
            output.mode.name,
            None if measurement is None else measurement.mode.name,
            () if measurement is None else _names(measurement.switches),
            () if measurement is None else _names(measurement.faults),
            *timing,
            *_of_duty(output),
            *(_UNKNOWN if measurement is None else _of_measurement(measurement) + _of_link(measurement.link)),
        )


# typed: a switch and a fault of the same bits are equal
@lru_cache(maxsize=None, typed=True)
def _names(bits: Switches | DeviceFault) -> tuple[str, ...]:
    return tuple(str(bit.name) for bit in type(bits) if bit in bits)


def measurement_of(tick: Any) -> Measurement | None:
    """Return the measurement of which a tick was made."""
    if tick.measurement is None:
        return None
    values = msgspec.structs.astuple(tick)[-len(_UNKNOWN) :]
    if None in values or tick.device_mode is None:
        raise ValueError("a measurement in parts: allowed is a whole one, or none")
    fields = [name for name in Measurement.__match_args__ if name not in ("mode", "switches", "faults", "link")]
    return Measurement(
        **dict(zip(fields, values, strict=False)),
        mode=DeviceMode[tick.device_mode],
        switches=Switches(sum([Switches[name] for name in tick.device_switches])),
        faults=DeviceFault(sum([DeviceFault[name] for name in tick.device_faults])),
        link=LinkQuality(*values[len(fields) :]),
    )


def limits_held(safety: SafetyState, output: Duty, plan: Plan) -> tuple[str, ...]:
    """Return the limits in force; none while the device is not driven."""
    return tuple(dict.fromkeys((*plan.limits, *output.limits))) if safety.is_driven else ()


_SHARED = tuple([name for name in Telemetry.__struct_fields__ if name in COLUMNS])


def snapshot(tick: Any, **told: Any) -> Telemetry:
    """Return the telemetry message of a tick; `told` are fields that are not in it, or are told in another way."""
    known = tick.left_mm is not None and tick.right_mm is not None
    left, right = tick.left_mm or 0.0, tick.right_mm or 0.0
    fields: dict[str, Any] = {name: getattr(tick, name) for name in _SHARED}
    fields |= {
        "v": VERSION,
        # no field is planned for a gap that is open or opening
        "field_mT": None if tick.governed_cf is None else tick.field_mT,
        "gap_mm": left + right if known else None,
        "gap_setpoint_mm": tick.reference_gap_mm,
        "measured_jp": (left, right) if known else None,
        "skew_mm": left - right if known else None,
        "duty": (tick.left_duty, tick.right_duty),
        "tick": Tick(lateness_us=tick.lateness_us, exec_us=tick.exec_us),
        "search_age_ms": tick.search_age_s * 1e3,
    }
    return Telemetry(**(fields | told))


def beliefs(planner: Planner, stepper: Stepper, now_s: float, terms: Terms) -> dict[str, BeliefReport]:
    """Return each thing believed of the device at `now_s`, by name, and whether it acts."""
    believe, plan = planner.believe, planner.planned
    fit, memory, zero_sd_N = believe.fit, believe.memory, believe.zero.sd_N(now_s)
    ripple = max(believe.ripple.shares)
    is_ahead, trust = plan.foresight >= MIN_FORESIGHT, planner.governor.forecast.trust
    told: dict[str, tuple[float, float | None, str, bool]] = {
        "scale": (fit.scale, fit.scale_sd, "", terms.scale),
        "offset": (fit.offset_N, fit.deviation_N(0.0), "N", terms.offset),
        "low_speed_factor": (believe.slow.factor_at(0.0), None, "", terms.creep),
        "sensor_zero": (believe.zero.zero_N, zero_sd_N, "N", believe.knows_zero(now_s)),
        "way": (believe.zero.way, math.sqrt(believe.zero.way_variance), "", believe.zero.way != 0.0),
        "ripple": (ripple, None, "", ripple > 0.0),
        "carriage_lag": (believe.carriages.lag_s, None, "s", terms.motor and is_ahead),
        "acceleration_scale": (stepper.move.acceleration_scale, None, "", stepper.move.reference is not None),
        "forecast_trust": (trust, None, "", trust > 0.0 and plan.foresight > 0.0),
        "relaxed": (memory.relaxed_N, None, "N", memory.relaxed_N != 0.0),
        "field_lag": (memory.lag_mT, None, "mT", memory.lag_mT != 0.0),
    }
    return {
        name: BeliefReport(value=value, sd=sd, unit=unit, acts=acts) for name, (value, sd, unit, acts) in told.items()
    }
