"""What the virtual firmware does with motors, switches and encoders, seen through the wire in virtual time.

The rules of the page are the conformance kit's, which it passes (tests/firmware_protocol).
"""

import itertools
from typing import NamedTuple

import pytest

from firmware_protocol.codec import (
    Clear,
    DeviceFault,
    DeviceMode,
    Home,
    Sense,
    State,
    Status,
    Switches,
)
from tormagd.simulation.parameters import load_plant

SAMPLES = ("sample_1", "sample_2", "sample_3")

COMMAND_TIMEOUT_S = 0.05
STATUS_PERIOD_S = 0.02


def count(host, kind) -> int:
    return sum(isinstance(message, kind) for _, message in host.received)


# -- status, and answers to Drives: exactly, where the kit allows for a wire ------------------------------------------


def test_status_comes_fifty_times_a_second_unasked_and_nothing_else_does(make_host) -> None:
    host = make_host()
    host.wait(2.0)
    assert 99 <= count(host, Status) <= 101
    assert len(host.received) == count(host, Status)


def test_each_accepted_drive_is_answered_once_by_state_and_sense(make_host) -> None:
    host = make_host()
    host.heartbeat(0.5)
    host.wait(0.005)
    states = [message for _, message in host.received if isinstance(message, State)]
    assert len(states) == count(host, Sense) == 500
    assert all((after.counter - before.counter) % 256 == 1 for before, after in itertools.pairwise(states))
    host.wait(STATUS_PERIOD_S)
    assert host.status.drive_counter == 500 % 256


# -- what must come before a run -----------------------------------------------------------------------------------


def test_drive_run_moves_nothing_before_homing(make_host) -> None:
    host = make_host()
    host.hello()
    before_mm = host.device.truth.gap_mm
    for _ in range(200):
        host.drive(-1.0, -1.0)
    assert host.status.mode is DeviceMode.IDLE
    assert host.device.truth.gap_mm == before_mm


def test_drive_run_is_refused_without_a_hello(make_host) -> None:
    host = make_host()
    host.command(Home)
    host.heartbeat(3.0)
    assert Switches.HOMED in host.status.switches
    for _ in range(100):
        host.drive(-1.0, -1.0)
    assert host.status.mode is DeviceMode.IDLE
    host.hello()
    for _ in range(100):
        host.drive(-0.5, -0.5)
    assert host.status.mode is DeviceMode.RUN


# -- homing --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SAMPLES)
def test_homing_zeroes_the_encoders_at_the_open_switches_repeatably(make_host, name: str) -> None:
    host = make_host(plant=load_plant(name))
    zeros = []
    for _ in range(2):
        host.home()
        truth, state = host.device.truth, host.last(State)
        zeros.append((truth.left_mm - state.left_position_mm, truth.right_mm - state.right_position_mm))
        assert truth.left_mm == pytest.approx(47.5, abs=0.05)
        assert truth.right_mm == pytest.approx(47.5, abs=0.05)
        assert host.status.switches == Switches.LEFT_OPEN | Switches.RIGHT_OPEN | Switches.HOMED
        host.go_to(80.0, 1.0)
        host.heartbeat(2.0)
    assert [zero for pair in zeros for zero in pair] == pytest.approx([47.5] * 4, abs=0.02)
    assert zeros[0] == pytest.approx(zeros[1], abs=0.01)


def test_homing_without_an_encoder_fails_and_opens(make_host) -> None:
    host = make_host(["encoder_stuck_left"])
    host.command(Home)
    smallest_mm = host.device.truth.gap_mm
    while host.status.mode is not DeviceMode.LATCHED:
        host.heartbeat(0.01)
        assert host.time_s < 20.0
        smallest_mm = min(smallest_mm, host.device.truth.gap_mm)
    assert host.status.faults == DeviceFault.HOMING_FAILED
    assert Switches.HOMED not in host.status.switches
    assert host.device.truth.gap_mm == pytest.approx(95.0, abs=0.6)
    assert smallest_mm > 78.0


def test_duties_are_applied_in_steps_of_ten_bits(running) -> None:
    def travel(duty: float) -> float:
        host = running()
        for _ in range(300):
            host.drive(duty, duty)
        return host.device.truth.gap_mm

    step = 1.0 / 1023.0
    assert travel(512.3 * step) == travel(511.7 * step) == travel(512 * step)
    assert travel(513 * step) > travel(512 * step) > 60.0


# -- ways out of a run ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SAMPLES)
def test_silence_opens_the_gap_and_latches(running, name: str) -> None:
    host = running(plant=name)
    for _ in range(200):  # stand still first
        host.drive(0.0, 0.0)
    stood_mm, silent_s = host.device.truth.gap_mm, host.time_s
    moved_s = safe_s = None
    fastest_mm_s = 0.0
    while host.status.mode is not DeviceMode.LATCHED:
        before_mm = host.device.truth.gap_mm
        host.wait(1e-3)
        truth = host.device.truth
        fastest_mm_s = max(fastest_mm_s, (truth.gap_mm - before_mm) / 1e-3)
        if moved_s is None and truth.gap_mm > stood_mm + 0.05:
            moved_s = host.time_s - silent_s
        if safe_s is None and truth.force_N < 1.0:
            safe_s = host.time_s - silent_s
    assert moved_s is not None
    assert COMMAND_TIMEOUT_S - 1e-3 <= moved_s < COMMAND_TIMEOUT_S + 0.03
    # from 60 mm, with what the sensorless watch waits and the bounded travel
    assert safe_s is not None
    assert 0.3 < safe_s < 0.8
    assert fastest_mm_s < 2 * 20.0
    assert host.status.faults == DeviceFault.COMMAND_TIMEOUT
    assert Switches.HOMED not in host.status.switches
    assert host.device.truth.gap_mm == pytest.approx(95.0, abs=0.6)
    assert host.device.truth.left_A == 0.0


class Ending(NamedTuple):
    """How a run from a gap of `gap_mm` ends, with these faults of the device, while the host drives so."""

    faults: tuple[str, ...]
    duties: tuple[float, float] | None
    "None: it falls silent."
    gap_mm: float
    at_once: DeviceFault
    "What is latched when it is out of RUN."
    latched: DeviceFault
    "And once the drives are off."
    left_mm: float
    right_mm: float
    "Where the carriages are then."
    within_mm: float = 0.3


OPEN_MM = 47.5
ENDINGS = {
    "a closed switch": Ending((), (-0.3, -0.3), 50.0, DeviceFault.END_STOP, DeviceFault.END_STOP, OPEN_MM, OPEN_MM),
    "skew": Ending((), (0.4, -0.4), 60.0, DeviceFault.SKEW, DeviceFault.SKEW, OPEN_MM, OPEN_MM),
    # the other carriage is opened all the same
    "a blocked carriage": Ending(
        ("blocked_left@3.5",),
        (1.0, 0.0),
        60.0,
        DeviceFault.OVERCURRENT,
        DeviceFault.OVERCURRENT | DeviceFault.RETRACT_FAILED,
        30.0,
        OPEN_MM,
    ),
    "a stiff guide": Ending(
        ("drag_left=+1000%@3.5",),
        None,
        60.0,
        DeviceFault.COMMAND_TIMEOUT,
        DeviceFault.COMMAND_TIMEOUT,
        OPEN_MM,
        OPEN_MM,
    ),
    # found by the skew, and opened blind
    "a stuck encoder": Ending(
        ("encoder_stuck_left@3.5",), (-0.3, -0.3), 60.0, DeviceFault.SKEW, DeviceFault.SKEW, OPEN_MM, OPEN_MM
    ),
    "no supply": Ending(
        ("supply_loss@3.5",),
        (0.0, 0.0),
        60.0,
        DeviceFault.SUPPLY,
        DeviceFault.SUPPLY | DeviceFault.RETRACT_FAILED,
        30.0,
        30.0,
        0.16,
    ),
    "a worn gearbox without supply": Ending(
        ("worn_gearbox@3.5", "supply_loss@3.5"),
        (0.0, 0.0),
        48.0,
        DeviceFault.SUPPLY,
        DeviceFault.SUPPLY | DeviceFault.UNCOMMANDED_MOTION | DeviceFault.RETRACT_FAILED,
        22.0,
        22.0,
        0.24,
    ),
    "a worn gearbox after a reset": Ending(
        ("worn_gearbox@3.6", "reset@3.5"),
        (0.0, 0.0),
        48.0,
        DeviceFault(0),
        DeviceFault.UNCOMMANDED_MOTION,
        OPEN_MM,
        OPEN_MM,
    ),
}


@pytest.mark.parametrize("ending", ENDINGS.values(), ids=ENDINGS)
def test_how_a_run_ends(running, ending: Ending) -> None:
    host = running(ending.faults, gap_mm=ending.gap_mm)
    if ending.faults:
        host.drive_until(3.5)
    while host.status.mode is DeviceMode.RUN:
        if ending.duties is None:
            host.wait(1e-3)
        else:
            host.drive(*ending.duties)
        assert host.time_s < 20.0
    assert host.status.faults == ending.at_once
    truth = host.device.truth
    assert abs(truth.left_mm - truth.right_mm) < 4.0
    assert truth.gap_mm > 44.0 - 1e-6
    host.wait_for(DeviceMode.LATCHED)
    host.wait(1.0)
    truth = host.device.truth
    assert (host.status.faults, truth.left_A, truth.right_A) == (ending.latched, 0.0, 0.0)
    assert truth.left_mm == pytest.approx(ending.left_mm, abs=ending.within_mm)
    assert truth.right_mm == pytest.approx(ending.right_mm, abs=ending.within_mm)


def test_a_fault_is_not_cleared_while_its_cause_lasts(running) -> None:
    host = running(["supply_loss@3.5"])
    host.drive_until(3.5)
    stood_mm = host.device.truth.gap_mm
    host.wait_for(DeviceMode.LATCHED)
    assert host.status.supply_V == 0.0
    assert host.device.truth.gap_mm == pytest.approx(stood_mm, abs=0.02)
    host.command(Clear)
    assert not host.acknowledged()


# -- injected faults -----------------------------------------------------------------------------------------------


def test_reset_forgets_zero_handshake_and_mode_but_holds_the_gap(running) -> None:
    host = running(["reset@3.5"], gap_mm=60.0)
    host.drive_until(3.6, -0.2, -0.2)
    assert host.status.mode is DeviceMode.IDLE
    assert Switches.HOMED not in host.status.switches
    stood_mm = host.device.truth.gap_mm
    host.heartbeat(0.5)
    assert host.device.truth.gap_mm == pytest.approx(stood_mm, abs=1e-6)
    assert host.last(State).left_position_mm == pytest.approx(0.0, abs=0.3)
    host.home()
    host.go_to(60.0)


def test_a_gap_that_closes_fast_is_noticed_while_the_device_still_tries_to_open(running) -> None:
    host = running(["worn_gearbox@3.5", "supply_loss@3.5"], gap_mm=47.0, plant="sample_3")
    host.drive_until(3.5)
    while DeviceFault.UNCOMMANDED_MOTION not in host.status.faults:
        host.wait(1e-3)
        assert host.time_s < 5.0
    assert host.status.mode is DeviceMode.RETRACTING
    assert DeviceFault.RETRACT_FAILED not in host.status.faults


@pytest.mark.parametrize("reversed_part", ["motor_reversed_left", "encoder_reversed_left"])
def test_homing_that_goes_the_wrong_way_ends_where_it_is(make_host, reversed_part: str) -> None:
    """It does not press shut until its time is up; and it does not open either, which such a drive cannot."""
    host = make_host([reversed_part])
    before = host.device.truth
    host.command(Home)
    while host.status.mode is not DeviceMode.LATCHED:
        host.heartbeat(0.01)
        assert host.time_s < 2.0
    host.heartbeat(3.0)
    assert (host.status.mode, host.status.faults) == (DeviceMode.LATCHED, DeviceFault.HOMING_FAILED)
    assert not host.device.messages.firmware.output.enabled
    assert abs(host.device.truth.left_mm - before.left_mm) < 2.0
