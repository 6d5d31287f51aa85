"""What `make run` prints at its end is a table, and the README's sample is that table."""

import re
from pathlib import Path

import demo
import numpy as np
from rehearsal import Rehearsal

README = Path(__file__).parents[2] / "README.md"


def printed_lines(capsys) -> list[str]:
    axis = np.linspace(0.0, 6.0, 601)
    asked = 1.5 + 0.1 * np.sin(axis)
    rehearsals = [Rehearsal(case, axis, asked, asked + 0.01, axis, axis) for case in demo.CASES]
    group = {"hz": 1e3, "merged": 3, "runs": 9, "lateness_us": {"p50": 1, "p99": 2}, "exec_us": {"p50": 1, "p99": 2}}
    status = {"rates": {"control": group, "inference": group}, "link": {"frames": 7}}
    shown = demo.Shown(axis, asked, asked + 0.01, axis, status, {"RATE": 0.1}, {})
    demo.print_summary(demo.scored(axis, asked, asked + 0.01), shown, rehearsals, 0)
    return [line for line in capsys.readouterr().out.splitlines() if line]


def test_the_columns_stand_under_each_other(capsys):
    lines = printed_lines(capsys)
    heading = lines[1]
    rows = [line for line in lines if re.search(r" mN +\d+ mN ", line)]
    assert len(rows) == 1 + sum(case.hand == "steady" for case in demo.CASES)
    for row in rows:
        assert [match.end() for match in re.finditer(r"mN", row)] == [
            heading.index(h) + len(h) for h in ("RMS", "worst")
        ]


def test_the_readmes_sample_has_the_lines_that_are_printed(capsys):
    (sample,) = re.findall(r"```\n(force asked .*?)```", README.read_text(encoding="utf-8"), re.DOTALL)

    def labels(lines: list[str]) -> list[str]:
        # each line's first words: what two spaces end
        return [re.split(r"(?<=\S) {2,}", line)[0].strip() for line in lines[1:]]

    assert labels(sample.splitlines()) == labels(printed_lines(capsys))
