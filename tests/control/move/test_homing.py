"""The device's homing as it is watched: opening, both switches, in time, at a force that does not rise."""

import pytest

from firmware_protocol.codec import DeviceFault, DeviceMode, Switches
from tormagd.control.move.homing import BACKS_OFF_MM, Homing, LONGEST_S, watch
from tormagd.hardware.measurement import Measurement
from tormagd.safety.codes import Fault

CEILING_N = 3.0
BOTH = Switches.LEFT_OPEN | Switches.RIGHT_OPEN
HOMED = {"mode": DeviceMode.IDLE, "switches": Switches.HOMED | BOTH}


class Bench:
    """A device that homes, a look every millisecond."""

    def __init__(self, measure) -> None:
        self._measure, self.ticks = measure, 0
        self.homing: Homing | None = None
        self.faults: list[Fault] = []

    def look(self, count: int = 1, **changes: object) -> None:
        for _ in range(count):
            self.ticks += 1
            seen: Measurement = self._measure(
                self.ticks, **{"mode": DeviceMode.HOMING, "switches": Switches(0), "force_N": 0.3, **changes}
            )
            self.homing = watch(self.homing, self.ticks * 1e-3, seen, CEILING_N)
            if self.homing is not None:
                self.faults += self.homing.faults

    def travel(self, left_mm: float, right_mm: float, speed_mm_s: float = 15.0, **changes: object) -> None:
        """Both carriages go there from -20 mm, the sum of both at this speed."""
        steps = max(round(max(abs(left_mm), abs(right_mm)) / speed_mm_s * 1e3), 1)
        for step in range(1, steps + 1):
            share = step / steps
            self.look(left_mm=-20.0 + share * left_mm, right_mm=-20.0 + share * right_mm, **changes)


@pytest.fixture
def bench(measure) -> Bench:
    return Bench(measure)


def test_no_homing_is_watched_while_there_is_none(bench: Bench) -> None:
    bench.look(100, mode=DeviceMode.IDLE, left_mm=-3.0)
    bench.look(100, mode=DeviceMode.RETRACTING, left_mm=-30.0)
    assert bench.homing is None


@pytest.mark.parametrize("zeroed", [False, True], ids=["homed again", "the zero moves"])
def test_an_ordinary_homing(bench: Bench, zeroed: bool) -> None:
    bench.travel(20.0, 20.0)
    bench.look(50, left_mm=0.0, right_mm=0.0, switches=BOTH)
    for step in range(70):
        bench.look(left_mm=-0.015 * step, right_mm=-0.015 * step)
    bench.look(10, left_mm=-30.0 if zeroed else 0.0, right_mm=12.0 if zeroed else 0.0, switches=BOTH)
    bench.look(100, left_mm=0.0, right_mm=0.0, **HOMED)
    assert not bench.faults
    assert bench.homing is not None
    assert bench.homing.has_ended


@pytest.mark.parametrize("left_mm", [-20.0, 15.0])
def test_a_carriage_that_closes_is_named_before_it_has_gone_far(bench: Bench, left_mm: float) -> None:
    bench.travel(left_mm, -15.0)
    assert bench.faults[0] is Fault.WRONG_DIRECTION
    assert bench.homing is not None
    gone_mm = [round(mm, 1) for mm in bench.homing.went_back_mm]
    assert max(gone_mm) > BACKS_OFF_MM
    assert "back towards closed" in str(bench.homing)


def test_a_firmware_that_gives_up_on_the_wrong_way_is_asked_which_way_it_went(bench: Bench) -> None:
    bench.travel(-1.0, 0.4)
    assert not bench.faults
    bench.look(mode=DeviceMode.LATCHED, faults=DeviceFault.HOMING_FAILED, left_mm=-21.0, right_mm=-19.6)
    assert bench.faults == [Fault.WRONG_DIRECTION]
    bench.look(50, mode=DeviceMode.LATCHED, faults=DeviceFault.HOMING_FAILED)
    assert bench.faults == [Fault.WRONG_DIRECTION], "told once"


@pytest.mark.parametrize("seen", [Switches(0), Switches.LEFT_OPEN, Switches.RIGHT_OPEN])
def test_a_switch_that_never_closed_is_missed(bench: Bench, seen: Switches) -> None:
    bench.travel(20.0, 20.0)
    bench.look(20, left_mm=0.0, right_mm=0.0, switches=seen)
    bench.look(20, left_mm=0.0, right_mm=0.0, mode=DeviceMode.IDLE, switches=Switches.HOMED | seen)
    assert bench.faults == [Fault.HOMING]
    for name in ("LEFT_OPEN", "RIGHT_OPEN"):
        assert (name in str(bench.homing)) == (Switches[name] not in seen)


def test_homing_without_end(bench: Bench) -> None:
    bench.look(round(LONGEST_S * 1e3))
    assert not bench.faults
    bench.look(3)
    assert bench.faults[0] is Fault.HOMING


@pytest.mark.parametrize(("before_N", "most_N"), [(0.3, 3.0), (10.0, 12.5), (-10.0, 12.5)])
def test_a_force_that_rises(bench: Bench, before_N: float, most_N: float) -> None:
    bench.look(20, force_N=before_N)
    bench.look(500, force_N=-most_N + 0.01)
    assert not bench.faults
    bench.look(39, force_N=most_N + 0.01)
    assert not bench.faults
    bench.look(3, force_N=most_N + 0.01)
    assert bench.faults[0] is Fault.OVER_FORCE


def test_a_status_that_stops(bench: Bench) -> None:
    bench.look(20)
    last_s = bench.ticks * 1e-3
    bench.look(99, reported_s=last_s)
    assert not bench.faults
    bench.look(3, reported_s=last_s)
    assert bench.faults[0] is Fault.STATUS_STALE


def test_the_next_homing_begins_anew(bench: Bench) -> None:
    bench.travel(20.0, 20.0)
    bench.look(20, left_mm=0.0, right_mm=0.0, **HOMED)
    bench.faults.clear()
    bench.look(20, left_mm=-30.0, right_mm=-30.0)
    bench.look(20, left_mm=-30.0, right_mm=-30.0, switches=BOTH)
    bench.look(20, left_mm=-30.0, right_mm=-30.0, **HOMED)
    assert not bench.faults
