"""What the device last said, with the wire's wrap-around taken out."""

from typing import NamedTuple

from firmware_protocol.codec import DeviceFault, DeviceMode, Switches


class Measurement(NamedTuple):
    """One device state. Carriage positions are mm from the home switches (closing is negative); times are in s.

    `received_s` is the host's clock, `device_time_s` the device's own, unwrapped from an arbitrary start. `handle_mm`
    is the travel of the roller's surface, unwrapped. `number` counts the states of this connection. `delay_s` is how
    long ago the first Drive was sent that the device had not obeyed when it last said which it does: at most the way
    there and back.
    """

    number: int
    received_s: float
    device_time_s: float
    left_mm: float
    right_mm: float
    left_current_A: float
    right_current_A: float
    force_N: float
    handle_mm: float
    mode: DeviceMode
    switches: Switches
    faults: DeviceFault
    temperature_C: float
    supply_V: float
    delay_s: float = 0.0

    @property
    def is_homed(self) -> bool:
        """The device knows where its carriages are."""
        return Switches.HOMED in self.switches

    @property
    def is_left_open(self) -> bool:
        """The left carriage is at its open switch."""
        return Switches.LEFT_OPEN in self.switches

    @property
    def is_right_open(self) -> bool:
        """The right carriage is at its open switch."""
        return Switches.RIGHT_OPEN in self.switches

    @property
    def is_busy(self) -> bool:
        """The device moves by its own routine and takes no drive commands."""
        return self.mode in (DeviceMode.HOMING, DeviceMode.RETRACTING)

    @property
    def is_latched(self) -> bool:
        """The device holds a fault that only a Clear takes away."""
        return self.mode is DeviceMode.LATCHED or bool(self.faults)
