"""What is newer, what is a restart, what is neither: no number keeps a publisher out."""

from itertools import pairwise
from typing import NamedTuple

import pytest
from hypothesis import given, strategies as st

from tormagd.daemon.sequence import LONGEST_JUMP, RUN, STRAYS_S, Order, Sequence

NEWER, RESTARTED, REPLACED, STRAY = Order.NEWER, Order.RESTARTED, Order.REPLACED, Order.STRAY


class Part(NamedTuple):
    """Some messages of a stream, and what each has to be taken for."""

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
            Part([0, 1, 2], [RESTARTED, NEWER, NEWER], 8),
            # what the one before has left on the way is not taken any more
            Part([1_001, 1_002], [STRAY, STRAY], 7),
            Part([3], [NEWER], 8),
        ],
        {"session": 8, "seq": 3, "restarts": 1},
    ),
    "a publisher without session that starts at 0 is heard after some messages": (
        (None, 1_000),
        [Part([0, 1, 2, 3], [STRAY, STRAY, REPLACED, NEWER])],
        {"restarts": 1},
    ),
    "and at once where what came before is not valid any more": (
        (None, 1_000),
        [Part([0, 0], [REPLACED, STRAY], is_over=True)],
        {},
    ),
    **{
        f"no number locks a source out, as {wrong}": (
            (None, 0),
            # one wrong message in a stream is no more than that; nothing of the stream is lost
            [Part([1, 2, wrong, 3, 4], [NEWER, NEWER, STRAY, NEWER, NEWER])],
            {},
        )
        for wrong in (LAST, 10_000_000)
    },
    **{
        f"nor as the second message, where it cannot be told from a publisher that counts so, as {wrong}": (
            (None, 0),
            [Part([wrong, 1, 2, 3, 4], [NEWER, STRAY, STRAY, REPLACED, NEWER])],
            {},
        )
        for wrong in (LAST, 10_000_000)
    },
    **{
        f"nor as the first, as {wrong}": (
            (None, wrong),
            [Part([1, 2, 3, 4], [STRAY, STRAY, REPLACED, NEWER])],
            {},
        )
        for wrong in (LAST, 10_000_000)
    },
    "no session locks a source out": (
        (1, 10),
        [Part([0], [RESTARTED], LAST), Part([11, 12, 13, 14], [STRAY, STRAY, REPLACED, NEWER], 1)],
        {},
    ),
    "more missing than a loss can be is another run": (
        (None, 0),
        [
            Part([1, 1 + LONGEST_JUMP], [NEWER, NEWER]),
            Part([FAR, FAR + 1, FAR + 2], [STRAY, STRAY, REPLACED]),
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


@pytest.mark.parametrize("sessions", [(None, None), (1, 1), (1, 2), (2, 1)])
@pytest.mark.parametrize("rates", [(1, 1), (1, 2), (2, 1), (5, 1), (1, 5)])
def test_two_publishers_of_one_name_do_not_alternate(
    sessions: tuple[int | None, int | None], rates: tuple[int, int]
) -> None:
    """One of the two is followed, and that there are two is said."""
    sequence = Sequence(sessions[0], 0)
    numbers, taken, doubled = [0, 50_000], [], 0
    for round_ in range(200):
        for who in (0, 1):
            for _ in range(rates[who]):
                numbers[who] += 1
                order = sequence.order(round_ * 0.01, sessions[who], numbers[who], is_over=False)
                if order is not STRAY:
                    taken.append(who)
        doubled += sequence.is_doubled(round_ * 0.01)
    assert sum(a != b for a, b in pairwise(taken)) <= 2
    assert doubled > 150
    assert not sequence.is_doubled(2.0 + STRAYS_S)


@given(st.lists(st.tuples(st.sampled_from([None, 0, 1, 2**63 - 1]), st.integers(0, 2**63 - 1)), max_size=20))
def test_whatever_came_before_a_stream_is_heard_within_a_few_messages(before: list[tuple[int | None, int]]) -> None:
    sequence = Sequence(None, 0)
    for session, number in before:
        sequence.order(0.0, session, number, is_over=False)
    for session in (None, 3):
        heard = [sequence.order(0.0, session, number, is_over=False) for number in range(RUN + 2)]
        assert STRAY not in heard[RUN - 1 :]
