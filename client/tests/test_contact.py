"""The wall that a tip touches, from a noisy place and force."""

import math
import random

import pytest

from tormagd_client.contact import ContactEstimator
from tormagd_client.messages import Contact

HZ = 500
NOISE_N, NOISE_MM = 0.02, 0.2
SPEED_MM_S = 8.0


class Tip:
    def __init__(self, wall_mm: float, stiffness_N_mm: float, friction_N: float = 0.1, seed: int = 0) -> None:
        self.wall_mm, self.stiffness_N_mm, self.friction_N = wall_mm, stiffness_N_mm, friction_N
        self.found, self.place_mm, self.speed_mm_s = ContactEstimator(), 0.0, SPEED_MM_S
        self._draw = random.Random(seed)

    def go(self, *places_mm: float) -> None:
        for to_mm in places_mm:
            self._go(to_mm)

    def _go(self, to_mm: float) -> None:
        """Move at the tip's speed, or rest for a second if it is there."""
        steps = round(abs(to_mm - self.place_mm) * HZ / self.speed_mm_s)
        onward_mm = (to_mm - self.place_mm) / steps if steps else 0.0
        for _ in range(steps or HZ):
            self.place_mm += onward_mm
            wall_N = self.stiffness_N_mm * max(self.place_mm - self.wall_mm, 0.0)
            way = -1.0 if onward_mm < 0.0 else 1.0
            force_N = wall_N + way * self.friction_N + self._draw.gauss(0.0, NOISE_N)
            self.found.update(self.place_mm + self._draw.gauss(0.0, NOISE_MM), force_N, way)

    def expect(self, within_mm: float = 0.2, share: float = 0.1) -> None:
        contact = self.found.contact
        assert contact is not None
        assert contact.handle_mm == pytest.approx(self.wall_mm, abs=within_mm)
        assert contact.stiffness_N_mm == pytest.approx(self.stiffness_N_mm, rel=share)
        assert contact.friction_N == pytest.approx(self.friction_N, abs=0.02)
        assert 0.0 < contact.place_sd_mm < within_mm
        assert 0.0 < contact.stiffness_share < share


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("stiffness_N_mm", [0.3, 0.5, 1.0, 2.0])
def test_a_wall_is_known_once_it_was_touched_and_stays_known(stiffness_N_mm: float, seed: int) -> None:
    tip = Tip(12.0, stiffness_N_mm, seed=seed)
    tip.go(12.0)
    assert tip.found.contact is None
    for to_mm in (14.0, 14.0, 14.0, 2.0, 2.0, 11.0, 14.0):
        tip.go(to_mm)
        tip.expect()


@pytest.mark.parametrize("speed_mm_s", [8.0, 20.0, 60.0])
@pytest.mark.parametrize("stiffness_N_mm", [0.1, 0.3])
def test_a_wall_is_as_sure_as_it_says(stiffness_N_mm: float, speed_mm_s: float) -> None:
    squares = 0.0
    for seed in range(20, 40):
        tip = Tip(12.0, stiffness_N_mm, seed=seed)
        tip.speed_mm_s = speed_mm_s
        tip.go(12.0 + 1.8 / stiffness_N_mm)
        contact = tip.found.contact
        assert contact is not None
        squares += ((contact.handle_mm - 12.0) / contact.place_sd_mm) ** 2
    assert math.sqrt(squares / 20.0) < 2.0


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("moves_mm", [-5.0, 5.0])
def test_a_wall_that_has_moved_is_followed_within_a_second_of_touching_it_again(moves_mm: float, seed: int) -> None:
    tip = Tip(12.0, 0.5, seed=seed)
    tip.go(15.0, 0.0)
    tip.wall_mm += moves_mm
    tip.go(tip.wall_mm, tip.wall_mm + 0.5 * SPEED_MM_S)
    tip.expect()


@pytest.mark.parametrize(
    ("before_mm", "wall_mm", "to_mm"),
    [((15.0, 0.0), 20.0, 15.0), ((), 12.0, 12.6)],
    ids=["between the walls", "what noise allows no word of"],
)
def test_where_there_is_no_wall_to_tell_none_is_told(
    before_mm: tuple[float, ...], wall_mm: float, to_mm: float
) -> None:
    tip = Tip(12.0, 0.5)
    tip.go(*before_mm)
    tip.wall_mm = wall_mm
    tip.go(to_mm)
    assert tip.found.contact is None


def test_another_stiffness_is_learned_too() -> None:
    tip = Tip(12.0, 0.5)
    tip.go(16.0, 8.0)
    tip.stiffness_N_mm = 1.0
    tip.go(16.0)
    tip.expect()


@pytest.mark.parametrize("friction_N", [0.0, 0.1, 0.4])
def test_friction_alone_is_no_wall(friction_N: float) -> None:
    tip = Tip(1e3, 0.5, friction_N)
    for to_mm in (30.0, 0.0, 30.0):
        tip.go(to_mm)
        assert tip.found.contact is None
    assert tip.found.friction_N == pytest.approx(friction_N, abs=0.02)


def test_without_noise_it_is_the_wall() -> None:
    estimator = ContactEstimator()
    for step in range(2_000):
        place_mm = 0.01 * step
        estimator.update(place_mm, 0.2 + 0.8 * max(place_mm - 10.0, 0.0), 1.0)
    contact = estimator.contact or Contact(handle_mm=0.0, stiffness_N_mm=0.0)
    assert (contact.handle_mm, contact.stiffness_N_mm) == (pytest.approx(10.0, abs=0.1), pytest.approx(0.8, rel=0.02))
