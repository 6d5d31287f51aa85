"""Look and refinement: roots beside the last field, steep steps, peaks between grid points."""

from typing import Any

import numpy as np
import pytest

from tormagd.inverse.bracketed import BracketedSearch, Refinement, finer_grid, newton
from tormagd.inverse.newton import ACCURACY_MT
from tormagd.inverse.solution import Reach
from tormagd.model.model_file import ForceModel
from tormagd.physics.errors import DomainError

RANGE_MT = (100.0, 800.0)
CIP = 40.0
REFINEMENTS = (newton, finer_grid)


def search(refine: Refinement, step_mT: float = 30.0) -> BracketedSearch:
    return BracketedSearch(field_range_mT=RANGE_MT, refine=refine, step_mT=step_mT)


def test_a_step_steeper_than_the_grid_is_met_exactly(plateau: ForceModel) -> None:
    """Newton's slope is zero to the last bit on both sides of the step: bisection carries it there."""
    middle = 0.5 * sum(plateau.predict_one(0.5, 10, field, CIP) for field in RANGE_MT)
    solution = search(newton, 60.0).solve(plateau.curve(0.5, 10, CIP), middle, 200.0)
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


def test_newton_needs_few_evaluations(rising: ForceModel) -> None:
    rng = np.random.default_rng(2)
    counts = []
    for field in rng.uniform(*RANGE_MT, 200).tolist():
        force = rising.predict_one(0.5, 10, field, CIP)
        counts.append(search(newton).solve(rising.curve(0.5, 10, CIP), force, field + 20).iterations)
    assert np.mean(counts) < 6
    assert max(counts) < 12


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"step_mT": 0.0}, "step_mT"),
        ({"step_mT": 701.0}, "step_mT"),
        ({"field_range_mT": (9.0, 9.0)}, "field_range_mT"),
    ],
)
def test_parameters_that_cannot_work_are_refused(options: dict[str, Any], name: str) -> None:
    with pytest.raises(DomainError, match=name):
        BracketedSearch(**{"field_range_mT": RANGE_MT, "refine": newton, **options})
