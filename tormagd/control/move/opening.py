"""The watch on the gap's opening: while nothing is driven, each carriage is open, or gets there in time.

    late  <-  max(late + dt - way / v, 0)        way: opened by since the last State; v: the device's own speed

A carriage that is later than LATE_S is a fault. Opening is the firmware's own routine. Without known positions (not
homed, or no State comes) the device's word is judged. Once asked to open, it must show both open switches, report that
it failed, or say that it is opening, for no longer than a search of the switches takes.
"""

from typing import Final, final

from firmware_protocol.codec import DeviceFault, DeviceMode
from tormagd.config import Config
from tormagd.control.safety.codes import Fault
from tormagd.control.safety.operating_state import SafetyState
from tormagd.hardware.measurement import DeviceRequest, Measurement
from tormagd.scenes.scene import Scene

LATE_S: Final = 0.35
"Turning round, a request that a bad line loses twice, and weak motors take 0.1 s each."
OPEN_MM: Final = 0.5
"A carriage this near its switch is open: the force is within 2 % of the open gap's."
SEARCH_SHARE: Final = 0.5
"A device without a zero opens at half of its speed or more."
REPORT_S: Final = 0.1
"A longer pause between two Status messages counts as this."
LOWEST_SUPPLY: Final = 0.5
"A lower reading gives no speed, and the device reports it."

_HOMING: Final = DeviceMode.HOMING
_RETRACTING: Final = DeviceMode.RETRACTING
_RETRACT: Final = DeviceRequest.RETRACT
_FAILED: Final = int(DeviceFault.RETRACT_FAILED) | int(DeviceFault.HOMING_FAILED)


def is_open(measurement: Measurement, is_placed: bool) -> bool:
    if is_placed:
        return min(measurement.left_mm, measurement.right_mm) >= -OPEN_MM
    return measurement.is_left_open and measurement.is_right_open


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
        """Look once at a device that is not driven, and set `faults`."""
        number = safety.request_number
        if self.faults:
            self.told_request, self.faults = number, ()
        if measurement.mode is _HOMING:
            self.rest(number)
            return
        if number <= self.told_request:
            self.is_watching = False
            return
        if not self.is_watching:
            self.is_watching, self.reported_s = True, measurement.reported_s
            self.left_late_s = self.right_late_s = self.waits_s = 0.0
            self._place(measurement)
        if not is_placed or is_blind:
            is_asked = safety.request is _RETRACT and number > self.unheard_request
            self._judge_by_word(measurement, is_asked, is_placed)
        else:
            self._judge_by_places(measurement)

    def _place(self, measurement: Measurement) -> None:
        self.device_s = measurement.device_time_s
        self.left_mm, self.right_mm = measurement.left_mm, measurement.right_mm

    def _judge_by_places(self, measurement: Measurement) -> None:
        dt_s = max(measurement.device_time_s - self.device_s, 0.0)
        share = min(max(measurement.supply_V / self._supply_V, LOWEST_SUPPLY), 1.0)
        speed_mm_s = share * self._full_mm_s
        self.left_late_s = _late_s(self.left_late_s + dt_s, self.left_mm, measurement.left_mm, speed_mm_s)
        self.right_late_s = _late_s(self.right_late_s + dt_s, self.right_mm, measurement.right_mm, speed_mm_s)
        self._place(measurement)
        self.waits_s, self.reported_s = 0.0, measurement.reported_s
        if max(self.left_late_s, self.right_late_s) > LATE_S:
            self.faults = (Fault.NOT_OPENING,)

    def _judge_by_word(self, measurement: Measurement, is_asked: bool, is_placed: bool) -> None:
        """Judge the device by its own report, while its places are unknown or the loop is blind."""
        if not is_placed:
            self._place(measurement)
        dt_s = min(measurement.reported_s - self.reported_s, REPORT_S)
        self.reported_s = measurement.reported_s
        opens = measurement.mode is _RETRACTING
        shown: int = measurement.faults
        if is_open(measurement, False) or shown & _FAILED or not (opens or is_asked):
            self.waits_s = 0.0
            return
        self.waits_s += dt_s
        if self.waits_s > (self._search_s if opens else LATE_S):
            self.faults = (Fault.NOT_OPENING,)


def _late_s(late_s: float, before_mm: float, now_mm: float, speed_mm_s: float) -> float:
    return 0.0 if now_mm >= -OPEN_MM else max(late_s - (now_mm - before_mm) / speed_mm_s, 0.0)
