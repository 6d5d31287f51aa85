"""Constitutive model: stress against the energy's derivative, and its link to the brake's force law."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, strategies as st

from tormagd.lab.characterisation.constitutive import (
    MooneyRivlin,
    cauchy_stress_Pa,
    nominal_stress_Pa,
    pressure_for_free_ends_Pa,
    stretches,
)
from tormagd.lab.design.force_law import stretch_minus_one
from tormagd.physics.force import MU0_H_M, TORMAG, Elastomer, brake_force_N

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
    stretch, b_T = stretches(radial, around), np.array([radial_T, 0.0, axial_T])
    gradient = torch.tensor(np.diag(stretch), requires_grad=True)
    energy = energy_by_definition(gradient, torch.tensor(b_T), material)
    (slope,) = torch.autograd.grad(energy, gradient)
    # the constraint det F = 1 adds -p F^-T
    nominal = slope.numpy() - pressure * np.diag(1.0 / stretch)
    size = np.abs(slope.numpy()).max() + abs(pressure) * 10.0
    np.testing.assert_allclose(nominal_stress_Pa(stretch, b_T, material, pressure), nominal, atol=1e-12 * size)
    cauchy = nominal @ np.diag(stretch)
    np.testing.assert_allclose(cauchy_stress_Pa(stretch, b_T, material, pressure), cauchy, atol=1e-11 * size)
    assert stretch.prod() == pytest.approx(1.0, rel=1e-12)


def test_the_force_law_is_the_radial_stress_per_undeformed_shaft_with_the_sign_of_the_field_turned() -> None:
    """What Eq. 33 makes of Eq. 27: T_rr / lambda_1^2 at lambda_2 = 1 with free ends. Its field is the one in the
    deformed elastomer, and its Maxwell term presses the elastomer on the shaft.
    """
    elastomer = Elastomer(277.3e3, 4.0, 0.2)
    material = MooneyRivlin(100e3, 38.65e3, 4.0)
    for moment_Tm in (1e-4, 1e-3, 2.5e-3):
        lambda_1 = 1.0 + stretch_minus_one(moment_Tm, elastomer, TORMAG)
        stretch, none = stretches(lambda_1, 1.0), np.zeros(3)
        pressure = pressure_for_free_ends_Pa(stretch, none, material)
        elastic = float(cauchy_stress_Pa(stretch, none, material, pressure)[0, 0])
        in_deformed_T = moment_Tm * 4.0 / 4.0 / TORMAG.inner_radius_m
        with_field = cauchy_stress_Pa(stretch, np.array([in_deformed_T / lambda_1, 0.0, 0.0]), material, pressure)
        maxwell = float(with_field[0, 0]) - elastic
        area_m2 = 2.0 * math.pi * TORMAG.thickness_m * TORMAG.inner_radius_m**2
        traction = 0.2 * area_m2 / (TORMAG.roller_radius_m * lambda_1)
        force = traction * (maxwell - elastic) / lambda_1**2
        assert force == pytest.approx(brake_force_N(moment_Tm, elastomer, TORMAG), rel=1e-9)
