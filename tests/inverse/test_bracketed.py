"""Look and refinement: roots beside the last field, steep steps, peaks between grid points."""

import numpy as np
import pytest

from tormagd.inverse.bracketed import BracketedSearch, Refinement, brent, finer_grid, newton
from tormagd.inverse.newton import ACCURACY_MT
from tormagd.inverse.solution import Reach
from tormagd.lab.searches.closed_form import ClosedForm
from tormagd.lab.searches.direct import DirectInverse
from tormagd.lab.searches.kd_tree import KdTreeSearch
from tormagd.model.model_file import ForceModel
from tormagd.physics.errors import DomainError
from tormagd.physics.force import TORMAG
from tormagd.physics.inserts import insert

RANGE_MT = (100.0, 800.0)
CIP = 40.0
REFINEMENTS = (newton, finer_grid, brent)


def search(refine: Refinement, step_mT: float = 30.0) -> BracketedSearch:
    return BracketedSearch(field_range_mT=RANGE_MT, refine=refine, step_mT=step_mT)


@pytest.mark.parametrize("refine", [newton, brent])
def test_a_step_steeper_than_the_grid_is_met_exactly(plateau: ForceModel, refine: Refinement) -> None:
    """Newton's slope is zero to the last bit on both sides of the step: bisection carries it there."""
    middle = 0.5 * sum(plateau.predict_one(0.5, 10, field, CIP) for field in RANGE_MT)
    solution = search(refine, 60.0).solve(plateau.curve(0.5, 10, CIP), middle, 200.0)
    assert solution.field_mT == pytest.approx(450, abs=ACCURACY_MT)
    assert solution.predicted_force_N == pytest.approx(middle, abs=1e-3)
    assert solution.iterations < 50


@pytest.mark.parametrize("refine", REFINEMENTS)
def test_a_force_met_only_between_grid_points_is_not_called_out_of_reach(bump: ForceModel, refine: Refinement) -> None:
    """The peak stands at 450 mT; a grid of 100 mT has points at 400 and 500, both lower."""
    peak, shoulder = (bump.predict_one(0.5, 10, field, CIP) for field in (450.0, 400.0))
    force = peak - 0.2 * (peak - shoulder)
    solution = search(refine, 100.0).solve(bump.curve(0.5, 10, CIP), force, 150.0)
    assert solution.reach is Reach.INSIDE
    assert solution.predicted_force_N == pytest.approx(force, abs=1e-3)
    assert solution.field_mT < 450


@pytest.mark.parametrize("refine", REFINEMENTS)
def test_the_last_field_is_a_point_of_the_grid(bump: ForceModel, refine: Refinement) -> None:
    """From near the peak both roots lie in intervals that a grid of 700 mT does not have."""
    force = bump.predict_one(0.5, 10, 440.0, CIP)
    for last, root in ((446.0, 440.0), (455.0, 460.0)):
        solution = search(refine, 700.0).solve(bump.curve(0.5, 10, CIP), force, last)
        assert solution.field_mT == pytest.approx(root, abs=1.0 if refine is finer_grid else 0.01)


@pytest.mark.parametrize("refine", REFINEMENTS)
@pytest.mark.parametrize("end", RANGE_MT)
def test_the_ends_themselves_are_inside(rising: ForceModel, refine: Refinement, end: float) -> None:
    solution = search(refine).solve(rising.curve(0.5, 10, CIP), rising.predict_one(0.5, 10, end, CIP), None)
    assert solution.reach is Reach.INSIDE
    assert solution.field_mT == pytest.approx(end, abs=0.01)


def test_newton_needs_few_evaluations(rising: ForceModel) -> None:
    rng = np.random.default_rng(2)
    counts = []
    for field in rng.uniform(*RANGE_MT, 200).tolist():
        force = rising.predict_one(0.5, 10, field, CIP)
        counts.append(search(newton).solve(rising.curve(0.5, 10, CIP), force, field + 20).iterations)
    assert np.mean(counts) < 6
    assert max(counts) < 12


def test_the_direct_inverse_is_the_same_for_the_same_seed(rising: ForceModel) -> None:
    answers = [
        DirectInverse(rising, field_range_mT=RANGE_MT, hidden=8, seed=seed, iterations=20)
        .solve(rising.curve(0.5, 10, CIP), 3.0, None)
        .field_mT
        for seed in (1, 1, 2)
    ]
    assert answers[0] == answers[1] != answers[2]


def test_the_tree_trusts_an_answer_less_the_farther_its_samples(rising: ForceModel) -> None:
    """Beside what the training ranges and the force left over already say."""
    tree = KdTreeSearch(rising, field_range_mT=RANGE_MT)
    for displacement, bound in ((0.5, 1.0), (1.5, 0.2)):
        curve = rising.curve(displacement, 10.0, CIP)
        force = curve.force_N(400.0)
        solution = tree.solve(curve, force, 300.0)
        elsewhere = curve.confidence(solution.field_mT, force - solution.predicted_force_N)
        assert solution.confidence <= bound * elsewhere


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda model: search(newton, 0.0), "step_mT"),
        (lambda model: search(newton, 701.0), "step_mT"),
        (lambda model: BracketedSearch(field_range_mT=(9.0, 9.0), refine=newton), "field_range_mT"),
        (lambda model: BracketedSearch(field_range_mT=RANGE_MT, refine=newton, dtype=np.float16), "dtype"),
        (lambda model: KdTreeSearch(model, field_range_mT=RANGE_MT, neighbours=0), "neighbours"),
        (lambda model: KdTreeSearch(model, field_range_mT=RANGE_MT, lattice=1), "lattice"),
        (lambda model: DirectInverse(model, field_range_mT=RANGE_MT, hidden=0), "hidden"),
        (
            lambda model: ClosedForm(model, insert("MRE-50-40").elastomer, TORMAG, field_range_mT=(800.0, 100.0)),
            "field_range_mT",
        ),
        (
            lambda model: ClosedForm(model, insert("MRE-50-40").elastomer, TORMAG, field_range_mT=(0.0, float("nan"))),
            "field_range_mT",
        ),
    ],
)
def test_parameters_that_cannot_work_are_refused(rising: ForceModel, make, name: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(DomainError, match=name):
        make(rising)
