"""Friction that varies over the angle of the handle (synthetic)."""

import math
from collections.abc import Callable

import pytest

from tormagd.control.believe.anchor import Anchor
from tormagd.control.believe.ripple import QUIET, Ripple
from tormagd.control.believe.strength import UNSEEN

RADIUS_MM, STEP_MM = 20.0, 0.2
TURN_MM = 2.0 * math.pi * RADIUS_MM

Shape = Callable[[float], float]
"By place, mm, the device's force over its mean."


def turned(shape: Shape, turns: float, way: float = 1.0, from_mm: float = 3.0) -> Ripple:
    """After so many turns at 1.5 N."""
    ripple, anchor = Ripple(RADIUS_MM), Anchor(UNSEEN)
    for step in range(round(turns * TURN_MM / STEP_MM)):
        place_mm = from_mm + way * step * STEP_MM
        reading_N = 1.5 * shape(place_mm) / (1.0 + ripple.share(place_mm))
        ripple.update(place_mm, 1.5, reading_N, anchor)
    return ripple


def waves(*harmonics: tuple[int, float]) -> Shape:
    return lambda place_mm: 1.0 + sum(share * math.sin(k * place_mm / RADIUS_MM + 0.5 * k) for k, share in harmonics)


@pytest.mark.parametrize("way", [1.0, -1.0])
@pytest.mark.parametrize("shape", [waves((1, 0.08)), waves((3, 0.12)), waves((1, 0.05), (2, 0.04), (3, 0.03))])
def test_two_turns_teach_once_twice_and_three_times_a_turn(shape: Shape, way: float) -> None:
    ripple = turned(shape, 2.1, way)
    for place_mm in range(0, 126, 7):
        assert 1.0 + ripple.share(place_mm) == pytest.approx(shape(place_mm), abs=0.006)


@pytest.mark.parametrize("turns", [0.9, 1.9])
def test_less_than_two_turns_teach_nothing(turns: float) -> None:
    assert turned(waves((1, 0.08)), turns).shares == [0.0] * 6


@pytest.mark.parametrize(
    "shape",
    [
        lambda place_mm: 1.0 - 3e-4 * place_mm,  # it fades
        lambda place_mm: 0.8 if place_mm > 150.0 else 1.0,  # it leaps
        waves((1, 0.9 * QUIET)),
    ],
    ids=["fades", "leaps", "is quiet"],
)
def test_what_does_not_come_again_at_the_same_angle_is_no_ripple(shape: Shape) -> None:
    assert turned(shape, 5.2).shares == [0.0] * 6


def test_a_handle_that_turns_back_begins_a_turn_anew() -> None:
    ripple, anchor, shape = Ripple(RADIUS_MM), Anchor(UNSEEN), waves((1, 0.08))
    for stroke in range(8):
        for step in range(300):
            place_mm = step * STEP_MM if stroke % 2 == 0 else (299 - step) * STEP_MM
            ripple.update(place_mm, 1.5, 1.5 * shape(place_mm), anchor)
    assert ripple.shares == [0.0] * 6
