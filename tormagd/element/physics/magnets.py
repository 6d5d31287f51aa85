"""Attraction between the two magnets: the axial load that the lead screws have to hold.

Closed form for two identical, coaxial, uniformly magnetised cuboids in free space (Akoun and Yonnet, IEEE Trans. Magn.
20 (1984) 1962-1964). On the axis the 64 corner terms fold to 12. Inverse hyperbolic sines in place of the logarithms
leave no difference of nearly equal numbers.
"""

import math
from dataclasses import dataclass
from itertools import product

import numpy as np

from tormagd.element.physics.errors import Real, require

MU0_H_M = 4e-7 * math.pi
MIN_GAP_MM = 0.01
MAX_GAP_PER_EDGE = 50.0
"The corner terms cancel too far beyond this many shortest edges."


@dataclass(frozen=True, slots=True)
class CuboidMagnet:
    """One block, magnetised along its thickness, the axis that joins the two."""

    width_m: float
    depth_m: float
    thickness_m: float
    remanence_T: float

    def __post_init__(self) -> None:
        for edge in ("width_m", "depth_m", "thickness_m"):
            require(edge, getattr(self, edge), 1e-3, 1.0)
        require("remanence_T", self.remanence_T, 0.01, 3.0)


def attraction_N(gap_mm: Real, magnet: CuboidMagnet) -> Real:
    edges_m = (magnet.width_m, magnet.depth_m, magnet.thickness_m)
    require("gap_mm", gap_mm, MIN_GAP_MM, MAX_GAP_PER_EDGE * min(edges_m) * 1e3)
    gap_m = np.asarray(gap_mm, dtype=np.float64) * 1e-3
    thickness_m = magnet.thickness_m
    # distances between charged faces, each with its sign, and the lateral offsets
    axial = ((gap_m, 1.0), (gap_m + thickness_m, -2.0), (gap_m + 2.0 * thickness_m, 1.0))
    across = ((0.0, 1.0), (magnet.width_m, -1.0))
    along = ((0.0, 1.0), (magnet.depth_m, -1.0))
    total = np.zeros_like(gap_m)
    for (u, sign_u), (v, sign_v), (w, sign_w) in product(across, along, axial):
        r = np.sqrt(u * u + v * v + w * w)
        term = u * w * np.arcsinh(u / np.hypot(v, w)) + v * w * np.arcsinh(v / np.hypot(u, w))
        total = total + sign_u * sign_v * sign_w * (term + u * v * np.arctan2(u * v, r * w) - r * w)
    force = magnet.remanence_T**2 / (math.pi * MU0_H_M) * total
    return float(force) if isinstance(gap_mm, float | int) else force.astype(np.asarray(gap_mm).dtype)
