"""`tormag-lab import-data`: what it takes measured files for, and what it refuses."""

import json
from pathlib import Path

import numpy as np
import pytest

from tormag_lab.main import main
from tormag_lab.training.dataset import read_csv
from tormagd.ground.table import QUANTITIES, Wanted, read_table


def measured() -> dict[str, np.ndarray]:
    """A sweep in our units: the handle to and fro at three speeds while the field rises."""
    step = np.arange(600)
    way = np.where(step // 20 % 2 == 0, 1.0, -1.0)
    rate = way * np.array([2.0, 40.0, 300.0])[step // 40 % 3]
    time_s, field_mT = 0.05 * step, 100.0 + step
    place_mm = np.cumsum(rate) * 0.05
    return {"time": time_s, "field": field_mT, "x": place_mm, "rate": rate, "force": 0.002 * field_mT + 0.3}


def text(columns: dict[str, np.ndarray], delimiter: str = ",", comma: str = ".") -> str:
    rows = [delimiter.join(columns)]
    rows += [delimiter.join(f"{value:.6g}" for value in row) for row in zip(*columns.values(), strict=True)]
    return "\n".join(rows).replace(".", comma) + "\n"


def renamed(names: dict[str, str], **factors: float) -> dict[str, np.ndarray]:
    return {shown: measured()[name] * factors.get(name, 1.0) for name, shown in names.items()}


USUAL = {"x": "position_mm", "rate": "rate_mm_s", "field": "field_mT", "force": "force_N"}
GOOD: dict[str, tuple[str, tuple[str, ...], str]] = {
    "our own": (text(renamed(USUAL)), (), "force_N as it was"),
    "another order": (text(renamed(dict(reversed(USUAL.items())))), (), "as it was"),
    "units in brackets": (
        text(
            renamed(
                {"x": "Travel [m]", "rate": "Speed (m/s)", "field": "B [T]", "force": "Load [mN]"},
                x=1e-3,
                rate=1e-3,
                field=1e-3,
                force=1e3,
            )
        ),
        (),
        "as it was",
    ),
    "a row of units": (
        "x,v,B,F\nmm,mm/s,T,N\n"
        + text(renamed({"x": "x", "rate": "v", "field": "B", "force": "F"}, field=1e-3)).partition("\n")[2],
        (),
        "as it was",
    ),
    "decimal commas": (text(renamed(USUAL), ";", ","), (), "as it was"),
    "tabs, comments, a preamble": ("# bench 3\nSpecimen\tA\tB\tC\n" + text(renamed(USUAL), "\t"), (), "as it was"),
    "pulled the other way": (text(renamed(USUAL, force=-1.0)), (), "turned round"),
    "signed by the motion": (
        text(renamed(USUAL) | {"force_N": measured()["force"] * np.sign(measured()["rate"])}),
        (),
        "it had the rate's sign",
    ),
    "no rate": (
        text(renamed({"time": "t_s", "x": "x_mm", "field": "field_mT", "force": "force_N"})),
        (),
        "over time_s",
    ),
    "no displacement": (
        text(renamed({"rate": "rate_mm_s", "field": "field_mT", "force": "force_N"})),
        (),
        "as sliding",
    ),
    "other names": (
        text(renamed({"rate": "omega", "field": "Hall", "force": "Zug"}, field=1e-3)),
        ("--column", "rate_mm_s=omega:mm/s", "--column", "field_mT=Hall:T", "--column", "force_N=Zug:N"),
        "as it was",
    ),
    "time that begins anew with each cycle": (
        text(
            renamed({"x": "x_mm", "field": "field_mT", "force": "force_N"})
            | {"t_s": measured()["time"] % 10.0, "cycle": np.arange(600) // 200}
        ),
        (),
        "over time_s",
    ),
    "an outlier": (
        text(renamed(USUAL) | {"force_N": measured()["force"] + 4.0 * (np.arange(600) == 77)}),
        (),
        "as it was",
    ),
    "rows twice, and one with a hole": (
        text(renamed(USUAL)) + text(renamed(USUAL)).partition("\n")[2] + "1,1,,1\n",
        (),
        "as it was",
    ),
}


@pytest.mark.parametrize("case", GOOD)
def test_a_measured_file_becomes_rows_and_it_is_said_how(case: str, tmp_path: Path, capsys) -> None:
    content, options, told = GOOD[case]
    (tmp_path / "given.csv").write_text(content)
    out = tmp_path / "rows.csv"
    assert main(["import-data", str(tmp_path / "given.csv"), "--cip", "40", "--out", str(out), "--json", *options]) == 0
    found = json.loads(capsys.readouterr().out)
    rows = read_csv(out)
    assert told in " ".join(found["made"])
    assert len(rows) >= 599
    assert found["left_out"] == {
        "missing": 1 if "hole" in case else 0,
        "duplicate": 600 if "twice" in case else 0,
        "outlier": 1 if case == "an outlier" else 0,
    }
    assert np.allclose(rows.force_N, 0.002 * rows.features[:, 2] + 0.3, atol=1e-3)
    assert 0.0 <= rows.features[:, 0].min() <= rows.features[:, 0].max() <= 2.0
    assert 0.0 <= rows.features[:, 1].min() <= rows.features[:, 1].max() <= 301.0


def test_several_files_are_a_cycle_each_and_what_is_missing_is_said_and_drawn(tmp_path: Path, capsys) -> None:
    slow = {name: values[np.abs(measured()["rate"]) < 50.0] for name, values in measured().items()}
    for name, part in (("a.csv", slice(0, 100)), ("b.csv", slice(300, 400))):
        (tmp_path / name).write_text(text({USUAL[key]: slow[key][part] for key in USUAL}))
    files = [str(tmp_path / "a.csv"), str(tmp_path / "b.csv")]
    more = ["--cip", "40", "--out", str(tmp_path / "rows.csv"), "--picture", str(tmp_path / "p.png"), "--json"]
    assert main(["import-data", *files, *more]) == 0
    missing = " ".join(json.loads(capsys.readouterr().out)["missing"])
    assert "no field_mT between" in missing
    assert "no rate_mm_s above 40" in missing
    assert sorted(set(read_csv(tmp_path / "rows.csv").cycle)) == [0, 1]
    assert (tmp_path / "p.png").stat().st_size > 5_000


RANDOM_SIGN = renamed(USUAL) | {"force_N": measured()["force"] * np.where(np.arange(600) % 3 == 0, -1.0, 1.0)}
UNITS = {"rate": "v [mm/s]", "field": "B [mT]", "force": "F [N]"}
REFUSED: dict[str, tuple[str, ...]] = {
    "no force": (text(renamed({"rate": "v_mm_s", "field": "B_mT"})), "no column is force_N (force, load, kraft, F)"),
    "no unit": (text(renamed(UNITS | {"field": "B"}, field=1e-3)), "state --column field_mT=B:UNIT"),
    "a unit of the file, and another": (
        text(renamed(UNITS | {"force": "Zug [mN]"})),
        "'Zug [mN]' is in mN by its file, not in N",
        "--column",
        "force_N=Zug:N",
    ),
    "a strange unit": (text(renamed(UNITS | {"force": "F [stone]"})), "'F [stone]' has the unit 'stone'"),
    "two of one": (text(renamed(UNITS | {"x": "load [N]"})), "'load [N]' may both be force_N"),
    "no motion": (text(renamed({"field": "B [mT]", "force": "F [N]"})), "no column is rate_mm_s"),
    "signs at random": (text(RANDOM_SIGN), "follows neither"),
    "a word": (text(renamed(USUAL)) + "1,2,three,4\n", "row 602, field_mT = 'three': allowed is a finite number"),
    "commas in commas": (text(renamed(USUAL), ",", ","), "decimal commas need ; or tab"),
    "time that falls": (text(renamed({**USUAL, "time": "t_s"}, time=-1.0)), "t_s (s) falls after -0"),
    "time that stands": ("t_s,F_N,B_mT,x_mm\n" + "1,1,90,1\n1,1,91,2\n2,1,92,3\n", "time_s stands still"),
    "a cycle of one row": ("t_s,cycle,F_N,B_mT,v_mm_s\n5,0,1,90,1\n0,1,1,91,1\n1,1,1,92,1\n", "a cycle of one row"),
    "newtons of a press": (text(renamed(USUAL, force=1e6)), "is its unit another?"),
    "nothing": ("", "no numbers stand right below a row of names"),
    "a picture of sound": (text(renamed(USUAL)), "p.mp3: allowed is a name that ends with .png", "--picture", "p.mp3"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_told_is_refused_with_the_cause(case: str, tmp_path: Path, capsys) -> None:
    content, why, *options = REFUSED[case]
    (tmp_path / "given.csv").write_text(content)
    out = tmp_path / "rows.csv"
    assert main(["import-data", str(tmp_path / "given.csv"), "--cip", "40", "--out", str(out), *options]) == 2
    assert why in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.parametrize("has_rate", [True, False])
@pytest.mark.parametrize("offset", [0.0, 0.3, 0.5, 0.8])
def test_no_row_changes_its_sign_at_a_hundred_turns(has_rate: bool, offset: float, tmp_path: Path, capsys) -> None:
    step = np.arange(4_000) + offset
    way = np.where(step // 40 % 2 == 0, 1.0, -1.0)
    noise = np.random.default_rng(5).normal(0.0, 0.01, 4_000)
    columns = {"t_s": 0.01 * step, "force_N": -way * (1.0 + 0.001 * step), "field_mT": 100.0 + step % 7}
    columns |= {"v_mm_s": 25.0 * way + noise} if has_rate else {"x_mm": -10.0 * np.abs(step / 40.0 % 2.0 - 1.0)}
    (tmp_path / "given.csv").write_text(text(columns))
    out = tmp_path / "rows.csv"
    assert main(["import-data", str(tmp_path / "given.csv"), "--cip", "40", "--out", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["left_out"] == {"missing": 0, "duplicate": 0, "outlier": 0}
    assert read_csv(out).force_N == pytest.approx(1.0 + 0.001 * step, rel=1e-4)


@pytest.mark.parametrize(
    ("heading", "unit", "quantity", "worth"),
    [
        *(("F", unit, "force_N", worth) for unit, worth in (("mN", 1e-3), ("kN", 1e3), ("lbf", 4.4482216), ("N", 1.0))),
        *(("B", unit, "field_mT", worth) for unit, worth in (("mT", 1.0), ("T", 1e3), ("G", 0.1))),
        *(("x", unit, "displacement_mm", worth) for unit, worth in (("mm", 1.0), ("\u00b5m", 1e-3), ("m", 1e3))),
    ],
)
def test_a_unit_is_worth_what_it_is(tmp_path: Path, heading: str, unit: str, quantity: str, worth: float) -> None:
    (tmp_path / "f.csv").write_text(f"t_s,{heading} [{unit}]\n0,1\n1,2\n", encoding="utf-8")
    wanted = Wanted({name: QUANTITIES[name] for name in ("time_s", quantity)})
    assert read_table(tmp_path / "f.csv", wanted, 1_000).values[quantity] == pytest.approx([worth, 2.0 * worth])
