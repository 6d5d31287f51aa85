"""The daemon on a CAN bus, from arming to a device that goes away and comes back."""

import signal

import pytest

pytestmark = pytest.mark.live


def test_a_device_on_a_can_bus_is_driven_lost_and_found_again_without_re_arming(can_rig):
    can_rig.arm()
    can_rig.ask(1.5)
    can_rig.until(lambda: abs((can_rig.telemetry().measured_cf or 0.0) - 1.5) < 0.1, "1.5 N")
    can_rig.ask(1.8)
    can_rig.until(lambda: (can_rig.telemetry().gap_setpoint_mm or 95.0) < 66.0, "in motion")
    can_rig.end(can_rig.simulator, signal.SIGKILL)
    can_rig.until(lambda: "LINK_LOST" in can_rig.status()["faults"], "the loss is named")
    assert can_rig.status()["link"]["cause"]
    assert can_rig.status()["link"]["remedy"]
    can_rig.start_simulator()
    can_rig.until(lambda: can_rig.status()["link"]["state"] == "RUNNING", "the link runs again")
    assert can_rig.status()["operating_state"] == "FAULT"
    can_rig.until(lambda: not can_rig.status()["is_busy"], "the returned device is at rest")
    can_rig.done("clear-fault")
    can_rig.ask(0.5)
    can_rig.until(lambda: can_rig.telemetry().setpoint_cf == 0.5, "neutral again")
    assert can_rig.status()["operating_state"] == "DISABLED"
    assert not can_rig.status()["is_homed"]
    can_rig.arm()
