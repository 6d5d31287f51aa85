"""A simulated device's port in virtual time."""

from typing import Any


class VirtualPort:
    def __init__(self, device: Any) -> None:
        self.device, self.time_s = device, 0.0

    def now_s(self) -> float:
        return self.time_s

    def write(self, data: bytes) -> None:
        self.device.receive(self.time_s, data)

    def read(self, until_s: float) -> list[tuple[float, bytes]]:
        self.time_s = max(self.time_s, until_s)
        return [(self.time_s, self.device.transmit(self.time_s))]

    def close(self) -> None:
        pass
