"""The device's homing as it is watched: opening, both switches, in time, at a force that does not rise."""

import pytest

from firmware_protocol.codec import DeviceFault, DeviceMode, Switches
from tormagd.control.move.homing import BACKS_OFF_MM, LONGEST_S, Homing
from tormagd.control.safety.codes import Fault
from tormagd.ground.plain_values import plain

CEILING_N = 3.0
BOTH = Switches.LEFT_OPEN | Switches.RIGHT_OPEN
HOMED = {"mode": DeviceMode.IDLE, "switches": Switches.HOMED | BOTH}


class Home:
    def __init__(self, measure) -> None:
        self._measure, self.ticks = measure, 0
        self.homing = Homing(CEILING_N)
        self.faults: list[Fault] = []

    def look(self, count: int = 1, **changes: object) -> None:
        seen = {"mode": DeviceMode.HOMING, "switches": Switches(0), "force_N": 0.3, **changes}
        for _ in range(count):
            self.ticks += 1
            self.homing.update(self.ticks * 1e-3, self._measure(self.ticks, **seen))
            self.faults += self.homing.faults

    def travel(self, left_mm: float, right_mm: float) -> None:
        steps = max(round(max(abs(left_mm), abs(right_mm)) / 15.0 * 1e3), 1)
        for step in range(1, steps + 1):
            share = step / steps
            self.look(left_mm=-20.0 + share * left_mm, right_mm=-20.0 + share * right_mm)


@pytest.fixture
def home(measure) -> Home:
    return Home(measure)


def test_no_homing_is_watched_while_there_is_none(home: Home) -> None:
    home.look(100, mode=DeviceMode.IDLE, left_mm=-3.0)
    home.look(100, mode=DeviceMode.RETRACTING, left_mm=-30.0)
    assert plain(home.homing) == plain(Homing(CEILING_N))
    assert not home.faults


@pytest.mark.parametrize("zeroed", [False, True], ids=["homed again", "the zero moves"])
def test_an_ordinary_homing(home: Home, zeroed: bool) -> None:
    home.travel(20.0, 20.0)
    home.look(50, left_mm=0.0, right_mm=0.0, switches=BOTH)
    for step in range(70):
        home.look(left_mm=-0.015 * step, right_mm=-0.015 * step)
    home.look(10, left_mm=-30.0 if zeroed else 0.0, right_mm=12.0 if zeroed else 0.0, switches=BOTH)
    assert home.homing.is_running
    home.look(100, left_mm=0.0, right_mm=0.0, **HOMED)
    assert not home.faults
    assert not home.homing.is_running


@pytest.mark.parametrize("left_mm", [-20.0, 15.0])
def test_a_carriage_that_closes_is_named_before_it_has_gone_far(home: Home, left_mm: float) -> None:
    home.travel(left_mm, -15.0)
    assert home.faults[0] is Fault.WRONG_DIRECTION
    assert max(round(mm, 1) for mm in home.homing.went_back_mm) > BACKS_OFF_MM
    assert "back towards closed" in str(home.homing)


@pytest.mark.parametrize("mode", [DeviceMode.HOMING, DeviceMode.LATCHED])
@pytest.mark.parametrize("side", ["left", "right"])
def test_a_carriage_that_closes_with_its_open_switch_closed_has_a_switch_that_is_stuck(
    home: Home, side: str, mode: DeviceMode
) -> None:
    stuck = {"switches": Switches[f"{side.upper()}_OPEN"], "faults": DeviceFault.HOMING_FAILED}
    for mm in range(round(BACKS_OFF_MM) + 1):
        home.look(**stuck, **{f"{side}_mm": -8.0 - mm})
    home.look(**stuck, mode=mode, **{f"{side}_mm": -8.1 - mm})
    assert home.faults[0] is Fault.HOMING


def test_a_firmware_that_gives_up_on_the_wrong_way_is_asked_which_way_it_went(home: Home) -> None:
    home.travel(-1.0, 0.4)
    assert not home.faults
    home.look(mode=DeviceMode.LATCHED, faults=DeviceFault.HOMING_FAILED, left_mm=-21.0, right_mm=-19.6)
    assert home.faults == [Fault.WRONG_DIRECTION]
    home.look(50, mode=DeviceMode.LATCHED, faults=DeviceFault.HOMING_FAILED)
    assert home.faults == [Fault.WRONG_DIRECTION], "told once"


@pytest.mark.parametrize("seen", [Switches(0), Switches.LEFT_OPEN, Switches.RIGHT_OPEN])
def test_a_switch_that_never_closed_is_missed(home: Home, seen: Switches) -> None:
    home.travel(20.0, 20.0)
    home.look(20, left_mm=0.0, right_mm=0.0, switches=seen)
    home.look(20, left_mm=0.0, right_mm=0.0, mode=DeviceMode.IDLE, switches=Switches.HOMED | seen)
    assert home.faults == [Fault.HOMING]
    for name in ("LEFT_OPEN", "RIGHT_OPEN"):
        assert (name in str(home.homing)) == (Switches[name] not in seen)


def rising(before_N: float, most_N: float) -> list[tuple[int, dict[str, float]]]:
    """Forces that are borne, the last of them for as long as it may be."""
    return [(20, {"force_N": before_N}), (500, {"force_N": -most_N + 0.01}), (39, {"force_N": most_N + 0.01})]


@pytest.mark.parametrize(
    ("borne", "fault"),
    [
        ([(round(LONGEST_S * 1e3), {})], Fault.HOMING),
        (rising(0.3, 3.0), Fault.OVER_FORCE),
        (rising(10.0, 12.5), Fault.OVER_FORCE),
        (rising(-10.0, 12.5), Fault.OVER_FORCE),
        ([(20, {}), (99, {"reported_s": 0.02})], Fault.STATUS_STALE),
    ],
    ids=["no end", "a force", "a force from much", "a force from much the other way", "no Status"],
)
def test_what_is_borne_for_a_while_is_then_a_fault(
    home: Home, borne: list[tuple[int, dict[str, float]]], fault: Fault
) -> None:
    for count, seen in borne:
        home.look(count, **seen)
    assert not home.faults
    home.look(3, **seen)
    assert home.faults[0] is fault


def test_the_next_homing_begins_anew(home: Home) -> None:
    home.travel(20.0, 20.0)
    home.look(20, left_mm=0.0, right_mm=0.0, **HOMED)
    home.faults.clear()
    home.look(20, left_mm=-30.0, right_mm=-30.0)
    home.look(20, left_mm=-30.0, right_mm=-30.0, switches=BOTH)
    home.look(20, left_mm=-30.0, right_mm=-30.0, **HOMED)
    assert not home.faults
