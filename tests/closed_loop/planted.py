"""Errors planted into the simulated device for a test: a force sensor that lies."""

from collections.abc import Callable

from tormagd.simulation.device import VirtualDevice


class LyingSensor:
    """Before a device's own force sensor from `from_s` (its time) on; `lie` makes a false reading of a true one."""

    def __init__(self, device: VirtualDevice, lie: Callable[[float], float], from_s: float = 0.0) -> None:
        self._own, self._lie, self._from_s, self._time_s = device.messages.plant._force_sensor, lie, from_s, 0.0
        device.messages.plant._force_sensor = self  # type: ignore[assignment]

    def advance(self, time_s: float, force_N: float) -> None:
        """See `simulation.plant.ForceSensor`."""
        self._time_s = time_s
        self._own.advance(time_s, force_N)

    @property
    def reading_N(self) -> float:
        """What is shown, rounded as the wire does."""
        own = self._own.reading_N
        return own if self._time_s < self._from_s else min(max(self._lie(own), -20.0), 20.0)


def frozen() -> Callable[[float], float]:
    """A sensor that goes on showing its first reading."""
    first: list[float] = []

    def lie(reading_N: float) -> float:
        first[:] = first or [reading_N]
        return first[0]

    return lie
