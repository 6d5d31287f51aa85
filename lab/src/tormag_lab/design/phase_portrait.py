"""The phase portrait: which (force, force rate) points a brake renders at a gap speed, and how much of a task that is.

At the gap g the brake gives F(g) and |dF/dt| <= |dF/dg| * gap speed (Eq. 36), the *true* boundary. The thesis joins its
two end points by straight lines, a *trapezoid* that lies above it, as F falls about as gap^-2.6. The trapezoid serves
to compare with the thesis, the true boundary to decide.

Coverage of a region is a ratio of areas, exact for the trapezoid and an integral over the gap for the true boundary.
Coverage of a point cloud is a share of its points.
"""

from dataclasses import dataclass

import msgspec
import numpy as np

from tormag_lab.arrays import Mask
from tormag_lab.design.brake import Brake
from tormagd.element.physics.errors import FloatArray, require, require_that

MAX_FORCE_N = 1e6
MAX_RATE_N_S = 1e9
MAX_GAP_SPEED_MM_S = 1e4
_PANELS = 256
"Enough for a coverage good to 1e-5 (see the tests)."


class Region(msgspec.Struct, frozen=True):
    """A task's demand: |dF/dt| up to a rate that is linear in the force."""

    least_N: float
    least_rate_N_s: float
    most_N: float
    most_rate_N_s: float

    def __post_init__(self) -> None:
        for name in self.__struct_fields__:
            require(name, float(getattr(self, name)), 0.0, MAX_RATE_N_S if name.endswith("_s") else MAX_FORCE_N)
        require_that(self.least_N < self.most_N, "most_N", self.most_N, f"above least_N, {self.least_N:g}")
        is_moving = self.least_rate_N_s + self.most_rate_N_s > 0.0
        require_that(is_moving, "most_rate_N_s", self.most_rate_N_s, "above 0 where least_rate_N_s is 0")

    @property
    def half_area(self) -> float:
        return 0.5 * (self.least_rate_N_s + self.most_rate_N_s) * (self.most_N - self.least_N)

    def rate_N_s(self, force_N: FloatArray) -> FloatArray:
        share = (force_N - self.least_N) / (self.most_N - self.least_N)
        return self.least_rate_N_s + share * (self.most_rate_N_s - self.least_rate_N_s)


@dataclass(frozen=True, slots=True)
class PhasePortrait:
    """Phase portrait of a brake whose gap moves at up to `gap_speed_mm_s`."""

    brake: Brake
    gap_speed_mm_s: float

    def __post_init__(self) -> None:
        require("gap_speed_mm_s", self.gap_speed_mm_s, 1e-6, MAX_GAP_SPEED_MM_S)

    def trapezoid(self) -> Region:
        """Return the thesis's portrait, a straight line between the end points."""
        speed, brake = self.gap_speed_mm_s, self.brake
        return Region(
            brake.least_N,
            speed * brake.slope_N_mm(brake.open_mm),
            brake.most_N,
            speed * brake.slope_N_mm(brake.closed_mm),
        )

    def true_coverage(self, region: Region) -> float:
        brake = self.brake
        least, most = brake.least_N, brake.most_N
        low, high = max(region.least_N, least), min(region.most_N, most)
        if low >= high:
            return 0.0
        nearest_mm = brake.closed_mm if high == most else brake.gap_mm(high)
        farthest_mm = brake.open_mm if low == least else brake.gap_mm(low)
        # over ln(gap) the curves are nearly straight, and dF = |dF/dgap| gap d(ln gap)
        log_gap = np.linspace(np.log(nearest_mm), np.log(farthest_mm), _PANELS + 1)
        gap_mm = np.clip(np.exp(log_gap), brake.closed_mm, brake.open_mm)
        slope = brake.slope_N_mm(gap_mm)
        force = np.clip(brake.force_N(gap_mm), low, high)
        rendered = np.minimum(region.rate_N_s(force), self.gap_speed_mm_s * slope)
        # summed over the force's differences, full coverage is exactly 1
        return min(-float(np.trapezoid(rendered, force)) / region.half_area, 1.0)

    def trapezoid_coverage(self, region: Region) -> float:
        offered = self.trapezoid()
        low, high = max(region.least_N, offered.least_N), min(region.most_N, offered.most_N)
        if low >= high:
            return 0.0
        ends = np.array([low, high])
        first, last = offered.rate_N_s(ends) - region.rate_N_s(ends)
        crossing = low + (high - low) * first / (first - last) if first * last < 0.0 else low
        forces = np.array([low, crossing, high])
        smaller = np.minimum(region.rate_N_s(forces), offered.rate_N_s(forces))
        return min(float(np.trapezoid(smaller, forces)) / region.half_area, 1.0)

    def true_cloud(self, force_N: FloatArray, rate_N_s: FloatArray) -> Mask:
        """Return which points of a task, force and rate (n each), the true boundary covers."""
        gap_mm = np.geomspace(self.brake.open_mm, self.brake.closed_mm, 201)
        # a geometric series may end a rounding beyond its ends
        gap_mm = np.clip(gap_mm, self.brake.closed_mm, self.brake.open_mm)
        limit_N_s = self.gap_speed_mm_s * self.brake.slope_N_mm(gap_mm)
        limit: FloatArray = np.interp(force_N, self.brake.force_N(gap_mm), limit_N_s, left=-1.0, right=-1.0)
        return np.abs(rate_N_s) <= limit

    def trapezoid_cloud(self, force_N: FloatArray, rate_N_s: FloatArray) -> Mask:
        inside = (force_N >= self.brake.least_N) & (force_N <= self.brake.most_N)
        return inside & (np.abs(rate_N_s) <= self.trapezoid().rate_N_s(force_N))
