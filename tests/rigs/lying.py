"""A force sensor that lies."""

from collections.abc import Callable

from tormagd.simulation.plant import Plant

Lie = Callable[[float, float], float]
"The reading shown, from the first and the present true reading."


class LyingSensor:
    """A force sensor that lies from now on."""

    def __init__(self, plant: Plant, lie: Lie) -> None:
        self.mended, self._lie, self._first_N = plant.force_sensor, lie, plant.force_sensor.reading_N
        plant.force_sensor = self

    @property
    def reading_N(self) -> float:
        return min(max(self._lie(self._first_N, self.mended.reading_N), -20.0), 20.0)

    def advance(self, time_s: float, force_N: float) -> None:
        self.mended.advance(time_s, force_N)
