"""The timing benchmarks on made-up measurements: the contract's keys and their arithmetic, whatever the machine."""

import argparse
import math
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from benchmarks import browsers, fast, latency, loop, virtual_time
from benchmarks.against import checkout
from benchmarks.histograms import plot_histograms

import firmware_protocol
import tormagd
from tormagd.config import RealTime, load_config
from tormagd.control.core import build_core
from tormagd.hardware.backend import choose
from tormagd.hardware.serial_backend import SerialOptions

PNG = b"\x89PNG"
ROOT = Path(__file__).parents[2]


def block(lateness_us: float, merged: int) -> loop.Block:
    """Ten seconds in which every tick was equally late."""
    ticks = 10_000 - merged
    return loop.Block(np.full(ticks, lateness_us), np.full(ticks, 50.0), ticks, merged, 10.0)


def test_ratios_are_medians_over_the_pairs_and_not_of_the_sums() -> None:
    lateness = [(30.0, 20.0), (900.0, 300.0), (44.0, 40.0)]
    pairs = [loop.Pair(block(daemon, 10), block(bare, 0)) for daemon, bare in lateness]
    result = loop.summary(pairs, RealTime(fifo_priority=50))
    assert result["ratio"] == {"p50": 1.5, "p99": 1.5, "p999": 1.5}
    assert result["rate_hz"] == pytest.approx(999.0)
    assert (result["ticks"], result["merged_ticks"]) == (29_970, 30)
    assert result["lateness_us"] == {"p50": 44.0, "p99": 900.0, "p999": 900.0, "max": 900.0}
    assert result["control_exec_us"]["mean"] == 50.0
    assert result["bare"]["merged_share"] == 0.0
    assert result["merged_share"] == pytest.approx(30 / 29_970)


def test_browsers_are_judged_by_the_median_of_their_pairs(capsys: pytest.CaptureFixture[str]) -> None:
    lateness = [(20.0, 30.0), (300.0, 300.0), (40.0, 44.0)]
    pairs = [(block(without, 0), block(looked_at, 10)) for without, looked_at in lateness]
    result = browsers.summary(pairs)
    assert result["ratio"] == {"p50": 1.1, "p99": 1.1, "p999": 1.1}
    assert result["without"]["lateness_us"]["p50"] == 40.0
    assert result["looked_at"]["merged_share"] == pytest.approx(0.001, rel=0.01)
    told = {"browsers": 10, "kind": "streams", "state": "ENABLED", "fifo_priority": 50}
    browsers.print_table(result | told)
    assert "10 streams" in capsys.readouterr().out


def test_ratios_to_another_checkout_are_medians_over_the_pairs() -> None:
    def costing(tick_us: float, plan_us: float | None, share: float) -> loop.Block:
        plans = None if plan_us is None else {"p50": plan_us, "p99": 3 * plan_us}
        return block(40.0, 0)._replace(
            without_write_us=np.full(5, tick_us), plan_us=plans, core_share=share, core_share_without_clients=share / 2
        )

    pairs = [
        loop.Pair(costing(ours, 50.0, 0.2), block(40.0, 0), costing(theirs, 200.0, 0.4))
        for ours, theirs in ((30.0, 100.0), (10.0, 100.0), (20.0, 100.0))
    ]
    result = loop.summary(pairs, RealTime())
    assert result["against"]["ratio"] == {
        "tick_mean": 1.0,
        "core_share": 0.5,
        "core_share_without_clients": 0.5,
        "tick_without_write_mean": 0.2,
        "plan_p50": 0.25,
        "plan_p99": 0.25,
    }
    assert result["plan_us"] == {"p50": 50.0, "p99": 150.0}
    assert (result["core_share"], result["against"]["core_share"]) == (0.2, 0.4)
    assert result["tick_without_write_us"]["mean"] == 20.0
    # what one of the two does not tell has no ratio
    pairs[1] = pairs[1]._replace(against=costing(1.0, None, 0.4)._replace(without_write_us=np.array([])))
    ratio = loop.summary(pairs, RealTime())["against"]["ratio"]
    assert not {"plan_p50", "tick_without_write_mean"} & set(ratio)


def ticks(start_us: list[int], exec_us: list[float], received_s: list[float]) -> loop.Ticks:
    """Ticks that began then, by both clocks."""
    start_ns = np.array(start_us, dtype=np.int64) * 1_000
    none_late = np.zeros(start_ns.size)
    return loop.Ticks(start_ns, start_ns, none_late, np.array(exec_us), np.array(received_s))


def test_a_write_counts_for_the_tick_that_it_was_in(tmp_path: Path) -> None:
    made = ticks([1_000, 2_000, 3_000], [100.0, 100.0, 100.0], [0.0, 0.0, 0.0])
    times = [(1_010, 30), (1_050, 20), (1_500, 400), (3_099, 1)]  # two in the first, one outside, none in the second
    file = tmp_path / "writes"
    file.write_bytes((1_000 * np.array(times, dtype=np.int64)).tobytes())
    written = loop.writes(file)
    assert written is not None
    assert loop.without_writes(made, *written).tolist() == [50.0, 100.0, 99.0]
    file.write_bytes(b"")
    assert loop.writes(file) is None
    assert loop.writes(tmp_path / "never") is None
    elsewhere = np.array([9_000_000]), np.array([1_000])
    assert loop.without_writes(made, *elsewhere).size == 0


def test_a_tick_is_fresh_whose_state_came_since_the_one_before() -> None:
    made = ticks([0, 500, 1_000, 2_000, 2_500], [50.0] * 5, [0.1, 0.2, 0.2, 0.3, 0.4])
    result = fast.summary(made, 2_000, np.array([]))
    assert result["fresh_share"] == 0.75
    assert result["fresh_share_of_periods"] == 0.6  # one period had no tick
    assert (result["ticks"], result["merged_share"]) == (5, pytest.approx(1 / 6, abs=1e-4))
    assert result["tick_without_write_us"] is None


def test_what_cannot_be_run_is_told_and_not_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object) -> None:
        raise subprocess.CalledProcessError(1, ["tormagctl"], stderr=b"not_homed\n")

    monkeypatch.setattr(fast, "daemon", refused)
    found = fast.course(loop.Stand(RealTime(), 4_000, baud=4_000_000), 1.0)
    assert found == {"rate_hz": 4_000, "baud": 4_000_000, "not_measured": "not_homed"}


def test_both_fast_lines_are_configurations_that_tormagd_takes(tmp_path: Path) -> None:
    for rate_hz, baud in fast.LINES:
        stand = loop.Stand(RealTime(), rate_hz, fast.INFERENCE_HZ, baud)
        config = load_config(loop.write_config(tmp_path, "/dev/null", stand))
        line = choose(config.device, config.rates).options
        assert (config.rates.control_hz, line) == (rate_hz, SerialOptions(baud=baud))
        build_core(config)


def test_the_bound_is_the_hops_and_a_period_and_a_quarter_of_a_millisecond() -> None:
    for whole_us, kept in ((1_350.0, True), (1_351.0, False)):
        course = latency.Course(np.array([whole_us]), np.zeros(1), np.zeros(1), np.array([100.0]))
        result = latency.summary(course, 1, RealTime())
        assert (result["bound_us"], result["kept"]) == (1_350.0, kept)


def test_the_first_tick_that_used_a_setpoint_counts() -> None:
    rows = [{"setpoint_cf": force, "t_ns": number} for number, force in enumerate((None, 1.0, 1.0, 1.5, 9.0))]
    found = latency.first_ticks({1.0: 100, 1.5: 200}, rows)
    assert [(stamp, row["t_ns"]) for stamp, row in found] == [(100, 1), (200, 3)]


def test_stages_add_up_to_the_whole() -> None:
    course = latency.Course(
        sent_to_plan_us=np.array([200.0, 400.0]),
        plan_to_tick_us=np.array([700.0, 100.0]),
        tick_to_wire_us=np.array([60.0, 70.0]),
        hop_us=np.array([100.0, 120.0]),
    )
    result = latency.summary(course, 3, RealTime())
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
    monkeypatch.setattr(virtual_time, "SHOWN", 10_000)  # all: on a busy machine the order is anybody's
    options = argparse.Namespace(seconds=0.2, plant="sample_1", profile=True, against=ROOT)
    result = virtual_time.measure(options)
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
        def tick_us(run: str, ticks: int) -> float:
            asked.append((name, run))
            assert ticks == virtual_time.STRETCH_TICKS
            # the machine gives ever less; the builds, side by side, are as much apart as they were
            return taken_us * (1 + (len(asked) - 1) // 6) * (2 if run == "whole_core" else 1)

        return tick_us

    builds = {"compiled": build("compiled", 20.0), "interpreted": build("interpreted", 100.0)}
    found = virtual_time.take_turns(builds | {"against": build("against", 80.0)}, 500)
    assert all(len(taken) == 5 for loops in found.values() for taken in loops.values())
    assert [name for name, run in asked[6:] if run == "whole_core"][:9:3] == ["compiled", "interpreted", "against"]
    result = virtual_time.summary(found, 1_000.0)
    assert result["build"] == "compiled"
    assert result["ratio"] == {"whole_core": 5.0, "position_loop": 5.0}
    assert result["against"]["ratio"]["compiled"] == {"whole_core": 4.0, "position_loop": 4.0}
    assert result["against"]["ratio"]["interpreted"] == {"whole_core": 0.8, "position_loop": 0.8}
    assert result["whole_core"]["factor"] == result["compiled"]["whole_core"]
    assert set(result["compiled"]) == {"whole_core", "position_loop", "tick_us"}


def test_without_a_compiled_build_there_is_none() -> None:
    taken = {"whole_core": [100.0, 300.0, 200.0], "position_loop": [50.0]}
    result = virtual_time.summary({"interpreted": taken}, 1_000.0)
    assert result["compiled"] is None
    assert result["build"] == "interpreted"
    assert (result["interpreted"]["whole_core"], result["interpreted"]["position_loop"]) == (5.0, 20.0)
    assert not {"ratio", "against"} & set(result)


def test_only_a_checkout_is_measured_against(tmp_path: Path) -> None:
    assert checkout(str(ROOT)) == ROOT
    with pytest.raises(argparse.ArgumentTypeError, match="allowed is the root of a checkout"):
        checkout(str(tmp_path))
    with pytest.raises(RuntimeError, match="ended with status"):
        virtual_time.Build("no such plant")


def test_a_package_that_was_not_asked_for_is_not_measured(tmp_path: Path) -> None:
    """A folder with tools and without a package would be measured with whatever is installed."""
    (tmp_path / "tormagd").mkdir()
    shutil.copytree(ROOT / "tools", tmp_path / "tools")
    with pytest.raises(RuntimeError):
        virtual_time.Build("sample_1", tmp_path)


def test_rooms_are_told_by_where_the_packages_are(tmp_path: Path) -> None:
    """A checkout may stand in a folder that is called as a package is."""
    control = Path(tormagd.__path__[0], "control", "step.py")
    assert virtual_time._room(str(control)) == "control"
    assert virtual_time._room(str(Path(tormagd.__path__[0], "messages.py"))) == "messages"
    assert virtual_time._room(str(Path(firmware_protocol.__path__[0], "codec.py"))) == "firmware_protocol"
    for elsewhere in (tmp_path / "tormagd" / "tools" / "demo.py", Path(np.__file__), "~", "<string>"):
        assert virtual_time._room(str(elsewhere)) == "Python and NumPy"
