"""Bad serial lines and CAN buses between a host and a simulated device."""

import math
import random
from collections.abc import Callable
from typing import Generic, TypeVar

from tormagd.simulation.can_device import CanDevice, CanFrame, Delivery
from tormagd.simulation.device import MessageDevice, SerialDevice

FOREIGN_HOST = 2
FOREIGN = CanFrame(0x00F, bytes(8))
"""Another node's, which wins every arbitration."""
DELIMITER = b"\x00"
SEED = 7


Transfer = Callable[[float, list[bytes]], list[bytes]]
MakeTransfer = Callable[[], Transfer]


def whole() -> Transfer:
    return lambda _now_s, units: units


def losing(share: float) -> Transfer:
    draw = random.Random(SEED)
    return lambda _now_s, units: [unit for unit in units if draw.random() >= share]


def damaging(share: float) -> Transfer:
    draw = random.Random(SEED)

    def flipped(unit: bytes) -> bytes:
        at, bit = draw.randrange(len(unit)), draw.randrange(8)
        return unit[:at] + bytes((unit[at] ^ 1 << bit,)) + unit[at + 1 :]

    return lambda _now_s, units: [flipped(unit) if draw.random() < share else unit for unit in units]


def doubling() -> Transfer:
    return lambda _now_s, units: [unit for unit in units for _ in range(2)]


def reordering(share: float) -> Transfer:
    """Let a share of the units be overtaken by the next."""
    draw, waiting = random.Random(SEED), list[bytes]()

    def carry(_now_s: float, units: list[bytes]) -> list[bytes]:
        out: list[bytes] = []
        for unit in units:
            if not waiting and draw.random() < share:
                waiting.append(unit)
            else:
                out += [unit, *waiting]
                waiting.clear()
        return out

    return carry


def _due(due_s: Callable[[float], float]) -> Transfer:
    waiting: list[tuple[float, bytes]] = []

    def carry(now_s: float, units: list[bytes]) -> list[bytes]:
        waiting.extend((due_s(now_s), unit) for unit in units)
        out = [unit for each_s, unit in waiting if each_s <= now_s]
        waiting[:] = [(each_s, unit) for each_s, unit in waiting if each_s > now_s]
        return out

    return carry


def delaying(delay_s: float) -> Transfer:
    return _due(lambda now_s: now_s + delay_s)


def in_bursts(period_s: float) -> Transfer:
    return _due(lambda now_s: (math.floor(now_s / period_s) + 1) * period_s)


def stopped_until(until_s: float) -> Transfer:
    return _due(lambda now_s: max(now_s, until_s))


DeviceT = TypeVar("DeviceT", bound=SerialDevice | CanDevice)


class _Spoilt(Generic[DeviceT]):
    """A device behind a wire that is sound until it is spoilt."""

    def __init__(self, device: DeviceT) -> None:
        self._device = device
        self.spoil(whole)

    @property
    def messages(self) -> MessageDevice:
        return self._device.messages

    def spoil(self, way: MakeTransfer, foreign_frames_ms: float = 0.0) -> None:
        """Carry as `way` does; `FOREIGN` fills a bus."""
        self._up, self._down, self._foreign_frames_ms = way(), way(), foreign_frames_ms


class BadSerialLine(_Spoilt[SerialDevice]):
    """A serial line in front of a device that may go bad, in both directions."""

    def __init__(self, device: SerialDevice) -> None:
        super().__init__(device)
        self._unfinished = b""

    def receive(self, now_s: float, data: bytes) -> None:
        for unit in self._down(now_s, [data]):
            self._device.receive(now_s, unit)

    def transmit(self, now_s: float) -> bytes:
        for unit in self._down(now_s, []):
            self._device.receive(now_s, unit)
        *units, self._unfinished = (self._unfinished + self._device.transmit(now_s)).split(DELIMITER)
        return b"".join(self._up(now_s, [unit + DELIMITER for unit in units]))


class BadBus(_Spoilt[CanDevice]):
    """The same on a bus, above its own CRC: in an adapter or a driver. Another node may fill it too."""

    def __init__(self, device: CanDevice) -> None:
        super().__init__(device)
        self._owed = 0.0

    def receive(self, now_s: float, frame: CanFrame) -> None:
        for unit in self._down(now_s, [unit_of(frame)]):
            self._device.receive(now_s, frame_of(unit))

    def transmit(self, now_s: float) -> list[Delivery]:
        for unit in self._down(now_s, []):
            self._device.receive(now_s, frame_of(unit))
        delivered = self._device.transmit(now_s)
        self._owed += self._foreign_frames_ms  # called once a millisecond
        while self._owed >= 1.0:
            self._owed -= 1.0
            self._device.receive(now_s, FOREIGN, FOREIGN_HOST)
        ours = [unit_of(delivery.frame) for delivery in delivered if delivery.sender == 0]
        return [Delivery(0, frame_of(unit), now_s) for unit in self._up(now_s, ours)]


def unit_of(frame: CanFrame) -> bytes:
    return frame.data + frame.identifier.to_bytes(2, "big")


def frame_of(unit: bytes) -> CanFrame:
    """Return the frame of a unit: whatever was flipped, a controller hands out 11 bits of identifier."""
    return CanFrame(int.from_bytes(unit[-2:], "big") & 0x7FF, unit[:-2])
