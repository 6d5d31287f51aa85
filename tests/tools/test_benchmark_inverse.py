"""The quick run of `benchmark inverse`: the contract's keys, and errors that do not depend on the machine's speed."""

import contextlib
import io
import json

import benchmark
import msgspec
import numpy as np
import pytest
from benchmarks import inverse_report, inverse_workload
from benchmarks.inverse_report import ROOT

from tormagd.simulation.element import Element
from tormagd.simulation.parameters import load_plant

KEYS = {
    "name", "dtype", "hidden", "p50_us", "p99_us", "p999_us", "solver_mae_mT", "plant_mae_mT", "plant_max_mT",
    "force_mae_N", "memory_kB", "pareto",
}  # fmt: skip


@pytest.fixture(scope="module")
def result():
    """The object, by way of the command line."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        assert benchmark.main(["inverse", "--quick", "--json"]) == 0
    return json.loads(printed.getvalue())


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
    errors = [
        row["plant_mae_mT"]
        for row in [*rows(result, "newton"), *rows(result, "torch"), *rows(result, "nearest")]
        if row["step_mT"] <= 2.0
    ]
    assert np.ptp(errors) < 1e-3
    assert min(errors) > 0.01


def test_a_scene_gets_a_search_that_is_measured_and_exact_enough(result):
    assert set(result["chosen"]) >= {"coronary", "pulse"}
    for chosen in result["chosen"].values():
        assert chosen["solver_force_max_N"] <= 0.1 * chosen["tolerance_rms_N"]
        assert any(row["name"] == chosen["name"] for row in result["variants"])


def test_the_roots_that_judge_are_roots():
    plant = load_plant("sample_1")
    model = inverse_workload.trained(inverse_workload.training_data(plant, 600, seed=1), hidden=8, epochs=5)
    along = inverse_workload.course(plant, 50)
    for (displacement, rate, force), roots in zip(
        along.rows(), inverse_workload.network_roots_mT(model, along), strict=True
    ):
        for root in roots.tolist():
            assert model.predict_one(displacement, rate, root, inverse_workload.CIP_PERCENT) == pytest.approx(
                force, abs=1e-9
            )


def test_the_plant_of_the_workload_is_the_plant():
    """Against the simulator's own element, turned steadily after a reversal, its memory switched off."""
    plant = load_plant("sample_1")
    still = msgspec.structs.replace(
        plant,
        relaxation=msgspec.structs.replace(plant.relaxation, fractions=(0.0, 0.0, 0.0)),
        field=msgspec.structs.replace(plant.field, hysteresis_percent=0.0),
        thermal=msgspec.structs.replace(plant.thermal, force_percent_K=0.0),
    )
    gap, speed, travel, dt = 60.0, 20.0, 1.8, 1e-4
    element = Element(still, gap, dt)
    for tick in range(20_000):
        element.advance(tick * dt, gap, -speed)
    for tick in range(round(travel / speed / dt)):
        element.advance(tick * dt, gap, speed)
    field = inverse_workload.NOMINAL.field_mT(gap)
    (expected,) = inverse_workload.plant_force_N(plant, np.array([travel]), np.array([speed]), np.array([field]))
    assert element.force_N == pytest.approx(expected, abs=2e-3)


def test_the_committed_page_is_of_the_committed_figures() -> None:
    figures = json.loads((ROOT / "docs/evidence/inverse.json").read_text(encoding="utf-8"))["figures"]
    assert inverse_report.PAGE.read_text(encoding="utf-8") == inverse_report.page(figures), (
        "python tools/evidence.py inverse writes both anew"
    )
