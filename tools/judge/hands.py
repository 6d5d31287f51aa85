"""Hands at the handle: legs of even speed."""

import math
from collections.abc import Callable

import numpy as np

from tormagd.simulation.hand import Hand, RecordedHand

Legs = list[tuple[float, float]]
"How long, s, and how fast, mm/s."


class WaitingHand:
    def __init__(self) -> None:
        self._goes: Hand | None = None

    def begin(self, legs: Legs, start_s: float) -> None:
        times_s = np.cumsum([start_s, *(lasts_s for lasts_s, _ in legs)])
        places_mm = np.cumsum([0.0, *(lasts_s * speed_mm_s for lasts_s, speed_mm_s in legs)])
        self._goes = RecordedHand(tuple(times_s.tolist()), tuple(places_mm.tolist()))

    def position_mm(self, time_s: float) -> float:
        return 0.0 if self._goes is None else self._goes.position_mm(time_s)


def flicks() -> Legs:
    """Return 42 mm/s, with up to 200 mm/s and down again within half a second each, both ways."""
    legs: Legs = []
    for direction in (1.0, -1.0, 1.0, -1.0):
        rise = [(0.02, direction * (42.0 + 158.0 * step / 25.0)) for step in range(26)]
        legs += [(1.0, direction * 42.0), *rise, (0.3, direction * 200.0), *rise[::-1]]
    return legs * 3


def reversals(seed: int) -> Legs:
    """Turn and stop every 1..4 s, at speeds from a creep to 300 mm/s."""
    random = np.random.default_rng(seed)
    legs, direction = [], 1.0
    for _ in range(20):
        legs.append((random.uniform(1.0, 4.0), direction * math.exp(random.uniform(math.log(0.5), math.log(300.0)))))
        if random.random() < 0.4:
            legs.append((random.uniform(0.1, 1.0), 0.0))
        direction = -direction
    return legs


def ladder() -> Legs:
    """Go from 5 to 300 mm/s and back again, three seconds each."""
    speeds = (5.0, 8.0, 15.0, 42.0, 100.0, 200.0, 300.0)
    return [(3.0, speed) for speed in (*speeds, *(-speed for speed in speeds[::-1]))]


HANDS: dict[str, Callable[[], Legs]] = {
    "creep": lambda: [(3.0, 42.0), (30.0, 0.5)],
    "1 mm/s": lambda: [(3.0, 42.0), (30.0, 1.0)],
    "5 mm/s": lambda: [(60.0, 5.0)],
    "42 mm/s": lambda: [(60.0, 42.0)],
    "100 mm/s": lambda: [(60.0, -100.0)],
    "300 mm/s": lambda: [(60.0, 300.0)],
    "ladder": ladder,
    "flicks": flicks,
    "reversals": lambda: reversals(1),
    "other reversals": lambda: reversals(2),
}
