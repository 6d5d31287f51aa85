"""The cost of plans with a preview: what is timed are the plans of a pulse that is followed."""

import argparse

import pytest
from benchmarks import preview


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing has to be foreseen here."""
    monkeypatch.setattr(preview, "LEARNS_S", 0.1)


def test_plans_that_know_what_follows_stand_beside_those_that_do_not(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(preview, "ROUNDS", 1)
    result = preview.measure(argparse.Namespace(scene="radial_pulse", seconds=0.1))
    assert all(0.0 < result[name]["mean_us"] <= result[name]["max_us"] for name in preview.AHEAD_S)
    assert set(result["ratio"]) == {"preview_70_ms", "preview_400_ms"}
    preview.print_table(result)
    assert "400 ms" in capsys.readouterr().out


def test_what_is_timed_are_the_plans_of_the_run() -> None:
    live, known = (preview.plans("radial_pulse", ahead_s, 0.02)[-1]().plan for ahead_s in (0.0, 0.4))
    assert live.foresight < 1.0
    assert known.foresight == 1.0
