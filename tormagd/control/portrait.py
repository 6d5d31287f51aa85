"""The device's phase portrait: which forces a gap gives, and how fast a gap speed changes them."""

from bisect import bisect_right
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tormagd.learning.displacement import MOBILISED_MM
from tormagd.learning.model_file import ForceModel
from tormagd.physics.field import FieldLaw, flux_density_T, radial_moment_from_flux_density_Tm
from tormagd.physics.force import Elastomer, Geometry, brake_force_N

Array = npt.NDArray[np.float64]
ROLLER_RATE_MM_S = 42.0
"Surface speed of the roller at the thesis's 20 rpm: the portrait is drawn for a handle in motion."
GRID = 201


class FieldOfGap(NamedTuple):
    """The flux density at the shaft's surface, mT, over the gap, mm, in one insert."""

    law: FieldLaw
    relative_permeability: float
    inner_radius_m: float

    def field_mT(self, gap_mm: float) -> float:
        """Flux density |b| at R_i (Eq. 6 with a of the field law)."""
        moment = self.law.radial_moment_Tm(gap_mm)
        return 1e3 * float(flux_density_T(moment, self.relative_permeability, self.inner_radius_m))

    def gap_mm(self, field_mT: float) -> float:
        """The gap that gives `field_mT`."""
        moment = radial_moment_from_flux_density_Tm(1e-3 * field_mT, self.relative_permeability, self.inner_radius_m)
        return float(self.law.gap_mm(moment))


class Portrait(NamedTuple):
    """Force over gap with friction fully mobilised, and its slope; forces rise and gaps fall along the arrays."""

    gap_mm: Array
    force_N: Array
    slope_N_mm: Array
    """|dF/dgap|, N per mm."""

    @property
    def least_N(self) -> float:
        """F_min: what the open gap gives. A passive brake gives no less."""
        return float(self.force_N[0])

    @property
    def most_N(self) -> float:
        """F_max: what the closed gap gives."""
        return float(self.force_N[-1])

    def slope_at_N_mm(self, force_N: float) -> float:
        """|dF/dgap| where the gap gives this force."""
        return float(np.interp(force_N, self.force_N, self.slope_N_mm))

    def gaps_mm(self, forces_N: Array) -> Array:
        """The gaps that give these forces; the nearest end of the range where none does."""
        gaps: Array = np.interp(forces_N, self.force_N, self.gap_mm)
        return gaps

    def gap_mm_at(self, force_N: float) -> float:
        """`gaps_mm` of one force."""
        return float(np.interp(force_N, self.force_N, self.gap_mm))

    def force_rate_N_s(self, force_N: float, gap_speed_mm_s: float) -> float:
        """The fastest change of force that a gap speed renders at this force."""
        return gap_speed_mm_s * self.slope_at_N_mm(force_N)


class LawOfField(NamedTuple):
    """The magnetoelastic law of the insert (Eq. 29 to 34) over the gaps of a portrait, scaled to its force: what the
    learned model is held against. Force and field rise along the arrays."""

    force_N: list[float]
    fields_mT: list[float]

    @classmethod
    def beside(cls, shown: Portrait, field: FieldOfGap, elastomer: Elastomer, geometry: Geometry) -> "LawOfField":
        """The law beside a portrait. Raises `DomainError` where the gaps leave the law's domain."""
        moments_Tm: Array = np.asarray(field.law.radial_moment_Tm(shown.gap_mm), dtype=np.float64)
        forces_N: Array = np.asarray(brake_force_N(moments_Tm, elastomer, geometry), dtype=np.float64)
        scale = float(np.median(shown.force_N / forces_N))
        return cls((scale * forces_N).tolist(), [field.field_mT(gap_mm) for gap_mm in shown.gap_mm.tolist()])

    def field_mT(self, force_N: float) -> float:
        """The field for a force; that of the nearer end where none gives it."""
        return _interpolated(force_N, self.force_N, self.fields_mT)


def portrait(model: ForceModel, field: FieldOfGap, cip_percent: float, gap_range_mm: tuple[float, float]) -> Portrait:
    """The portrait that the learned model predicts over a gap range, for a handle that turns at ROLLER_RATE_MM_S, or
    the nearest rate that the model knows."""
    gaps = np.linspace(gap_range_mm[1], gap_range_mm[0], GRID)
    (_, mobilised_mm), rates_mm_s, _, _ = model.feature_ranges
    rate_mm_s = min(max(ROLLER_RATE_MM_S, rates_mm_s[0]), rates_mm_s[1])
    displacement_mm = min(MOBILISED_MM, mobilised_mm)
    features = np.array([[displacement_mm, rate_mm_s, field.field_mT(float(gap)), cip_percent] for gap in gaps])
    force = model.predict(features)
    return Portrait(gaps, force, np.abs(np.gradient(force, gaps)))


def _interpolated(x: float, xs: list[float], ys: list[float]) -> float:
    """Linear between the points of rising `xs`, and the outermost `ys` beyond: NumPy takes longer for one point."""
    after = bisect_right(xs, x)
    if after == 0:
        return ys[0]
    if after == len(xs):
        return ys[-1]
    share = (x - xs[after - 1]) / (xs[after] - xs[after - 1])
    return ys[after - 1] + share * (ys[after] - ys[after - 1])
