"""The closed form for the torque element: the thesis's magnetoelastic law inverted, no network, no search."""

import math

from tormagd.inverse.solution import FieldSolution, Reach, answer, checked_near_mT
from tormagd.model.features import Element
from tormagd.model.force_curve import ForceCurve
from tormagd.model.model_file import ForceModel
from tormagd.physics.errors import DomainError
from tormagd.physics.field import flux_density_T, radial_moment_from_flux_density_Tm
from tormagd.physics.force import Elastomer, Geometry, brake_force_N, radial_moment_for_force_Tm


class ClosedForm:
    """Field at the shaft from the kinetic force (Eq. 29 to 34 inverted).

    It knows neither displacement nor rate: pre-sliding and Stribeck friction, which the network has learned, are its
    error. The force rises strictly with the field, so there are no branches and the last field is checked and not used.
    What the curve gives at the answer is reported, and its disagreement lowers the confidence.
    Raises `DomainError` on a model of another element, and on a field range outside the force law's domain.
    """

    def __init__(
        self, model: ForceModel, elastomer: Elastomer, geometry: Geometry, *, field_range_mT: tuple[float, float]
    ) -> None:
        if model.metadata.element is not Element.TORQUE:
            raise DomainError("element", model.metadata.element, "the torque element: the law is that of its friction")
        low_mT, high_mT = field_range_mT
        if not low_mT < high_mT:
            raise DomainError("field_range_mT", field_range_mT, "a least field below the greatest")
        self._elastomer, self._geometry = elastomer, geometry
        self._range_mT = field_range_mT
        self._least_N, self._most_N = self._force_N(low_mT), self._force_N(high_mT)

    def solve(self, curve: ForceCurve, force_N: float, last_field_mT: float | None) -> FieldSolution:
        """See `FieldSolver.solve`; `reach` is that of the closed form."""
        low_mT, high_mT = self._range_mT
        checked_near_mT(force_N, last_field_mT, low_mT)
        if force_N < self._least_N:
            field_mT, reach = low_mT, Reach.BELOW
        elif force_N > self._most_N:
            field_mT, reach = high_mT, Reach.ABOVE
        else:
            field_mT, reach = min(max(self._field_mT(force_N), low_mT), high_mT), Reach.INSIDE
        return answer(curve, field_mT, force_N, curve.force_N(field_mT), 0, reach)

    def _force_N(self, field_mT: float) -> float:
        """Kinetic force at a field; `DomainError` outside the law's domain."""
        if not math.isfinite(field_mT):
            raise DomainError("field_range_mT", field_mT, "finite fields")
        moment = radial_moment_from_flux_density_Tm(
            1e-3 * field_mT, self._elastomer.relative_permeability, self._geometry.inner_radius_m
        )
        return float(brake_force_N(moment, self._elastomer, self._geometry))

    def _field_mT(self, force_N: float) -> float:
        moment = radial_moment_for_force_Tm(force_N, self._elastomer, self._geometry)
        return 1e3 * flux_density_T(moment, self._elastomer.relative_permeability, self._geometry.inner_radius_m)
