"""Friction that varies over the angle of the handle (synthetic)."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from tormagd.control.believe.ripple import Ripple

STEP_RAD = 0.01

Shape = Callable[[float], float]
"By angle, the device's force over its mean."


def turned(shape: Shape, turns: float, way: float = 1.0, stroke_rad: float = math.inf) -> Ripple:
    """After so many turns at 1.5 N, one way or to and fro."""
    ripple, angle = Ripple(), 0.2
    for step in range(round(turns * math.tau / STEP_RAD)):
        now = way if (step * STEP_RAD) // stroke_rad % 2 == 0 else -way
        angle += STEP_RAD * now
        ripple.update(angle, 42.0 * now, 1.5, 1.5 * shape(angle) / (1.0 + ripple.share(angle)))
    return ripple


def waves(*harmonics: tuple[int, float]) -> Shape:
    return lambda angle: 1.0 + sum(share * math.sin(k * angle + 0.5 * k) for k, share in harmonics)


@pytest.mark.parametrize("turn", [{}, {"way": -1.0}, {"stroke_rad": 10.0}])
@pytest.mark.parametrize("shape", [waves((1, 0.08)), waves((3, 0.12)), waves((1, 0.05), (2, 0.04), (3, 0.03))])
def test_turns_teach_once_twice_and_three_times_a_turn(shape: Shape, turn: dict[str, float]) -> None:
    ripple = turned(shape, 8.0, **turn)
    for angle in range(7):
        assert 1.0 + ripple.share(angle) == pytest.approx(shape(angle), abs=0.015)


@pytest.mark.parametrize(
    "shape",
    [
        lambda angle: 1.0 - 0.002 * angle,  # it fades
        lambda angle: 0.8 if angle > 7.5 else 1.0,  # it leaps
    ],
    ids=["fades", "leaps"],
)
def test_what_does_not_come_again_at_the_same_angle_is_no_ripple(shape: Shape) -> None:
    assert list(map(turned(shape, 5.2).share, range(7))) == pytest.approx([0.0] * 7, abs=1e-3)


@pytest.mark.parametrize(
    ("stroke_rad", "fades_N", "swing_N"), [(2.0, 1e-4, 0.0), (10.0, 1e-4, 0.0), (math.inf, 0.0, 0.3)]
)
def test_neither_a_fade_nor_what_lags_behind_a_swing_is_a_ripple(
    stroke_rad: float, fades_N: float, swing_N: float
) -> None:
    ripple, angle = Ripple(), 0.2
    for step in range(6000):
        way = 1.0 if (step * STEP_RAD) // stroke_rad % 2 == 0 else -1.0
        angle += STEP_RAD * way
        force_N, lags_N = 1.5 + swing_N * math.sin(3.0 * angle), 0.15 * swing_N * math.cos(3.0 * angle)
        ripple.update(angle, 42.0 * way, force_N, (force_N - lags_N - fades_N * step) / (1.0 + ripple.share(angle)))
    assert [ripple.share(angle) for angle in range(7)] == pytest.approx([0.0] * 7, abs=0.01)


def test_another_force_is_no_ripple() -> None:
    ripple = Ripple()
    for step in range(4000):
        model_N = 0.8 if step % 400 < 200 else 1.6
        ripple.update(step * STEP_RAD, 42.0, model_N, 1.06 * model_N - 0.04)
    assert [ripple.share(angle) for angle in range(7)] == pytest.approx([0.0] * 7, abs=1e-3)


def test_another_rate_is_no_ripple() -> None:
    ripple, rate_mm_s = Ripple(), 300.0
    for step in range(4000):
        rate_mm_s += 0.1 * ((300.0 if step % 400 < 200 else 42.0) - rate_mm_s)
        ripple.update(step * STEP_RAD, rate_mm_s, 1.0, 1.0 + 5e-4 * rate_mm_s)
    assert [ripple.share(angle) for angle in range(7)] == pytest.approx([0.0] * 7, abs=1e-3)


def test_few_readings_at_a_place_are_no_ripple() -> None:
    ripple, noise_N = Ripple(), np.random.default_rng(1).normal(0.0, 0.01, 4000).tolist()
    for step in range(4000):
        ripple.update(0.05 * step, 300.0, 0.6, 0.6 + noise_N[step])
    assert [ripple.share(angle) for angle in range(7)] == [0.0] * 7
