"""The timing benchmarks on made-up measurements: the contract's keys and their arithmetic, whatever the machine."""

import argparse
import math
from collections.abc import Callable
from pathlib import Path

import benchmark_against
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
ROOT = Path(__file__).parents[2]


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
    options = argparse.Namespace(seconds=0.2, plant="sample_1", profile=True, against=ROOT)
    result = benchmark_virtual_time.measure(options)
    for name in ("whole_core", "position_loop"):
        found = result[name]
        assert found["factor"] == pytest.approx(1e3 / found["tick_us"]["p50"], rel=0.01)
        assert found["tick_us"]["p10"] <= found["tick_us"]["p50"]
        assert result[result["build"]][name] == found["factor"]
        assert result["against"][name] > 0.0
    shares = result["profile"]["rooms"]
    assert {"simulation", "control", "inverse", "firmware_protocol", "hardware", "closed_loop"} <= set(shares)
    assert math.isclose(sum(shares.values()), 1.0, abs_tol=0.01)
    assert any(name.startswith("simulation: axis.step, 4 a tick") for name in result["profile"]["functions"])
    assert result["profile"]["calls_per_tick"] > 100


def test_builds_take_turns_in_stretches_and_ratios_are_medians_over_them() -> None:
    asked: list[tuple[str, str]] = []

    def build(name: str, taken_us: float) -> Callable[[str, int], float]:
        def tick_us(loop: str, ticks: int) -> float:
            asked.append((name, loop))
            assert ticks == benchmark_virtual_time.STRETCH_TICKS
            # the machine gives ever less; the builds, side by side, are as much apart as they were
            return taken_us * (1 + (len(asked) - 1) // 6) * (2 if loop == "whole_core" else 1)

        return tick_us

    builds = {"compiled": build("compiled", 20.0), "interpreted": build("interpreted", 100.0)}
    found = benchmark_virtual_time.take_turns(builds | {"against": build("against", 80.0)}, 500)
    assert all(len(taken) == 5 for loops in found.values() for taken in loops.values())
    assert [name for name, loop in asked[6:] if loop == "whole_core"][:9:3] == ["compiled", "interpreted", "against"]
    result = benchmark_virtual_time.summary(found, 1_000.0)
    assert result["build"] == "compiled"
    assert result["ratio"] == {"whole_core": 5.0, "position_loop": 5.0}
    assert result["against"]["ratio"]["compiled"] == {"whole_core": 4.0, "position_loop": 4.0}
    assert result["against"]["ratio"]["interpreted"] == {"whole_core": 0.8, "position_loop": 0.8}
    assert result["whole_core"]["factor"] == result["compiled"]["whole_core"]
    assert set(result["compiled"]) == {"whole_core", "position_loop", "tick_us"}


def test_without_a_compiled_build_there_is_none() -> None:
    taken = {"whole_core": [100.0, 300.0, 200.0], "position_loop": [50.0]}
    result = benchmark_virtual_time.summary({"interpreted": taken}, 1_000.0)
    assert result["compiled"] is None
    assert result["build"] == "interpreted"
    assert (result["interpreted"]["whole_core"], result["interpreted"]["position_loop"]) == (5.0, 20.0)
    assert not {"ratio", "against"} & set(result)


def test_only_a_checkout_is_measured_against(tmp_path: Path) -> None:
    assert benchmark_against.checkout(str(ROOT)) == ROOT
    with pytest.raises(argparse.ArgumentTypeError, match="allowed is the root of a checkout"):
        benchmark_against.checkout(str(tmp_path))
    with pytest.raises(RuntimeError, match="ended with status"):
        benchmark_virtual_time.Build("no such plant")


def test_a_package_that_was_not_asked_for_is_not_measured(tmp_path: Path) -> None:
    """A folder with tools and without a package would be measured with whatever is installed."""
    (tmp_path / "tormagd").mkdir()
    (tmp_path / "tools").mkdir()
    for tool in (ROOT / "tools").glob("benchmark*.py"):
        (tmp_path / "tools" / tool.name).write_bytes(tool.read_bytes())
    with pytest.raises(RuntimeError):
        benchmark_virtual_time.Build("sample_1", tmp_path)


def test_rooms_are_told_by_where_the_packages_are(tmp_path: Path) -> None:
    """A checkout may stand in a folder that is called as a package is."""
    control = Path(tormagd.__path__[0], "control", "step.py")
    assert benchmark_virtual_time._room(str(control)) == "control"
    assert benchmark_virtual_time._room(str(Path(tormagd.__path__[0], "messages.py"))) == "messages"
    assert benchmark_virtual_time._room(str(Path(firmware_protocol.__path__[0], "codec.py"))) == "firmware_protocol"
    for elsewhere in (tmp_path / "tormagd" / "tools" / "demo.py", Path(np.__file__), "~", "<string>"):
        assert benchmark_virtual_time._room(str(elsewhere)) == "Python and NumPy"
