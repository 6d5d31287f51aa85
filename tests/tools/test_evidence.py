"""Evidence is collected part by part: one that fails is written down and stops no other."""

import json
from pathlib import Path
from typing import Any

import evidence
import pytest
from evidence import Part


def printing(figures: dict[str, Any], status: int = 0, **fields: bool) -> Part:
    text = json.dumps(json.dumps(figures))
    return Part(f"-c 'import sys; print({text}); sys.exit({status})'", "{cases} cases", **fields)


def test_all_parts_run_and_the_status_tells_of_the_failed(tmp_path: Path) -> None:
    page = tmp_path / evidence.README
    page.write_text(
        evidence.HEADER + "| good | `old` | 0.0.0 | yes | 7 cases |\n| other | `old` | 0.0.0 | yes | kept |\n"
    )
    parts = {
        "good": printing({"cases": 1, "passed": True}, is_kept=True),
        "doubtful": printing({"cases": 2, "passed": False}),
        "failed": printing({"cases": 3, "passed": False}, status=1),
        "crashed": Part("-c 'import sys; sys.exit(\"no device\")'", "{cases} cases"),
        "measured": printing({"cases": 5}, judges=False),
    }
    assert evidence.collect(parts, tmp_path) == 1
    rows = [line.strip("| ").split(" | ") for line in page.read_text("utf-8").splitlines() if " | `" in line]
    assert [(row[0], *row[-2:]) for row in rows] == [
        ("good", "yes", "1 cases"),
        ("other", "yes", "kept"),
        ("doubtful", "**no**", "2 cases"),
        ("failed", "**no**", "3 cases"),
        ("crashed", "**no**", "no figures, exit status 1"),
        ("measured", "measured", "5 cases"),
    ]
    assert [path.name for path in tmp_path.glob("*.json")] == ["good.json"]
    assert evidence.collect({"good": parts["good"]}, tmp_path) == 0


def test_an_unknown_part_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match=r"^2$"):
        evidence.main(["fuz"])
    said = capsys.readouterr().err
    assert "invalid choice: 'fuz'" in said
    assert "replug-serial" in said


def test_every_tool_that_is_called_is_there() -> None:
    for part in evidence.PARTS.values():
        assert (evidence.ROOT / part.command.split()[0]).is_file()


def test_only_what_a_page_is_made_of_is_kept() -> None:
    kept = {name for name, part in evidence.PARTS.items() if part.is_kept}
    assert {path.stem for path in evidence.FOLDER.glob("*.json")} == kept
