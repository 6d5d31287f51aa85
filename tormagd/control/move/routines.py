"""The watch on the firmware's own routines, homing and opening, while the core drives nothing.

homing   the gap opens, both switches close, homing ends, and the force does not grow: a motor with wrong wiring presses
         shut while it believes to open
opening  each carriage is open, or gets there in time:
             late  <-  max(late + dt - way / v, 0)        way: opened by since the last State; v: the device's own speed
         A carriage that is later than LATE_S is a fault. Without known positions (not homed, or no State comes) the
         device's word is judged. Once asked to open, it must show both open switches, report that it failed, or say
         that it is opening, for no longer than a search of the switches takes.
"""

from typing import Final, final

from firmware_protocol.codec import DeviceFault, DeviceMode, Switches
from tormagd.config import Config
from tormagd.control.safety.codes import Fault
from tormagd.control.safety.operating_state import SafetyState
from tormagd.hardware.measurement import DeviceRequest, Measurement
from tormagd.scenes.scene import Scene

LONGEST_S: Final = 12.0
"The slowest homing from a closed gap takes under 10 s."
BACKS_OFF_MM: Final = 3.0
"A firmware backs off less from a switch: a carriage that goes further goes the wrong way."
WENT_BACK_MM: Final = 0.5
"A carriage whose homing failed went the wrong way if it moved this far towards closed."
ZEROED_MM: Final = 1.0
"No carriage moves this far between two looks: the device has set its zero."
STATUS_S: Final = 0.1
"A device sends a Status every 20 ms: a longer pause counts as this, and is a fault while homing."
OVER_S: Final = 0.04
RISES: Final = 1.25
"The sensor may show this many times what it showed at the start, for OVER_S at most."
LATE_S: Final = 0.35
"Turning round, a request that a bad line loses twice, and weak motors take 0.1 s each."
OPEN_MM: Final = 0.5
"A carriage this near its switch is open: the force is within 2 % of the open gap's."
SEARCH_SHARE: Final = 0.5
"A device without a zero opens at half of its speed or more."
LOWEST_SUPPLY: Final = 0.5
"A lower reading gives no speed, and the device reports it."

_HOMING: Final = DeviceMode.HOMING
_BOTH_OPEN: Final = int(Switches.LEFT_OPEN) | int(Switches.RIGHT_OPEN)
_FAILED: Final = int(DeviceFault.RETRACT_FAILED) | int(DeviceFault.HOMING_FAILED)


@final
class Homing:
    """The watch on one homing of the device after another. `faults` are those of the newest look."""

    is_running: bool = False
    began_s: float = 0.0
    time_s: float = 0.0
    left_mm: float = 0.0
    "How far open the carriage has been."
    right_mm: float = 0.0
    left_at_mm: float = 0.0
    "Where it is."
    right_at_mm: float = 0.0
    switches: int = 0
    "The open switches that were seen closed."
    max_N: float = 0.0
    "The greatest force that the sensor may show."
    over_s: float = 0.0
    faults: tuple[Fault, ...] = ()

    def __init__(self, ceiling_N: float) -> None:
        self._ceiling_N: Final = ceiling_N

    @property
    def went_back_mm(self) -> tuple[float, float]:
        return self.left_mm - self.left_at_mm, self.right_mm - self.right_at_mm

    def __str__(self) -> str:
        left_mm, right_mm = self.went_back_mm
        missing = Switches(_BOTH_OPEN & ~self.switches)
        names = " and ".join([str(bit.name) for bit in Switches if bit in missing])
        never = f", never closed: {names}" if names else ""
        return (
            f"after {self.time_s - self.began_s:.1f} s of homing, left {left_mm:.1f} mm and right {right_mm:.1f} mm "
            f"back towards closed{never}"
        )

    def update(self, now_s: float, measurement: Measurement) -> None:
        """Look at the device once, and set `faults`."""
        was_running, self.is_running, self.faults = self.is_running, measurement.mode is _HOMING, ()
        if not (was_running or self.is_running):
            return
        if not was_running:
            self.began_s, self.time_s, self.over_s, self.switches = now_s, now_s, 0.0, 0
            self.left_mm, self.right_mm = measurement.left_mm, measurement.right_mm
            self.left_at_mm, self.right_at_mm = measurement.left_mm, measurement.right_mm
            self.max_N = max(self._ceiling_N, RISES * abs(measurement.force_N))
        self.switches |= int(measurement.switches) & _BOTH_OPEN
        fault = self._of_its_way(now_s, measurement) if self.is_running else self._of_its_end(measurement)
        self.time_s, self.faults = now_s, () if fault is None else (fault,)

    def _of_its_way(self, now_s: float, measurement: Measurement) -> Fault | None:
        self.left_mm = _outermost_mm(self.left_mm, self.left_at_mm, measurement.left_mm)
        self.right_mm = _outermost_mm(self.right_mm, self.right_at_mm, measurement.right_mm)
        self.left_at_mm, self.right_at_mm = measurement.left_mm, measurement.right_mm
        self.over_s = self.over_s + (now_s - self.time_s) if abs(measurement.force_N) > self.max_N else 0.0
        if max(self.went_back_mm) > BACKS_OFF_MM:
            return self._went_back(BACKS_OFF_MM, measurement)
        if now_s - self.began_s > LONGEST_S:
            return Fault.HOMING
        if self.over_s > OVER_S:
            return Fault.OVER_FORCE
        return Fault.STATUS_STALE if now_s - measurement.reported_s > STATUS_S else None

    def _of_its_end(self, measurement: Measurement) -> Fault | None:
        """Judge a homing that was completed, given up, or replaced by a request to open."""
        if measurement.is_homed:
            return None if self.switches == _BOTH_OPEN else Fault.HOMING
        is_wrong = measurement.is_latched and max(self.went_back_mm) > WENT_BACK_MM
        return self._went_back(WENT_BACK_MM, measurement) if is_wrong else None

    def _went_back(self, most_mm: float, measurement: Measurement) -> Fault:
        left_mm, right_mm = self.went_back_mm
        is_left_stuck = left_mm > most_mm and measurement.is_left_open
        is_right_stuck = right_mm > most_mm and measurement.is_right_open
        return Fault.HOMING if is_left_stuck or is_right_stuck else Fault.WRONG_DIRECTION


def _outermost_mm(outermost_mm: float, last_mm: float, now_mm: float) -> float:
    return now_mm if abs(now_mm - last_mm) > ZEROED_MM else max(outermost_mm, now_mm)


def is_open(measurement: Measurement, is_placed: bool) -> bool:
    by_switches = measurement.is_left_open and measurement.is_right_open
    return min(measurement.left_mm, measurement.right_mm) >= -OPEN_MM if is_placed else by_switches


@final
class Opening:
    """The watch on the opening of a device that the core does not drive. `faults` are those of the newest look."""

    is_watching: bool = False
    device_s: float = 0.0
    "The device's clock at the newest State."
    left_mm: float = 0.0
    right_mm: float = 0.0
    left_late_s: float = 0.0
    "How late the carriage is against the device's own speed."
    right_late_s: float = 0.0
    reported_s: float = 0.0
    waits_s: float = 0.0
    "How long a device whose carriages' places are unknown has not been open."
    unheard_request: int = 0
    "The newest request before this watch began, which had another purpose."
    told_request: int = -1
    "The request that followed the newest fault; only later ones are judged."
    faults: tuple[Fault, ...] = ()

    def __init__(self, config: Config, scene: Scene) -> None:
        self._full_mm_s: Final = config.device.retract_mm_s
        self._supply_V: Final = config.motor.supply_V
        # a device without a zero may be anywhere, and should report by itself that it failed: this is in case it does
        # not
        self._search_s: Final = 0.5 * scene.insert.gap_open_mm / (SEARCH_SHARE * self._full_mm_s) + LATE_S

    def __str__(self) -> str:
        if self.waits_s > 0.0:
            return f"not open by its switches for {self.waits_s:.2f} s; where the carriages are is not known"
        return (
            f"left {-self.left_mm:.1f} mm from open, {self.left_late_s:.2f} s late; "
            f"right {-self.right_mm:.1f} mm, {self.right_late_s:.2f} s"
        )

    def rest(self, request_number: int) -> None:
        self.is_watching, self.unheard_request, self.told_request, self.faults = False, request_number, -1, ()

    def update(self, measurement: Measurement, is_placed: bool, is_blind: bool, safety: SafetyState) -> None:
        """Look at the device once, and set `faults`."""
        number = safety.request_number
        if self.faults:
            self.told_request, self.faults = number, ()
        if safety.is_driven or measurement.mode is _HOMING:
            self.rest(number)
            return
        if number <= self.told_request:
            self.is_watching = False
            return
        if not self.is_watching:
            self.is_watching, self.reported_s = True, measurement.reported_s
            self.left_late_s = self.right_late_s = self.waits_s = 0.0
            self._place(measurement)
        is_asked = safety.request is DeviceRequest.RETRACT and number > self.unheard_request
        by_places = is_placed and not is_blind
        is_late = self._is_late(measurement) if by_places else self._says_so(measurement, is_asked, is_placed)
        self.faults = (Fault.NOT_OPENING,) if is_late else ()

    def _place(self, measurement: Measurement) -> None:
        self.device_s = measurement.device_time_s
        self.left_mm, self.right_mm = measurement.left_mm, measurement.right_mm

    def _is_late(self, measurement: Measurement) -> bool:
        """Tell by its carriages' places whether the device is late."""
        dt_s = max(measurement.device_time_s - self.device_s, 0.0)
        share = min(max(measurement.supply_V / self._supply_V, LOWEST_SUPPLY), 1.0)
        speed_mm_s = share * self._full_mm_s
        self.left_late_s = _late_s(self.left_late_s + dt_s, self.left_mm, measurement.left_mm, speed_mm_s)
        self.right_late_s = _late_s(self.right_late_s + dt_s, self.right_mm, measurement.right_mm, speed_mm_s)
        self._place(measurement)
        self.waits_s, self.reported_s = 0.0, measurement.reported_s
        return max(self.left_late_s, self.right_late_s) > LATE_S

    def _says_so(self, measurement: Measurement, is_asked: bool, is_placed: bool) -> bool:
        """Tell by its own report whether it is late, while its places are unknown or the loop is blind."""
        if not is_placed:
            self._place(measurement)
        dt_s = min(measurement.reported_s - self.reported_s, STATUS_S)
        self.reported_s = measurement.reported_s
        opens = measurement.mode is DeviceMode.RETRACTING
        shown: int = measurement.faults
        is_told = is_open(measurement, False) or shown & _FAILED != 0 or not (opens or is_asked)
        self.waits_s = 0.0 if is_told else self.waits_s + dt_s
        return self.waits_s > (self._search_s if opens else LATE_S)


def _late_s(late_s: float, before_mm: float, now_mm: float, speed_mm_s: float) -> float:
    return 0.0 if now_mm >= -OPEN_MM else max(late_s - (now_mm - before_mm) / speed_mm_s, 0.0)
