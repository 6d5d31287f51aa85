"""What a recording says of its console, and what it does not."""

import io
import json
from pathlib import Path

import pytest

from tormagd.lab.consoles.summary import FIELDS, summarise
from tormagd.recording.reader import RecordingError, read_open_recording, read_recording
from tormagd.recording.ticks import TickBatch
from tormagd.recording.writer import RecordingWriter

START_NS = 1_790_000_000_000_000_000
COLUMNS = (
    *("t_ns", "setpoint_cf", "measured_cf", "operating_state", "limits", "faults", "trim", "device_clock_drift"),
    *("left_current_A", "right_current_A", "lateness_us", "gap_mm"),
)
SCENE = json.dumps({"name": "pulse", "insert": {"name": "MRE-50-40"}})


def tick(k):
    """Every ms: DISABLED and far off for 50 ms, then ENABLED and 20 mN off; RATE for 10 ms, and a fault at 100 ms."""
    row = (START_NS + k * 1_000_000, 1.5)
    if k < 50:
        return *row, 9.0, "DISABLED", (), (), 7.0, 1e-3, 9.0, 9.0, 900.0, 70.0
    state, faults = ("FAULT", ("SKEW",)) if k >= 100 else ("ENABLED", ())
    limits = ("RATE",) if 60 <= k < 70 else ()
    return *row, 1.52, state, limits, faults, 1.1, 2e-5, 0.3 if k % 2 else -0.3, 0.4, 30.0, 70.0


@pytest.fixture
def written(tmp_path: Path) -> Path:
    path = tmp_path / "a.mcap"
    about = {"serial_number": "1234", "scene": SCENE}
    with RecordingWriter(path, about) as writer:
        writer.ticks(TickBatch(v=1, columns=COLUMNS, rows=tuple(tick(k) for k in range(120))))
    return path


def test_the_time_enabled_is_what_counts(written):
    found = summarise(read_recording(written))
    assert (found.serial_number, found.insert, found.scene, found.is_complete, found.start_s) == (
        1234,
        "MRE-50-40",
        "pulse",
        True,
        START_NS * 1e-9,
    )
    assert (found.duration_s, found.enabled_s, found.tracking_rms_N) == pytest.approx((0.119, 0.05, 0.02))
    assert (found.limits_s, found.faults_at_s, found.trim, found.late_p99_us) == (
        {"RATE": pytest.approx(0.01)},
        {"SKEW": pytest.approx(0.1)},
        1.1,
        30.0,
    )
    assert (found.clock_drift_ppm, found.current_A) == pytest.approx((20.0, 0.4))
    assert found.temperature_C is None


def test_what_is_not_kept_is_not_missed(written):
    with written.open("rb") as file:
        some = read_open_recording(file, "a.mcap", FIELDS)
    assert "gap_mm" not in some.ticks.numbers
    assert summarise(some) == summarise(read_recording(written))


def test_metadata_of_another_making_are_not_known(tmp_path):
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, {"serial_number": "none", "scene": '{"insert": 3}'}) as writer:
        writer.ticks(TickBatch(v=1, columns=("t_ns",), rows=((START_NS,),)))
    found = summarise(read_recording(path))
    assert (found.serial_number, found.insert, found.scene) == (None, "", "")
    assert (found.tracking_rms_N, found.trim, found.enabled_s, found.limits_s) == (None, None, 0.0, {})


def test_a_file_that_is_open_is_called_by_its_name(written):
    torn = io.BytesIO(written.read_bytes()[1:])
    with pytest.raises(RecordingError, match=r"^s3://there: not an intact"):
        read_open_recording(torn, "s3://there")
