"""Newton on the whole range: the root that Brent's method finds, from any last field, on any force that rises."""

import numpy as np
import pytest
from hypothesis import example, given, strategies as st
from scipy.optimize import brentq

from tormagd.inverse.newton import ACCURACY_MT, MOST_EVALUATIONS, RisingSearch
from tormagd.inverse.solution import FieldSolution, Reach
from tormagd.model.force_curve import ForceCurve, Known, Network
from tormagd.model.model_file import ForceModel
from tormagd.physics.errors import DomainError

RANGE_MT = (100.0, 800.0)
CIP = 40.0
KNOWN = Known(((0.0, 1.0), (0.0, 60.0), RANGE_MT, (CIP, CIP)), 6.0)

Steps = list[tuple[float, float, float]]
"""Of each unit: 1/mT, the field, mT, at which it opens half, and N."""

SMOOTH = (0.005, 450.0, 5.0)
"It gives every network a slope of 1e-4 N/mT at least, so that a root is where its force is, beyond rounding."

steps = st.lists(st.tuples(st.floats(1e-4, 100.0), st.floats(-300.0, 1200.0), st.floats(1e-6, 5.0)), max_size=10)
fields = st.floats(*RANGE_MT)
lasts = st.one_of(st.none(), fields, st.floats(-1e9, 1e9), st.sampled_from(RANGE_MT))


def curve_of(units: Steps) -> ForceCurve:
    rows = np.array([*units, SMOOTH])
    weight = np.zeros((len(rows), 4))
    weight[:, 2] = rows[:, 0]
    return Network(weight, -rows[:, 0] * rows[:, 1], rows[:, 2], -0.5, KNOWN).curve(0.5, 10.0, CIP)


def solved(curve: ForceCurve, force_N: float, last_field_mT: float | None) -> FieldSolution:
    """The answer, as far as every answer has to be so."""
    solution = RisingSearch(RANGE_MT).solve(curve, force_N, last_field_mT)
    assert RANGE_MT[0] <= solution.field_mT <= RANGE_MT[1]
    assert solution.predicted_force_N == curve.force_N(solution.field_mT)
    assert solution.confidence == curve.confidence(solution.field_mT, force_N - solution.predicted_force_N)
    assert 1 <= solution.iterations < MOST_EVALUATIONS
    return solution


@given(units=steps, share=st.floats(0.0, 1.0), last=lasts)
def test_the_root_is_that_of_brent(units: Steps, share: float, last: float | None) -> None:
    curve = curve_of(units)
    least_N, most_N = (curve.force_N(field) for field in RANGE_MT)
    force = least_N + share * (most_N - least_N)
    root = brentq(lambda field: curve.force_N(field) - force, *RANGE_MT, xtol=1e-9) if 0 < share < 1 else None
    solution = solved(curve, force, last)
    assert solution.reach is Reach.INSIDE
    assert solution.field_mT == pytest.approx(RANGE_MT[round(share)] if root is None else root, rel=0, abs=ACCURACY_MT)


@given(units=steps, field=fields, last=lasts)
def test_the_field_of_a_force_is_found_again(units: Steps, field: float, last: float | None) -> None:
    curve = curve_of(units)
    solution = solved(curve, curve.force_N(field), last)
    assert solution.reach is Reach.INSIDE
    assert solution.field_mT == pytest.approx(field, rel=0, abs=ACCURACY_MT)


@given(units=steps, beyond=st.floats(1e-9, 1e6), last=lasts)
@example(units=[], beyond=1e-9, last=103.0)
@example(units=[], beyond=1.0, last=RANGE_MT[0] + 0.5 * ACCURACY_MT)
@example(units=[], beyond=1.0, last=RANGE_MT[1] - 0.5 * ACCURACY_MT)
def test_out_of_reach_is_the_end_and_says_so(units: Steps, beyond: float, last: float | None) -> None:
    curve = curve_of(units)
    least_N, most_N = (curve.force_N(field) for field in RANGE_MT)
    below, above = solved(curve, least_N - beyond, last), solved(curve, most_N + beyond, last)
    assert (below.field_mT, below.reach) == (RANGE_MT[0], Reach.BELOW)
    assert (above.field_mT, above.reach) == (RANGE_MT[1], Reach.ABOVE)


@pytest.mark.parametrize("end", RANGE_MT)
def test_out_of_reach_costs_one_evaluation_while_it_lasts(rising: ForceModel, end: float) -> None:
    force = 100.0 if end == RANGE_MT[1] else -100.0
    assert solved(rising.curve(0.5, 10.0, CIP), force, end).iterations == 1


def test_from_the_answer_it_does_not_move(rising: ForceModel) -> None:
    curve = rising.curve(0.5, 10.0, CIP)
    first = solved(curve, 2.5, 300.0)
    again = solved(curve, first.predicted_force_N, first.field_mT)
    assert (again.field_mT, again.iterations) == (first.field_mT, 1)


def test_a_force_that_moves_is_followed_with_few_evaluations(rising: ForceModel) -> None:
    """20 pulses of 100 mT in 4 s, planned 200 times a second: most answers take three evaluations or fewer."""
    counts, last = [], 450.0
    for field in (450.0 + 50.0 * np.sin(np.arange(800) * 2 * np.pi * 5 / 200)).tolist():
        curve = rising.curve(0.5, 10.0, CIP)
        solution = solved(curve, curve.force_N(field), last)
        counts.append(solution.iterations)
        last = solution.field_mT
    assert np.mean(counts) <= 3.0
    assert max(counts) <= 5


@pytest.mark.parametrize("rate", [1.0, 5.0, 25.0])
def test_flat_stretches_do_not_stop_it(rate: float) -> None:
    """A stair whose steps are 1/rate mT wide, and flat to the last bit between: Newton has no direction there."""
    rows = np.array([(rate, 150.0 + 100.0 * place, 1.0) for place in range(7)])
    weight = np.zeros((7, 4))
    weight[:, 2] = rows[:, 0]
    curve = Network(weight, -rows[:, 0] * rows[:, 1], rows[:, 2], 0.0, KNOWN).curve(0.5, 10.0, CIP)
    for stair in range(7):
        for last in (None, *RANGE_MT, 199.9, 450.0, 650.1):
            solution = solved(curve, stair + 0.5, last)
            assert solution.field_mT == pytest.approx(150.0 + 100.0 * stair, abs=ACCURACY_MT)


@pytest.mark.parametrize("ends", [(800.0, 100.0), (9.0, 9.0), (100.0, float("nan")), (float("-inf"), 100.0)])
def test_a_range_that_is_none_is_refused(ends: tuple[float, float]) -> None:
    with pytest.raises(DomainError, match="field_range_mT"):
        RisingSearch(ends)
