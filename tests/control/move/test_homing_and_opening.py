"""The homing and the opening of a device as they are watched: in time, complete, at a force that does not rise."""

import pytest

from firmware_protocol.codec import DeviceFault, DeviceMode, Switches
from tormagd.config import Config
from tormagd.control.move.routines import BACKS_OFF_MM, LATE_S, LONGEST_S, OPEN_MM, Homing, Opening, is_open
from tormagd.control.safety.codes import Fault
from tormagd.control.safety.operating_state import SafetyState, latch
from tormagd.hardware.measurement import DeviceRequest
from tormagd.scenes.scene import load_scene

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


# -- the opening -------------------------------------------------------------------------------------------------------


CONFIG = Config()
SPEED_MM_S = CONFIG.device.retract_mm_s
LATCHED = {"mode": DeviceMode.LATCHED, "switches": Switches(0)}


class Opens:
    def __init__(self, measure) -> None:
        self._measure, self.ticks = measure, 0
        self.opening = Opening(CONFIG, load_scene("coronary"))
        self.safety = SafetyState()
        self.ask()

    def ask(self) -> None:
        self.safety = self.safety.ask(DeviceRequest.RETRACT)

    def look(self, seconds: float, start_mm: float = -20.0, speed_mm_s: float = 0.0, **changes: object) -> float | None:
        for step in range(1, round(seconds * 1e3) + 1):
            self.ticks += 1
            at_mm = min(start_mm + 1e-3 * step * speed_mm_s, 0.0)
            seen = {"mode": DeviceMode.RETRACTING, "left_mm": at_mm, "right_mm": at_mm, **changes}
            measured = self._measure(self.ticks, **seen)
            is_placed = measured.is_homed and not self.safety.needs_homing
            self.opening.update(measured, is_placed, False, self.safety)
            if self.opening.faults:
                self.safety = latch(self.safety, self.opening.faults)
                return 1e-3 * step
        return None


@pytest.fixture
def opens(measure) -> Opens:
    return Opens(measure)


@pytest.mark.parametrize("start_mm", [-25.0, -12.0, -2.0, -0.2])
def test_an_ordinary_opening(opens: Opens, start_mm: float) -> None:
    assert [
        opens.look(0.1, start_mm),
        opens.look(2.0, start_mm, SPEED_MM_S),
        opens.look(5.0, 0.0, mode=DeviceMode.IDLE, switches=Switches.HOMED | BOTH),
        opens.look(5.0, -0.3, mode=DeviceMode.IDLE),
    ] == 4 * [None]


@pytest.mark.parametrize("start_mm", [-25.0, -12.0, -2.0])
@pytest.mark.parametrize("mode", [DeviceMode.IDLE, DeviceMode.RETRACTING, DeviceMode.RUN])
def test_one_that_does_not_begin(opens: Opens, start_mm: float, mode: DeviceMode) -> None:
    assert opens.look(1.0, start_mm, mode=mode) == pytest.approx(LATE_S, abs=3e-3)
    assert f"left {-start_mm:.1f} mm from open, {LATE_S:.2f} s late" in str(opens.opening)


@pytest.mark.parametrize(
    ("well_s", "start_mm", "speed_mm_s", "seen", "late_s"),
    [
        (0.0, -25.0, SPEED_MM_S, {"right_mm": -20.0}, LATE_S),
        (0.0, -12.0, -SPEED_MM_S, {}, LATE_S / 2.0),
        (0.8, -13.0, 0.0, {"mode": DeviceMode.IDLE}, LATE_S),
        *((0.0, -25.0, share * SPEED_MM_S, {}, LATE_S / (1.0 - share)) for share in (0.3, 0.6, 0.8)),
    ],
)
def test_one_that_goes_on_wrong(
    opens: Opens, well_s: float, start_mm: float, speed_mm_s: float, seen: dict, late_s: float
) -> None:
    assert opens.look(well_s, -25.0, SPEED_MM_S) is None
    assert opens.look(8.0, start_mm, speed_mm_s, **seen) == pytest.approx(late_s, rel=0.02)


def test_a_low_supply_explains_a_lower_speed(opens: Opens) -> None:
    assert opens.look(5.0, -25.0, 0.7 * SPEED_MM_S, supply_V=9.0) is None
    assert opens.look(5.0, -25.0, 0.3 * SPEED_MM_S, supply_V=0.0) is not None


def test_a_line_that_shows_nothing_for_a_while_hides_no_opening_and_no_standstill(opens: Opens) -> None:
    assert opens.look(0.2, -25.0, SPEED_MM_S) is None
    opens.ticks += 700
    assert opens.look(0.1, -11.5, SPEED_MM_S) is None
    opens.ticks += 700
    assert opens.look(0.1, -10.0) == pytest.approx(1e-3)


def test_a_fault_is_told_once_and_again_after_another_request(opens: Opens) -> None:
    assert opens.look(1.0) is not None
    assert opens.safety.faults == (Fault.NOT_OPENING,)
    assert opens.look(5.0) is None
    opens.safety = opens.safety.replaced(faults=(), needs_homing=False)
    assert opens.look(5.0, mode=DeviceMode.IDLE) is None
    opens.ask()
    assert opens.look(1.0) == pytest.approx(LATE_S, abs=3e-3)


def test_a_device_without_a_zero_is_judged_by_what_it_says(opens: Opens) -> None:
    unhomed = {"switches": Switches(0)}
    opens.safety = SafetyState()
    assert opens.look(5.0, mode=DeviceMode.IDLE, **unhomed) is None
    opens.ask()
    assert opens.look(5.0, mode=DeviceMode.IDLE, switches=BOTH) is None
    assert opens.look(4.0, **unhomed) is None
    assert opens.look(5.0, 0.0, mode=DeviceMode.IDLE, switches=BOTH) is None
    assert opens.look(1.0, mode=DeviceMode.IDLE, **unhomed) == pytest.approx(LATE_S, abs=3e-3)
    assert f"not open by its switches for {LATE_S:.2f} s" in str(opens.opening)


def test_a_search_that_does_not_end_is_named(opens: Opens) -> None:
    assert 5.0 < (opens.look(9.0, switches=Switches(0)) or 0.0) < 7.0


@pytest.mark.parametrize("fault", [DeviceFault.RETRACT_FAILED, DeviceFault.HOMING_FAILED | DeviceFault.SUPPLY])
def test_a_device_that_says_itself_that_it_failed_is_not_told_twice(opens: Opens, fault: DeviceFault) -> None:
    assert opens.look(5.0, **LATCHED, faults=fault) is None
    assert opens.look(1.0, **LATCHED, faults=DeviceFault.COMMAND_TIMEOUT) == pytest.approx(LATE_S, abs=3e-3)


def test_a_homing_and_a_device_that_was_away_are_no_failure(opens: Opens) -> None:
    assert [opens.look(5.0, mode=mode, switches=Switches(0)) for mode in (DeviceMode.HOMING, DeviceMode.IDLE)] == [
        None,
        None,
    ]
    opens.ask()
    assert opens.look(0.3) is None
    opens.opening.rest(opens.safety.request_number)
    assert opens.look(5.0, mode=DeviceMode.IDLE, switches=Switches(0)) is None


def test_open_is_by_places_or_by_both_switches(measure) -> None:
    near, off = (measure(1, left_mm=-OPEN_MM, right_mm=right_mm) for right_mm in (0.1, -OPEN_MM - 0.1))
    assert (is_open(near, True), is_open(near, False), is_open(off, True)) == (True, False, False)
    assert [is_open(measure(1, switches=only), False) for only in (BOTH, Switches.LEFT_OPEN)] == [True, False]
