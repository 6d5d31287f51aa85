"""What every search promises, whatever its method: one suite over all of them."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest

from tormagd.inverse.bracketed import BracketedSearch, Refinement, finer_grid, newton
from tormagd.inverse.linear import GridArgmin, LinearFieldSearch, torch_row
from tormagd.inverse.nearest import NearestFieldSearch
from tormagd.inverse.newton import ACCURACY_MT, RisingSearch
from tormagd.inverse.solution import FieldSolver, Reach
from tormagd.model.features import LARGEST
from tormagd.model.model_file import ForceModel
from tormagd.physics.errors import DomainError

RANGE_MT = (100.0, 750.0)
CIP = 40.0
Make = Callable[[ForceModel], FieldSolver]


class Subject(NamedTuple):
    """A search, how near the root it comes on the smooth model (mT), and what it promises beyond."""

    make: Make
    accuracy_mT: float
    is_continuous: bool = True
    needs_rising: bool = False


def bracketed(refine: Refinement) -> Make:
    return lambda model: BracketedSearch(field_range_mT=RANGE_MT, refine=refine)


SUBJECTS = {
    "nearest": Subject(lambda model: NearestFieldSearch(field_range_mT=RANGE_MT), 5e-3),
    "coarse-to-fine": Subject(bracketed(finer_grid), 5e-3),
    "newton": Subject(bracketed(newton), 1e-6),
    "rising": Subject(lambda model: RisingSearch(RANGE_MT), ACCURACY_MT, needs_rising=True),
    "thesis-linear": Subject(
        lambda model: LinearFieldSearch(field_range_mT=RANGE_MT, epsilon_N=0.01, predict_one=torch_row(model)),
        *(5.0, False),
    ),
    "linear-argmin": Subject(lambda model: LinearFieldSearch(field_range_mT=RANGE_MT, epsilon_N=0.0), 0.51, False),
    "vectorised-argmin": Subject(lambda model: GridArgmin(model, field_range_mT=RANGE_MT), 0.51, False),
}
ANY_SHAPE = [name for name, subject in SUBJECTS.items() if not subject.needs_rising]
CONTINUOUS = [name for name in ANY_SHAPE if SUBJECTS[name].is_continuous]
FORGETFUL = [name for name in ANY_SHAPE if not SUBJECTS[name].is_continuous]
_MADE: dict[tuple[str, int], FieldSolver] = {}


def solver(name: str, model: ForceModel) -> FieldSolver:
    """The search on that model, made once."""
    if (name, id(model)) not in _MADE:
        _MADE[name, id(model)] = SUBJECTS[name].make(model)
    return _MADE[name, id(model)]


@pytest.mark.parametrize("name", SUBJECTS)
def test_on_a_rising_model_the_root_is_found(rising: ForceModel, name: str) -> None:
    searcher, accuracy = solver(name, rising), SUBJECTS[name].accuracy_mT
    rng = np.random.default_rng(3)
    last: float | None = None
    for displacement, rate, field in rng.uniform((0.05, 3, 110), (0.95, 57, 740), (60, 3)).tolist():
        force = rising.predict_one(displacement, rate, field, CIP)
        solution = searcher.solve(rising.curve(displacement, rate, CIP), force, last)
        assert solution.field_mT == pytest.approx(field, abs=accuracy)
        assert solution.reach is Reach.INSIDE
        assert solution.predicted_force_N == pytest.approx(
            rising.predict_one(displacement, rate, solution.field_mT, CIP), abs=1e-12
        )
        assert (0.999 if SUBJECTS[name].is_continuous else 0.0) < solution.confidence <= 1
        assert isinstance(solution.field_mT, float)
        last = solution.field_mT


@pytest.mark.parametrize("name", CONTINUOUS)
def test_on_a_model_that_falls_again_the_branch_is_kept(bump: ForceModel, name: str) -> None:
    searcher = solver(name, bump)
    peak = bump.predict_one(0.5, 10, 450.0, CIP)
    for start, side in ((400.0, -1), (500.0, 1)):
        last = start
        for depth in (*np.linspace(0.2, 2, 40), *np.linspace(2, 0.2, 40)):
            solution = searcher.solve(bump.curve(0.5, 10, CIP), peak - float(depth), last)
            assert solution.reach is Reach.INSIDE
            assert (solution.field_mT - 450) * side > 0
            assert abs(solution.field_mT - last) < 60
            assert solution.predicted_force_N == pytest.approx(peak - depth, abs=1e-3)
            last = solution.field_mT


@pytest.mark.parametrize("name", CONTINUOUS)
def test_without_a_last_field_the_lowest_root_wins(bump: ForceModel, name: str) -> None:
    force = bump.predict_one(0.5, 10, 300.0, CIP)
    accuracy = SUBJECTS[name].accuracy_mT
    assert solver(name, bump).solve(bump.curve(0.5, 10, CIP), force, None).field_mT == pytest.approx(
        300, abs=10 * accuracy
    )


@pytest.mark.parametrize("name", FORGETFUL)
def test_a_search_without_memory_answers_with_one_of_the_roots(bump: ForceModel, name: str) -> None:
    force = bump.predict_one(0.5, 10, 300.0, CIP)
    solution = solver(name, bump).solve(bump.curve(0.5, 10, CIP), force, 600.0)
    assert min(abs(solution.field_mT - 300), abs(solution.field_mT - 600)) <= 5
    assert solution.reach is Reach.INSIDE


@pytest.mark.parametrize("name", SUBJECTS)
@pytest.mark.parametrize("end", RANGE_MT)
def test_the_ends_themselves_are_inside(rising: ForceModel, name: str, end: float) -> None:
    curve = rising.curve(0.5, 10, CIP)
    solution = solver(name, rising).solve(curve, curve.force_N(end), None)
    assert solution.reach is Reach.INSIDE
    assert solution.field_mT == pytest.approx(end, abs=0.01 if SUBJECTS[name].is_continuous else 5.0)


@pytest.mark.parametrize("name", SUBJECTS)
def test_out_of_reach_is_the_nearest_end_and_never_silent(rising: ForceModel, name: str) -> None:
    searcher = solver(name, rising)
    least, most = (rising.predict_one(0.5, 10, field, CIP) for field in RANGE_MT)
    below = searcher.solve(rising.curve(0.5, 10, CIP), least - 0.5, 500.0)
    above = searcher.solve(rising.curve(0.5, 10, CIP), most + 0.5, 500.0)
    assert (below.field_mT, below.reach) == (RANGE_MT[0], Reach.BELOW)
    assert (above.field_mT, above.reach) == (RANGE_MT[1], Reach.ABOVE)
    for solution in (below, above):
        assert solution.confidence == pytest.approx(math.exp(-20 * 0.5 / 6), rel=1e-4)


@pytest.mark.parametrize("name", ANY_SHAPE)
def test_above_the_peak_of_a_bump_is_above(bump: ForceModel, name: str) -> None:
    peak = bump.predict_one(0.5, 10, 450.0, CIP)
    solution = solver(name, bump).solve(bump.curve(0.5, 10, CIP), peak + 0.1, 200.0)
    assert solution.reach is Reach.ABOVE
    assert solution.field_mT == pytest.approx(450, abs=2)


@pytest.mark.parametrize("name", ANY_SHAPE)
def test_a_tie_is_resolved_by_continuity(plateau: ForceModel, name: str) -> None:
    """Hundreds of fields give the same force to the last bit: the last field among them stays."""
    top = plateau.predict_one(0.5, 10, 740.0, CIP)
    for last in (600.0, 633.3):
        solution = solver(name, plateau).solve(plateau.curve(0.5, 10, CIP), top, last)
        assert solution.reach is Reach.INSIDE
        assert solution.predicted_force_N == pytest.approx(top, abs=0.02)
        if name in CONTINUOUS:
            # the grid searches may move to a neighbouring grid point
            assert solution.field_mT == pytest.approx(last, abs=2.0 if "nearest" in name else 1e-9)


@pytest.mark.parametrize("name", SUBJECTS)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e300])
def test_numbers_that_are_none_are_refused(rising: ForceModel, name: str, value: float) -> None:
    names = ("displacement_mm", "rate_mm_s", "force_N", "cip_percent", "last_field_mT")
    for position, word in enumerate(names):
        point = [0.5, 10.0, 2.0, CIP, 400.0]
        point[position] = value
        displacement, rate, force, cip, last = point
        with pytest.raises(DomainError, match=word):
            solver(name, rising).solve(rising.curve(displacement, rate, cip), force, last)


EXTREMES = (0.0, -0.0, 5e-324, -5e-324, 2.2e-308, 1e-300)
HUNDREDFOLD = {"displacement": 100.0, "rate": 6000.0, "force": 600.0, "cip": 4000.0, "last": 80_000.0}


@pytest.mark.parametrize("name", SUBJECTS)
def test_extreme_inputs_have_a_defined_answer(rising: ForceModel, name: str) -> None:
    """100 times the training range, zeros, denormals, the largest admissible: in range, finite, the same again."""
    searcher = solver(name, rising)
    usual = {"displacement": 0.5, "rate": 10.0, "force": 2.0, "cip": CIP, "last": 400.0}
    points = [usual | {key: value} for key in usual for value in (*EXTREMES, LARGEST, -LARGEST)]
    points += [usual | {key: sign * value} for key, value in HUNDREDFOLD.items() for sign in (1, -1)]
    points += [{key: sign * value for key, value in HUNDREDFOLD.items()} for sign in (1, -1)]
    points += [dict.fromkeys(usual, value) for value in (*EXTREMES, LARGEST, -LARGEST)]
    for point in points:
        displacement, rate, force, cip, last = point.values()
        curve = rising.curve(displacement, rate, cip)
        solution = searcher.solve(curve, force, last)
        assert RANGE_MT[0] <= solution.field_mT <= RANGE_MT[1]
        assert solution.predicted_force_N == pytest.approx(curve.force_N(solution.field_mT), rel=1e-12, abs=1e-12)
        least, most = (curve.force_N(field) for field in RANGE_MT)
        if not least - 0.01 <= force <= most + 0.01:
            assert solution.reach is (Reach.BELOW if force < least else Reach.ABOVE)
        elif least + 0.01 < force < most - 0.01:
            assert solution.reach is Reach.INSIDE
        assert 0 <= solution.confidence <= 1
        assert solution == searcher.solve(curve, force, last)


@pytest.mark.parametrize("name", SUBJECTS)
def test_far_outside_the_training_range_the_answer_is_not_trusted(rising: ForceModel, name: str) -> None:
    assert solver(name, rising).solve(rising.curve(100.0, 10.0, CIP), 2.0, 400.0).confidence < 1e-6
