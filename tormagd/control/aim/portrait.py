"""The phase portrait of a device: which forces its gaps give, how fast a gap speed changes them, and the least gap."""

from typing import Final, final

import numpy as np
import numpy.typing as npt

from tormagd.control.believe.strength import DeviceFit
from tormagd.control.interpolation import Rising, at_step, interpolated, interpolated_before
from tormagd.control.nominal import FieldOfGap
from tormagd.control.records import Belief
from tormagd.element.inverse.solution import FieldSolution, Reach, checked_near_mT
from tormagd.element.model.force_curve import ForceCurve

Array = npt.NDArray[np.float64]
GRID: Final = 201
CEILING: Final = 1.25
"The gap stays where the device surely gives no more than this many times the scene's greatest force."
LAW_SHARE: Final = 0.12
"On sample 1 the search's field differs from the force law's by 1 to 11%."


@final
class Portrait:
    """Force and its slope |dF/dgap| over the gap, from open to closed, without memory. Beyond the ends the nearer end
    holds.
    """

    def __init__(self, gap_mm: list[float], force_N: list[float], slope_N_mm: list[float]) -> None:
        self.gap_mm: Final = gap_mm
        self.force_N: Final = force_N
        self.slope_N_mm: Final = slope_N_mm
        self.min_N: Final = force_N[0]
        self.max_N: Final = force_N[-1]
        self._step_mm: Final = (gap_mm[0] - gap_mm[-1]) / (len(gap_mm) - 1)
        self._rising_N: Final = Rising(force_N)

    def slope_at_N_mm(self, force_N: float) -> float:
        return interpolated(force_N, self._rising_N, self.slope_N_mm)

    def gap_and_slope_at(self, force_N: float) -> tuple[float, float]:
        """Return the gap of `force_N`, and |dF/dgap| at the next point of more force."""
        after = self._rising_N.after(force_N)
        gap_mm = interpolated_before(after, force_N, self._rising_N, self.gap_mm)
        return gap_mm, self.slope_N_mm[min(after, len(self.slope_N_mm) - 1)]

    def gap_mm_at(self, force_N: float) -> float:
        return interpolated(force_N, self._rising_N, self.gap_mm)

    def gap_for_mm(self, force_N: float, device: DeviceFit) -> float:
        return self.gap_mm_at(device.model_N(force_N))

    def force_N_at(self, gap_mm: float) -> float:
        return at_step(max((self.gap_mm[0] - gap_mm) / self._step_mm, 0.0), self.force_N)

    def force_rate_N_s(self, force_N: float, gap_speed_mm_s: float) -> float:
        return gap_speed_mm_s * self.slope_at_N_mm(force_N)


@final
class PortraitSearch:
    """The field search of a scene without the term `rate`: a look into the portrait."""

    def __init__(self, shown: Portrait, field: FieldOfGap) -> None:
        self._portrait: Final = shown
        self._field: Final = field

    def solve(self, curve: ForceCurve, force_N: float, last_field_mT: float | None) -> FieldSolution:
        checked_near_mT(force_N, last_field_mT, 0.0)
        shown = self._portrait
        field_mT = self._field.field_mT(shown.gap_mm_at(force_N))
        if shown.min_N <= force_N <= shown.max_N:
            return FieldSolution(field_mT, force_N, 1.0, 1, Reach.INSIDE)
        nearest_N, reach = (shown.min_N, Reach.BELOW) if force_N < shown.min_N else (shown.max_N, Reach.ABOVE)
        return FieldSolution(field_mT, nearest_N, curve.confidence(field_mT, force_N - nearest_N), 1, reach)


@final
class LawOfField:
    """The insert's magnetoelastic law (Eq. 29 to 34) over a portrait's gaps, scaled to its force."""

    def __init__(self, force_N: list[float], fields_mT: list[float]) -> None:
        self._rising_N: Final = Rising(force_N)
        self.fields_mT: Final = fields_mT

    def held_mT(self, field_mT: float, force_N: float) -> float:
        law_mT = interpolated(force_N, self._rising_N, self.fields_mT)
        return min(max(field_mT, (1.0 - LAW_SHARE) * law_mT), (1.0 + LAW_SHARE) * law_mT)


def portrait(curve: ForceCurve, field: FieldOfGap, gap_range_mm: tuple[float, float]) -> Portrait:
    """Return the portrait that the model's `curve` predicts over `gap_range_mm` (closed, open)."""
    gaps: Array = np.linspace(gap_range_mm[1], gap_range_mm[0], GRID)
    gap_mm: list[float] = gaps.tolist()
    forces_N = curve.forces_N(np.array([field.field_mT(gap) for gap in gap_mm]))
    slopes: list[float] = np.abs(np.gradient(forces_N, gaps)).tolist()
    return Portrait(gap_mm, forces_N.tolist(), slopes)


def least_mm(portrait: Portrait, belief: Belief, ceiling_N: float, scales: tuple[float, float]) -> float:
    """Return the least gap allowed for the believed device, and for an unseen one where there is one."""
    model_N = min(belief.device.surely_within_N(ceiling_N, scales), belief.anchor_N)
    if belief.unseen is not None:
        model_N = min(model_N, belief.unseen.surely_within_N(ceiling_N, scales))
    return portrait.gap_mm_at(model_N)
