"""The force curve: the same force as the model's, torch's and a 50-digit calculation's, and how far it is trusted."""

import math
from pathlib import Path

import mpmath
import numpy as np
import pytest
import torch
from hypothesis import given, strategies as st

from tormagd.model.features import LARGEST
from tormagd.model.force_curve import LARGEST_EXPONENT, Known, Network
from tormagd.model.model_file import ForceModel, load_model
from tormagd.model.network import to_network
from tormagd.model.shipped import model_path

BOX = ((0.0, 0.0, 100.0, 40.0), (1.0, 60.0, 800.0, 40.0))
Array = np.ndarray


@pytest.fixture(scope="module")
def shipped() -> ForceModel:
    return load_model(model_path("torque_mre_50_40", Path()), element="torque")


def states(count: int) -> Array:
    """Features (count x 4), a third of them up to ten ranges outside the box, and share of iron too."""
    rng = np.random.default_rng(11)
    rows = rng.uniform(*BOX, (count, 4))
    rows[::3] += rng.normal(size=(len(rows[::3]), 4)) * (3.0, 200.0, 2000.0, 10.0)
    return rows


def exact_N(model: ForceModel, row: list[float]) -> mpmath.mpf:
    """The network in physical units with 50 digits."""
    weight, bias, output, constant = model.physical
    with mpmath.workdps(50):
        total = mpmath.mpf(constant)
        for column, shift, height in zip(weight.tolist(), bias.tolist(), output.tolist(), strict=True):
            pairs = zip(column, row, strict=True)
            exponent = mpmath.mpf(shift) + mpmath.fsum(mpmath.mpf(a) * mpmath.mpf(b) for a, b in pairs)
            total += mpmath.mpf(height) / (1 + mpmath.exp(-exponent))
        return total


@pytest.mark.parametrize("fixture", ["model", "shipped"])
def test_the_force_is_that_of_the_model(request: pytest.FixtureRequest, fixture: str) -> None:
    model = request.getfixturevalue(fixture)
    rows = states(300)
    with torch.inference_mode():
        by_torch = to_network(model)(torch.from_numpy(rows)).numpy()
    forces = [model.curve(row[0], row[1], row[3]).force_N(row[2]) for row in rows.tolist()]
    assert forces == pytest.approx(model.predict(rows), rel=0, abs=1e-12 * model.curve(0.5, 10.0, 40.0).magnitude_N)
    assert forces == pytest.approx(by_torch, rel=0, abs=1e-12 * model.curve(0.5, 10.0, 40.0).magnitude_N)


@pytest.mark.parametrize("fixture", ["model", "shipped"])
def test_the_force_agrees_with_50_digits(request: pytest.FixtureRequest, fixture: str) -> None:
    model = request.getfixturevalue(fixture)
    for row in states(60).tolist():
        curve = model.curve(row[0], row[1], row[3])
        exact = float(exact_N(model, row))
        assert curve.force_N(row[2]) == pytest.approx(exact, rel=0, abs=1e-13 * curve.magnitude_N)
        assert curve.force_and_slope(row[2])[0] == curve.force_N(row[2])


@pytest.mark.parametrize("fixture", ["model", "shipped"])
def test_the_slope_is_that_of_the_model(request: pytest.FixtureRequest, fixture: str) -> None:
    model = request.getfixturevalue(fixture)
    rows = states(300)
    slopes = [model.curve(row[0], row[1], row[3]).force_and_slope(row[2])[1] for row in rows.tolist()]
    steepest = float(np.abs(model.physical.output_weight) @ np.abs(model.physical.hidden_weight[:, 2]))
    assert slopes == pytest.approx(model.field_slope_N_per_mT(rows), rel=0, abs=1e-12 * steepest)


@pytest.mark.parametrize(("dtype", "accuracy"), [(np.float64, 1e-13), (np.float32, 1e-5)])
def test_a_grid_of_fields_has_the_forces_of_its_fields(
    shipped: ForceModel, dtype: type[np.floating], accuracy: float
) -> None:
    curve = shipped.curve(2.0, 20.0, 40.0)
    fields = np.linspace(250.0, 850.0, 61)
    forces = curve.forces_N(fields.astype(dtype))
    assert forces.dtype == dtype
    one_by_one = [curve.force_N(field) for field in fields.tolist()]
    assert forces == pytest.approx(one_by_one, rel=0, abs=accuracy * curve.magnitude_N)


def test_its_state_is_the_one_asked_for(model: ForceModel) -> None:
    curve = model.curve(0.3, 12.0, 41.0)
    assert (curve.displacement_mm, curve.rate_mm_s, curve.cip_percent) == (0.3, 12.0, 41.0)
    assert curve.magnitude_N == pytest.approx(
        float(np.abs(model.physical.output_weight).sum()) + abs(model.physical.output_bias)
    )


@pytest.mark.parametrize("exponent", [LARGEST_EXPONENT, 709.7, 710.0, 1e4, 1e18])
@pytest.mark.parametrize("side", [1, -1])
def test_a_unit_far_from_its_step_is_shut_or_open(exponent: float, side: int) -> None:
    """exp() of more than 709.78 has no float."""
    known = Known(((0.0, 1.0), (0.0, 60.0), (100.0, 800.0), (40.0, 40.0)), 6.0)
    weight = np.array([[0.0, 0.0, side * exponent / 400.0, 0.0]])
    curve = Network(weight, np.zeros(1), np.array([3.0]), 0.25, known).curve(0.5, 10.0, 40.0)
    expected = 3.25 if side > 0 else 0.25
    assert curve.force_N(400.0) == expected
    assert curve.force_and_slope(400.0) == (expected, pytest.approx(0.0, abs=1e-300))
    assert curve.forces_N(np.array([400.0])) == pytest.approx([expected], abs=1e-15)


@given(
    displacement=st.floats(-LARGEST, LARGEST),
    rate=st.floats(-LARGEST, LARGEST),
    field=st.floats(-LARGEST, LARGEST),
    cip=st.floats(-LARGEST, LARGEST),
)
def test_no_state_and_no_field_has_no_force(
    shipped: ForceModel, displacement: float, rate: float, field: float, cip: float
) -> None:
    curve = shipped.curve(displacement, rate, cip)
    force, slope = curve.force_and_slope(field)
    assert abs(force) <= curve.magnitude_N * (1 + 1e-12)
    assert force == curve.force_N(field)
    assert math.isfinite(slope)
    assert 0.0 <= curve.confidence(field, force) <= 1.0


@pytest.mark.parametrize(
    ("place", "error_N", "expected"),
    [
        ((0.5, 10.0, 400.0, 40.0), 0.0, 1.0),
        ((0.5, 10.0, 400.0, 40.0), 0.3, pytest.approx(math.exp(-20 * 0.3 / 5.6))),
        ((1.25, 10.0, 400.0, 40.0), 0.0, pytest.approx(math.exp(-1))),
        ((-0.25, 75.0, 400.0, 40.0), 0.0, pytest.approx(math.exp(-2))),
        ((0.5, 10.0, 975.0, 40.0), 0.0, pytest.approx(math.exp(-1))),
        ((0.5, 10.0, -75.0, 40.0), 0.0, pytest.approx(math.exp(-1))),
        ((0.5, 10.0, 400.0, 50.0), 0.0, pytest.approx(math.exp(-1))),
        ((LARGEST, 10.0, 400.0, 40.0), LARGEST, 0.0),
    ],
)
def test_confidence_follows_its_formula(
    model: ForceModel, place: tuple[float, float, float, float], error_N: float, expected: float
) -> None:
    """The model's force span is 5.6 N; its share of iron never varied."""
    displacement, rate, field, cip = place
    curve = model.curve(displacement, rate, cip)
    assert curve.confidence(field, error_N) == expected
    assert curve.confidence(field, -error_N) == curve.confidence(field, error_N)
