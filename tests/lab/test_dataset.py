"""Training data: what is read is what was written, and what is wrong is refused by row, column and value."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st

from tormagd.lab.errors import LabError
from tormagd.lab.training.dataset import ALLOWED, COLUMNS, Dataset, read_csv, write_csv

HEADER = "displacement_mm,rate_mm_s,field_mT,cip_percent,force_N"
GOOD = "0.5,10,300,40,1.5"


def write(path: Path, *lines: str) -> Path:
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def dataset(rows: int = 40, cycles: int | None = 8) -> Dataset:
    rng = np.random.default_rng(1)
    features = rng.uniform((0, 0, 100, 40), (1, 60, 800, 40.0001), (rows, 4))
    cycle = None if cycles is None else np.arange(rows) * cycles // rows
    return Dataset(features, rng.uniform(0, 6, rows), cycle, np.arange(rows) * 0.01)


@given(
    st.lists(
        st.tuples(*(st.floats(*ALLOWED[name]) for name in COLUMNS), st.integers(0, 10**9), st.floats(0, 1e9)),
        min_size=2,
        max_size=20,
    )
)
def test_round_trip_keeps_every_bit(tmp_path_factory: pytest.TempPathFactory, rows: list[tuple[float, ...]]) -> None:
    path = tmp_path_factory.mktemp("csv") / "data.csv"
    table = np.array(rows)
    written = Dataset(table[:, :4], table[:, 4], table[:, 5].astype(np.int64), table[:, 6])
    write_csv(path, written)
    read = read_csv(path)
    for name, column in written.columns().items():
        np.testing.assert_array_equal(read.columns()[name], column)
    assert read.sha256() == written.sha256()


@pytest.mark.parametrize("column", COLUMNS)
@pytest.mark.parametrize("value", ["nan", "inf", "-inf", "", "1e9", "-1e9", "abc", "1_0", "0x10", "1e999"])
def test_a_bad_value_is_named(tmp_path: Path, column: str, value: str) -> None:
    cells = GOOD.split(",")
    cells[COLUMNS.index(column)] = value
    path = write(tmp_path / "d.csv", HEADER, GOOD, ",".join(cells), GOOD)
    low, high = ALLOWED[column]
    with pytest.raises(LabError, match=rf"row 3, {column}: .*{value}.* only numbers {low:g} to {high:g}"):
        read_csv(path)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ((), "row 1: header"),
        (("",), "row 1: header"),
        ((HEADER,), "0 rows"),
        ((HEADER, GOOD), "1 rows"),
        ((HEADER + ",colour", GOOD + ",1"), "row 1: header"),
        ((HEADER + ",cycle,cycle", GOOD + ",1,1"), "row 1: header"),
        (("rate_mm_s,displacement_mm,field_mT,cip_percent,force_N", GOOD, GOOD), "row 1: header"),
        ((HEADER, GOOD, "1,2,3"), "row 3: 3 values; needed are 5"),
        ((HEADER, GOOD, GOOD + ",1"), "row 3: 6 values; needed are 5"),
        ((HEADER, GOOD, ""), "row 3: 0 values"),
        ((HEADER + ",cycle", GOOD + ",1.5"), "row 2, cycle: '1.5' is not allowed, only whole numbers"),
        ((HEADER + ",time_s", GOOD + ",-1"), "row 2, time_s"),
        ((HEADER, GOOD, '"' + "1" * 200_000), "row 3: not CSV"),
        ((HEADER, GOOD, '"0.5"x,10,300,40,1'), "row 3: not CSV"),
    ],
)
def test_a_malformed_file_is_refused(tmp_path: Path, lines: tuple[str, ...], message: str) -> None:
    with pytest.raises(LabError, match=message):
        read_csv(write(tmp_path / "d.csv", *lines))


def test_a_file_that_is_no_text_or_missing_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "d.csv"
    with pytest.raises(LabError, match=r"d\.csv: cannot be read: No such file"):
        read_csv(path)
    path.write_bytes(HEADER.encode() + b"\n\xff\xfe\x00\x01")
    with pytest.raises(LabError, match="UTF-8"):
        read_csv(path)


def test_a_split_keeps_cycles_whole() -> None:
    data = dataset()
    training, validation = data.split(0.25, seed=3)
    assert set(training.cycle) & set(validation.cycle) == set()
    assert len(set(validation.cycle)) == 2
    assert len(training) + len(validation) == len(data)


@pytest.mark.parametrize("share", [0.0, 1.0, -0.1, float("nan"), 0.01])
def test_a_split_without_two_sides_is_refused(share: float) -> None:
    with pytest.raises(LabError, match="validation_share"):
        dataset().split(share, seed=0)
