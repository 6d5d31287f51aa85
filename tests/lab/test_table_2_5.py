"""Table 2.5 in both readings: what the thesis names matches by width, and no brake gives the least forces."""

from pathlib import Path

from tormagd.lab.thesis import page, table_2_5
from tormagd.lab.thesis.values import TABLE_2_5
from tormagd.physics.inserts import INSERTS

FOUND = table_2_5.table_2_5()


def test_every_insert_stands_before_every_task_in_both_readings() -> None:
    for (task, _), found in zip(TABLE_2_5, FOUND["tasks"], strict=True):
        assert {row["insert"] for row in found["ranked"]} == set(INSERTS)
        for row in found["ranked"]:
            wide = INSERTS[row["insert"]].force_range.measured_N >= task.most_N - task.least_N
            assert (row["matched_share"] == 1.0) == wide
            assert not row["serves"]  # every task begins at 0 N


def test_of_what_the_thesis_names_one_is_not_wide_enough() -> None:
    rows = [dict(zip(table_2_5.COLUMNS, row, strict=True)) for row in table_2_5.readings(FOUND)]
    assert len(rows) == sum(len(named) for _, named in TABLE_2_5)
    short = [row for row in rows if row["range matched"] != "100%"]
    assert [row["insert the thesis names"] for row in short] == ["MRE-30-30"]
    assert "0.67 N of the width" in short[0]["missed"]
    named = {row["task"].split(",")[0]: row["narrowest that matches"] for row in rows}
    assert all(named[task.name] in inserts for task, inserts in TABLE_2_5)


def test_the_page_has_it() -> None:
    """`tormag-lab reproduce-thesis --out docs` writes it."""
    written = Path(__file__).parents[2] / "docs" / "reproduction.md"
    assert page.table_2_5(FOUND) in written.read_text(encoding="utf-8")
