"""The device's homing, watched from here: it opens, it finds both switches, it ends, and the force stays what it was.

Homing is the firmware's own routine, and a motor that is wired the wrong way presses shut while it believes to open.
"""

from typing import Final, final

from firmware_protocol.codec import DeviceMode, Switches
from firmware_protocol.value import Value
from tormagd.hardware.measurement import Measurement
from tormagd.safety.codes import Fault

LONGEST_S: Final = 12.0
"The slowest homing from a closed gap takes under 10 s."
BACKS_OFF_MM: Final = 3.0
"A carriage that goes further towards closed than a firmware backs off from a switch goes the wrong way,"
WENT_BACK_MM: Final = 0.5
"and one whose homing failed has gone there by this."
ZEROED_MM: Final = 1.0
"No carriage moves so far between two looks: the device has set its zero."
STATUS_S: Final = 0.1
"Status says that the device homes still; it comes every 20 ms."
OVER_S: Final = 0.04
RISES: Final = 1.25
"An opening gap brakes less and less; what the sensor shows may be this many times what it showed when homing began."

_HOMING: Final = DeviceMode.HOMING
_BOTH_OPEN: Final = int(Switches.LEFT_OPEN) | int(Switches.RIGHT_OPEN)
_NOTHING: Final[tuple[Fault, ...]] = ()


@final
class Homing(Value):
    """One homing: since when; how far open either carriage has been and where it is, mm; the open switches that were
    seen closed; the most that the force sensor may show, N, and for how long it has shown more; whether it has ended;
    what was wrong with it.
    """

    def __init__(
        self,
        began_s: float,
        time_s: float,
        left_mm: float,
        right_mm: float,
        left_at_mm: float,
        right_at_mm: float,
        switches: int,
        most_N: float,
        over_s: float = 0.0,
        has_ended: bool = False,
        faults: tuple[Fault, ...] = _NOTHING,
    ) -> None:
        self.began_s: Final = began_s
        self.time_s: Final = time_s
        self.left_mm: Final = left_mm
        self.right_mm: Final = right_mm
        self.left_at_mm: Final = left_at_mm
        self.right_at_mm: Final = right_at_mm
        self.switches: Final = switches
        self.most_N: Final = most_N
        self.over_s: Final = over_s
        self.has_ended: Final = has_ended
        self.faults: Final = faults

    @property
    def went_back_mm(self) -> tuple[float, float]:
        """How far left and right carriage have come back towards closed from where they were most open."""
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


def watch(homing: Homing | None, now_s: float, measurement: Measurement, ceiling_N: float) -> Homing | None:
    """The homing after one more look at the device; None before the first. `ceiling_N` is what the force sensor may
    show at any time. What is wrong stands in its `faults`, and is told once."""
    if measurement.mode is not _HOMING:
        if homing is None or homing.has_ended:
            return homing if homing is None or not homing.faults else homing.replaced(faults=_NOTHING)
        return _ended(homing, now_s, measurement)
    if homing is None or homing.has_ended:
        left_mm, right_mm = measurement.left_mm, measurement.right_mm
        most_N = max(ceiling_N, RISES * abs(measurement.force_N))
        return Homing(now_s, now_s, left_mm, right_mm, left_mm, right_mm, _open_switches(measurement), most_N)
    left_mm = _outermost_mm(homing.left_mm, homing.left_at_mm, measurement.left_mm)
    right_mm = _outermost_mm(homing.right_mm, homing.right_at_mm, measurement.right_mm)
    over_s = homing.over_s + (now_s - homing.time_s) if abs(measurement.force_N) > homing.most_N else 0.0
    faults = _NOTHING
    if left_mm - measurement.left_mm > BACKS_OFF_MM or right_mm - measurement.right_mm > BACKS_OFF_MM:
        faults = (Fault.WRONG_DIRECTION,)
    elif now_s - homing.began_s > LONGEST_S:
        faults = (Fault.HOMING,)
    elif over_s > OVER_S:
        faults = (Fault.OVER_FORCE,)
    elif now_s - measurement.reported_s > STATUS_S:
        faults = (Fault.STATUS_STALE,)
    return Homing(
        homing.began_s,
        now_s,
        left_mm,
        right_mm,
        measurement.left_mm,
        measurement.right_mm,
        homing.switches | _open_switches(measurement),
        homing.most_N,
        over_s,
        False,
        faults,
    )


def _ended(homing: Homing, now_s: float, measurement: Measurement) -> Homing:
    """Homed, or given up by the device, or ended by a request to open."""
    switches = homing.switches | _open_switches(measurement)
    faults = _NOTHING
    if measurement.is_homed:
        if switches != _BOTH_OPEN:
            faults = (Fault.HOMING,)
    elif measurement.is_latched and max(homing.went_back_mm) > WENT_BACK_MM:
        faults = (Fault.WRONG_DIRECTION,)
    return homing.replaced(time_s=now_s, switches=switches, has_ended=True, faults=faults)


def _open_switches(measurement: Measurement) -> int:
    return int(measurement.switches) & _BOTH_OPEN


def _outermost_mm(outermost_mm: float, last_mm: float, now_mm: float) -> float:
    return now_mm if abs(now_mm - last_mm) > ZEROED_MM else max(outermost_mm, now_mm)
