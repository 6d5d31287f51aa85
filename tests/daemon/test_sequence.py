"""What is newer, what is a restart, what is neither: no number keeps a publisher out."""

from itertools import pairwise

import pytest
from hypothesis import given, strategies as st

from tormagd.daemon.sequence import LONGEST_JUMP, RUN, STRAYS_S, Order, Sequence

NEWER, RESTARTED, REPLACED, STRAY = Order.NEWER, Order.RESTARTED, Order.REPLACED, Order.STRAY


def orders(sequence: Sequence, numbers: list[int], session: int | None = None, *, is_over: bool = False) -> list[Order]:
    return [sequence.order(0.0, session, number, is_over=is_over) for number in numbers]


def test_what_grows_is_newer_and_what_does_not_is_not_taken() -> None:
    sequence = Sequence(None, 5)
    assert orders(sequence, [6, 7, 7, 5, 7, 8]) == [NEWER, NEWER, STRAY, STRAY, STRAY, NEWER]
    assert (sequence.seq, sequence.lost, sequence.restarts) == (8, 0, 0)


def test_losses_are_counted_where_the_publisher_counts_by_ones() -> None:
    sequence = Sequence(None, 0)
    orders(sequence, [1, 2, 5, 6, 16])
    assert sequence.lost == 2 + 9
    in_ns = Sequence(None, 0)
    orders(in_ns, [2_000_000, 4_100_000, 5_900_000, 9_900_000])
    assert (in_ns.seq, in_ns.lost) == (9_900_000, 0)


def test_a_higher_session_starts_anew_at_once() -> None:
    sequence = Sequence(7, 1_000)
    assert orders(sequence, [0, 1, 2], session=8) == [RESTARTED, NEWER, NEWER]
    # what the one before has left on the way is not taken any more
    assert orders(sequence, [1_001, 1_002], session=7) == [STRAY, STRAY]
    assert orders(sequence, [3], session=8) == [NEWER]
    assert (sequence.session, sequence.seq, sequence.restarts) == (8, 3, 1)


def test_a_publisher_without_session_that_starts_at_0_is_heard_after_some_messages() -> None:
    sequence = Sequence(None, 1_000)
    assert orders(sequence, [0, 1, 2, 3]) == [STRAY, STRAY, REPLACED, NEWER]
    assert sequence.restarts == 1


def test_it_is_heard_at_once_where_what_came_before_is_not_valid_any_more() -> None:
    sequence = Sequence(None, 1_000)
    assert orders(sequence, [0], is_over=True) == [REPLACED]
    assert orders(sequence, [0], is_over=True) == [STRAY]


@pytest.mark.parametrize("wrong", [2**63 - 1, 10_000_000])
def test_no_number_locks_a_source_out(wrong: int) -> None:
    """One wrong message in a stream is no more than that; nothing of the stream is lost."""
    sequence = Sequence(None, 0)
    assert orders(sequence, [1, 2, wrong, 3, 4]) == [NEWER, NEWER, STRAY, NEWER, NEWER]
    # as the second message it cannot be told from a publisher that counts so
    sequence = Sequence(None, 0)
    assert orders(sequence, [wrong, 1, 2, 3, 4]) == [NEWER, STRAY, STRAY, REPLACED, NEWER]
    # and as the first not either
    sequence = Sequence(None, wrong)
    assert orders(sequence, [1, 2, 3, 4]) == [STRAY, STRAY, REPLACED, NEWER]


def test_no_session_locks_a_source_out() -> None:
    sequence = Sequence(1, 10)
    assert orders(sequence, [0], session=2**63 - 1) == [RESTARTED]
    assert orders(sequence, [11, 12, 13, 14], session=1) == [STRAY, STRAY, REPLACED, NEWER]


def test_more_missing_than_a_loss_can_be_is_another_run() -> None:
    sequence = Sequence(None, 0)
    orders(sequence, [1])
    assert orders(sequence, [1 + LONGEST_JUMP]) == [NEWER]
    far = 1 + 3 * LONGEST_JUMP
    assert orders(sequence, [far, far + 1, far + 2]) == [STRAY, STRAY, REPLACED]
    assert orders(sequence, [2 * far], is_over=True) == [NEWER]


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
