"""Search in a k-d tree over precomputed samples of the network. For the laboratory: scipy is no daemon dependency."""

import numpy as np
from scipy.spatial import cKDTree

from tormagd.inverse.nearest import field_grid
from tormagd.inverse.scan import FieldScan
from tormagd.inverse.solution import FieldSolution, answer
from tormagd.model.features import FIELD
from tormagd.model.force_curve import EXTRAPOLATION_RATE, ForceCurve
from tormagd.model.model_file import ForceModel
from tormagd.physics.errors import DomainError

SCAN_INTERVALS = 16
BRANCH_SHARE = 1 / 8
"""Neighbours farther than this share of the field range from the one nearest the last field are of another branch."""


class KdTreeSearch:
    """Answers with the mean field, weighted by 1 / distance, of the `neighbours` nearest samples of the network.

    Samples lie on a lattice over the training ranges of displacement, rate and CIP (`lattice` points each) and over the
    field (every `step_mT`). Distance is Euclidean in shares of the ranges, force counting `FORCE_WEIGHT` times. Of
    neighbours on several branches, those near the last field (or the lowest) are averaged. The ends of reach come from
    a coarse look, which an average of samples cannot give. The distance to the samples, beyond a cell's size, lowers
    the confidence. Raises `DomainError` on parameters it cannot use.
    """

    FORCE_WEIGHT = 4.0

    def __init__(
        self,
        model: ForceModel,
        *,
        field_range_mT: tuple[float, float],
        step_mT: float = 4.0,
        neighbours: int = 8,
        lattice: int = 12,
    ) -> None:
        fields = field_grid(field_range_mT, step_mT)
        if lattice < 2:
            raise DomainError("lattice", lattice, "2 points or more")
        low_mT, high_mT = field_range_mT
        self._scan = FieldScan(
            field_range_mT=field_range_mT, step_mT=(high_mT - low_mT) / SCAN_INTERVALS, dtype=np.float64
        )
        axes = [np.linspace(low, high, lattice if high > low else 1) for low, high in model.feature_ranges]
        axes[FIELD] = fields
        samples = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))
        if not 1 <= neighbours <= len(samples):
            raise DomainError("neighbours", neighbours, f"1 to the number of samples, {len(samples)}")
        self._neighbours = neighbours
        self._branch_mT = BRANCH_SHARE * (high_mT - low_mT)
        spans = [(high - low) or 1.0 for low, high in model.feature_ranges]
        self._scale = np.array([1 / spans[0], 1 / spans[1], self.FORCE_WEIGHT / model.force_span_N, 1 / spans[3]])
        self._sample_mT = samples[:, FIELD].copy()
        samples[:, FIELD] = model.predict(samples)  # the force takes the field's place among the coordinates
        self._tree = cKDTree(samples * self._scale)
        self._cell = 1 / (lattice - 1)

    def solve(self, curve: ForceCurve, force_N: float, last_field_mT: float | None) -> FieldSolution:
        """See `FieldSolver.solve`."""
        look = self._scan.look(curve, force_N, last_field_mT)
        field_mT, iterations, far = look.candidate_mT, look.iterations, 0.0
        if field_mT is None:
            point = np.array((curve.displacement_mm, curve.rate_mm_s, force_N, curve.cip_percent)) * self._scale
            distances, found = self._tree.query(point, k=self._neighbours)
            distances, fields = np.atleast_1d(distances), self._sample_mT[np.atleast_1d(found)]
            seed_mT = fields[np.abs(fields - look.near_mT).argmin()]
            branch = np.abs(fields - seed_mT) <= self._branch_mT
            weights = 1 / np.maximum(distances[branch], 1e-9)
            field_mT = float(weights.dot(fields[branch]) / weights.sum())
            far = max(float(distances[0]) - self._cell, 0.0)
        solution = answer(curve, field_mT, force_N, curve.force_N(field_mT), iterations + 1, look.reach)
        return solution.replaced(confidence=solution.confidence * float(np.exp(-EXTRAPOLATION_RATE * far)))
