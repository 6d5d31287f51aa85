"""Recordings of many consoles: one by one, on Dask workers and from a bucket."""

import json
import os
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import fsspec
import msgspec
import pyarrow.parquet
import pytest
from distributed import LocalCluster

from tormag_lab.fleet import Console, Drift, Summary, consoles, files, read, read_all
from tormag_lab.main import main
from tormagd.commission.finding import Finding
from tormagd.commission.sequence import Report
from tormagd.record.ticks import TickBatch
from tormagd.record.writer import RecordingWriter

DAY_S = 86_400
START_S = 1_790_000_000
COLUMNS = ("t_ns", "setpoint_cf", "measured_cf", "operating_state", "limits", "faults", "trim", "left_current_A")
SCENE = json.dumps({"insert": {"name": "MRE-50-40"}})


def put(path: Path, columns: tuple[str, ...], rows: Iterable[tuple[object, ...]], **about: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with RecordingWriter(path, about) as writer:
        writer.ticks(TickBatch(v=1, columns=columns, rows=tuple(rows)))


def write(path: Path, serial_number: int, day: int, error_N: float, trim: float) -> None:
    """2 s, with RATE for the first half."""
    begin_ns = (START_S + day * DAY_S) * 10**9
    rows = (
        (begin_ns + k * 20 * 10**6, 1.5, 1.5 + error_N, "ENABLED", ("RATE",) if k < 50 else (), (), trim, 0.5)
        for k in range(100)
    )
    put(path, COLUMNS, rows, serial_number=str(serial_number), scene=SCENE)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two consoles, three days; one file is no recording, another a pipe without a writer."""
    folder = tmp_path_factory.mktemp("fleet")
    for console in 1, 2:
        for day in range(3):
            write(folder / f"{console}" / f"{day}.mcap", console, day, 0.01 * console, 1.0 + 0.02 * console * day)
    (folder / "2" / "torn.mcap").write_bytes(b"no recording")
    os.mkfifo(folder / "pipe.mcap")
    return folder


@pytest.fixture(scope="module")
def scheduler() -> Iterator[str]:
    with LocalCluster(n_workers=2, threads_per_worker=1, processes=False, dashboard_address=":0") as cluster:
        yield cluster.scheduler_address


def test_dask_workers_find_what_is_found_one_by_one(folder, scheduler, capsys, tmp_path):
    said = []
    for name, where in (("one.parquet", ["--workers", "1"]), ("dask.parquet", ["--dask", scheduler])):
        assert main(["fleet", str(folder), "--json", "--out", str(tmp_path / name), *where]) == 1
        out, err = capsys.readouterr()
        assert "left out 2/torn.mcap: not an intact MCAP file" in err
        assert "left out pipe.mcap: it is no regular file" in err
        said.append((json.loads(out), pyarrow.parquet.read_table(tmp_path / name)))
    assert said[0] == said[1]
    result, table = said[0]
    assert list(result["recordings"]) == [f"{console}/{day}.mcap" for console in (1, 2) for day in range(3)]
    assert table.column_names == ["file", *Summary.__struct_fields__]
    rows = [{**row, **{name: dict(row[name]) for name in ("limits_s", "faults_at_s")}} for row in table.to_pylist()]
    assert {row.pop("file"): row for row in rows} == result["recordings"]


def test_a_console_is_summed_up_over_its_days(folder, scheduler, capsys):
    assert main(["fleet", str(folder / "2"), "--dask", scheduler, "--json"]) == 1
    found = msgspec.convert(json.loads(capsys.readouterr().out)["consoles"][0], Console)
    assert (found.serial_number, found.insert, found.recordings, found.tracking_rms_N, found.limits) == (
        2,
        "MRE-50-40",
        3,
        pytest.approx(0.02),
        {"RATE": pytest.approx(0.5)},
    )
    assert (found.trim, found.current_A, found.clock_drift_ppm) == (
        Drift(1.0, pytest.approx(1.08), pytest.approx(0.04)),
        Drift(0.5, 0.5, pytest.approx(0.0)),
        None,
    )


def test_the_error_of_a_console_is_that_of_all_its_time(tmp_path):
    for error_N in (0.01, 0.03):
        write(tmp_path / f"{error_N}.mcap", 1, 0, error_N, 1.0)
    read_of_each = [read(str(tmp_path / f"{error_N}.mcap")) for error_N in (0.01, 0.03)]
    first, second = (found for found in read_of_each if isinstance(found, Summary))
    (console,) = consoles([msgspec.structs.replace(first, enabled_s=6.0), second], [])
    assert (console.tracking_rms_N, console.worst_rms_N) == pytest.approx((((3 * 0.01**2 + 0.03**2) / 4) ** 0.5, 0.03))
    assert console.trim == Drift(1.0, 1.0, None)


def test_a_commissioning_is_told_of_its_device_whether_it_was_recorded_or_not(tmp_path, capsys):
    write(tmp_path / "1" / "a.mcap", 1, 0, 0.01, 1.0)
    row = Finding("drag", 4.0, 0.1, "N", 0.0, 3.0, "grease it")
    for serial_number, day, findings in ((1, 1, {"step": [row]}), (2, 0, {})):
        report = Report(serial_number=serial_number, began_ns=(START_S + day * DAY_S) * 10**9, findings=findings)
        (tmp_path / f"{serial_number:08x}.json").write_bytes(msgspec.json.encode(report))
    (tmp_path / "notes.json").write_text("of somebody else")
    (tmp_path / "0000000a.json").write_text("{}")
    assert main(["fleet", str(tmp_path), "--workers", "1"]) == 1
    told = capsys.readouterr()
    assert [line.split()[0] for line in told.out.splitlines()] == ["device", "00000001", "00000002"]
    assert "2026-09-22, not whole, drag 4 ± 0.1 N" in told.out
    assert told.err.count("\n") == 1
    assert "left out 0000000a.json: " in told.err


def test_what_cannot_be_kept_is_told_after_what_was_found(folder, scheduler, capsys, tmp_path):
    (tmp_path / "file").touch()
    for url, reason in (
        (f"{tmp_path}/file/a.parquet", f"{tmp_path}/file"),
        (f"{tmp_path}/absent/a.parquet", f"{tmp_path}/absent"),
        ("nothing://a", "not known: nothing"),
    ):
        assert main(["fleet", str(folder / "1"), "--dask", scheduler, "--out", url]) == 2
        out, err = capsys.readouterr()
        assert "MRE-50-40" in out
        assert reason in err
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_bucket_is_read_like_a_folder(folder):
    fsspec.filesystem("memory").put(f"{folder}/1/", "/fleet/1/", recursive=True)
    in_bucket, here = files("memory://fleet"), files(str(folder))
    assert list(in_bucket) == ["1/0.mcap", "1/1.mcap", "1/2.mcap"]
    with ThreadPoolExecutor(1) as thread:
        assert read_all(in_bucket, thread) == read_all({name: here[name] for name in in_bucket}, thread)


def test_a_worker_that_dies_is_told_with_its_file(folder):
    with ThreadPoolExecutor(1) as here:
        _, _, left_out = read_all({"a.mcap": 3}, here)  # type: ignore[dict-item]
    assert left_out["a.mcap"].startswith("the worker that read it failed: ")


ALL_COLUMNS = (
    *("t_ns", "setpoint_cf", "measured_cf", "operating_state", "limits", "faults", "trim", "device_clock_drift"),
    *("left_current_A", "right_current_A", "lateness_us", "gap_mm"),
)
PULSE = json.dumps({"name": "pulse", "insert": {"name": "MRE-50-40"}})


def tick(k):
    """Every ms: DISABLED and far off for 50 ms, then ENABLED and 20 mN off; RATE for 10 ms, a fault at 100 ms."""
    row = (START_S * 10**9 + k * 1_000_000, 1.5)
    if k < 50:
        return *row, 9.0, "DISABLED", (), (), 7.0, 1e-3, 9.0, 9.0, 900.0, 70.0
    state, faults = ("FAULT", ("SKEW",)) if k >= 100 else ("ENABLED", ())
    limits = ("RATE",) if 60 <= k < 70 else ()
    return *row, 1.52, state, limits, faults, 1.1, 2e-5, 0.3 if k % 2 else -0.3, 0.4, 30.0, 70.0


def test_the_time_enabled_is_what_counts(tmp_path):
    put(tmp_path / "a.mcap", ALL_COLUMNS, map(tick, range(120)), serial_number="1234", scene=PULSE)
    found = read(str(tmp_path / "a.mcap"))
    assert (found.serial_number, found.insert, found.scene, found.is_complete, found.start_s) == (
        1234,
        "MRE-50-40",
        "pulse",
        True,
        START_S,
    )
    # too little was followed to say how well
    assert (found.duration_s, found.enabled_s, found.tracking_rms_N) == pytest.approx((0.119, 0.05, None))
    assert (found.limits_s, found.faults_at_s, found.trim, found.late_p99_us) == (
        {"RATE": pytest.approx(0.01)},
        {"SKEW": pytest.approx(0.1)},
        1.1,
        30.0,
    )
    assert (found.clock_drift_ppm, found.current_A, found.temperature_C) == pytest.approx((20.0, 0.4, None))


def test_metadata_of_another_making_are_not_known(tmp_path):
    put(tmp_path / "a.mcap", ("t_ns",), [(START_S * 10**9,)], serial_number="none", scene='{"insert": 3}')
    found = read(str(tmp_path / "a.mcap"))
    assert (found.serial_number, found.insert, found.scene) == (None, "", "")
    assert (found.tracking_rms_N, found.trim, found.enabled_s, found.limits_s) == (None, None, 0.0, {})
