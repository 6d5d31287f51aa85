"""Lines that are not what they should be, between a host and a simulated device: serial, and CAN."""

import random
from collections.abc import Callable
from typing import Generic, TypeVar

from tormagd.simulation.can_device import CanDevice, Delivery
from tormagd.simulation.can_frame import CanFrame
from tormagd.simulation.device import MessageDevice, SerialDevice
from tormagd.simulation.plant import Truth

FOREIGN_HOST = 2
FOREIGN = CanFrame(0x00F, bytes(8))
"""Another node's, which wins every arbitration."""
DELIMITER = b"\x00"


class Way:
    """One direction of a line. A unit is a frame, as bytes."""

    def __init__(self) -> None:
        self._random = random.Random(7)

    def carry(self, now_s: float, units: list[bytes]) -> list[bytes]:
        """What comes out now, of these units and earlier ones."""
        return units


class Losing(Way):
    """Loses a share of the units."""

    def __init__(self, share: float) -> None:
        super().__init__()
        self._share = share

    def carry(self, now_s: float, units: list[bytes]) -> list[bytes]:
        return [unit for unit in units if self._random.random() >= self._share]


class Damaging(Losing):
    """Flips a bit in a share of the units."""

    def carry(self, now_s: float, units: list[bytes]) -> list[bytes]:
        return [self._flipped(unit) if self._random.random() < self._share else unit for unit in units]

    def _flipped(self, unit: bytes) -> bytes:
        at, bit = self._random.randrange(len(unit)), self._random.randrange(8)
        return unit[:at] + bytes((unit[at] ^ 1 << bit,)) + unit[at + 1 :]


class Doubling(Way):
    """Every unit comes twice."""

    def carry(self, now_s: float, units: list[bytes]) -> list[bytes]:
        return [unit for unit in units for _ in range(2)]


class Reordering(Losing):
    """A share of the units is overtaken by the next."""

    def __init__(self, share: float) -> None:
        super().__init__(share)
        self._waiting: list[bytes] = []

    def carry(self, now_s: float, units: list[bytes]) -> list[bytes]:
        out: list[bytes] = []
        for unit in units:
            if not self._waiting and self._random.random() < self._share:
                self._waiting.append(unit)
            else:
                out += [unit, *self._waiting]
                self._waiting.clear()
        return out


class Delaying(Way):
    """Every unit comes so much later."""

    def __init__(self, delay_s: float) -> None:
        super().__init__()
        self._delay_s = delay_s
        self._waiting: list[tuple[float, bytes]] = []

    def carry(self, now_s: float, units: list[bytes]) -> list[bytes]:
        self._waiting += [(now_s + self._delay_s, unit) for unit in units]
        out = [unit for due_s, unit in self._waiting if due_s <= now_s]
        self._waiting = [(due_s, unit) for due_s, unit in self._waiting if due_s > now_s]
        return out


MakeWay = Callable[[], Way]


DeviceT = TypeVar("DeviceT", bound=SerialDevice | CanDevice)


class _Spoilt(Generic[DeviceT]):
    """A device behind a wire that is in order until it is spoilt."""

    def __init__(self, device: DeviceT) -> None:
        self._device = device
        self._up, self._down = Way(), Way()

    @property
    def messages(self) -> MessageDevice:
        return self._device.messages

    @property
    def truth(self) -> Truth:
        return self._device.truth

    def spoil(self, way: MakeWay) -> None:
        """From now on."""
        self._up, self._down = way(), way()


class BadSerialLine(_Spoilt[SerialDevice]):
    """A serial line in front of a device that may go bad, in both directions."""

    def __init__(self, device: SerialDevice) -> None:
        super().__init__(device)
        self._unfinished = b""

    def receive(self, now_s: float, data: bytes) -> None:
        for unit in self._down.carry(now_s, [data]):
            self._device.receive(now_s, unit)

    def transmit(self, now_s: float) -> bytes:
        for unit in self._down.carry(now_s, []):
            self._device.receive(now_s, unit)
        *units, self._unfinished = (self._unfinished + self._device.transmit(now_s)).split(DELIMITER)
        return b"".join(self._up.carry(now_s, [unit + DELIMITER for unit in units]))


class BadBus(_Spoilt[CanDevice]):
    """The same on a bus, above its own CRC: in an adapter, or in a driver. Another node may fill it too."""

    def __init__(self, device: CanDevice) -> None:
        super().__init__(device)
        self._foreign_frames_ms = 0.0
        self._owed = 0.0

    def fill(self, frames_ms: float) -> None:
        """Another node sends so many frames a millisecond from now on, and wins every arbitration."""
        self._foreign_frames_ms = frames_ms

    def receive(self, now_s: float, frame: CanFrame) -> None:
        for unit in self._down.carry(now_s, [_unit(frame)]):
            self._device.receive(now_s, _frame(unit))

    def transmit(self, now_s: float) -> list[Delivery]:
        for unit in self._down.carry(now_s, []):
            self._device.receive(now_s, _frame(unit))
        delivered = self._device.transmit(now_s)
        self._owed += self._foreign_frames_ms  # called once a millisecond
        while self._owed >= 1.0:
            self._owed -= 1.0
            self._device.receive(now_s, FOREIGN, FOREIGN_HOST)
        ours = [_unit(delivery.frame) for delivery in delivered if delivery.sender == 0]
        return [Delivery(0, _frame(unit)) for unit in self._up.carry(now_s, ours)]


def _unit(frame: CanFrame) -> bytes:
    return frame.data + frame.identifier.to_bytes(2, "big")


def _frame(unit: bytes) -> CanFrame:
    return CanFrame(int.from_bytes(unit[-2:], "big") & 0x7FF, unit[:-2])
