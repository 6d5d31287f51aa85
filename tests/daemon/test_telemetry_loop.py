"""What of a telemetry period's work is done after which control tick."""

import itertools

import pytest

from tormagd.daemon.telemetry_loop import Part, spread


def _part(name: str) -> Part:
    def part(_now_s: float) -> None:
        raise AssertionError(f"{name} is only placed")

    return part


PARTS = tuple(_part(name) for name in "abcde")


@pytest.mark.parametrize(("turns", "at_once"), [(1, 5), (2, 3), (4, 2), (5, 1), (20, 1), (80, 1)])
def test_each_part_has_one_turn_and_shares_it_with_no_more_than_it_must(turns: int, at_once: int) -> None:
    spread_out = spread(PARTS, turns)
    assert len(spread_out) == turns
    assert tuple(itertools.chain(*spread_out)) == PARTS
    assert max(map(len, spread_out)) == at_once
