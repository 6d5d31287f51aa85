"""What the device's firmware does with motors, switches and encoders, seen through the wire."""

from collections.abc import Iterable

import pytest
from devices import SAMPLES
from virtual_port import VirtualPort

from firmware_protocol.codec import (
    Clear,
    DeviceFault,
    DeviceMode,
    DriveMode,
    Home,
    State,
    Switches,
)
from firmware_protocol.conformance.host import Host
from firmware_protocol.conformance.line import SerialLine
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.faults import parse_fault
from tormagd.simulation.hand import SteadyHand
from tormagd.simulation.parameters import PlantParameters, load_plant, standing

# -- the rules of the page are the conformance kit's, which this firmware passes
# -----------------------------------------


PERIOD_S = 1e-3


class Bench(Host):
    def __init__(self, faults: Iterable[str] = (), plant: PlantParameters | None = None) -> None:
        device = VirtualDevice(plant or load_plant("sample_1"), SteadyHand(), [parse_fault(fault) for fault in faults])
        self.device = device.messages
        super().__init__(SerialLine(VirtualPort(device)))

    def go_to(self, gap_mm: float, seconds: float = 1.5) -> None:
        target_mm = gap_mm / 2.0 - 47.5
        for _ in range(round(seconds / PERIOD_S)):
            state = self.last(State)
            errors = (target_mm - state.left_position_mm, target_mm - state.right_position_mm)
            self.beat(DriveMode.RUN, *(min(max(2.0 * error, -1.0), 1.0) for error in errors))

    def run_until(self, time_s: float, duty: float = 0.0) -> None:
        while self.now_s < time_s:
            self.beat(DriveMode.RUN, duty, duty)


def running(faults: Iterable[str] = (), *, gap_mm: float = 60.0, plant: str = "sample_1") -> Bench:
    host = Bench(faults, standing(load_plant(plant), 46.0, 45.5))
    host.homed()
    host.go_to(gap_mm)
    assert host.status.mode is DeviceMode.RUN
    assert host.now_s < 3.4
    assert host.device.truth.gap_mm == pytest.approx(gap_mm, abs=0.3)
    return host


@pytest.mark.parametrize("name", SAMPLES)
def test_homing_zeroes_the_encoders_at_the_open_switches_repeatably(name: str) -> None:
    host = Bench(plant=load_plant(name))
    zeros = []
    for _ in range(2):
        host.hello()
        host.home()
        assert (host.status.mode, host.status.faults) == (DeviceMode.IDLE, DeviceFault(0))
        truth, state = host.device.truth, host.last(State)
        zeros.append((truth.left_mm - state.left_position_mm, truth.right_mm - state.right_position_mm))
        assert (truth.left_mm, truth.right_mm) == pytest.approx((47.5, 47.5), abs=0.05)
        assert host.status.switches == Switches.LEFT_OPEN | Switches.RIGHT_OPEN | Switches.HOMED
        host.go_to(80.0, 1.0)
        host.pass_time(2.0, DriveMode.OFF)
    assert [zero for pair in zeros for zero in pair] == pytest.approx([47.5] * 4, abs=0.02)
    assert zeros[0] == pytest.approx(zeros[1], abs=0.01)


@pytest.mark.parametrize(
    ("fault", "within_s", "gap_mm"),
    [
        ("encoder_stuck_left", 20.0, pytest.approx(95.0, abs=0.6)),
        ("motor_reversed_left", 2.0, pytest.approx(79.0, abs=2.0)),
        ("encoder_reversed_left", 2.0, pytest.approx(79.0, abs=2.0)),
    ],
)
def test_homing_that_fails_opens_where_it_can_and_does_not_press_shut(
    fault: str, within_s: float, gap_mm: object
) -> None:
    host = Bench([fault])
    host.command(Home)
    while host.status.mode is not DeviceMode.LATCHED:
        host.pass_time(0.01, DriveMode.OFF)
        assert host.now_s < within_s
        assert host.device.truth.gap_mm > 77.0
    host.pass_time(3.0, DriveMode.OFF)
    assert (host.status.mode, host.status.faults) == (DeviceMode.LATCHED, DeviceFault.HOMING_FAILED)
    assert Switches.HOMED not in host.status.switches
    assert not host.device.firmware.output.enabled
    assert host.device.truth.gap_mm == gap_mm


def test_duties_are_applied_in_steps_of_ten_bits() -> None:
    def travel(duty: float) -> float:
        host = running()
        host.run_until(host.now_s + 0.3, duty)
        return host.device.truth.gap_mm

    step = 1.0 / 1023.0
    assert travel(512.3 * step) == travel(511.7 * step) == travel(512 * step)
    assert travel(513 * step) > travel(512 * step) > 60.0


OPEN_MM = 47.5
TIMEOUT, SUPPLY, MOVED = DeviceFault.COMMAND_TIMEOUT, DeviceFault.SUPPLY, DeviceFault.UNCOMMANDED_MOTION
SHUT = DeviceFault.RETRACT_FAILED
BOTH_OPEN = pytest.approx((OPEN_MM, OPEN_MM), abs=0.3)
ENDINGS = {
    "silence": ((), None, 60.0, TIMEOUT, TIMEOUT, BOTH_OPEN),
    "a closed switch": ((), (-0.3, -0.3), 50.0, DeviceFault.END_STOP, DeviceFault.END_STOP, BOTH_OPEN),
    "skew": ((), (0.4, -0.4), 60.0, DeviceFault.SKEW, DeviceFault.SKEW, BOTH_OPEN),
    "a blocked carriage": (
        ("blocked_left@3.5",),
        (1.0, 0.0),
        60.0,
        DeviceFault.OVERCURRENT,
        DeviceFault.OVERCURRENT | SHUT,
        pytest.approx((30.0, OPEN_MM), abs=0.3),
    ),
    "a stiff guide": (("drag_left=+1000%@3.5",), None, 60.0, TIMEOUT, TIMEOUT, BOTH_OPEN),
    # what is late goes on opening
    "weak motors": (("opening=-60%@3.5",), None, 52.0, TIMEOUT, TIMEOUT | SHUT, BOTH_OPEN),
    # found by the skew, and opened blind
    "a stuck encoder": (("encoder_stuck_left@3.5",), (-0.3, -0.3), 60.0, DeviceFault.SKEW, DeviceFault.SKEW, BOTH_OPEN),
    "no supply": (("supply_loss@3.5",), (0.0, 0.0), 60.0, SUPPLY, SUPPLY | SHUT, pytest.approx((30.0, 30.0), abs=0.16)),
    "a worn gearbox without supply": (
        ("worn_gearbox@3.5", "supply_loss@3.5"),
        (0.0, 0.0),
        48.0,
        SUPPLY,
        SUPPLY | MOVED | SHUT,
        pytest.approx((22.0, 22.0), abs=0.24),
    ),
    "a worn gearbox after a reset": (
        ("worn_gearbox@3.6", "reset@3.5"),
        (0.0, 0.0),
        48.0,
        DeviceFault(0),
        MOVED,
        BOTH_OPEN,
    ),
}


@pytest.mark.parametrize(("faults", "duties", "gap_mm", "at_once", "latched", "end_mm"), ENDINGS.values(), ids=ENDINGS)
def test_how_a_run_ends(
    faults: tuple[str, ...],
    duties: tuple[float, float] | None,
    gap_mm: float,
    at_once: DeviceFault,
    latched: DeviceFault,
    end_mm: object,
) -> None:
    host = running(faults, gap_mm=gap_mm)
    host.run_until(3.5)
    beat = (None,) if duties is None else (DriveMode.RUN, *duties)
    while host.status.mode is DeviceMode.RUN:
        host.beat(*beat)
        assert host.now_s < 20.0
    assert host.status.faults == at_once
    truth = host.device.truth
    assert abs(truth.left_mm - truth.right_mm) < 4.0
    assert truth.gap_mm > 44.0 - 1e-6
    assert host.until(lambda: host.status.mode is DeviceMode.LATCHED, 10.0), host.status
    host.pass_time(1.0)
    truth = host.device.truth
    assert (host.status.faults, truth.left_A, truth.right_A) == (latched, 0.0, 0.0)
    assert (truth.left_mm, truth.right_mm) == end_mm
    assert host.command(Clear) is (SUPPLY not in latched), "its cause lasts"


def test_a_gap_that_closes_fast_is_noticed_while_the_device_still_tries_to_open() -> None:
    host = running(["worn_gearbox@3.5", "supply_loss@3.5"], gap_mm=47.0, plant="sample_3")
    host.run_until(3.5)
    while DeviceFault.UNCOMMANDED_MOTION not in host.status.faults:
        host.beat(None)
        assert host.now_s < 5.0
    assert host.status.mode is DeviceMode.RETRACTING
    assert DeviceFault.RETRACT_FAILED not in host.status.faults
