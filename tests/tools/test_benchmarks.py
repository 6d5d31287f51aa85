"""The subcommands of `benchmark`: their keys, their arithmetic, figures of no machine in particular."""

import argparse
import json
import math
import os
import subprocess
import time
from pathlib import Path

import benchmark
import msgspec
import numpy as np
import pytest
from benchmarks import inverse, latency, loop, step

from tormag_lab.told import lines
from tormagd.commission.gains import MIN_GAIN_MARGIN_DB, MIN_PHASE_MARGIN_DEG
from tormagd.config import Config, RealTime, load_config
from tormagd.control.assembly.build import build_core
from tormagd.simulation.element import TorqueElement
from tormagd.simulation.parameters import load_plant

KEYS = {
    "name", "dtype", "hidden", "p50_us", "p99_us", "p999_us", "solver_mae_mT", "plant_mae_mT", "plant_max_mT",
    "force_mae_N", "memory_kB", "pareto",
}  # fmt: skip


@pytest.fixture(scope="module")
def result():
    return inverse.measure(argparse.Namespace(quick=True))


def rows(result, name, hidden=50):
    return [row for row in result["variants"] if (row["solver"], row["hidden"]) == (name, hidden)]


def test_every_variant_has_the_keys_of_the_contract(result):
    for row in result["variants"]:
        assert row.keys() >= KEYS
        assert 0 < row["p50_us"] <= row["p99_us"] <= row["p999_us"]
        assert row["memory_kB"] > 0 or row["solver"] == "newton"
    assert {row["name"] for row in result["variants"]} >= {"thesis-linear", "linear-argmin", "vectorised-argmin"}
    assert any(row["pareto"] for row in result["variants"])
    assert result["speedup_vs_thesis_linear"] > 0
    assert rows(result, "newton") or "newton, 50 units" in result["refused"]


def test_the_solver_error_is_that_of_the_method(result):
    assert all(row["solver_max_mT"] < 1e-3 for row in rows(result, "newton"))
    assert all(row["solver_max_mT"] < 1e-2 for row in rows(result, "torch") if row["step_mT"] == 1.0)
    assert all(row["solver_max_mT"] <= 0.5 + 1e-6 for row in rows(result, "linear-argmin"))
    # with the network's mean error for a radius, the thesis's search stops before the nearest row
    (thesis,), (argmin,) = rows(result, "thesis-linear"), rows(result, "linear-argmin")
    assert thesis["solver_mae_mT"] > argmin["solver_mae_mT"]


def test_no_search_is_better_than_its_network(result):
    searches = [*rows(result, "newton"), *rows(result, "torch"), *rows(result, "nearest")]
    errors = [row["plant_mae_mT"] for row in searches if row["step_mT"] <= 2.0]
    assert 0.01 < min(errors) <= max(errors) < min(errors) + 1e-3


def test_a_scene_gets_a_search_that_is_measured_and_exact_enough(result):
    assert set(result["chosen"]) >= {"coronary", "pulse"}
    for chosen in result["chosen"].values():
        assert chosen["solver_force_max_N"] <= 0.1 * chosen["tolerance_rms_N"]
        assert any(row["name"] == chosen["name"] for row in result["variants"])


def test_the_plant_of_the_workload_is_the_plant():
    plant = load_plant("sample_1")
    still = msgspec.structs.replace(
        plant,
        relaxation=msgspec.structs.replace(plant.relaxation, fractions=(0.0, 0.0, 0.0)),
        field=msgspec.structs.replace(plant.field, hysteresis_percent=0.0),
        thermal=msgspec.structs.replace(plant.thermal, force_percent_K=0.0),
    )
    gap, speed, travel, dt = 60.0, 20.0, 1.8, 1e-4
    element = TorqueElement(still, gap, dt)
    for ticks, rate in ((20_000, -speed), (round(travel / speed / dt), speed)):
        for tick in range(ticks):
            element.advance(tick * dt, gap, rate)
    field = inverse.NOMINAL.field_mT(gap)
    (expected,) = inverse.plant_force_N(plant, np.array([travel]), np.array([speed]), np.array([field]))
    assert element.force_N == pytest.approx(expected, abs=2e-3)


@pytest.fixture(scope="module")
def measured():
    found = step.measure(argparse.Namespace(plant="sample_1"))
    return found | {f"{name}, worst corner": margin for name, margin in found["corners"].items()}


@pytest.mark.parametrize(
    ("figure", "least", "most"),
    [
        ("rise_s", 0.0, 0.06),
        ("rise_over_time_optimal", 1.0, 1.5),
        ("overshoot", 0.0, 0.02),
        ("settling_5pct_s", 0.0, 0.12),
        ("overshoot_over_stroke", 0.0, 0.02),
        ("steady_error_um", 0.0, 5.0),
        ("skew_um", 0.0, 30.0),
        # the motors limit the stroke, and the transfer function is the plant's
        ("stroke_ratio", 1.0, 1.15),
        ("model_nrmse", 0.0, 0.05),
        ("gain_margin_dB, worst corner", MIN_GAIN_MARGIN_DB, math.inf),
        ("phase_margin_deg, worst corner", MIN_PHASE_MARGIN_DEG, math.inf),
    ],
)
def test_a_millimetre_is_nearly_time_optimal_and_the_figures_are_those_promised(measured, figure, least, most):
    assert least <= measured[figure] <= most


def test_a_wrong_motor_is_noticed_in_the_comparison():
    heavy = msgspec.structs.replace(Config().motor, inertia_kg_m2=1.6e-6)
    assert step.nrmse(*step.model_step(heavy, load_plant("sample_1"), step.MODEL_DUTY)) > 0.1


def block(lateness_us: float, merged: int) -> loop.Block:
    ticks = 10_000 - merged
    return loop.Block(np.full(ticks, lateness_us), np.full(ticks, 50.0), ticks, merged, 10.0)


def test_ratios_are_medians_over_the_pairs_and_not_of_the_sums() -> None:
    lateness = [(30.0, 20.0), (900.0, 300.0), (44.0, 40.0)]
    pairs = [loop.Pair(block(daemon, 10), block(bare, 0)) for daemon, bare in lateness]
    result = loop.summary(pairs, RealTime(fifo_priority=50))
    expected = {
        "ratio": {"p50": 1.5, "p99": 1.5, "p999": 1.5},
        "rate_hz": pytest.approx(999.0),
        "ticks": 29_970,
        "merged_ticks": 30,
        "merged_share": pytest.approx(30 / 29_970),
        "lateness_us": {"p50": 44.0, "p99": 900.0, "p999": 900.0, "max": 900.0},
        "control_exec_us": {"mean": 50.0, "p50": 50.0, "p99": 50.0, "p999": 50.0, "max": 50.0},
    }
    assert {name: result[name] for name in expected} == expected
    assert result["bare"]["merged_share"] == 0.0


def test_a_tick_is_fresh_whose_state_came_since_the_one_before() -> None:
    times = zip((0, 1, 2, 4, 5), (0.1, 0.2, 0.2, 0.3, 0.4), strict=True)
    made = loop.as_block([[stamp_ms * 1_000_000, 0.0, 50.0, received_s] for stamp_ms, received_s in times], 1_000)
    assert (made.ticks, made.merged, made.fresh) == (5, 1, 3)
    assert loop.summary([loop.Pair(made, made._replace(lateness_us=np.ones(5)))], RealTime())["fresh_share"] == 0.75


def test_what_is_measured_is_a_configuration_that_tormagd_takes(tmp_path: Path) -> None:
    config = load_config(loop.write_config(tmp_path, "/dev/null", loop.Stand(RealTime())))
    assert (config.rates.control_hz, config.rates.inference_hz) == (loop.CONTROL_HZ, loop.CONTROL_HZ)
    build_core(config)


@pytest.mark.usefixtures("c_compiler")
def test_the_host_in_c_is_built_without_a_warning_and_says_how_it_is_called(tmp_path: Path) -> None:
    said = subprocess.run([loop.built_host(tmp_path)], check=False, capture_output=True, text=True)
    assert (said.returncode, said.stderr) == (2, "reference_host PORT PERIOD_US SECONDS FIFO\n")


def test_wake_ups_are_counted_by_thread() -> None:
    _, share, hz = loop.spent(os.getpid(), lambda: [time.sleep(1e-3) for _ in range(50)])
    assert 0.0 <= share < 1.0
    assert 50.0 < hz["control"] <= hz["all"]


def test_the_first_tick_that_used_a_setpoint_counts() -> None:
    rows = [{"setpoint_cf": force, "t_ns": number} for number, force in enumerate((None, 1.0, 1.0, 1.5, 9.0))]
    made = [row | dict.fromkeys(latency.COLUMNS[1:], 0.0) for row in rows]
    assert [tick[:2] for tick in latency.first_ticks({1.0: 100, 1.5: 200}, made)] == [(100, 1), (200, 3)]


def test_stages_add_up_to_the_whole() -> None:
    # sent, written by the wall clock; the beat's time until then
    found_us = latency.stages([(1_000_000, 1_960_000, 60.0), (3_000_000, 3_570_000, 70.0)])
    assert {name: each_us.tolist() for name, each_us in found_us.items()} == {
        latency.WHOLE: [960.0, 570.0],
        "sent, until its beat begins": [900.0, 500.0],
        "the beat, until it has written": [60.0, 70.0],
    }
    result = latency.summary(found_us | {latency.HOP: np.array([100.0, 120.0])}, 3, RealTime())
    whole_us = result["setpoint_to_wire_us"]
    assert (whole_us["p50"], whole_us["max"], result["ratio"]) == pytest.approx((765.0, 960.0, 6.95), abs=0.01)
    assert (result["setpoints"], result["seen"], len(result["stages_us"])) == (3, 2, 2)


def test_a_measurement_is_one_object_and_says_how_fast_the_machine_was(capsys: pytest.CaptureFixture[str]) -> None:
    assert benchmark.main(["step", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert min(found["virtual_time_factor"], found["machine_us"]) > 0.0


def test_a_result_is_told_by_lines_and_tables() -> None:
    result = {"rate_hz": 999.26, "lateness_us": {"p50": 44.0, "p99": 900.0}, "against": {"ratio": {"p50": 1.5}}}
    rows = [{"name": "a", "p50_us": 1.25, "more": {}}, {"name": "long", "p50_us": 10.0, "more": {"RATE": 0.5}}]
    assert [" ".join(line.split()) for line in lines(result | {"variants": rows, "cpus": [0, 1]})] == [
        "rate_hz 999.3", "lateness_us p50 44, p99 900", "against ratio p50 1.5",
        "variants", "name p50_us more RATE", "a 1.25", "long 10 0.5", "cpus 0, 1",
    ]  # fmt: skip


def test_only_a_checkout_can_be_measured_against(tmp_path: Path):
    assert loop.checkout(str(loop.TOOLS.parent)) == loop.TOOLS.parent
    with pytest.raises(argparse.ArgumentTypeError, match="allowed is the root of a checkout"):
        loop.checkout(str(tmp_path))
