"""What is asked of the device, and its newest state as one record, its wrapping counters unwrapped."""

from enum import StrEnum
from typing import Final, final

from firmware_protocol.codec import DeviceFault, DeviceMode, Switches
from firmware_protocol.value import Value
from tormagd.hardware.link_statistics import UNKNOWN_QUALITY, LinkQuality

# an operation on flags makes a new one, in a microsecond; a shift does not
_HOMED: Final = Switches.HOMED.bit_length() - 1
_LEFT_OPEN: Final = Switches.LEFT_OPEN.bit_length() - 1
_RIGHT_OPEN: Final = Switches.RIGHT_OPEN.bit_length() - 1
_LATCHED: Final = DeviceMode.LATCHED
_BUSY: Final = (DeviceMode.HOMING, DeviceMode.RETRACTING)
_LARGEST: Final = 1e10
"300 years in seconds; what is computed from larger numbers may overflow."


def _is_set(bits: int, place: int) -> bool:
    return bits >> place & 1 != 0


class DeviceRequest(StrEnum):
    """A routine that the daemon asks the firmware for, once per request number."""

    NONE = "none"
    HOME = "home"
    RETRACT = "retract"
    CLEAR = "clear"


@final
class Measurement(Value):
    """One device state. Carriage positions are mm from the home switches (closing is negative)."""

    def __init__(
        self,
        number: int,
        received_s: float,
        device_time_s: float,
        left_mm: float,
        right_mm: float,
        left_current_A: float,
        right_current_A: float,
        force_N: float,
        handle_mm: float,
        mode: DeviceMode,
        switches: Switches,
        faults: DeviceFault,
        temperature_C: float,
        supply_V: float,
        sensed_s: float,
        reported_s: float,
        delay_s: float = 0.0,
        link: LinkQuality = UNKNOWN_QUALITY,
    ) -> None:
        self.number: Final = number
        self.received_s: Final = received_s
        self.device_time_s: Final = device_time_s
        self.left_mm: Final = left_mm
        self.right_mm: Final = right_mm
        self.left_current_A: Final = left_current_A
        self.right_current_A: Final = right_current_A
        self.force_N: Final = force_N
        self.handle_mm: Final = handle_mm
        self.mode: Final = mode
        self.switches: Final = switches
        self.faults: Final = faults
        self.temperature_C: Final = temperature_C
        self.supply_V: Final = supply_V
        self.sensed_s: Final = sensed_s
        self.reported_s: Final = reported_s
        self.delay_s: Final = delay_s
        self.link: Final = link

    @property
    def is_finite(self) -> bool:
        """Whether the root of the sum of the numbers' squares is at most 1e10."""
        link = self.link
        # one comparison in every tick: a sum of squares with NaN is not less, and nothing cancels
        squares = (
            self.received_s * self.received_s
            + self.device_time_s * self.device_time_s
            + self.left_mm * self.left_mm
            + self.right_mm * self.right_mm
            + self.left_current_A * self.left_current_A
            + self.right_current_A * self.right_current_A
            + self.force_N * self.force_N
            + self.handle_mm * self.handle_mm
            + self.temperature_C * self.temperature_C
            + self.supply_V * self.supply_V
            + self.sensed_s * self.sensed_s
            + self.reported_s * self.reported_s
            + self.delay_s * self.delay_s
            + link.round_trip_s * link.round_trip_s
            + link.clock_drift * link.clock_drift
        )
        return squares <= _LARGEST * _LARGEST

    @property
    def is_homed(self) -> bool:
        return _is_set(self.switches, _HOMED)

    @property
    def is_left_open(self) -> bool:
        return _is_set(self.switches, _LEFT_OPEN)

    @property
    def is_right_open(self) -> bool:
        return _is_set(self.switches, _RIGHT_OPEN)

    @property
    def is_busy(self) -> bool:
        return self.mode in _BUSY

    @property
    def is_latched(self) -> bool:
        faults: int = self.faults
        return self.mode is _LATCHED or faults != 0
