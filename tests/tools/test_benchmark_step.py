"""The step benchmark on the plant: figures of the position loop that are promised to users."""

import msgspec
import pytest
from benchmarks import step

from tormagd.config import Config
from tormagd.lab.tune_position import LEAST_GAIN_MARGIN_DB, LEAST_PHASE_MARGIN_DEG, corner_margins
from tormagd.simulation.parameters import load_plant


@pytest.fixture(scope="module")
def measured():
    """One run on the sample the loop was tuned on."""
    return step.run("sample_1")


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
    ],
)
def test_a_millimetre_is_nearly_time_optimal(measured, figure, least, most):
    assert least <= measured[figure] <= most


def test_the_stroke_is_limited_by_the_motors(measured):
    assert 1.0 <= measured["stroke_ratio"] <= 1.15


def test_the_transfer_function_is_the_plants(measured):
    assert measured["model_nrmse"] <= 0.05


def test_a_wrong_motor_is_noticed_in_the_comparison():
    """With twice the inertia the same comparison fails: it can."""
    heavy = msgspec.structs.replace(Config().motor, inertia_kg_m2=1.6e-6)
    assert step.nrmse(*step.model_step(heavy, load_plant("sample_1"), step.MODEL_DUTY)) > 0.1


def test_the_shipped_gains_are_robust():
    corners = corner_margins(Config())
    assert corners["gain_margin_dB"] >= LEAST_GAIN_MARGIN_DB
    assert corners["phase_margin_deg"] >= LEAST_PHASE_MARGIN_DEG
