"""What every search promises, whatever its method: one suite over all of them."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest

from tormagd.inverse.bracketed import BracketedSearch, Refinement, brent, finer_grid, newton
from tormagd.inverse.linear import GridArgmin, LinearFieldSearch, torch_row
from tormagd.inverse.nearest import NearestFieldSearch
from tormagd.inverse.newton import ACCURACY_MT, RisingSearch
from tormagd.inverse.solution import FieldSolver, Reach
from tormagd.lab.searches.closed_form import ClosedForm
from tormagd.lab.searches.direct import DirectInverse
from tormagd.lab.searches.kd_tree import KdTreeSearch
from tormagd.model.features import LARGEST
from tormagd.model.model_file import ForceModel
from tormagd.physics.errors import DomainError
from tormagd.physics.field import radial_moment_from_flux_density_Tm
from tormagd.physics.force import TORMAG, brake_force_N
from tormagd.physics.inserts import insert

RANGE_MT = (100.0, 750.0)
CIP = 40.0
ELASTOMER = insert("MRE-50-40").elastomer
Make = Callable[[ForceModel], FieldSolver]


class Subject(NamedTuple):
    """A search, how near the root it comes on the smooth model (mT), and what it promises beyond."""

    make: Make
    accuracy_mT: float
    is_continuous: bool = True
    needs_rising: bool = False
    uses_network: bool = True


def bracketed(refine: Refinement, dtype: type[np.floating] = np.float64) -> Make:
    return lambda model: BracketedSearch(field_range_mT=RANGE_MT, refine=refine, dtype=dtype)


def linear(epsilon_N: float) -> Make:
    return lambda model: LinearFieldSearch(field_range_mT=RANGE_MT, epsilon_N=epsilon_N, predict_one=torch_row(model))


SUBJECTS = {
    "nearest": Subject(lambda model: NearestFieldSearch(field_range_mT=RANGE_MT), 5e-3),
    "nearest float32": Subject(
        lambda model: NearestFieldSearch(field_range_mT=RANGE_MT, step_mT=1.0, dtype=np.float32), 1e-2
    ),
    "coarse-to-fine": Subject(bracketed(finer_grid), 5e-3),
    "coarse-to-fine float32": Subject(bracketed(finer_grid, np.float32), 2e-2),
    "newton": Subject(bracketed(newton), 1e-6),
    "newton float32": Subject(bracketed(newton, np.float32), 1e-2),
    "rising": Subject(lambda model: RisingSearch(RANGE_MT), ACCURACY_MT, needs_rising=True),
    "brent": Subject(bracketed(brent), 1e-3),
    "k-d tree": Subject(lambda model: KdTreeSearch(model, field_range_mT=RANGE_MT), 25.0),
    "direct": Subject(lambda model: DirectInverse(model, field_range_mT=RANGE_MT), 10.0, True, True),
    "thesis-linear": Subject(linear(0.01), 5.0, False),
    "linear-argmin": Subject(linear(0.0), 0.51, False),
    "vectorised-argmin": Subject(lambda model: GridArgmin(model, field_range_mT=RANGE_MT), 0.51, False),
    "closed form": Subject(
        lambda model: ClosedForm(model, ELASTOMER, TORMAG, field_range_mT=RANGE_MT), 1e-6, uses_network=False
    ),
}
NETWORK = [name for name, subject in SUBJECTS.items() if subject.uses_network]
CONTINUOUS = [name for name in NETWORK if SUBJECTS[name].is_continuous and not SUBJECTS[name].needs_rising]
FORGETFUL = [name for name in NETWORK if not SUBJECTS[name].is_continuous]
_MADE: dict[tuple[str, int], FieldSolver] = {}


def solver(name: str, model: ForceModel) -> FieldSolver:
    """The search on that model, made once: some take a training."""
    if (name, id(model)) not in _MADE:
        _MADE[name, id(model)] = SUBJECTS[name].make(model)
    return _MADE[name, id(model)]


def force_N(name: str, model: ForceModel, displacement_mm: float, rate_mm_s: float, field_mT: float) -> float:
    """The force that the search inverts: the network's, or the closed form's."""
    if SUBJECTS[name].uses_network:
        return model.predict_one(displacement_mm, rate_mm_s, field_mT, CIP)
    moment = radial_moment_from_flux_density_Tm(1e-3 * field_mT, ELASTOMER.relative_permeability, TORMAG.inner_radius_m)
    return float(brake_force_N(moment, ELASTOMER, TORMAG))


@pytest.mark.parametrize("name", SUBJECTS)
def test_on_a_rising_model_the_root_is_found(rising: ForceModel, name: str) -> None:
    searcher, accuracy = solver(name, rising), SUBJECTS[name].accuracy_mT
    rng = np.random.default_rng(3)
    last: float | None = None
    for displacement, rate, field in rng.uniform((0.05, 3, 110), (0.95, 57, 740), (60, 3)).tolist():
        force = force_N(name, rising, displacement, rate, field)
        solution = searcher.solve(rising.curve(displacement, rate, CIP), force, last)
        assert solution.field_mT == pytest.approx(field, abs=accuracy)
        assert solution.reach is Reach.INSIDE
        assert solution.predicted_force_N == pytest.approx(
            rising.predict_one(displacement, rate, solution.field_mT, CIP), abs=1e-12
        )
        assert 0 < solution.confidence <= 1
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


@pytest.mark.parametrize("fixture", ["bump", "plateau"])
def test_a_direct_inverse_refuses_a_model_that_has_none(request: pytest.FixtureRequest, fixture: str) -> None:
    with pytest.raises(DomainError, match="rises with the field everywhere"):
        SUBJECTS["direct"].make(request.getfixturevalue(fixture))


@pytest.mark.parametrize("name", SUBJECTS)
def test_out_of_reach_is_the_nearest_end_and_never_silent(rising: ForceModel, name: str) -> None:
    searcher = solver(name, rising)
    least, most = (force_N(name, rising, 0.5, 10, field) for field in RANGE_MT)
    below = searcher.solve(rising.curve(0.5, 10, CIP), least - 0.5, 500.0)
    above = searcher.solve(rising.curve(0.5, 10, CIP), most + 0.5, 500.0)
    assert (below.field_mT, below.reach) == (RANGE_MT[0], Reach.BELOW)
    assert (above.field_mT, above.reach) == (RANGE_MT[1], Reach.ABOVE)
    if SUBJECTS[name].uses_network:
        assert max(below.confidence, above.confidence) <= math.exp(-20 * 0.49 / 6)


@pytest.mark.parametrize("name", NETWORK)
def test_above_the_peak_of_a_bump_is_above(bump: ForceModel, name: str) -> None:
    if SUBJECTS[name].needs_rising:
        pytest.skip("for rising forces only")
    peak = bump.predict_one(0.5, 10, 450.0, CIP)
    solution = solver(name, bump).solve(bump.curve(0.5, 10, CIP), peak + 0.1, 200.0)
    assert solution.reach is Reach.ABOVE
    assert solution.field_mT == pytest.approx(450, abs=2)


@pytest.mark.parametrize("name", NETWORK)
def test_a_tie_is_resolved_by_continuity(plateau: ForceModel, name: str) -> None:
    """Hundreds of fields give the same force to the last bit: the last field among them stays."""
    if SUBJECTS[name].needs_rising:
        pytest.skip("for rising forces only")
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
        assert math.isfinite(solution.predicted_force_N)
        assert 0 <= solution.confidence <= 1
        assert solution == searcher.solve(curve, force, last)


@pytest.mark.parametrize("name", SUBJECTS)
def test_far_outside_the_training_range_the_answer_is_not_trusted(rising: ForceModel, name: str) -> None:
    assert solver(name, rising).solve(rising.curve(100.0, 10.0, CIP), 2.0, 400.0).confidence < 1e-6


@pytest.mark.parametrize(("single", "double"), [("newton float32", "newton"), ("nearest float32", "nearest")])
def test_single_precision_stays_near_double(rising: ForceModel, single: str, double: str) -> None:
    rng = np.random.default_rng(5)
    for displacement, rate, field in rng.uniform((0.05, 3, 110), (0.95, 57, 740), (100, 3)).tolist():
        force = rising.predict_one(displacement, rate, field, CIP)
        ends = [
            solver(name, rising).solve(rising.curve(displacement, rate, CIP), force, 400.0).field_mT
            for name in (single, double)
        ]
        assert ends[0] == pytest.approx(ends[1], abs=0.01)
