"""What the element remembers, beside the laws that it follows: a Prony series, and a lag that goes along changes."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tormagd.config import Config
from tormagd.control.core import build_core
from tormagd.control.estimate import Estimate, Handle
from tormagd.control.plan import PlanState
from tormagd.control.remembered import NOTHING_REMEMBERED, Remembered, Remembering
from tormagd.model.displacement import Turn
from tormagd.model.memory import NO_MEMORY, Memory
from tormagd.physics.relaxation import PronySeries

MEMORY = Memory(fractions=(0.05, 0.04, 0.04), times_s=(8.0, 90.0, 900.0), lag_mT=8.0, turn_mT=80.0)
REMEMBERING = Remembering(MEMORY)


def test_it_relaxes_as_its_series_does() -> None:
    series = PronySeries(MEMORY.fractions, MEMORY.times_s)
    after_rest, jump, step = series.relaxed(0.6), series.discretise(0.0), series.discretise(0.5)
    _, state = jump.advance(after_rest, 2.0)
    remembered = REMEMBERING.rested(300.0, 0.6, 0.0)
    assert 0.6 - remembered.relaxed_N == pytest.approx(0.6 * 0.87)
    for place in range(1, 41):
        true_N, state = step.advance(state, 2.0)
        remembered = REMEMBERING.followed(remembered, 300.0, 0.0, 2.0, 0.5 * place)
        assert 2.0 - remembered.relaxed_N == pytest.approx(true_N, abs=1e-12)


def test_the_field_lags_along_its_way_and_not_in_time() -> None:
    start = Remembered(400.0, 3.0, time_s=0.0)
    halfway = Remembered(430.0, REMEMBERING.lag_at_mT(start, 430.0), time_s=0.0)
    assert REMEMBERING.lag_at_mT(halfway, 460.0) == pytest.approx(REMEMBERING.lag_at_mT(start, 460.0))
    assert REMEMBERING.lag_at_mT(start, 400.0) == 3.0
    assert REMEMBERING.lag_at_mT(start, 2_000.0) == pytest.approx(8.0)
    assert REMEMBERING.lag_at_mT(start, -2_000.0) == pytest.approx(-8.0)


def test_an_element_without_memory_is_as_its_gap() -> None:
    forgetful = Remembering(NO_MEMORY)
    remembered = forgetful.followed(
        forgetful.rested(300.0, 0.6, 0.0), 500.0, forgetful.lag_at_mT(Remembered(time_s=0.0), 500.0), 2.0, 1.0
    )
    assert (remembered.lag_mT, remembered.relaxed_N) == (0.0, 0.0)


def test_before_anything_is_known_nothing_is_expected() -> None:
    assert REMEMBERING.lag_at_mT(NOTHING_REMEMBERED, 500.0) == 0.0
    assert NOTHING_REMEMBERED.relaxed_N == 0.0


RELAXED = 0.13
"Of what the shipped model's element has relaxed after a long rest, about."


def remembering(*estimates: Estimate) -> PlanState:
    """The state after plans that found the device as in these estimates, half a second apart."""
    core = build_core(Config())
    state = core.planner.start(0.0)
    for place, estimate in enumerate(estimates):
        state = core.planner.plan(state, 0.5 * place, None, estimate)
    return state


def found(gap_mm: float, *, is_homed: bool = True) -> Estimate:
    """A device at that gap, whose handle has not moved."""
    handle = Handle(0.0, 0.0, Turn(1.0, 0.0, 0.0))
    return Estimate(1, is_homed, 0.0, gap_mm / 2.0, gap_mm / 2.0, 0.0, 0.0, 0.0, handle, 0.0, 0.0, 0.0)


def test_a_device_that_is_found_homed_has_rested_there() -> None:
    remembered = remembering(found(95.0)).remembered
    assert remembered.relaxed_N == pytest.approx(RELAXED * 0.62, rel=0.1)
    assert remembered.lag_mT == 0.0


def test_one_that_has_to_be_homed_has_rested_where_it_was_switched_on() -> None:
    """Its counts are 0 there, and once more where the switches are; the flag comes later than that."""
    on_its_way = [found(95.0 + opened_mm, is_homed=False) for opened_mm in (0.0, 10.0, 16.0, 15.5, 0.0)]
    remembered = remembering(*on_its_way, found(95.0)).remembered
    at_79_N = remembering(found(79.0)).remembered.relaxed_N
    assert remembered.relaxed_N == pytest.approx(at_79_N, rel=0.02)
    assert remembered.lag_mT < 0.0  # the field fell


def test_a_gap_that_no_device_has_is_not_believed_to_have_been_one() -> None:
    remembered = remembering(found(900.0, is_homed=False), found(95.0)).remembered
    assert remembered.relaxed_N == pytest.approx(RELAXED * 0.62, rel=0.1)


@given(
    steps=st.lists(
        st.tuples(st.floats(100.0, 900.0), st.floats(0.0, 8.0), st.floats(-1.0, 1e6)), min_size=1, max_size=30
    )
)
def test_it_never_remembers_more_than_there_was(steps: list[tuple[float, float, float]]) -> None:
    remembered, most_N = REMEMBERING.rested(300.0, 0.6, 0.0), 0.6
    for field_mT, force_N, time_s in steps:
        lag_mT = REMEMBERING.lag_at_mT(remembered, field_mT)
        remembered = REMEMBERING.followed(remembered, field_mT, lag_mT, force_N, time_s)
        most_N = max(most_N, force_N)
        assert abs(remembered.lag_mT) <= MEMORY.lag_mT
        assert 0.0 <= remembered.relaxed_N <= sum(MEMORY.fractions) * most_N * (1.0 + 1e-12)
