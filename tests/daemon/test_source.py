import math
import random
from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import pytest
from hypothesis import assume, given, strategies as st

from tormagd.daemon.source import (
    AHEAD_S,
    DRIFT,
    FORGOTTEN_S,
    LONGEST_JUMP,
    MAX_WAY_S,
    RUN,
    SETTLED_S,
    STRAYS_S,
    Order,
    Sequence,
    SourceClock,
)

# -- numbers -----------------------------------------------------------------------------------------------------------


NEWER, NEW_RUN, STRAY = Order.NEWER, Order.NEW_RUN, Order.STRAY


class Part(NamedTuple):
    """Some messages of a stream, and how each must be taken."""

    numbers: list[int]
    orders: list[Order]
    session: int | None = None
    is_over: bool = False


FAR = 1 + 3 * LONGEST_JUMP
LAST = 2**63 - 1
Start = tuple[int | None, int]
STREAMS: dict[str, tuple[Start, list[Part], dict[str, int]]] = {
    "what grows is newer and what does not is not taken": (
        (None, 5),
        [Part([6, 7, 7, 5, 7, 8], [NEWER, NEWER, STRAY, STRAY, STRAY, NEWER])],
        {"seq": 8, "lost": 0, "restarts": 0},
    ),
    "losses are counted where the publisher counts by ones": (
        (None, 0),
        [Part([1, 2, 5, 6, 16], [NEWER] * 5)],
        {"lost": 2 + 9},
    ),
    "and not where it counts in nanoseconds": (
        (None, 0),
        [Part([2_000_000, 4_100_000, 5_900_000, 9_900_000], [NEWER] * 4)],
        {"seq": 9_900_000, "lost": 0},
    ),
    "a higher session starts anew at once": (
        (7, 1_000),
        [
            Part([0, 1, 2], [NEW_RUN, NEWER, NEWER], 8),
            Part([1_001, 1_002], [STRAY, STRAY], 7),
            Part([3], [NEWER], 8),
        ],
        {"session": 8, "seq": 3, "restarts": 1},
    ),
    "a publisher without session that starts at 0 is heard after some messages": (
        (None, 1_000),
        [Part([0, 1, 2, 3], [STRAY, STRAY, NEW_RUN, NEWER])],
        {"restarts": 1},
    ),
    "and at once where what came before is not valid any more": (
        (None, 1_000),
        [Part([0, 0], [NEW_RUN, STRAY], is_over=True)],
        {},
    ),
    **{
        f"no number locks a source out, as {wrong}": (
            (None, 0),
            # one wrong message costs nothing of the stream
            [Part([1, 2, wrong, 3, 4], [NEWER, NEWER, STRAY, NEWER, NEWER])],
            {},
        )
        for wrong in (LAST, 10_000_000)
    },
    **{
        f"nor as the second message, where it cannot be told from a publisher that counts so, as {wrong}": (
            (None, 0),
            [Part([wrong, 1, 2, 3, 4], [NEWER, STRAY, STRAY, NEW_RUN, NEWER])],
            {},
        )
        for wrong in (LAST, 10_000_000)
    },
    **{
        f"nor as the first, as {wrong}": (
            (None, wrong),
            [Part([1, 2, 3, 4], [STRAY, STRAY, NEW_RUN, NEWER])],
            {},
        )
        for wrong in (LAST, 10_000_000)
    },
    "no session locks a source out": (
        (1, 10),
        [Part([0], [NEW_RUN], LAST), Part([11, 12, 13, 14], [STRAY, STRAY, NEW_RUN, NEWER], 1)],
        {},
    ),
    "more missing than a loss can be is another run": (
        (None, 0),
        [
            Part([1, 1 + LONGEST_JUMP], [NEWER, NEWER]),
            Part([FAR, FAR + 1, FAR + 2], [STRAY, STRAY, NEW_RUN]),
            Part([2 * FAR], [NEWER], is_over=True),
        ],
        {},
    ),
}


@pytest.mark.parametrize(("start", "parts", "known"), STREAMS.values(), ids=STREAMS)
def test_what_the_messages_of_a_stream_are_taken_for(start: Start, parts: list[Part], known: dict[str, int]) -> None:
    sequence = Sequence(*start)
    for numbers, orders, session, is_over in parts:
        assert [sequence.order(0.0, session, number, is_over=is_over) for number in numbers] == orders
    assert {name: getattr(sequence, name) for name in known} == known


@pytest.mark.parametrize(("apart_s", "is_doubled"), [(0.5 * STRAYS_S, True), (0.6, False)])
def test_strays_that_are_far_apart_are_of_no_second_publisher(apart_s: float, is_doubled: bool) -> None:
    sequence = Sequence(None, 100)
    assert [sequence.order(k * apart_s, None, 50 - k, is_over=False) for k in range(RUN)] == [STRAY] * RUN
    assert sequence.is_doubled((RUN - 1) * apart_s) == is_doubled


@given(st.lists(st.tuples(st.sampled_from([None, 0, 1, 2**63 - 1]), st.integers(0, 2**63 - 1)), max_size=20))
def test_whatever_came_before_a_stream_is_heard_within_a_few_messages(before: list[tuple[int | None, int]]) -> None:
    sequence = Sequence(None, 0)
    for session, number in before:
        sequence.order(0.0, session, number, is_over=False)
    for session in (None, 3):
        heard = [sequence.order(0.0, session, number, is_over=False) for number in range(RUN + 2)]
        assert STRAY not in heard[RUN - 1 :]


# -- clocks; known are when each message was sent, and its delay -------------------------------------------------------


PERIOD_S = 0.01
JITTER_S = 0.002


class Heard(NamedTuple):
    sent_s: float
    way_s: float
    believed_s: float


def exponential(seed: int, least_s: float = 0.001, mean_s: float = JITTER_S) -> Callable[[float], float]:
    noise = random.Random(seed)
    return lambda sent_s: least_s + noise.expovariate(1.0 / mean_s)


def listen(
    clock_s: Callable[[float], float],
    way_s: Callable[[float], float],
    lasts_s: float = 10.0,
    period_s: float = PERIOD_S,
    lost: Callable[[int], bool] = lambda number: False,
) -> tuple[SourceClock, list[Heard]]:
    """Messages in order of arrival, from a clock that shows `clock_s`."""
    clock, heard, last_s = SourceClock(), [], -math.inf
    for number in range(round(lasts_s / period_s)):
        if lost(number):
            continue
        sent_s = number * period_s
        # nobody overtakes: messages queue
        last_s = max(last_s, sent_s + way_s(sent_s))
        heard.append(Heard(sent_s, last_s - sent_s, clock.hear(last_s, last_s - clock_s(sent_s))))
    return clock, heard


def worst_error_s(heard: list[Heard], from_s: float) -> float:
    return max(abs(each.believed_s - each.way_s) for each in heard if each.sent_s >= from_s)


SHORT = 0.001
HIDES_S = SHORT + 5.0 * JITTER_S
"A wrong clock hides the constant part of the way; setting it hides the jitter of that moment."
CLOCKS: dict[str, tuple[Callable[[float], float], float, dict[str, float]]] = {
    "right": (lambda t: t, 0.0, {}),
    "1 s behind": (lambda t: t - 1.0, 1.0, {}),
    "1 s ahead": (lambda t: t + 1.0, -1.0, {}),
    "since 1970": (lambda t: t - 1.8e9, 1.8e9, {}),
    "set back by 1 s": (lambda t: t - 1.0 * (t > 4.0), 1.0, {"steps": 1, "stepped_s": -1.0}),
    "set forward by 1 s": (lambda t: t + 1.0 * (t > 4.0), -1.0, {"steps": 1, "stepped_s": 1.0}),
    "set back by 60 ms": (lambda t: t - 0.06 * (t > 4.0), 0.06, {}),
    "set to and fro": (lambda t: t + (t > 3.0) - 2.0 * (t > 6.0), 1.0, {}),
    "once three centuries ahead": (lambda t: t + 9.2e9 * (9.9 <= t < 9.905), 0.0, {}),
    "1 s behind, 200 ppm fast": (lambda t: t * (1.0 + 200e-6) - 1.0, 0.998, {}),
    "200 ppm slow": (lambda t: t * (1.0 - 200e-6), 0.002, {}),
}


@pytest.mark.parametrize("name", CLOCKS)
def test_the_delay_is_believed_to_be_what_it_is_whatever_the_clock_shows(name: str) -> None:
    clock_s, behind_s, known = CLOCKS[name]
    clock, heard = listen(clock_s, exponential(1))
    assert worst_error_s(heard, SETTLED_S + PERIOD_S) <= HIDES_S
    known |= {"is_settled": True, "offset_s": behind_s, "is_wrong": abs(behind_s) > AHEAD_S}
    assert {each: getattr(clock, each) for each in known} == pytest.approx(known, abs=HIDES_S)
    assert clock.jitter_s < 2.0 * JITTER_S


Way = tuple[Callable[[float], float], float, float, float, float, dict[str, float]]
WAYS: dict[str, Way] = {
    # way, clock's lag, from when on the delay is believed to within what, the last, what is known
    "longer for a while": (
        *(lambda t: 0.001 + (0.4 if 4.0 < t < 40.0 else 0.0), 1.0),
        *(1.0, 0.001 + DRIFT * 37.0, 0.0, {"steps": 0.0}),
    ),
    "a backlog": (lambda t: 0.001 + (5.0 - t if 4.0 < t < 5.0 else 0.0), 0.0, 0.0, 1.1 * DRIFT, 0.0, {}),
    **{
        f"a backlog at first contact, {behind_s} s behind": (
            *(lambda t: max(0.8 - t, 0.0) + 0.001, behind_s),
            *(0.81 + SETTLED_S, 0.0011, 0.0, {"offset_s": behind_s}),
        )
        for behind_s in (0.0, 1.0)
    },
    **{
        f"always {way_s} s": (lambda t, way_s=way_s: way_s, 0.0, 20.0, 1e-5, way_s, {"is_wrong": False})  # type: ignore[misc]
        for way_s in (0.0, 0.08, MAX_WAY_S)
    },
    "longer than a way may be": (lambda t: 0.5, 0.0, 20.0, 0.5 + 1e-5, 0.0, {"is_wrong": True}),
}


@pytest.mark.parametrize("name", WAYS)
def test_a_way_is_not_taken_for_a_clock_while_a_way_may_be_so_long(name: str) -> None:
    way_s, behind_s, from_s, within_s, last_s, known = WAYS[name]
    clock, heard = listen(lambda t: t - behind_s, way_s, 60.0)
    assert worst_error_s(heard, from_s) <= within_s
    assert heard[-1].believed_s == pytest.approx(last_s, abs=0.001)
    assert {each: getattr(clock, each) for each in known} == pytest.approx(known, abs=0.002)


@pytest.mark.parametrize("drift_ppm", [200.0, -200.0, 0.0])
def test_a_drifting_clock_is_followed_for_an_hour_and_its_drift_told(drift_ppm: float) -> None:
    clock, heard = listen(lambda t: t * (1.0 + drift_ppm * 1e-6), exponential(2), 3_600.0, period_s=0.1)
    assert worst_error_s(heard, 1.0) < 0.006
    # one message in ten of the half second's five comes without a queue
    assert (clock.steps, clock.line.fit().drift_ppm) == (0, pytest.approx(drift_ppm, abs=40.0))


@pytest.mark.parametrize(
    ("lateness_s", "is_right", "first_s", "settled_s"),
    [
        (-AHEAD_S, True, 0.0, 0.0),
        (MAX_WAY_S, True, MAX_WAY_S, MAX_WAY_S),
        *((lateness_s, False, lateness_s, 0.0) for lateness_s in (-1.0, -1.01 * AHEAD_S, 1.01 * MAX_WAY_S, 1.0)),
    ],
)
def test_until_it_is_settled_a_message_is_as_old_as_it_says_and_one_that_may_be_right_settles_it(
    lateness_s: float, is_right: bool, first_s: float, settled_s: float
) -> None:
    clock = SourceClock()
    heard = [(clock.hear(at_s, lateness_s), clock.is_settled) for at_s in (0.0, SETTLED_S - 0.01, SETTLED_S)]
    assert heard == [(first_s, is_right), (first_s, is_right), (settled_s, True)]


def test_a_reader_that_is_held_up_blames_no_clock() -> None:
    clock = SourceClock()
    for number in range(100):
        clock.hear(number * 0.002, 0.001)
    for number in range(100, 115):
        late_s = 0.23 - number * 0.002
        assert clock.hear(0.23 + number * 1e-6, late_s) == pytest.approx(late_s, abs=1e-4)
    assert (clock.steps, clock.offset_s) == (0, pytest.approx(0.0, abs=1e-4))


def test_after_a_long_silence_a_clock_may_have_been_set() -> None:
    clock, _ = listen(lambda t: t, lambda t: 0.001)
    later_s = 10.0 + FORGOTTEN_S + 1.0
    assert (clock.hear(later_s, 0.9), clock.is_settled) == (0.9, False)
    clock.hear(later_s + SETTLED_S, 0.9)
    assert clock.hear(later_s + 2.0 * SETTLED_S, 0.901) == pytest.approx(0.001, abs=1e-4)
    # a message that fits what was known is believed at once
    clock, _ = listen(lambda t: t, lambda t: 0.001)
    assert (clock.hear(later_s, 0.15), clock.is_settled) == (pytest.approx(0.15, abs=1e-4), True)


@given(
    st.integers(0, 2**32),
    st.floats(-5.0, 5.0),
    st.floats(-200e-6, 200e-6),
    st.floats(0.0, 0.02),
    st.floats(0.0, 0.5),
    st.lists(st.tuples(st.floats(1.0, 9.0), st.floats(-3.0, 3.0)), max_size=3),
)
def test_any_clock_any_jitter_any_losses(
    seed: int, behind_s: float, drift: float, jitter_s: float, losses: float, steps: list[tuple[float, float]]
) -> None:
    noise = random.Random(seed)
    lost = {number for number in range(1_000) if noise.random() < losses}

    def clock_s(sent_s: float) -> float:
        return sent_s * (1.0 + drift) - behind_s + sum(by_s for at_s, by_s in steps if sent_s >= at_s)

    clock, heard = listen(clock_s, exponential(seed, 0.001, jitter_s + 1e-6), lost=lambda number: number in lost)
    settled = [each for each in heard if each.sent_s > SETTLED_S + 1.0]
    assume(settled)
    assert clock.is_settled
    assert min(each.believed_s for each in settled) >= 0.0
    longest_s = max(each.way_s for each in heard)
    gap_s = max(b.sent_s + b.way_s - a.sent_s - a.way_s for a, b in pairwise(heard))
    # a step back shorter than its pause looks like a longer way; a plausible lateness at the start is kept as way
    bound_s = longest_s + MAX_WAY_S + (1.0 + len(steps)) * (longest_s + gap_s + 0.005)
    assert worst_error_s(settled, 0.0) <= bound_s
