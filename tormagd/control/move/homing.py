"""The watch on the device's homing: the gap opens, both switches close, homing ends, and the force does not grow.

Homing is the firmware's own routine, and a motor with wrong wiring presses shut while it believes to open.
"""

from typing import Final, final

from firmware_protocol.codec import DeviceMode, Switches
from tormagd.control.safety.codes import Fault
from tormagd.hardware.measurement import Measurement

LONGEST_S: Final = 12.0
"The slowest homing from a closed gap takes under 10 s."
BACKS_OFF_MM: Final = 3.0
"A firmware backs off less from a switch: a carriage that goes further goes the wrong way."
WENT_BACK_MM: Final = 0.5
"A carriage whose homing failed went the wrong way if it moved this far towards closed."
ZEROED_MM: Final = 1.0
"No carriage moves this far between two looks: the device has set its zero."
STATUS_S: Final = 0.1
"A homing device sends a Status every 20 ms."
OVER_S: Final = 0.04
RISES: Final = 1.25
"The sensor may show this many times what it showed at the start, for OVER_S at most."

_HOMING: Final = DeviceMode.HOMING
_BOTH_OPEN: Final = int(Switches.LEFT_OPEN) | int(Switches.RIGHT_OPEN)


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
        self.faults = ()
        if measurement.mode is not _HOMING:
            if self.is_running:
                self._end(now_s, measurement)
        elif not self.is_running:
            self._begin(now_s, measurement)
        else:
            self._follow(now_s, measurement)

    def _begin(self, now_s: float, measurement: Measurement) -> None:
        self.is_running, self.began_s, self.time_s, self.over_s = True, now_s, now_s, 0.0
        self.left_mm, self.right_mm = measurement.left_mm, measurement.right_mm
        self.left_at_mm, self.right_at_mm = measurement.left_mm, measurement.right_mm
        self.switches = int(measurement.switches) & _BOTH_OPEN
        self.max_N = max(self._ceiling_N, RISES * abs(measurement.force_N))

    def _follow(self, now_s: float, measurement: Measurement) -> None:
        self.left_mm = _outermost_mm(self.left_mm, self.left_at_mm, measurement.left_mm)
        self.right_mm = _outermost_mm(self.right_mm, self.right_at_mm, measurement.right_mm)
        self.left_at_mm, self.right_at_mm = measurement.left_mm, measurement.right_mm
        self.switches |= int(measurement.switches) & _BOTH_OPEN
        self.over_s = self.over_s + (now_s - self.time_s) if abs(measurement.force_N) > self.max_N else 0.0
        self.time_s = now_s
        if max(self.went_back_mm) > BACKS_OFF_MM:
            self.faults = (self._went_back(BACKS_OFF_MM, measurement),)
        elif now_s - self.began_s > LONGEST_S:
            self.faults = (Fault.HOMING,)
        elif self.over_s > OVER_S:
            self.faults = (Fault.OVER_FORCE,)
        elif now_s - measurement.reported_s > STATUS_S:
            self.faults = (Fault.STATUS_STALE,)

    def _end(self, now_s: float, measurement: Measurement) -> None:
        """Judge a homing that was completed, given up, or replaced by a request to open."""
        self.is_running, self.time_s = False, now_s
        self.switches |= int(measurement.switches) & _BOTH_OPEN
        if measurement.is_homed:
            if self.switches != _BOTH_OPEN:
                self.faults = (Fault.HOMING,)
        elif measurement.is_latched and max(self.went_back_mm) > WENT_BACK_MM:
            self.faults = (self._went_back(WENT_BACK_MM, measurement),)

    def _went_back(self, most_mm: float, measurement: Measurement) -> Fault:
        left_mm, right_mm = self.went_back_mm
        is_left_stuck = left_mm > most_mm and measurement.is_left_open
        is_right_stuck = right_mm > most_mm and measurement.is_right_open
        return Fault.HOMING if is_left_stuck or is_right_stuck else Fault.WRONG_DIRECTION


def _outermost_mm(outermost_mm: float, last_mm: float, now_mm: float) -> float:
    return now_mm if abs(now_mm - last_mm) > ZEROED_MM else max(outermost_mm, now_mm)
