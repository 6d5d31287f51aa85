"""Tables as test machines and spreadsheets write them are read as meant."""

import math
from pathlib import Path

import pytest

from tormagd.ground.force_file import read_column, read_forces
from tormagd.ground.table import TableError

ROWS = [(0.01 * row, 1.5 + 0.3 * math.sin(row)) for row in range(100)]


def lines(form: str, end: str = "\n", comma: str = ".") -> str:
    rows = (form.format(t=f"{t:.4f}", f=f"{f:.5f}", mN=f"{f * 1e3:.2f}", big=f"{f * 1e3:,.2f}") for t, f in ROWS)
    return "".join(row.replace(".", comma) + end for row in rows)


FORMS: dict[str, tuple[bytes, dict[str, str], str]] = {
    "plain": (("t_s,force_N\n" + lines("{t},{f}")).encode(), {}, ""),
    "blank rows and columns": (("t_s,force_N,,\n,,,\n" + lines("{t},{f},,") + ",,,\n").encode(), {}, ""),
    "sep= and decimal commas": (
        ("sep=;\r\nTime [s];Kraft [mN]\r\n" + lines("{t};{mN}", "\r\n", ",")).encode("utf-8-sig"),
        {},
        "force_N is 0.001 times 'Kraft [mN]'",
    ),
    "UTF-16 with tabs": (("t_s\tforce_N\r\n" + lines("{t}\t{f}", "\r\n")).encode("utf-16"), {}, "utf-16"),
    "cp1252": (("Zeit (s);Kraft (N);\u00b5\n" + lines("{t};{f};1", comma=",")).encode("cp1252"), {}, "cp1252"),
    "comments": (('# rig 3\n% "a, b\n# t_s,force_N\n' + lines("{t},{f}") + "# end\n").encode(), {}, "rows above"),
    "a preamble and a row of units": (
        ("Specimen,A,B\n\nElapsed Time,Load\nSec,mN\n" + lines("{t},{mN}")).encode(),
        {},
        "force_N is 0.001 times 'Load'",
    ),
    "spaces": (("t_s  force_N\n" + lines("  {t}   {f}")).encode(), {}, ""),
    "a clock, and a stated column": (
        ("Time,Kanal 3\n" + "".join(f"10:00:{t:07.4f},{f}\n" for t, f in ROWS)).encode(),
        {"force_N": "Kanal 3:N"},
        "",
    ),
    "a stated column with its unit": (
        ("t_s,Kraft A [mN],Kraft B [mN]\n" + lines("{t},{mN},0")).encode(),
        {"force_N": "Kraft A [mN]"},
        "left out: Kraft B [mN]",
    ),
    "thousands": (("t_s,F [mN]\n" + lines('{t},"{big}"')).encode(), {}, "0.001"),
    "a unit after a slash": (("t / s;F / mN\n" + lines("{t};{mN}", comma=",")).encode(), {}, "commas are decimal"),
}


@pytest.mark.parametrize("form", FORMS)
def test_each_form_is_read_as_meant_and_told(tmp_path: Path, form: str) -> None:
    content, stated, told = FORMS[form]
    (tmp_path / "f.csv").write_bytes(content)
    table = read_forces(tmp_path / "f.csv", stated)
    times_s = [time_s - table.values["time_s"][0] for time_s in table.values["time_s"]]
    assert times_s == pytest.approx([t for t, _ in ROWS], abs=1e-9)
    assert list(table.values["force_N"]) == pytest.approx([f for _, f in ROWS], abs=1e-5)
    assert told in "; ".join(table.told)


def test_a_force_around_zero_is_zero_and_counted(tmp_path: Path) -> None:
    (tmp_path / "f.csv").write_text("t_s,force_N\n0,-0.005\n1,-1e-17\n2,0.001\n")
    table = read_forces(tmp_path / "f.csv")
    assert list(table.values["force_N"]) == [0.0, 0.0, 0.001]
    assert table.told == ["2 forces within 5 mN under 0 are taken as 0"]


def test_a_scaled_column_needs_no_unit(tmp_path: Path) -> None:
    (tmp_path / "f.csv").write_text("'Elapsed time','PLETH'\n'seconds','NU'\n0,-0.5\n1,0.5\n")
    stated = {"force_N": "PLETH"}
    assert list(read_column(tmp_path / "f.csv", stated, has_unit=False).values["force_N"]) == [-0.5, 0.5]
    with pytest.raises(TableError, match="'PLETH' has the unit 'NU': force_N is in N"):
        read_column(tmp_path / "f.csv", stated, has_unit=True)


@pytest.mark.parametrize(
    "name", ["[" * 100_000, "F" + " " * 100_000 + "x", "F [" + "m" * 100_000], ids=["[", "F x", "F [m"]
)
def test_a_heading_of_any_length_is_read_at_once(tmp_path: Path, name: str) -> None:
    (tmp_path / "f.csv").write_text(f"t_s,{name}\n0,1\n1,1\n")
    with pytest.raises(TableError, match=r"no column is force_N \(force, load"):
        read_forces(tmp_path / "f.csv")
