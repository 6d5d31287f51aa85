"""Clocks and counters through where they roll over: shifted to just before, the core gives the same duties."""

import math

import pytest

from tormagd.control.assembly.build import Core
from tormagd.control.records import Duty, TimedSetpoint
from tormagd.control.safety.operating_state import Conditions
from tormagd.daemon.inbox import SetpointInbox
from tormagd.simulation.closed_loop import Sample
from tormagd_client.messages import Setpoint, encode

LASTS_S, BEFORE_S = 1.5, 0.7
"How long a repeated run takes, and how long before the rollover it begins."
SENT_HZ = 137.3
"Out of step with the forecast's grid, where the last digit of a stamp would decide."
SAME_DUTY = 1e-4
"One step on the wire: a clock of coarser floats may change as much."
READY = Conditions(True, True, True, False, False)


def swinging(now_s: float) -> TimedSetpoint:
    at_s = math.floor(now_s * SENT_HZ) / SENT_HZ
    return TimedSetpoint(1.3 + 0.4 * math.sin(3.0 * at_s), at_s, 0.1)


@pytest.fixture(scope="module")
def recorded(arm) -> list[Sample]:
    return list(arm().run(LASTS_S, swinging))


def duties(core: Core, recorded: list[Sample], device_s: float, host_s: float) -> list[Duty]:
    begins_s = host_s + recorded[0].time_s
    stepper, planner = core.stepper(begins_s), core.planner(begins_s)
    found: list[Duty] = []
    for tick, sample in enumerate(recorded):
        now_s, setpoint = host_s + sample.time_s, swinging(sample.time_s)
        shifted = sample.measurement.replaced(
            received_s=host_s + sample.measurement.received_s,
            sensed_s=host_s + sample.measurement.sensed_s,
            reported_s=host_s + sample.measurement.reported_s,
            device_time_s=device_s + sample.measurement.device_time_s,
        )
        found.append(stepper.step(now_s, shifted, planner.planned))
        if tick == 3:
            stepper.command("enable", now_s, READY)
        if tick % 4 == 0:
            planner.plan(now_s, setpoint.replaced(stamp_s=host_s + setpoint.stamp_s), stepper.measured)
            planner.foresee()
    return found


@pytest.mark.parametrize(
    ("device_s", "host_s"),
    [
        pytest.param(2.0**32 * 1e-6, BEFORE_S, id="device clock through 2^32 us"),
        pytest.param(2.0**32 * 1e-3, BEFORE_S, id="device clock through 2^32 ms"),
        pytest.param(BEFORE_S, 2.0**32 * 1e-6, id="host clock through 2^32 us"),
        pytest.param(BEFORE_S, 2.0**53 * 1e-9, id="host clock through 2^53 ns"),
        pytest.param(2.0**53 * 1e-9, 2.0**53 * 1e-9, id="both through 2^53 ns"),
    ],
)
def test_a_rollover_changes_no_duty(core: Core, recorded: list[Sample], device_s: float, host_s: float) -> None:
    usual = duties(core, recorded, 0.0, 0.0)
    assert max(abs(duty.left_duty) for duty in usual) > 0.1
    for ours, duty in zip(duties(core, recorded, device_s - BEFORE_S, host_s - BEFORE_S), usual, strict=True):
        assert (ours.left_duty, ours.right_duty) == pytest.approx((duty.left_duty, duty.right_duty), abs=SAME_DUTY)


def stamped_s(base_ns: int) -> float:
    inbox = SetpointInbox()
    for ago_ns in (4 * 10**6, 3 * 10**6, 2 * 10**6, 10**6):
        at_ns = base_ns - ago_ns
        sent = Setpoint(v=1, source="a", seq=at_ns, stamp_ns=at_ns, servo_cf=1.0, valid_for_ms=100.0)
        inbox.take(encode(sent), 5.0 - ago_ns * 1e-9 + 1e-3, at_ns + 10**6)
    assert inbox.newest is not None, inbox.last_refusal
    return inbox.newest.stamp_s


@pytest.mark.parametrize("at_ns", [2**53, 2**62, 2**63 - 1])
def test_a_large_stamp_is_taken_as_any_other(at_ns: int) -> None:
    assert stamped_s(at_ns - 10**7) == pytest.approx(stamped_s(10**9), abs=1e-9)
