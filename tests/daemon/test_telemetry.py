import math
import time
from typing import Any

import msgspec
import pytest

from firmware_protocol.codec import DeviceFault, DeviceMode, DriveMode, Switches
from tormagd.config import Config
from tormagd.control.assembly.build import Core
from tormagd.control.believe.strength import DeviceFit
from tormagd.control.core import Stepper
from tormagd.control.move.actuator import Reference
from tormagd.control.records import Duty, Outside, Plan
from tormagd.control.safety.codes import Fault, Limit
from tormagd.control.safety.operating_state import OperatingState, SafetyState
from tormagd.daemon.verdict import ARRIVES, CANNOT, RENDERED, ForceDelay, Judged, judged
from tormagd.element.model.features import FEATURES
from tormagd.hardware.link_statistics import LinkQuality
from tormagd.hardware.measurement import DeviceRequest, Measurement
from tormagd.record.stream import Moment, limits_held, snapshot
from tormagd.record.ticks import encode_ticks
from tormagd.scenes.scene import Budget, load_scene
from tormagd_client.messages import BeliefReport, Telemetry, decode, encode

PLAN = Plan(7, 1.0, 1.5, 0.01, 1.4, 1.38, 500.0, 64.0, -1.0, 0.9, (Limit.RANGE, Limit.SKEW))
BELIEF = {"scale": BeliefReport(value=1.02, sd=0.04, unit="", acts=True)}
OUTPUT = Duty(DriveMode.RUN, 0.1, -0.2, DeviceRequest.NONE, 0, (Limit.SKEW, Limit.RATE))
MEASUREMENT = Measurement(
    number=1,
    received_s=1.0,
    device_time_s=0.5,
    left_mm=-15.0,
    right_mm=-15.5,
    left_current_A=0.3,
    right_current_A=0.4,
    force_N=1.39,
    handle_mm=3.0,
    mode=DeviceMode.RUN,
    switches=Switches.HOMED,
    faults=DeviceFault(0),
    temperature_C=25.0,
    supply_V=12.1,
    sensed_s=1.0,
    reported_s=1.0,
)


def stepped(safety: SafetyState, measurement: Measurement | None, now_s: float = 1.0) -> Stepper:
    stepper = Stepper(Config(), load_scene("coronary"), now_s)
    stepper.safety = safety
    if measurement is not None:
        stepper.measure.begin(measurement)
    return stepper


def telemetry(
    measurement: Measurement | None, safety: SafetyState, reference: Reference | None = None, is_busy: bool = False
) -> Telemetry:
    stepper = stepped(safety, measurement)
    stepper.move.reference = reference
    tick = Moment(stepper, OUTPUT, PLAN, measurement, 20.0, 150.0).row()
    is_homed = stepper.measured is not None and stepper.measured.is_homed
    return decode(
        encode(snapshot(tick, seq=3, is_homed=is_homed, is_busy=is_busy, setpoint_age_ms=12.0, belief=BELIEF)),
        Telemetry,
    )


NOT_KNOWN = {"gap_mm": None, "measured_jp": None, "skew_mm": None, "gap_setpoint_mm": None}


@pytest.mark.parametrize(
    ("published", "known"),
    [
        (
            telemetry(MEASUREMENT, SafetyState(OperatingState.ENABLED), Reference(64.2)),
            {
                "measured_jp": (32.5, 32.0),
                "belief": BELIEF,
                "gap_mm": 64.5,
                "skew_mm": 0.5,
                "gap_setpoint_mm": 64.2,
                "setpoint_cf": 1.5,
                "governed_cf": 1.4,
                "predicted_cf": 1.38,
                "measured_cf": 1.39,
                "duty": (0.1, -0.2),
                "setpoint_age_ms": pytest.approx(12.0),
                "is_homed": True,
                "is_busy": False,
                "operating_state": "ENABLED",
                # each limit once, the plan's first
                "limits": ("RANGE", "SKEW", "RATE"),
            },
        ),
        (
            telemetry(MEASUREMENT.replaced(switches=Switches(0), mode=DeviceMode.HOMING), SafetyState(), is_busy=True),
            NOT_KNOWN | {"is_homed": False, "is_busy": True, "measured_cf": 1.39},
        ),
        (telemetry(None, SafetyState()), NOT_KNOWN | {"is_homed": False, "is_busy": False, "measured_cf": None}),
    ],
    ids=["driven", "before homing", "without a device"],
)
def test_what_is_known_is_published_and_the_rest_is_null(published: Telemetry, known: dict[str, Any]) -> None:
    assert {name: getattr(published, name) for name in known} == known
    assert (published.tick.lateness_us, published.tick.exec_us) == (20.0, 150.0)


def test_a_tick_is_recorded_whole() -> None:
    measurement = MEASUREMENT.replaced(
        number=11,
        received_s=1.25,
        device_time_s=2.25,
        switches=Switches.HOMED | Switches.LEFT_OPEN,
        faults=DeviceFault.SUPPLY | DeviceFault.SKEW,
        temperature_C=25.5,
        sensed_s=1.2505,
        reported_s=1.2405,
        delay_s=0.031,
        link=LinkQuality(0.021, 0.022, 0.023, 0.00071, -0.0005),
    )
    plan = Plan(
        number=7,
        time_s=1.125,
        setpoint_N=1.5,
        setpoint_age_s=0.012,
        governed_N=1.4,
        predicted_N=1.38,
        field_mT=500.0,
        gap_mm=64.0,
        gap_speed_mm_s=-1.0,
        confidence=0.9,
        limits=(Limit.RANGE,),
        gap_acceleration_mm_s2=-7.5,
        foresight=0.75,
        min_gap_mm=31.0,
        outside=(Outside("rate_mm_s", 1 / 3, 300.0),),
        sensor_doubted_s=0.0625,
        trim=1.1,
        search_age_s=0.0125,
    )
    safety = SafetyState(OperatingState.PAUSED, (Fault.SKEW, Fault.SENSOR), DeviceRequest.CLEAR, 99)
    stepper = stepped(safety, measurement, 1.5)
    stepper.move.reference = Reference(64.2)
    output = Duty(DriveMode.RUN, 0.1, -0.2, DeviceRequest.HOME, 5, (Limit.RATE,))
    tick = Moment(stepper, output, plan, measurement, 20.0, 150.0, 9).row()
    sent = msgspec.msgpack.decode(encode_ticks([tick]))
    row = dict(zip(sent["columns"], sent["rows"][0], strict=True))
    assert abs(row.pop("t_ns") - time.time_ns()) < 60_000_000_000
    assert row == {
        "monotonic_s": 1.5,
        "plan": 7,
        "setpoint_cf": 1.5,
        "plan_setpoint_age_s": 0.012,
        "governed_cf": 1.4,
        "plan_governed_cf": 1.4,
        "predicted_cf": 1.38,
        "field_mT": 500.0,
        "plan_gap_mm": 64.0,
        "plan_gap_speed_mm_s": -1.0,
        "plan_gap_acceleration_mm_s2": -7.5,
        "plan_least_gap_mm": 31.0,
        "plan_limits": ["RANGE"],
        "plan_outside": ["rate_mm_s 0.3333333333333333 300.0"],
        "plan_sensor_doubted_s": 0.0625,
        "foresight": 0.75,
        "plan_time_s": 1.125,
        "confidence": 0.9,
        "trim": 1.1,
        "measurement": 11,
        "received_s": 1.25,
        "delay_s": 0.031,
        "sensed_s": 1.2505,
        "reported_s": 1.2405,
        "link_unanswered": 0.021,
        "link_damaged": 0.022,
        "link_unsent": 0.023,
        "link_round_trip_s": 0.00071,
        "device_clock_drift": -0.0005,
        "device_time_s": 2.25,
        "device_left_mm": -15.0,
        "device_right_mm": -15.5,
        "device_handle_mm": 3.0,
        "device_force_N": 1.39,
        "device_mode": "RUN",
        "device_switches": ["LEFT_OPEN", "HOMED"],
        "device_faults": ["SUPPLY", "SKEW"],
        "device_temperature_C": 25.5,
        "left_current_A": 0.3,
        "right_current_A": 0.4,
        "supply_V": 12.1,
        "reference_gap_mm": 64.2,
        "measured_cf": stepper.measured.force_N,
        "left_mm": 32.5,
        "right_mm": 32.0,
        "handle_mm": stepper.measured.handle_mm,
        "handle_rate_mm_s": stepper.measured.handle.rate_mm_s,
        "operating_state": "PAUSED",
        "limits": ["RANGE", "RATE"],
        "step_limits": ["RATE"],
        "faults": ["SKEW", "SENSOR"],
        "drive_mode": "RUN",
        "left_duty": 0.1,
        "right_duty": -0.2,
        "request": "home",
        "request_number": 5,
        "lateness_us": 20.0,
        "exec_us": 150.0,
        "tick": 9,
        "search_age_s": 0.0125,
        "plan_stamp_s": -math.inf,
    }


@pytest.mark.parametrize("present", OperatingState)
def test_nothing_is_governed_or_holds_back_while_the_device_is_not_driven(present: OperatingState) -> None:
    is_driven = present in (OperatingState.ENABLED, OperatingState.PAUSED)
    published = telemetry(MEASUREMENT, SafetyState(present))
    assert bool(limits_held(SafetyState(present), OUTPUT, PLAN)) == is_driven
    assert (published.governed_cf, published.setpoint_cf, published.field_mT is not None) == (
        1.4 if is_driven else None,
        1.5,
        is_driven,
    )


# -- the way of a setpoint ---------------------------------------------------------------------------------------------


def test_each_setpoint_ends_its_way_once_with_the_first_duty_that_follows_it() -> None:
    way = ForceDelay()
    way.ticked(0.5, PLAN, 0.0)  # it follows no setpoint
    found = way.report(400.0, 0.013, Budget())
    assert (found.to_duty_us.max, found.total_ms) == (0.0, None)
    for tick in range(1_000):
        # a new one every 10 ms, first followed at 20 ms
        way.ticked(1.0 + tick * 1e-3, PLAN.replaced(stamp_s=1.0 + tick // 10 * 0.01 - 0.015), 0.005)
    found = way.report(400.0, 0.013, Budget())
    assert (found.to_duty_us.max, found.to_duty_us.p50) == (
        pytest.approx(20_000.0, abs=1.0),
        pytest.approx(20_000.0, rel=0.04),
    )
    assert (found.device_us, found.carriages_ms, found.total_ms) == (
        400.0,
        13.0,
        pytest.approx(20.0 + 0.4 + 13.0, abs=0.7),
    )
    # a stale one ends no way
    way.ticked(9.0, PLAN, 0.0)
    found = way.report(None, 0.013, Budget())
    assert (found.to_duty_us.max, found.total_ms) == (pytest.approx(20_000.0, abs=1.0), None)


def test_the_ways_budget_is_the_scenes_where_it_states_one() -> None:
    assert [ForceDelay().report(None, 0.0, each).budget_ms for each in (Budget(delay_ms=150.0), Budget())] == [
        150.0,
        400.0,
    ]


# -- verdicts ----------------------------------------------------------------------------------------------------------


CARRIAGES = {"gap_speed_mm_s": 40.0, "lag_s": 0.01, "tolerance_N": 0.05, "release_N_s": 2.0}
STRONG = DeviceFit(scale=1.25)


def plan(asked_N: float | None = 1.5, limits: tuple[Limit, ...] = (), **fields: Any) -> Plan:
    known: dict[str, Any] = {"predicted_N": None, "field_mT": 90.0, "gap_mm": math.nan, "gap_speed_mm_s": 0.0}
    return Plan(1, 1.0, asked_N, 0.01, asked_N or 0.5, confidence=1.0, limits=limits, **known | fields)


def found(
    core: Core,
    planned: Plan,
    shown_N: float = 1.0,
    state: OperatingState = OperatingState.ENABLED,
    device: DeviceFit = STRONG,
) -> Judged:
    gap_mm = core.portrait.gap_mm_at(device.model_N(shown_N))
    if math.isnan(planned.gap_mm):
        planned = planned.replaced(gap_mm=core.portrait.gap_mm_at(device.model_N(planned.governed_N)))
    return judged(planned, state, gap_mm, core.portrait, device, **CARRIAGES)


@pytest.mark.parametrize(("shown_N", "is_rendered"), [(1.449, False), (1.451, True), (1.549, True), (1.551, False)])
def test_it_is_rendered_within_what_the_scene_tolerates(core: Core, shown_N: float, is_rendered: bool) -> None:
    judgement = found(core, plan(1.5), shown_N)
    assert (judgement == Judged(RENDERED, 0.0), judgement.outcome == ARRIVES) == (is_rendered, not is_rendered)


def test_the_gap_is_held_against_the_plans_with_the_elements_memory_in_it(core: Core) -> None:
    planned_mm = core.portrait.gap_mm_at(STRONG.model_N(1.5)) - 3.0
    planned = plan(1.5, gap_mm=planned_mm)
    assert judged(planned, OperatingState.ENABLED, planned_mm, core.portrait, STRONG, **CARRIAGES).outcome == RENDERED
    judgement = judged(planned, OperatingState.ENABLED, planned_mm + 8.0, core.portrait, STRONG, **CARRIAGES)
    assert judgement == (ARRIVES, pytest.approx(1e3 * (8.0 / 40.0 + 0.01), abs=0.051), ())


def test_it_arrives_when_the_gap_has_gone_there_and_the_carriages_have_come(core: Core) -> None:
    way_mm = core.portrait.gap_mm_at(0.8) - core.portrait.gap_mm_at(1.2)
    judgement = found(core, plan(1.5), 1.0)
    assert judgement == (ARRIVES, pytest.approx(1e3 * (way_mm / 40.0 + 0.01), abs=0.051), ())
    assert found(core, plan(1.0), 1.5).arrives_ms == judgement.arrives_ms
    # the ramp begins where the gap is open
    on_its_way = plan(1.5, (Limit.TAKEOVER, Limit.F_MIN)).replaced(governed_N=0.5)
    assert found(core, on_its_way, 0.5).arrives_ms == pytest.approx(1e3 * (1.0 / 2.0 + 0.01))


@pytest.mark.parametrize(
    ("asked_N", "limits", "outside", "why"),
    [
        (3.0, (Limit.RANGE,), None, ("RANGE",)),
        (3.0, (Limit.RANGE, Limit.F_MAX, Limit.RATE), None, ("RANGE", "F_MAX")),
        (3.0, (Limit.STANDBY, Limit.OTHER_SOURCE), None, ("STANDBY",)),
        (0.1, (Limit.F_MIN,), None, ("F_MIN",)),
        (None, (Limit.STALE, Limit.SENSOR), None, ("STALE",)),
        (None, (Limit.STALE, Limit.OTHER_SOURCE), None, ("STALE", "OTHER_SOURCE")),
        *(
            (1.5, (limit,), None, ())
            for limit in (Limit.RATE, Limit.TAKEOVER, Limit.OTHER_SOURCE, Limit.LOW_CONFIDENCE)
        ),
        (1.5, (Limit.MODEL_RANGE,), Outside("rate_mm_s", 300.0, 84.0), ()),
        (1.5, (Limit.MODEL_RANGE,), Outside(FEATURES[2], 120.0, 100.0), ("MODEL_RANGE",)),
    ],
)
def test_it_cannot_where_a_limit_holds_it(
    core: Core, asked_N: float | None, limits: tuple[Limit, ...], outside: Outside | None, why: tuple[str, ...]
) -> None:
    judgement = found(core, plan(asked_N, limits, outside=(outside,) if outside else ()))
    assert (judgement.outcome, judgement.arrives_ms is None, judgement.why) == (
        CANNOT if why else ARRIVES,
        bool(why),
        why,
    )


def test_the_ceiling_holds_what_is_beyond_it_and_not_what_it_lets_pass(core: Core) -> None:
    held = {"min_gap_mm": core.portrait.gap_mm_at(STRONG.model_N(1.6)), "limits": (Limit.CEILING,)}
    assert found(core, plan(1.8, **held)) == (CANNOT, None, ("CEILING",))
    assert found(core, plan(1.5, **held)).outcome == ARRIVES


@pytest.mark.parametrize("state", [OperatingState.DISABLED, OperatingState.PAUSED, OperatingState.FAULT])
def test_a_device_that_does_not_follow_says_its_state(core: Core, state: OperatingState) -> None:
    assert found(core, plan(1.5), 1.5, state) == (CANNOT, None, (str(state),))
    assert judged(plan(1.5), state, None, core.portrait, STRONG, **CARRIAGES).why == (str(state),)
