"""What the element remembers, beside the laws that it follows: a Prony series, and a lag that goes along changes."""

from pathlib import Path

import pytest
from hypothesis import given, strategies as st

from tormagd.config import Config
from tormagd.assembly.build import build_core
from tormagd.control.records import Handle, Measured
from tormagd.control.plan import PlanState
from tormagd.control.believe.memory import NOTHING_REMEMBERED, Remembered, Remembering
from tormagd.model.displacement import Turn
from tormagd.model.memory import NO_MEMORY, Memory
from tormagd.model.model_file import load_model
from tormagd.model.shipped import model_path
from tormagd.physics.relaxation import PronySeries

MEMORY = Memory(fractions=(0.05, 0.04, 0.04), times_s=(8.0, 90.0, 900.0), lag_mT=8.0, turn_mT=80.0)
FIELDS_MT = (50.0, 900.0)
STEADY = MEMORY.of(relaxes=lambda _: True, hysteresis=False)
REMEMBERING = Remembering(MEMORY, FIELDS_MT)
CURVE = load_model(model_path("torque_mre_50_40", Path()), element="torque").curve(1.5, 42.0, 40.0)
FREE_N = REMEMBERING.free_N(CURVE)


def test_it_relaxes_as_its_series_does() -> None:
    series = PronySeries(MEMORY.fractions, MEMORY.times_s)
    before_N, after_N = CURVE.force_N(300.0), CURVE.force_N(700.0)
    step, state = series.discretise(0.5), series.relaxed(before_N)
    remembered = Remembering(STEADY, FIELDS_MT).rested(CURVE, FREE_N, 300.0, 0.0)
    assert remembered.relaxed_N == pytest.approx(before_N * 0.13)
    for place in range(1, 41):
        true_N, state = step.advance(state, after_N)
        remembered = Remembering(STEADY, FIELDS_MT).followed(remembered, CURVE, FREE_N, 700.0, 0.5 * place)
        assert after_N - remembered.relaxed_N == pytest.approx(true_N, abs=1e-12)


def test_what_the_field_adds_relaxes_by_fractions_of_its_own() -> None:
    memory = Memory(fractions=(0.05, 0.04), times_s=(1.0, 30.0), field_fractions=(0.1, 0.02))
    remembering = Remembering(memory, FIELDS_MT)
    remembered = remembering.unloaded(700.0, 5.0)
    assert remembered.relaxed_N == 0.0
    remembered = remembering.followed(remembered, CURVE, FREE_N, 700.0, 5.0)
    assert remembered.relaxed_N == pytest.approx(0.0)
    remembered = remembering.followed(remembered, CURVE, FREE_N, 700.0, 1e4)
    free_N = CURVE.force_N(FIELDS_MT[0])
    assert remembered.relaxed_N == pytest.approx(0.09 * free_N + 0.12 * (CURVE.force_N(700.0) - free_N))


def test_time_that_goes_back_ages_nothing() -> None:
    remembered = REMEMBERING.rested(CURVE, FREE_N, 300.0, 10.0)
    remembered = REMEMBERING.followed(remembered, CURVE, FREE_N, 700.0, 11.0)
    earlier = REMEMBERING.followed(remembered, CURVE, FREE_N, 700.0, 10.0)
    assert earlier.relaxed_N == pytest.approx(remembered.relaxed_N)


def test_the_field_lags_along_its_way_and_not_in_time() -> None:
    start = Remembered(400.0, 3.0, time_s=0.0)
    halfway = Remembered(430.0, REMEMBERING.lag_at_mT(start, 430.0), time_s=0.0)
    assert REMEMBERING.lag_at_mT(halfway, 460.0) == pytest.approx(REMEMBERING.lag_at_mT(start, 460.0))
    assert REMEMBERING.lag_at_mT(start, 400.0) == 3.0
    assert REMEMBERING.lag_at_mT(start, 2_000.0) == pytest.approx(8.0)
    assert REMEMBERING.lag_at_mT(start, -2_000.0) == pytest.approx(-8.0)


def test_what_relaxes_is_the_force_of_the_element_s_own_field() -> None:
    remembered = REMEMBERING.followed(REMEMBERING.rested(CURVE, FREE_N, 300.0, 0.0), CURVE, FREE_N, 500.0, 0.0)
    lag_mT = REMEMBERING.lag_at_mT(Remembered(300.0, time_s=0.0), 500.0)
    assert remembered.lag_mT == lag_mT
    steady = Remembering(STEADY, FIELDS_MT)
    without_lag = steady.followed(steady.rested(CURVE, FREE_N, 300.0, 0.0), CURVE, FREE_N, 500.0 - lag_mT, 0.0)
    assert remembered.relaxed_N == pytest.approx(without_lag.relaxed_N, abs=1e-12)


def test_an_element_without_memory_is_as_its_gap() -> None:
    forgetful = Remembering(NO_MEMORY, FIELDS_MT)
    remembered = forgetful.followed(forgetful.rested(CURVE, FREE_N, 300.0, 0.0), CURVE, FREE_N, 500.0, 1.0)
    assert (remembered.lag_mT, remembered.relaxed_N) == (0.0, 0.0)


def test_before_anything_is_known_nothing_is_expected() -> None:
    assert NOTHING_REMEMBERED.is_empty
    assert REMEMBERING.lag_at_mT(NOTHING_REMEMBERED, 500.0) == 0.0
    assert NOTHING_REMEMBERED.relaxed_N == 0.0


def test_each_can_be_left_out() -> None:
    assert MEMORY.of(relaxes=lambda _: True, hysteresis=True) == MEMORY
    assert MEMORY.of(relaxes=lambda _: True, hysteresis=False) == STEADY
    assert MEMORY.of(relaxes=lambda _: False, hysteresis=True) == Memory(lag_mT=8.0, turn_mT=80.0)
    short = MEMORY.of(relaxes=lambda time_s: time_s < 100.0, hysteresis=False)
    assert short == Memory(fractions=(0.05, 0.04), times_s=(8.0, 90.0), turn_mT=80.0)
    pads = Memory(fractions=(0.01, 0.04), times_s=(1.0, 10.0), field_fractions=(0.03, 0.05))
    assert pads.of(relaxes=lambda time_s: time_s > 5.0, hysteresis=True) == Memory(
        fractions=(0.04,), times_s=(10.0,), field_fractions=(0.05,)
    )


RELAXED = 0.13
"Of what the shipped model's element has relaxed after a long rest, about."


def remembering(*estimates: Measured) -> PlanState:
    """The state after plans that found the device as in these estimates, half a second apart."""
    core = build_core(Config())
    state = core.planner.start(0.0)
    for place, estimate in enumerate(estimates):
        state = core.planner.plan(state, 0.5 * place, None, estimate)
    return state


def found(gap_mm: float, *, is_homed: bool = True) -> Measured:
    """A device at that gap, whose handle has not moved."""
    handle = Handle(0.0, 0.0, Turn(1.0, 0.0, 0.0))
    return Measured(1, is_homed, 0.0, gap_mm / 2.0, gap_mm / 2.0, 0.0, 0.0, 0.0, handle, 0.0, 0.0, 0.0)


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


@given(steps=st.lists(st.tuples(st.floats(100.0, 900.0), st.floats(0.0, 1e6)), min_size=1, max_size=30))
def test_it_never_remembers_more_than_there_was(steps: list[tuple[float, float]]) -> None:
    remembered, most_N = REMEMBERING.rested(CURVE, FREE_N, 300.0, 0.0), CURVE.force_N(300.0)
    for field_mT, time_s in steps:
        remembered = REMEMBERING.followed(remembered, CURVE, FREE_N, field_mT, time_s)
        most_N = max(most_N, CURVE.force_N(min(field_mT - remembered.lag_mT, FIELDS_MT[1])))
        assert abs(remembered.lag_mT) <= MEMORY.lag_mT
        assert remembered.relaxed_N <= sum(MEMORY.fractions) * most_N * (1.0 + 1e-12)
