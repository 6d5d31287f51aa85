"""Evidence is collected part by part: one that fails is written down and stops no other."""

import json
from pathlib import Path
from typing import Any

import evidence
import pytest
from evidence import Part


def says(figures: dict[str, Any]) -> str:
    return f"{figures['cases']} cases"


def printing(figures: dict[str, Any], status: int = 0) -> Part:
    """A part whose command prints these figures."""
    return Part(f"-c 'import sys; print({json.dumps(json.dumps(figures))}); sys.exit({status})'", says)


def test_all_parts_run_and_the_status_tells_of_the_failed(tmp_path: Path) -> None:
    parts = {
        "good": printing({"cases": 1, "passed": True}),
        "doubtful": printing({"cases": 2, "passed": False}),
        "failed": printing({"cases": 3, "passed": False}, status=1),
        "crashed": Part("-c 'import sys; sys.exit(\"no device\")'", says),
        "measured": printing({"cases": 5})._replace(judges=False),
    }
    assert evidence.collect(parts, tmp_path) == 1
    records = {name: json.loads((tmp_path / f"{name}.json").read_text(encoding="utf-8")) for name in parts}
    assert {name: record["held"] for name, record in records.items()} == {
        "good": True,
        "doubtful": False,
        "failed": False,
        "crashed": False,
        "measured": True,
    }
    assert records["crashed"]["figures"] is None
    assert "exit status 1" in records["crashed"]["error"]
    assert records["good"]["figures"]["cases"] == 1
    page = (tmp_path / "README.md").read_text(encoding="utf-8")
    rows = {line.split("]")[0].removeprefix("| ["): line for line in page.splitlines() if line.startswith("| [")}
    assert set(rows) == set(parts)
    assert "| yes | 1 cases |" in rows["good"]
    assert "| **no** | 3 cases |" in rows["failed"]
    assert "| **no** | no figures, exit status 1 |" in rows["crashed"]
    assert "| measured | 5 cases |" in rows["measured"]


def test_figures_of_an_earlier_form_are_told_and_hide_no_others(tmp_path: Path) -> None:
    parts = {"old": printing({"rows": 1}), "good": printing({"cases": 1})}
    assert evidence.collect(parts, tmp_path) == 0
    page = (tmp_path / "README.md").read_text(encoding="utf-8")
    assert "measured before this part had 'cases': run it again" in page
    assert "1 cases" in page


def test_nothing_failed(tmp_path: Path) -> None:
    assert evidence.collect({"good": printing({"cases": 1})}, tmp_path) == 0


def test_an_unknown_part_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        evidence.main(["fuz"])
    assert caught.value.code == 2
    assert "fuz: allowed are fuzz" in capsys.readouterr().err


def test_every_tool_that_is_called_is_there() -> None:
    for part in evidence.PARTS.values():
        assert (evidence.ROOT / part.command.split()[0]).is_file()
