"""Attraction of the magnets against the published 64-term sum in 50 digits, and against magpylib."""

import math
from itertools import product
from typing import Any

import mpmath as mp
import numpy as np
import pytest

from tormagd.physics.errors import DomainError
from tormagd.physics.magnets import CuboidMagnet, attraction_N

BLOCK = CuboidMagnet(width_m=0.040, depth_m=0.040, thickness_m=0.020, remanence_T=1.45)
SLAB = CuboidMagnet(width_m=0.060, depth_m=0.015, thickness_m=0.008, remanence_T=1.2)


def published_sum_N(gap_mm: float, magnet: CuboidMagnet) -> Any:
    """Akoun and Yonnet's force along z, all 64 terms, attraction positive."""
    a, b, c, remanence = (
        mp.mpf(edge) / divisor
        for edge, divisor in (
            (magnet.width_m, 2),
            (magnet.depth_m, 2),
            (magnet.thickness_m, 2),
            (magnet.remanence_T, 1),
        )
    )
    distance = mp.mpf(gap_mm) / 1000 + 2 * c
    total = mp.mpf(0)
    for i, j, k, m, p, q in product((1, -1), repeat=6):
        u, v, w = (j - i) * a, (m - k) * b, distance + (q - p) * c
        r = mp.sqrt(u * u + v * v + w * w)
        logs = u * w * mp.log(r - u) + v * w * mp.log(r - v)
        total += i * j * k * m * p * q * (logs - u * v * mp.atan(u * v / (r * w)) + r * w)
    return remanence**2 / (16 * mp.pi**2 * mp.mpf(10) ** -7) * total


@pytest.mark.parametrize("magnet", [BLOCK, SLAB])
@pytest.mark.parametrize(
    ("gap_mm", "tolerance"), [(0.01, 1e-12), (1.0, 1e-12), (45.0, 1e-11), (95.0, 1e-11), (200.0, 1e-9), (400.0, 1e-7)]
)
def test_agrees_with_the_published_sum(magnet: CuboidMagnet, gap_mm: float, tolerance: float) -> None:
    with mp.workdps(50):
        expected = float(published_sum_N(gap_mm, magnet))
    assert attraction_N(gap_mm, magnet) == pytest.approx(expected, rel=tolerance)


@pytest.mark.parametrize("magnet", [BLOCK, SLAB])
def test_agrees_with_magpylib(magnet: CuboidMagnet) -> None:
    magpylib = pytest.importorskip("magpylib")
    gaps_mm = np.array([10.0, 45.0, 60.0, 80.0, 95.0])
    edges = (magnet.width_m, magnet.depth_m, magnet.thickness_m)
    for gap_mm, ours in zip(gaps_mm, attraction_N(gaps_mm, magnet), strict=True):
        above = (0.0, 0.0, magnet.thickness_m + gap_mm * 1e-3)
        lower = magpylib.magnet.Cuboid(dimension=edges, polarization=(0.0, 0.0, magnet.remanence_T))
        upper = magpylib.magnet.Cuboid(dimension=edges, polarization=(0.0, 0.0, magnet.remanence_T), position=above)
        force, _ = magpylib.getFT(lower, upper, meshing=(16, 16, 8))
        assert -force[2] == pytest.approx(ours, rel=2e-3)


def test_agrees_with_the_published_sum_for_any_block_out_to_the_last_gap() -> None:
    rng = np.random.default_rng(1)
    for edges_m in 10 ** rng.uniform(-3.0, 0.0, (150, 3)):
        width_m, depth_m, thickness_m = map(float, edges_m)
        magnet = CuboidMagnet(width_m, depth_m, thickness_m, 1.3)
        last_mm = 49.999e3 * min(width_m, depth_m, thickness_m)
        for gap_mm in (last_mm, 10 ** rng.uniform(-1.0, math.log10(last_mm))):
            with mp.workdps(50):
                expected = float(published_sum_N(gap_mm, magnet))
            assert attraction_N(gap_mm, magnet) == pytest.approx(expected, rel=1e-5), edges_m
    with pytest.raises(DomainError, match="gap_mm"):
        attraction_N(1.01 * last_mm, magnet)


def test_far_apart_they_are_two_dipoles() -> None:
    moment = BLOCK.remanence_T / (4e-7 * math.pi) * BLOCK.width_m * BLOCK.depth_m * BLOCK.thickness_m
    distance_m = 0.8 + BLOCK.thickness_m
    assert attraction_N(800.0, BLOCK) == pytest.approx(6e-7 * moment**2 / distance_m**4, rel=0.01)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_falls_with_the_gap_and_keeps_the_type(dtype: Any) -> None:
    force = attraction_N(np.linspace(0.01, 200.0, 400).astype(dtype), BLOCK)
    assert force.dtype == dtype
    assert force.shape == (400,)
    assert (np.diff(force) < 0.0).all()
    assert force.min() > 0.0
    assert isinstance(attraction_N(60.0, BLOCK), float)


@pytest.mark.parametrize("gap_mm", [0.0, -1.0, 1001.0, math.nan, math.inf])
def test_gaps_outside_are_refused(gap_mm: float) -> None:
    with pytest.raises(DomainError, match="gap_mm"):
        attraction_N(gap_mm, BLOCK)
    with pytest.raises(DomainError, match="gap_mm"):
        attraction_N(np.array([60.0, gap_mm]), BLOCK)


@pytest.mark.parametrize("values", [(0.0, 0.04, 0.02, 1.45), (0.04, math.nan, 0.02, 1.45), (0.04, 0.04, 0.02, 14.5)])
def test_magnets_are_checked(values: tuple[float, float, float, float]) -> None:
    with pytest.raises(DomainError):
        CuboidMagnet(*values)
