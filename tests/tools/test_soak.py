"""The soak in small, and that it would notice."""

import copy
import os
from pathlib import Path
from typing import Any

import pytest
import soak

from tormagd.recording.ticks import TickBatch
from tormagd.recording.writer import RecordingWriter

QUIET: dict[str, Any] = {
    "virtual": {"growth_kB": 100, "faults": [], "mean_error_first_N": 0.02, "mean_error_last_N": 0.021},
    "daemon": {
        "growth_kB": -4,
        "held_up": [{"what": "MEASUREMENT_STALE", "host_stood_still_ms": 76.0}],
        "descriptor_growth": 0,
        "recorder": {"growth_kB": 9, "descriptor_growth": 0},
        "recording": {
            "ticks": 9,
            "ticks_out_of_sequence": 0,
            "telemetry": 9,
            "telemetry_out_of_sequence": 0,
            "deadline_ms": 50.0,
        },
        "killed_missing_ms": {"recorder": 400.0, "daemon": 30.0},
    },
}


def test_the_virtual_loop_tracks_without_a_fault() -> None:
    result = soak.virtual(0.02)
    assert result["ticks"] == 1_200
    assert result["faults"] == []
    assert 0.0 < result["mean_error_last_N"] < 0.1
    assert result["memory_kB"] > 10_000


def test_growth_is_above_the_first_once_everything_is_made() -> None:
    assert soak.growth([1, 90, 100, 100, 100, 100, 100, 100]) == 0
    assert soak.growth([1, 90, 100, 101, 102, 110, 104, 103]) == 10
    assert soak.growth([1, 5, 5, 4]) == 0
    # of a long run the first two minutes do not count: 240 samples
    assert soak.growth([*range(240), *(2_000 * [240]), 245]) == 5


def test_what_comes_and_goes_does_not_stay() -> None:
    assert soak.staying([3, 9, 5, 7, 6, 5, 9, 5]) == 0
    assert soak.staying([3, 9, 5, 7, 6, 5, 7, 6]) == 1


@pytest.mark.parametrize(
    ("part", "key", "value", "says"),
    [
        ("virtual", "growth_kB", 5_000, "virtual: memory grew by 5000 kB"),
        ("virtual", "faults", ["SKEW"], "virtual: faults SKEW"),
        ("virtual", "mean_error_last_N", 0.2, "the force error grew by 0.180 N"),
        ("daemon", "growth_kB", 5_000, "daemon: memory grew"),
        ("daemon", "descriptor_growth", 1, "1 more descriptors"),
        (
            *("daemon", "held_up", [{"what": "LINK_LOST", "host_stood_still_ms": 20.0}]),
            "daemon: LINK_LOST, while the host stood still for 20 ms",
        ),
        ("recorder", "growth_kB", 50_000, "recorder: memory grew"),
        ("recorder", "descriptor_growth", 2, "recorder: 2 more descriptors"),
        ("recording", "ticks_out_of_sequence", 3, "3 of 9 ticks out of sequence"),
        ("recording", "telemetry", 0, "0 of 0 telemetry"),
        ("killed_missing_ms", "recorder", 1_001.0, "recorder: 1001 ms missing"),
    ],
)
def test_what_grows_or_fails_is_named(part: str, key: str, value: object, says: str) -> None:
    assert soak.failures(QUIET) == []
    result = copy.deepcopy(QUIET)
    (result[part] if part in result else result["daemon"][part])[key] = value
    (failure,) = soak.failures(result)
    assert says in failure


def test_numbers_and_times_of_a_recording_are_looked_at(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with RecordingWriter(path) as writer:
        for tick in (1, 2, 5, 6, 60):  # 3 and 4 are missing, then what the device does not wait for
            row = (10**18 if tick < 5 else 0, tick, tick * 1e-3)  # somebody sets the wall clock, which is not looked at
            writer.ticks(TickBatch(v=1, columns=("t_ns", "tick", "monotonic_s"), rows=(row,)))
    found = soak.recording(path, 1.0, 50.0)
    assert (found["ticks"], found["ticks_out_of_sequence"], len(found["missed_deadlines_s"])) == (5, 2, 1)
    assert found["longest_between_ticks_ms"] == 54.0
    # one that was killed is read as far as it goes
    path.write_bytes(path.read_bytes()[:-500])
    assert soak.recording(path, 1.0, 50.0)["ticks"] == 5


def test_the_memory_of_a_process_is_its_own() -> None:
    assert soak.resident_kB(os.getpid()) > 10_000
