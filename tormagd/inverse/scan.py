"""The coarse look that precedes a refinement: where along the field the learned force meets the force asked."""

from bisect import bisect_left
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from tormagd.inverse.nearest import field_grid
from tormagd.inverse.solution import Reach, checked_near_mT
from tormagd.learning.features import FEATURES, FIELD
from tormagd.learning.model_file import ForceModel
from tormagd.physics.errors import DomainError

Floats: TypeAlias = NDArray[np.floating]

FINEST_MT = 2.0
"""Grids are refined until their step is this small: around the nearest point where nothing crosses, too."""

ZOOM_POINTS = 9


class Curve(NamedTuple):
    """The network along the field, other features fixed: force = constant_N + output . tanh(other + slope field)."""

    slope: Floats
    other: Floats
    output: Floats
    constant_N: float

    def forces_N(self, fields_mT: NDArray[np.float64]) -> Floats:
        """Force at each field."""
        hidden = np.multiply.outer(fields_mT.astype(self.slope.dtype), self.slope)
        hidden += self.other
        forces: Floats = np.tanh(hidden, hidden).dot(self.output)
        return forces + self.output.dtype.type(self.constant_N)

    def force_N(self, field_mT: float) -> float:
        """Force at one field."""
        hidden = self.slope * field_mT
        hidden += self.other
        return float(self.output.dot(np.tanh(hidden, hidden))) + self.constant_N

    def force_and_slope(self, field_mT: float) -> tuple[float, float]:
        """Force in N and dF/dB in N/mT at one field."""
        hidden = self.slope * field_mT
        hidden += self.other
        np.tanh(hidden, hidden)
        force_N = float(self.output.dot(hidden)) + self.constant_N
        hidden *= hidden
        np.subtract(1.0, hidden, hidden)
        hidden *= self.output
        return force_N, float(hidden.dot(self.slope))


class Bracket(NamedTuple):
    """Two fields between which the force crosses the one asked, and the force above it at each."""

    left_mT: float
    right_mT: float
    left_N: float
    right_N: float

    def distance_mT(self, field_mT: float) -> float:
        """How far a field lies outside."""
        return max(self.left_mT - field_mT, field_mT - self.right_mT, 0.0)

    @property
    def crossing_mT(self) -> float:
        """Where a straight line through both ends crosses."""
        return self.left_mT + (self.right_mT - self.left_mT) * (self.left_N / (self.left_N - self.right_N))


class Look(NamedTuple):
    """What a look shows: brackets to refine, nearest first, and `candidate_mT`, a field that fits or comes nearest.

    `near_mT` is the field from which distance counts; `ends_N` is how far the force at the least and the greatest field
    lies above the one asked. Out of reach there are no brackets, but a candidate.
    """

    curve: Curve
    near_mT: float
    ends_N: tuple[float, float]
    brackets: list[Bracket]
    candidate_mT: float | None
    reach: Reach
    iterations: int


class FieldScan:
    """Looks at the force on a coarse grid of fields (`step_mT`), the field-dependent half of the first layer hoisted.

    A dip or a bump narrower than the grid's step can go unseen, except where it decides over reach. `dtype` is
    numpy.float32 or numpy.float64. Raises `DomainError` on parameters it cannot use.
    """

    def __init__(
        self, model: ForceModel, *, field_range_mT: tuple[float, float], step_mT: float, dtype: type[np.floating]
    ) -> None:
        if dtype not in (np.float32, np.float64):
            raise DomainError("dtype", dtype, "numpy.float32 or numpy.float64")
        self._fields_mT = field_grid(field_range_mT, step_mT)
        # sigmoid(z) = (1 + tanh(z / 2)) / 2: numpy's tanh is vectorised, and it cannot overflow
        weight, bias, output, constant = model.physical
        others = [column for column in range(len(FEATURES)) if column != FIELD]
        self._other_weight = np.ascontiguousarray(weight[:, others] / 2)
        self._bias = bias / 2
        self._slope: Floats = (weight[:, FIELD] / 2).astype(dtype)
        self._output: Floats = (output / 2).astype(dtype)
        self._constant_N = constant + float(output.sum()) / 2
        self._field_half = np.multiply.outer(self._fields_mT, weight[:, FIELD] / 2).astype(dtype)
        self._hidden = np.empty_like(self._field_half)
        self._list_mT: list[float] = self._fields_mT.tolist()
        # sums of h terms, each wrong by a few units of rounding
        self.tie_N = 16 * float(np.finfo(dtype).eps) * (float(np.abs(output).sum()) + abs(constant))

    @property
    def field_range_mT(self) -> tuple[float, float]:
        """Least and greatest field."""
        return self._list_mT[0], self._list_mT[-1]

    def look(
        self, displacement_mm: float, rate_mm_s: float, force_N: float, cip_percent: float, last_field_mT: float | None
    ) -> Look:
        """Where the force is met, seen from the last field, or else from the least. `DomainError` on NaN."""
        least_mT = self._list_mT[0]
        near = checked_near_mT(displacement_mm, rate_mm_s, force_N, cip_percent, last_field_mT, least_mT)
        near = min(max(near, least_mT), self._list_mT[-1])
        other = self._other_weight.dot((displacement_mm, rate_mm_s, cip_percent)) + self._bias
        curve = Curve(self._slope, other.astype(self._slope.dtype, copy=False), self._output, self._constant_N)
        np.add(self._field_half, curve.other, out=self._hidden)
        forces = np.tanh(self._hidden, out=self._hidden).dot(self._output)
        lifted_N = force_N - self._constant_N
        excess = [force - lifted_N for force in forces.tolist()]
        fields = self._list_mT
        place = bisect_left(fields, near)
        if fields[place] == near:
            here_N = excess[place]
        else:
            here_N = curve.force_N(near) - force_N
            # the last field is one of the points: a crossing beside it is seen, and a flat force does not move it
            fields = [*fields[:place], near, *fields[place:]]
            excess.insert(place, here_N)
        return self._search(curve, near, here_N, fields, excess, force_N)

    def _search(
        self, curve: Curve, near: float, here_N: float, fields: list[float], excess: list[float], force_N: float
    ) -> Look:
        ends_N, iterations = (excess[0], excess[-1]), 2
        while True:
            brackets = _brackets(fields, excess)
            best_N = min(map(abs, excess))
            if brackets and best_N > self.tie_N:
                brackets.sort(key=lambda bracket: bracket.distance_mT(near))
                return Look(curve, near, ends_N, brackets, None, Reach.INSIDE, iterations)
            tied = [field for field, error in zip(fields, excess, strict=True) if abs(error) <= best_N + self.tie_N]
            nearest = min(tied, key=lambda field: abs(field - near))
            if best_N <= self.tie_N:
                brackets.sort(key=lambda bracket: bracket.distance_mT(near))
                return Look(curve, near, ends_N, brackets, nearest, Reach.INSIDE, iterations)
            at, last = fields.index(nearest), len(fields) - 1
            low, high = fields[max(at - 1, 0)], fields[min(at + 1, last)]
            if high - low <= 2 * FINEST_MT:
                if abs(here_N) <= best_N + self.tie_N:
                    nearest = near
                reach = Reach.ABOVE if excess[at] < 0 else Reach.BELOW
                return Look(curve, near, ends_N, [], nearest, reach, iterations)
            zoomed = np.linspace(low, high, ZOOM_POINTS)
            fields, iterations = zoomed.tolist(), iterations + 1
            excess = (curve.forces_N(zoomed) - force_N).tolist()


def _brackets(fields: list[float], excess: list[float]) -> list[Bracket]:
    return [
        Bracket(fields[left], fields[left + 1], at, excess[left + 1])
        for left, at in enumerate(excess[:-1])
        if (at < 0) != (excess[left + 1] < 0)
    ]
