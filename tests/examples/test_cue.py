"""The audible cue: once for a limit, again and again for a fault or silence."""

import runpy
from pathlib import Path
from types import SimpleNamespace
from typing import Any

Cue = runpy.run_path(str(Path(__file__).parents[2] / "examples" / "python" / "cue.py"))["Cue"]


def state(*limits: str, faults: tuple[str, ...] = ()) -> Any:
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
