"""The element in time: each term by itself, all left out, and refusals."""

import math

import pytest
from hypothesis import given, strategies as st

from tormagd.physics.element import RateStrengthening, TorqueElement
from tormagd.physics.errors import DomainError
from tormagd.physics.field import PowerFieldLaw
from tormagd.physics.force import TORMAG, Elastomer, brake_force_N
from tormagd.physics.friction import Friction
from tormagd.physics.hysteresis import Hysteresis
from tormagd.physics.relaxation import PronySeries

STIFF = Elastomer(277.3e3, 4.0, 0.2)
LAW = PowerFieldLaw()
PLAY = Hysteresis(shares=(0.05, 0.03), half_widths_Tm=(1e-4, 4e-4))
BARE = TorqueElement(LAW, STIFF, TORMAG)
gaps = st.floats(45.0, 95.0)


def static_N(gap_mm: float) -> float:
    return brake_force_N(LAW.radial_moment_Tm(gap_mm), STIFF, TORMAG)


def after(element: TorqueElement, gaps_mm: list[float], speed_mm_s: float = 42.0, dt_s: float = 1e-3) -> float:
    step, state, force = element.discretise(dt_s), element.rested(gaps_mm[0]), math.nan
    for gap_mm in gaps_mm:
        force, state = step.advance(state, gap_mm, speed_mm_s)
    return force


@given(st.lists(gaps, min_size=1, max_size=10), st.floats(-100.0, 100.0))
def test_without_terms_it_is_the_static_law_against_the_motion(path: list[float], speed: float) -> None:
    expected = math.copysign(static_N(path[-1]), speed) if speed != 0.0 else 0.0
    assert after(BARE, path, speed) == expected


def test_the_rate_term_is_linear_then_logarithmic() -> None:
    rate = RateStrengthening(strength=0.05, reference_speed_mm_s=10.0)
    assert rate.factor(0.0) == 1.0
    assert rate.factor(0.1) == rate.factor(-0.1) == pytest.approx(1.0 + 0.05 * 0.01, rel=1e-6)
    assert rate.factor(1e5) - rate.factor(1e4) == pytest.approx(0.05 * math.log(10.0), rel=1e-5)
    element = TorqueElement(LAW, STIFF, TORMAG, rate=rate)
    assert after(element, [60.0]) == pytest.approx(static_N(60.0) * rate.factor(42.0))


def test_the_relaxation_term_keeps_a_level_from_below_zero() -> None:
    element = TorqueElement(LAW, STIFF, TORMAG, relaxation=PronySeries((0.5, 0.4), (1.0, 10.0)))
    assert after(element, [45.0]) == pytest.approx(0.1 * static_N(45.0))
    assert after(element, [45.0, 95.0]) == 0.0


def test_the_friction_term_alone_is_the_friction_model() -> None:
    friction = Friction(8.0, 0.0005, 1.15, 5.0)
    element = TorqueElement(LAW, STIFF, TORMAG, friction=friction)
    assert after(element, [60.0], dt_s=1e-4) == friction.advance(0.0, 42.0, static_N(60.0), 1e-4)[0]


def test_hysteresis_makes_opening_stronger_than_closing() -> None:
    element = TorqueElement(LAW, STIFF, TORMAG, hysteresis=PLAY)
    closing, opening = after(element, [95.0, 60.0]), after(element, [45.0, 60.0])
    assert closing < static_N(60.0) < opening


@given(st.lists(st.floats(-0.01, 0.01), min_size=1, max_size=30))
def test_the_lag_is_bounded(path: list[float]) -> None:
    state = PLAY.demagnetised(0.0)
    most = sum(share * width for share, width in zip(PLAY.shares, PLAY.half_widths_Tm, strict=True))
    for moment in path:
        lagged, state = PLAY.advance(state, moment)
        assert abs(lagged - moment) <= most * (1.0 + 1e-12)


@given(st.floats(-0.01, 0.01), st.floats(-0.01, 0.01), st.integers(2, 40))
def test_hysteresis_does_not_depend_on_the_step(start: float, end: float, parts: int) -> None:
    once, state = PLAY.advance(PLAY.demagnetised(start), end)
    fine = PLAY.demagnetised(start)
    lagged = math.nan
    for part in range(1, parts + 1):
        lagged, fine = PLAY.advance(fine, end if part == parts else start + (end - start) * part / parts)
    assert lagged == pytest.approx(once, abs=1e-15)
    assert fine == pytest.approx(state, abs=1e-15)


def test_a_loop_closes_and_an_inner_loop_is_forgotten() -> None:
    _, at_low = PLAY.advance(PLAY.advance(PLAY.demagnetised(0.0), 0.01)[1], 0.0)
    _, at_high = PLAY.advance(at_low, 0.01)
    assert PLAY.advance(at_high, 0.0)[1] == at_low
    inner = at_high
    for moment in (0.006, 0.008, 0.005):
        _, inner = PLAY.advance(inner, moment)
    assert PLAY.advance(inner, 0.01)[1] == at_high


@pytest.mark.parametrize(
    ("shares", "widths", "name"),
    [
        ((0.1,), (), "half_widths_Tm"),
        ((-0.1,), (1e-3,), "shares"),
        ((0.6, 0.4), (1e-3, 1e-3), "shares"),
        ((0.1,), (-1e-3,), "half_widths_Tm"),
        ((math.nan,), (1e-3,), "shares"),
    ],
)
def test_hysteresis_is_checked(shares: tuple[float, ...], widths: tuple[float, ...], name: str) -> None:
    with pytest.raises(DomainError, match=name):
        Hysteresis(shares, widths)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_what_is_not_finite_is_refused(bad: float) -> None:
    step, state = BARE.discretise(1e-3), BARE.rested(60.0)
    with pytest.raises(DomainError, match="gap_mm"):
        step.advance(state, bad, 1.0)
    with pytest.raises(DomainError, match="speed_mm_s"):
        step.advance(state, 60.0, bad)
    with pytest.raises(DomainError, match="dt_s"):
        BARE.discretise(bad)
    with pytest.raises(DomainError, match="moment_Tm"):
        PLAY.advance(PLAY.demagnetised(0.0), bad)
    with pytest.raises(DomainError, match="strength"):
        RateStrengthening(bad, 1.0)


def test_a_state_of_another_hysteresis_is_refused() -> None:
    with pytest.raises(DomainError, match="state"):
        PLAY.advance((0.0,), 0.0)
