"""The searches: they find the network's own root, keep their branch, and say when there is none."""

import math

import numpy as np
import pytest
from scipy.optimize import brentq

from tormagd.inverse.linear import THESIS_EPSILON_N, LinearFieldSearch
from tormagd.inverse.nearest import NearestFieldSearch, field_grid
from tormagd.inverse.solution import FieldSolution, Reach
from tormagd.model.model_file import ForceModel
from tormagd.physics.errors import DomainError

RANGE_MT = (100.0, 800.0)
CIP = 40.0


def nearest(**options: object) -> NearestFieldSearch:
    return NearestFieldSearch(field_range_mT=RANGE_MT, **{"step_mT": 1.0, **options})  # type: ignore[arg-type]


def linear(epsilon_N: float = 0.0) -> LinearFieldSearch:
    return LinearFieldSearch(field_range_mT=RANGE_MT, epsilon_N=epsilon_N)


def attainable(model: ForceModel, displacement_mm: float, rate_mm_s: float, share: float) -> float:
    """Return the force at `share` of the way from the least to the greatest at that point."""
    low, high = (model.predict_one(displacement_mm, rate_mm_s, field, CIP) for field in RANGE_MT)
    return low + share * (high - low)


def network_root(model: ForceModel, displacement_mm: float, rate_mm_s: float, force_N: float) -> float:
    """Return the field at which a rising model gives the force, by Brent's method."""
    return float(
        brentq(lambda field: model.predict_one(displacement_mm, rate_mm_s, field, CIP) - force_N, *RANGE_MT, xtol=1e-10)
    )


def test_interpolation_beats_the_grid(rising: ForceModel) -> None:
    """With a grid of 25 mT the answers stay within a hundredth of a step."""
    solver = nearest(step_mT=25.0)
    for share in np.linspace(0.03, 0.97, 41).tolist():
        force = attainable(rising, 0.5, 20, share)
        root = network_root(rising, 0.5, 20, force)
        assert solver.solve(rising.curve(0.5, 20, CIP), force, None).field_mT == pytest.approx(root, abs=0.25)


@pytest.mark.parametrize(("neighbours", "keeps"), [(1, False), (2, False), (16, True)])
def test_neighbours_decide_where_the_force_falls(lopsided: ForceModel, neighbours: int, keeps: bool) -> None:
    """Steep up, gently down: of the points nearest in force the first few are all on the gentle side."""
    solver, curve = nearest(neighbours=neighbours, step_mT=5.0), lopsided.curve(0.5, 10, CIP)
    last, strayed = 440.0, False
    for force in np.linspace(curve.force_N(440.0), curve.force_N(420.0), 80).tolist():
        solution = solver.solve(curve, force, last)
        assert solution.reach is Reach.INSIDE
        strayed |= solution.field_mT > 450.0
        last = solution.field_mT
    assert strayed is not keeps


def test_one_neighbour_is_enough_where_the_force_rises(rising: ForceModel) -> None:
    one, many = nearest(neighbours=1), nearest(neighbours=64)
    last = None
    for displacement, rate, share in np.random.default_rng(5).uniform((0, 0, -0.1), (1, 60, 1.1), (200, 3)).tolist():
        curve, force = rising.curve(displacement, rate, CIP), attainable(rising, displacement, rate, share)
        solution = one.solve(curve, force, last)
        assert solution == many.solve(curve, force, last)
        last = solution.field_mT


def test_on_a_plateau_the_field_moves_as_little_as_possible(plateau: ForceModel) -> None:
    """Where hundreds of fields give the same force, the answer is one of the nearest in force, not a far one."""
    solver = nearest(neighbours=701)
    top = plateau.predict_one(0.5, 10, 800.0, CIP)
    assert solver.solve(plateau.curve(0.5, 10, CIP), top, 700.0).field_mT == pytest.approx(700, abs=0.5)
    above = solver.solve(plateau.curve(0.5, 10, CIP), top + 1, 600.0)
    assert above.reach is Reach.ABOVE
    assert above.field_mT == pytest.approx(600, abs=0.5)


def test_a_slope_below_rounding_does_not_move_the_field(creeping: ForceModel) -> None:
    """The greatest force of all is at 800 mT, by a few units of rounding: no reason to travel there."""
    grid = [creeping.predict_one(0.5, 10, field, CIP) for field in (500.0, 650.0, 800.0)]
    assert 0 < grid[2] - grid[0] < 1e-14
    solution = nearest(neighbours=701).solve(creeping.curve(0.5, 10, CIP), grid[2] + 1, 600.0)
    assert solution.reach is Reach.ABOVE
    assert solution.field_mT == pytest.approx(600, abs=0.5)


def test_linear_stops_at_the_first_row_within_epsilon(rising: ForceModel) -> None:
    force = attainable(rising, 0.5, 10, 0.7)
    curve = rising.curve(0.5, 10, CIP)
    solution = linear(epsilon_N=0.2).solve(curve, force, None)
    rows = [curve.force_N(field) for field in field_grid(RANGE_MT, 1.0).tolist()]
    first = next(index for index, predicted in enumerate(rows) if abs(force - predicted) <= 0.2)
    assert solution == FieldSolution(100.0 + first, rows[first], solution.confidence, first + 1, Reach.INSIDE)
    assert linear(epsilon_N=0.0).solve(rising.curve(0.5, 10, CIP), force, None).iterations == 701


def test_linear_with_no_epsilon_is_the_argmin(rising: ForceModel) -> None:
    force = attainable(rising, 0.5, 10, 0.4)
    grid = field_grid(RANGE_MT, 1.0)
    rows = rising.predict(np.column_stack((np.full(701, 0.5), np.full(701, 10.0), grid, np.full(701, CIP))))
    assert linear().solve(rising.curve(0.5, 10, CIP), force, None).field_mT == grid[np.abs(rows - force).argmin()]


def test_linear_has_the_radius_of_the_thesis_by_default(rising: ForceModel) -> None:
    force = rising.predict_one(0.5, 10, 100.0, CIP)
    solver = LinearFieldSearch(field_range_mT=RANGE_MT)
    assert THESIS_EPSILON_N == 1.26
    assert solver.solve(rising.curve(0.5, 10, CIP), force - 1.25, None).reach is Reach.INSIDE
    assert solver.solve(rising.curve(0.5, 10, CIP), force - 1.27, None).reach is Reach.BELOW


def test_a_solve_leaves_no_trace_in_the_next(rising: ForceModel) -> None:
    solver = nearest()
    first = solver.solve(rising.curve(0.5, 10, CIP), 2.5, 300.0)
    solver.solve(rising.curve(0.9, 50, CIP), 4.0, 700.0)
    assert solver.solve(rising.curve(0.5, 10, CIP), 2.5, 300.0) == first


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"field_range_mT": (800.0, 100.0)}, "field_range_mT"),
        ({"field_range_mT": (100.0, math.nan)}, "field_range_mT"),
        ({"field_range_mT": (100.0, math.inf)}, "field_range_mT"),
        ({"step_mT": 0.0}, "step_mT"),
        ({"step_mT": -1.0}, "step_mT"),
        ({"step_mT": math.nan}, "step_mT"),
        ({"step_mT": 1e-9}, "step_mT"),
        ({"step_mT": 701.0}, "step_mT"),
        ({"neighbours": 0}, "neighbours"),
        ({"neighbours": 702}, "neighbours"),
    ],
)
def test_parameters_that_cannot_work_are_refused(rising: ForceModel, options: dict[str, object], name: str) -> None:
    with pytest.raises(DomainError, match=name):
        NearestFieldSearch(**{"field_range_mT": RANGE_MT, "step_mT": 1.0, **options})  # type: ignore[arg-type]


@pytest.mark.parametrize("epsilon", [-1.0, math.nan, math.inf])
def test_an_epsilon_that_cannot_work_is_refused(rising: ForceModel, epsilon: float) -> None:
    with pytest.raises(DomainError, match="epsilon_N"):
        linear(epsilon_N=epsilon)


def test_the_grid_has_both_ends_and_no_wider_step() -> None:
    grid = field_grid((100.0, 800.0), 3.0)
    assert (grid[0], grid[-1]) == (100.0, 800.0)
    assert 2.9 < np.diff(grid).max() <= 3.0
