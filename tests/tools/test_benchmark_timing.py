"""The timing benchmarks on made-up measurements: the contract's keys and their arithmetic, whatever the machine."""

import argparse
from pathlib import Path

import numpy as np
import pytest
from benchmarks import latency, loop, virtual_time

from tormagd.assembly.build import build_core
from tormagd.config import RealTime, load_config
from tormagd.lab.told import lines


def block(lateness_us: float, merged: int) -> loop.Block:
    """Ten seconds in which every tick was equally late."""
    ticks = 10_000 - merged
    return loop.Block(np.full(ticks, lateness_us), np.full(ticks, 50.0), ticks, merged, 10.0)


def test_ratios_are_medians_over_the_pairs_and_not_of_the_sums() -> None:
    lateness = [(30.0, 20.0), (900.0, 300.0), (44.0, 40.0)]
    pairs = [loop.Pair(block(daemon, 10), block(bare, 0)) for daemon, bare in lateness]
    result = loop.summary(pairs, RealTime(fifo_priority=50))
    assert (result["ratio"], result["rate_hz"], result["ticks"], result["merged_ticks"]) == (
        {"p50": 1.5, "p99": 1.5, "p999": 1.5},
        pytest.approx(999.0),
        29_970,
        30,
    )
    assert (result["lateness_us"], result["control_exec_us"]["mean"], result["bare"]["merged_share"]) == (
        {"p50": 44.0, "p99": 900.0, "p999": 900.0, "max": 900.0},
        50.0,
        0.0,
    )
    assert result["merged_share"] == pytest.approx(30 / 29_970)


def test_a_tick_is_fresh_whose_state_came_since_the_one_before() -> None:
    times = zip((0, 1, 2, 4, 5), (0.1, 0.2, 0.2, 0.3, 0.4), strict=True)
    made = loop.as_block([[stamp_ms * 1_000_000, 0.0, 50.0, received_s] for stamp_ms, received_s in times])
    assert (made.ticks, made.merged, made.fresh) == (5, 1, 3)
    assert loop.summary([loop.Pair(made, made._replace(lateness_us=np.ones(5)))], RealTime())["fresh_share"] == 0.75


def test_what_is_measured_is_a_configuration_that_tormagd_takes(tmp_path: Path) -> None:
    config = load_config(loop.write_config(tmp_path, "/dev/null", loop.Stand(RealTime())))
    assert (config.rates.control_hz, config.rates.inference_hz) == (loop.CONTROL_HZ, loop.CONTROL_HZ)
    build_core(config)


def test_the_bound_is_the_hops_and_a_period_and_a_quarter_of_a_millisecond() -> None:
    for whole_us, kept in ((1_350.0, True), (1_351.0, False)):
        found_us = {latency.WHOLE: np.array([whole_us]), latency.HOP: np.array([100.0])}
        result = latency.summary(found_us, 1, RealTime())
        assert (result["bound_us"], result["kept"]) == (1_350.0, kept)


def test_the_first_tick_that_used_a_setpoint_counts() -> None:
    rows = [{"setpoint_cf": force, "t_ns": number} for number, force in enumerate((None, 1.0, 1.0, 1.5, 9.0))]
    made = [row | dict.fromkeys(latency.COLUMNS[1:], 0.0) for row in rows]
    assert [tick[:2] for tick in latency.first_ticks({1.0: 100, 1.5: 200}, made)] == [(100, 1), (200, 3)]


def test_stages_add_up_to_the_whole() -> None:
    # sent, written by the wall clock; the tick's time; planned, begun by the monotonic clock
    ticks = [(1_000_000, 1_960_000, 60.0, 5.0, 5.0007), (3_000_000, 3_570_000, 70.0, 7.0, 7.0001)]
    found_us = latency.stages(ticks) | {latency.HOP: np.array([100.0, 120.0])}
    assert list(found_us)[1:4] == ["sent, until planning begins", "then until the tick begins", "tick, until written"]
    expected_us = [[960.0, 570.0], [200.0, 400.0], [700.0, 100.0], [60.0, 70.0]]
    assert np.array(list(found_us.values())[:4]) == pytest.approx(np.array(expected_us))
    result = latency.summary(found_us, 3, RealTime())
    assert (result["setpoint_to_wire_us"]["p50"], result["setpoint_to_wire_us"]["max"]) == pytest.approx((765.0, 960.0))
    assert (result["ratio"], result["setpoints"], result["seen"], len(result["stages_us"])) == (
        pytest.approx(765.0 / 110.0, abs=0.01),
        3,
        2,
        3,
    )


def test_virtual_time_is_measured() -> None:
    found = virtual_time.measure(argparse.Namespace(seconds=0.2, plant="sample_1"))["interpreted"]
    expected = {name: pytest.approx(1e3 / found["tick_us"][name], rel=0.01) for name in virtual_time.LOOPS}
    assert {name: found[name] for name in virtual_time.LOOPS} == expected


def test_a_result_is_told_by_lines_and_tables() -> None:
    result = {"rate_hz": 999.26, "lateness_us": {"p50": 44.0, "p99": 900.0}, "against": {"ratio": {"p50": 1.5}}}
    rows = [{"name": "a", "p50_us": 1.25, "more": {}}, {"name": "long", "p50_us": 10.0, "more": {"RATE": 0.5}}]
    told = [" ".join(line.split()) for line in lines(result | {"variants": rows, "cpus": [0, 1]})]
    assert told == [
        "rate_hz 999.3", "lateness_us p50 44, p99 900", "against ratio p50 1.5",
        "variants", "name p50_us more RATE", "a 1.25", "long 10 0.5", "cpus 0, 1",
    ]  # fmt: skip
