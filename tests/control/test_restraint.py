"""How far the gap goes for forces that are over before it gets there. All forces are synthetic."""

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, strategies as st

from tormagd.control.device_fit import DeviceFit
from tormagd.control.portrait import Portrait
from tormagd.control.restraint import JUDGED_S, MEAN_S, RESTRAINED, Restraint, restrain

Array = npt.NDArray[np.float64]

OPEN_MM, CLOSED_MM = 95.0, 45.0
LEAST_N, MOST_N = 0.4, 2.2
PORTRAIT = Portrait(
    np.linspace(OPEN_MM, CLOSED_MM, 19).tolist(),
    np.linspace(LEAST_N, MOST_N, 19).tolist(),
    np.linspace(0.01, 0.1, 19).tolist(),
)
N_MM = (MOST_N - LEAST_N) / (OPEN_MM - CLOSED_MM)
SPEED_MM_S = 38.0
DT_S = 0.005


def step(
    state: Restraint | None, force_N: float, elapsed_s: float = DT_S, speed_mm_s: float = SPEED_MM_S
) -> tuple[Restraint, float]:
    """On the device of these tests, whose force is a straight line over the gap."""
    return restrain(state, elapsed_s, force_N, DeviceFit(), PORTRAIT, speed_mm_s)


def goes_for_N(forces_N: Array) -> tuple[Array, Restraint]:
    """What is gone for, force by force, and the state behind the last."""
    state, found = None, []
    for force_N in forces_N.tolist():
        state, for_N = step(state, force_N)
        found.append(for_N)
    assert state is not None
    return np.array(found), state


def followed_N(for_N: Array) -> Array:
    """Where a gap gets that goes there, with a delay of one step."""
    travel_N = SPEED_MM_S * DT_S * N_MM
    found = [for_N[0]]
    for wanted_N in for_N[:-1].tolist():
        found.append(found[-1] + min(max(wanted_N - found[-1], -travel_N), travel_N))
    return np.array(found)


def rms_N(errors_N: Array) -> float:
    return float(np.sqrt(np.mean(errors_N**2)))


def touches_N(seed: int, seconds: float = 20.0) -> Array:
    """A force that jumps between a rest and touches, each for 0.2 to 0.7 s."""
    random = np.random.default_rng(seed)
    forces: list[Array] = []
    while sum(map(len, forces)) * DT_S < seconds:
        lasts = [round(random.uniform(0.2, 0.7) / DT_S) for _ in range(2)]
        forces += [np.full(lasts[0], 0.62), np.full(lasts[1], random.uniform(0.9, 2.0))]
    return np.concatenate(forces)


@pytest.mark.parametrize("seed", range(50, 56))
def test_touches_too_fast_for_the_gap_are_missed_less(seed: int) -> None:
    asked_N = touches_N(seed)
    for_N, state = goes_for_N(asked_N)
    restrained, eager = (rms_N(followed_N(each) - asked_N) for each in (for_N, asked_N))
    assert restrained < 0.95 * eager
    assert state.trust > 0.5


def sine_N(times_s: Array) -> Array:
    """As fast as the gap may go."""
    return 1.4 + SPEED_MM_S * N_MM / (2.0 * math.pi) * np.sin(2.0 * math.pi * times_s)


def stairs_N(times_s: Array) -> Array:
    return 0.7 + 0.1 * (times_s // 1.0) % 1.0


def steps_N(times_s: Array) -> Array:
    """Up and down more than a newton, with the time for it."""
    return np.where((times_s // 3.0) % 2.0 == 1.0, 2.0, 0.8)


@pytest.mark.parametrize("kind", [sine_N, stairs_N, steps_N])
def test_what_the_gap_can_follow_is_followed(kind: Callable[[Array], Array]) -> None:
    asked_N = kind(np.arange(0.0, 24.0, DT_S))
    for_N, _ = goes_for_N(asked_N)
    assert np.mean(for_N != asked_N) < 0.06
    assert rms_N(followed_N(for_N) - asked_N) < 1.005 * rms_N(followed_N(asked_N) - asked_N)


def test_a_touch_that_stays_is_rendered() -> None:
    """After restraint was learned: all of it is gone for once the eager gap has been there for as long as a touch."""
    asked_N = np.concatenate([touches_N(57), np.full(round(4.0 / DT_S), 2.0)])
    for_N, state = goes_for_N(asked_N)
    held_N = for_N[-round(4.0 / DT_S) :]
    assert held_N.min() < 1.8
    assert np.all(held_N[round(3.0 / DT_S) :] == 2.0)
    assert state.trust == 0.0


def test_nothing_is_held_back_at_first() -> None:
    state, for_N = step(None, 1.7)
    assert (state.mean_N, state.trust, for_N) == (1.7, 0.0, 1.7)
    assert [state.eager_mm, state.restrained_mm] == pytest.approx([CLOSED_MM + 0.5 / N_MM] * 2)
    _, for_N = step(state, 0.7)
    assert for_N == 0.7


def test_gaps_and_mean_go_on_as_they_are_said_to() -> None:
    """By hand: a step of a newton from 0.7 N, and a tenth of a second."""
    start_mm = OPEN_MM - 0.3 / N_MM
    state, _ = step(Restraint(0.7, start_mm, start_mm), 1.7, elapsed_s=0.1)
    mean_N = 0.7 + 0.1 / (MEAN_S + 0.1)
    assert state.mean_N == pytest.approx(mean_N)
    assert state.eager_mm == pytest.approx(start_mm - 3.8)
    assert state.restrained_mm == pytest.approx(start_mm - 3.8)
    far, _ = step(Restraint(0.7, start_mm, start_mm), 1.7, elapsed_s=0.1, speed_mm_s=1_000.0)
    assert far.eager_mm == pytest.approx(start_mm - 1.0 / N_MM)
    assert far.restrained_mm == pytest.approx(start_mm - (mean_N - 0.7 + RESTRAINED * (1.7 - mean_N)) / N_MM)
    missed_N = (1.0 - RESTRAINED) * (1.7 - mean_N)
    assert far.skill.gained < 0.0
    share = 0.1 / (JUDGED_S + 0.1)
    assert far.skill.gained == pytest.approx(-share * missed_N**2)


@pytest.mark.parametrize("trust", [0.0, 0.25, 1.0])
def test_what_is_gone_for_lies_between_mean_and_force(trust: float) -> None:
    state = Restraint(1.0, 60.0, 60.0)
    state = state.replaced(skill=state.skill.replaced(gained=trust * (state.skill.apart + 9e-6)))
    _, for_N = step(state, 2.0, elapsed_s=0.0)
    assert for_N == pytest.approx(2.0 - trust * (1.0 - RESTRAINED))


@given(
    st.lists(
        st.tuples(
            st.floats(0.0, 5.0) | st.sampled_from([0.0, LEAST_N, MOST_N, 1e3]),
            st.floats(0.0, 0.2) | st.sampled_from([0.0, 1e-9, 10.0, 1e6]),
        ),
        min_size=1,
        max_size=60,
    )
)
def test_whatever_is_asked_nan_never_travels(asked: list[tuple[float, float]]) -> None:
    state = None
    for force_N, elapsed_s in asked:
        state, for_N = step(state, force_N, elapsed_s)
        assert 0.0 <= state.trust <= 1.0
        assert CLOSED_MM <= state.eager_mm <= OPEN_MM
        assert CLOSED_MM - 1e-9 <= state.restrained_mm <= OPEN_MM + 1e-9
        assert math.isfinite(for_N)
        assert for_N == force_N or LEAST_N - 1e-9 <= for_N <= MOST_N + 1e-9
