"""Constitutive model: stress against the energy's derivative, limits, and its link to the brake's force law."""

import math

import mpmath as mp
import numpy as np
import pytest
import torch
from hypothesis import given, strategies as st

from tormagd.lab.characterisation.constitutive import (
    MooneyRivlin,
    cauchy_stress_Pa,
    field,
    invariants,
    nominal_stress_Pa,
    pressure_for_free_ends_Pa,
    strain_energy_J_m3,
    stretches,
    total_energy_J_m3,
)
from tormagd.lab.design.force_law import stretch_minus_one
from tormagd.physics.errors import DomainError
from tormagd.physics.force import MU0_H_M, TORMAG, Elastomer, brake_force_N

MATERIAL = MooneyRivlin(c10_Pa=90e3, c01_Pa=48.65e3, relative_permeability=4.0)
stretch_values = st.floats(0.3, 3.0)
field_values = st.floats(-3.0, 3.0)
materials = st.builds(MooneyRivlin, st.floats(1e3, 1e6), st.floats(0.0, 1e6), st.floats(1.0, 10.0))


def energy_by_definition(gradient: torch.Tensor, b: torch.Tensor, material: MooneyRivlin) -> torch.Tensor:
    """Omega* straight from tensors: traces of C = F^T F, and C b . b."""
    c = gradient.T @ gradient
    i1, of_square = torch.trace(c), torch.trace(c @ c)
    elastic = material.c10_Pa * (i1 - 3) + material.c01_Pa * ((i1**2 - of_square) / 2 - 3)
    return elastic + b @ c @ b / (2 * MU0_H_M * material.relative_permeability)


@given(stretch_values, stretch_values, field_values, field_values, st.floats(-1e6, 1e6), materials)
def test_stress_is_the_derivative_of_the_energy(
    radial: float, around: float, radial_T: float, axial_T: float, pressure: float, material: MooneyRivlin
) -> None:
    stretch, b = stretches(radial, around), field(radial_T, axial_T)
    gradient = torch.tensor(stretch.deformation_gradient, requires_grad=True)
    energy = energy_by_definition(gradient, torch.tensor([radial_T, 0.0, axial_T], dtype=torch.float64), material)
    (slope,) = torch.autograd.grad(energy, gradient)
    # the constraint det F = 1 adds -p F^-T
    nominal = slope.numpy() - pressure * np.linalg.inv(stretch.deformation_gradient).T
    size = np.abs(slope.numpy()).max() + abs(pressure) * 10.0
    np.testing.assert_allclose(nominal_stress_Pa(stretch, b, material, pressure), nominal, atol=1e-12 * size)
    cauchy = nominal @ stretch.deformation_gradient.T
    np.testing.assert_allclose(cauchy_stress_Pa(stretch, b, material, pressure), cauchy, atol=1e-11 * size)
    assert total_energy_J_m3(stretch, b, material) == pytest.approx(energy.item(), abs=1e-9 * energy.item() + 1e-7)


@given(stretch_values, stretch_values, field_values, field_values)
def test_invariants_are_those_of_the_tensors(radial: float, around: float, radial_T: float, axial_T: float) -> None:
    stretch = stretches(radial, around)
    c, b = stretch.right_cauchy_green, np.array([radial_T, 0.0, axial_T])
    found = invariants(stretch, field(radial_T, axial_T))
    expected = (
        np.trace(c),
        (np.trace(c) ** 2 - np.trace(c @ c)) / 2.0,
        np.linalg.det(c),
        b @ b,
        b @ c @ b,
        b @ c @ c @ b,
    )
    # I2 by traces cancels where one stretch dominates
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12 * np.trace(c) ** 2)


@given(st.floats(-14.0, -0.3), st.floats(-14.0, -0.3), st.booleans(), st.booleans())
def test_strain_energy_keeps_its_digits_at_small_strain(
    radial: float, around: float, compressed: bool, pressed: bool
) -> None:
    lambda_1 = 1.0 - 10.0**radial if compressed else 1.0 + 10.0**radial
    lambda_2 = 1.0 - 10.0**around if pressed else 1.0 + 10.0**around
    with mp.workdps(60):
        first, second = mp.mpf(lambda_1) ** 2, mp.mpf(lambda_2) ** 2
        third = 1 / (first * second)
        exact = MATERIAL.c10_Pa * (first + second + third - 3)
        exact += MATERIAL.c01_Pa * (1 / first + 1 / second + 1 / third - 3)
    assert float(strain_energy_J_m3(stretches(lambda_1, lambda_2), MATERIAL)) == pytest.approx(float(exact), rel=1e-13)


def test_the_force_law_is_the_radial_stress_per_undeformed_shaft_with_the_sign_of_the_field_turned() -> None:
    """What Eq. 33 makes of Eq. 27: T_rr / lambda_1^2 at lambda_2 = 1 with free ends. Its field is the one in the
    deformed elastomer, and its Maxwell term presses the elastomer on the shaft.
    """
    elastomer = Elastomer(277.3e3, 4.0, 0.2)
    material = MooneyRivlin(100e3, 38.65e3, 4.0)
    for moment_Tm in (1e-4, 1e-3, 2.5e-3):
        lambda_1 = 1.0 + stretch_minus_one(moment_Tm, elastomer, TORMAG)
        stretch, none = stretches(lambda_1, 1.0), field(0.0)
        pressure = pressure_for_free_ends_Pa(stretch, none, material)
        elastic = float(cauchy_stress_Pa(stretch, none, material, pressure)[0, 0])
        in_deformed_T = moment_Tm * 4.0 / 4.0 / TORMAG.inner_radius_m
        with_field = cauchy_stress_Pa(stretch, field(in_deformed_T / lambda_1), material, pressure)
        maxwell = float(with_field[0, 0]) - elastic
        area_m2 = 2.0 * math.pi * TORMAG.thickness_m * TORMAG.inner_radius_m**2
        traction = 0.2 * area_m2 / (TORMAG.roller_radius_m * lambda_1)
        force = traction * (maxwell - elastic) / lambda_1**2
        assert force == pytest.approx(brake_force_N(moment_Tm, elastomer, TORMAG), rel=1e-9)


@pytest.mark.parametrize("bad", [0.0, -1.0, 0.01, 21.0, math.nan, math.inf, np.array([1.0, math.nan]), "one"])
@pytest.mark.parametrize(
    ("made", "name"),
    [(lambda bad: stretches(bad, 1.0), "radial"), (lambda bad: stretches(1.0, bad), "circumferential")],
)
def test_stretches_outside_the_range_are_refused(made, name, bad):
    with pytest.raises(DomainError, match=name):
        made(bad)


@pytest.mark.parametrize("bad", [math.nan, math.inf, 11.0, -11.0])
@pytest.mark.parametrize(("made", "name"), [(field, "radial_T"), (lambda bad: field(0.0, bad), "axial_T")])
def test_fields_are_checked(made, name, bad):
    with pytest.raises(DomainError, match=name):
        made(bad)


def test_the_axial_stretch_is_checked_too():
    with pytest.raises(DomainError, match="axial"):
        stretches(0.1, 0.1)


@pytest.mark.parametrize(
    ("constants", "name"),
    [
        ((-1.0, 1e3, 2.0), "c10_Pa"),
        ((1e3, math.nan, 2.0), "c01_Pa"),
        ((1e3, 1e3, 0.5), "relative_permeability"),
        ((0.0, 0.0, 2.0), r"c10_Pa \+ c01_Pa"),
    ],
)
def test_constants_are_checked(constants: tuple[float, float, float], name: str) -> None:
    with pytest.raises(DomainError, match=name):
        MooneyRivlin(*constants)
