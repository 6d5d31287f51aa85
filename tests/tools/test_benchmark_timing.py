"""The timing benchmarks on made-up measurements: the contract's keys and their arithmetic, whatever the machine."""

import argparse
import math
from pathlib import Path

import benchmark_latency
import benchmark_loop
import benchmark_virtual_time
import numpy as np
import pytest
from benchmark_plot import plot_histograms

import firmware_protocol
import tormagd
from tormagd.config import RealTime

PNG = b"\x89PNG"


def block(lateness_us: float, merged: int) -> benchmark_loop.Block:
    """Ten seconds in which every tick was equally late."""
    ticks = 10_000 - merged
    return benchmark_loop.Block(np.full(ticks, lateness_us), np.full(ticks, 50.0), ticks, merged, 10.0)


def test_ratios_are_medians_over_the_pairs_and_not_of_the_sums() -> None:
    lateness = [(30.0, 20.0), (900.0, 300.0), (44.0, 40.0)]
    pairs = [benchmark_loop.Pair(block(daemon, 10), block(bare, 0)) for daemon, bare in lateness]
    result = benchmark_loop.summary(pairs, RealTime(fifo_priority=50))
    assert result["ratio"] == {"p50": 1.5, "p99": 1.5, "p999": 1.5}
    assert result["rate_hz"] == pytest.approx(999.0)
    assert (result["ticks"], result["merged_ticks"]) == (29_970, 30)
    assert result["lateness_us"] == {"p50": 44.0, "p99": 900.0, "p999": 900.0, "max": 900.0}
    assert result["control_exec_us"]["mean"] == 50.0
    assert result["bare"]["merged_share"] == 0.0
    assert result["merged_share"] == pytest.approx(30 / 29_970)


def test_the_first_tick_that_used_a_setpoint_counts() -> None:
    rows = [{"setpoint_cf": force, "t_ns": number} for number, force in enumerate((None, 1.0, 1.0, 1.5, 9.0))]
    found = benchmark_latency.first_ticks({1.0: 100, 1.5: 200}, rows)
    assert [(stamp, row["t_ns"]) for stamp, row in found] == [(100, 1), (200, 3)]


def test_stages_add_up_to_the_whole() -> None:
    course = benchmark_latency.Course(
        sent_to_plan_us=np.array([200.0, 400.0]),
        plan_to_tick_us=np.array([700.0, 100.0]),
        tick_to_wire_us=np.array([60.0, 70.0]),
        hop_us=np.array([100.0, 120.0]),
    )
    result = benchmark_latency.summary(course, 3, RealTime())
    assert result["setpoint_to_wire_us"]["p50"] == pytest.approx(765.0)
    assert result["setpoint_to_wire_us"]["max"] == pytest.approx(960.0)
    assert result["ratio"] == pytest.approx(765.0 / 110.0, abs=0.01)
    assert (result["setpoints"], result["seen"]) == (3, 2)
    assert len(result["stages_us"]) == 3


def test_histograms_are_drawn_of_any_positive_or_zero_durations(tmp_path: Path) -> None:
    path = tmp_path / "lateness.png"
    plot_histograms(path, "two sets", {"one": np.array([0.0, 3.0, 5_000.0]), "other": np.full(10, 40.0)})
    assert path.read_bytes().startswith(PNG)


def test_virtual_time_is_measured_with_a_profile_of_every_room(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(benchmark_virtual_time, "SHOWN", 10_000)  # all: on a busy machine the order is anybody's
    options = argparse.Namespace(seconds=0.2, plant="sample_1", profile=True)
    result = benchmark_virtual_time.measure(options)
    for name in ("whole_core", "position_loop"):
        found = result[name]
        assert found["factor"] == pytest.approx(1e3 / found["tick_us"]["p50"], rel=0.01)
        assert found["tick_us"]["p10"] <= found["tick_us"]["p50"]
    shares = result["profile"]["rooms"]
    assert {"simulation", "control", "inverse", "firmware_protocol", "hardware", "closed_loop"} <= set(shares)
    assert math.isclose(sum(shares.values()), 1.0, abs_tol=0.01)
    assert max(shares, key=shares.__getitem__) == "simulation"
    assert any(name.startswith("simulation: axis.step, 4 a tick") for name in result["profile"]["functions"])
    assert result["profile"]["calls_per_tick"] > 100


def test_rooms_are_told_by_where_the_packages_are(tmp_path: Path) -> None:
    """A checkout may stand in a folder that is called as a package is."""
    control = Path(tormagd.__path__[0], "control", "step.py")
    assert benchmark_virtual_time._room(str(control)) == "control"
    assert benchmark_virtual_time._room(str(Path(tormagd.__path__[0], "messages.py"))) == "messages"
    assert benchmark_virtual_time._room(str(Path(firmware_protocol.__path__[0], "codec.py"))) == "firmware_protocol"
    for elsewhere in (tmp_path / "tormagd" / "tools" / "demo.py", Path(np.__file__), "~", "<string>"):
        assert benchmark_virtual_time._room(str(elsewhere)) == "Python and NumPy"
