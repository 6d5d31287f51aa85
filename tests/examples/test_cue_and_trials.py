"""The audible cue, once for a limit, again and again for a fault or silence; and the blinded trials."""

import runpy
from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest

Cue = runpy.run_path(str(Path(__file__).parents[2] / "examples" / "python" / "cue.py"))["Cue"]


def state(*limits: str, faults: tuple[str, ...] = ()):
    return SimpleNamespace(limits=limits, faults=faults)


def test_a_limit_that_stays_or_comes_and_goes_is_rung_for_once_and_others_never() -> None:
    cue = Cue(("STALE",), 0.0)
    rung = [cue.due([state("STALE", "RATE") if tick % 2 else state("RATE")], 0.05 * tick) for tick in range(100)]
    assert [each for due in rung for each in due] == ["STALE"]
    assert cue.due([state()], 7.0) == []
    assert cue.due([state("STALE")], 7.1) == ["STALE"]


def test_a_fault_and_silence_are_rung_for_every_two_seconds_until_they_are_over() -> None:
    cue = Cue(("STALE",), 0.0)
    rung = [cue.due([state("STALE", faults=("SKEW",))] if tick < 60 else [], 0.1 * tick) for tick in range(101)]
    assert [(tick, due) for tick, due in enumerate(rung) if due] == [
        (0, ["SKEW", "STALE"]),
        *((tick, ["SKEW"]) for tick in (20, 40, 60)),
        *((tick, ["nothing is heard"]) for tick in (80, 100)),
    ]
    assert cue.due([state()], 10.2) == []


# -- the trials --------------------------------------------------------------------------------------------------------


trials = SimpleNamespace(**runpy.run_path(str(Path(__file__).parents[2] / "examples" / "python" / "trials.py")))


def test_each_pair_is_offered_as_often_as_the_others_in_an_order_of_the_seed() -> None:
    offered = trials.pairs(16, 1)
    assert set(Counter(offered).values()) == {2}
    assert offered == trials.pairs(16, 1) != trials.pairs(16, 2)


def test_what_is_told_counts_by_the_order_that_was_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    offered = Mock(side_effect=[True, True, True, True, False, False])
    rows: list[list[object]] = []
    monkeypatch.setitem(trials.run.__globals__, "offered", offered)
    answers = iter(["1", "neither", "1"])
    pairs = [(2.0, True), (1.5, False), (1.1, True)]  # the last has no wall
    told = trials.run("folder", rows.append, pairs, lambda question: next(answers))
    assert [call.args[1] for call in offered.call_args_list[:4]] == pytest.approx([0.6, 0.3, 0.3, 0.45])
    assert (told[2.0], told[1.5], told[1.1]) == ([True], [False], [])
    assert rows == [[1, 2.0, 1, "1"], [2, 1.5, 2, "1"]]


def test_the_interval_of_a_share_is_wilsons() -> None:
    assert trials.interval(8, 10) == pytest.approx((0.490, 0.943), abs=1e-3)
