"""The ROS 2 example's translation, with stand-ins for CRTK's messages."""

import math
import runpy
from pathlib import Path
from types import SimpleNamespace

import msgspec
import pytest

from tormagd_client.messages import Motion, Setpoint, Telemetry, Tick, decode
from tormagd_client.wire import Numbering

translation = SimpleNamespace(**runpy.run_path(str(Path(__file__).parents[2] / "examples" / "ros2" / "translation.py")))

STATE = Telemetry(
    v=1,
    t_ns=1_800_000_000_250_000_000,
    seq=7,
    operating_state="ENABLED",
    is_homed=True,
    is_busy=False,
    setpoint_cf=1.5,
    governed_cf=1.5,
    measured_cf=1.48,
    predicted_cf=1.5,
    field_mT=90.0,
    gap_mm=60.0,
    gap_setpoint_mm=60.0,
    measured_jp=(30.0, 29.0),
    skew_mm=0.5,
    duty=(0.1, 0.1),
    limits=(),
    faults=(),
    setpoint_age_ms=1.0,
    confidence=1.0,
    tick=Tick(lateness_us=20.0, exec_us=60.0),
)


def wrench(force_N=0.0, sec=0, nanosec=0):
    stamp = SimpleNamespace(sec=sec, nanosec=nanosec)
    vector = SimpleNamespace(x=0.0, y=0.0, z=force_N)
    return SimpleNamespace(header=SimpleNamespace(stamp=stamp), wrench=SimpleNamespace(force=vector))


def test_a_wrench_along_the_shaft_is_a_setpoint_for_the_time_of_its_header():
    setpoint = decode(
        Numbering("ros2").setpoint(valid_for_ms=100.0, **translation.setpoint_of(wrench(1.4, 1_800_000_000, 5))),
        Setpoint,
    )
    assert (setpoint.servo_cf, setpoint.stamp_ns) == (1.4, 1_800_000_000_000_000_005)
    assert translation.setpoint_of(wrench(1.4))["stamp_ns"] is None


def test_commands_are_those_of_the_daemon_and_others_are_named():
    assert translation.command_of(SimpleNamespace(string="home")) == "home"
    with pytest.raises(ValueError, match="'unhome': allowed are home, enable, disable, pause, resume"):
        translation.command_of(SimpleNamespace(string="unhome"))


def test_telemetry_becomes_crtk_with_its_units_and_its_time():
    force = translation.fill_header(translation.fill_force(wrench(), STATE.measured_cf), STATE)
    assert (force.wrench.force.z, force.header.stamp.sec, force.header.stamp.nanosec) == (
        1.48,
        1_800_000_000,
        250_000_000,
    )
    joints = translation.fill_joints(SimpleNamespace(name=[], position=[]), STATE)
    assert (joints.name, joints.position) == (["left", "right"], [0.03, 0.029])
    state = translation.fill_operating_state(SimpleNamespace(), STATE)
    assert (state.state, state.is_homed, state.is_busy) == ("ENABLED", True, False)


def test_the_handle_is_a_joint_of_its_own_with_the_time_at_which_it_was_read():
    motion = Motion(v=1, t_ns=1_800_000_000_000_000_007, device_s=3.0, handle_mm=-12.0, handle_mm_s=40.0)
    handle = translation.fill_header(translation.fill_handle(wrench(), motion), motion)
    assert (handle.name, handle.position, handle.velocity) == (["handle"], [-0.012], [0.04])
    assert (handle.header.stamp.sec, handle.header.stamp.nanosec) == (1_800_000_000, 7)


def test_what_is_not_known_is_not_a_number():
    unknown = msgspec.structs.replace(STATE, measured_cf=None, measured_jp=None)
    assert math.isnan(translation.fill_force(wrench(), unknown.measured_cf).wrench.force.z)
    assert translation.fill_joints(SimpleNamespace(name=[], position=[]), unknown).position == []
