"""Laws, fits, tests of a sample, relaxation: on synthetic data, and on measured rubber."""

import json
import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import mpmath as mp
import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings, strategies as st

from tormag_lab.characterisation.compression import (
    CompressionRecord,
    Sample,
    deviations,
    evaluated_cycle,
    loading_halves,
    read_compression,
)
from tormag_lab.characterisation.constitutive import (
    MooneyRivlin,
    cauchy_stress_Pa,
    nominal_stress_Pa,
    pressure_for_free_ends_Pa,
    stretches,
)
from tormag_lab.characterisation.elasticity import (
    Shape,
    fit_neo_hookean,
    fit_ogden,
    fit_thesis_ogden,
    ogden_shape,
    thesis_shape,
)
from tormag_lab.characterisation.relaxation import RelaxationRecord, fit_relaxation
from tormag_lab.design.force_law import stretch_minus_one
from tormag_lab.errors import LabError
from tormag_lab.main import main
from tormag_lab.tables import read_columns
from tormagd.element.physics.errors import DomainError
from tormagd.element.physics.force import MU0_H_M, TORMAG, Elastomer, brake_force_N
from tormagd.element.physics.relaxation import PronySeries


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(
    ("shape", "exponent"),
    [(ogden_shape, 2.0), (ogden_shape, 9.0), (ogden_shape, -2.0), (thesis_shape, 2.7), (thesis_shape, 0.7)],
)
def test_stress_rises_from_three_times_the_shear_modulus_and_keeps_type_and_shape(
    shape: Shape, exponent: float, dtype: type
) -> None:
    around = shape(np.array([1.0 - 1e-6, 1.0, 1.0 + 1e-6]), exponent)
    assert (around[1], around[2] - around[0]) == (0.0, pytest.approx(3.0 * 2e-6, rel=1e-6))
    stretch: Any = np.linspace(0.1, 10.0, 60, dtype=dtype).reshape(6, 10)
    found = shape(stretch, exponent)
    assert (found.dtype, found.shape) == (dtype, stretch.shape)
    assert (np.diff(found.ravel()) > 0.0).all()


@given(st.floats(-15.0, -0.1), st.booleans(), st.floats(0.1, 20.0))
def test_stress_keeps_its_digits_at_small_strain(strain: float, compressed: bool, exponent: float) -> None:
    stretch = 1.0 - 10.0**strain if compressed else 1.0 + 10.0**strain
    with mp.workdps(50):
        power, log = mp.mpf(exponent), mp.log(mp.mpf(stretch))
        printed = mp.exp(power * log) - mp.exp(-power / 2 * log)
        engineering = 2 / power * printed / stretch
    at: Any = stretch
    assert thesis_shape(at, exponent) == pytest.approx(2.0 / exponent * float(printed), rel=1e-13)
    assert ogden_shape(at, exponent) == pytest.approx(float(engineering), rel=1e-13)


COMPRESSION = np.linspace(1.0, 0.75, 60)
TENSION = np.linspace(1.0, 4.0, 80)


@settings(max_examples=25, deadline=None)
@given(st.floats(3.0, 7.0), st.floats(0.4, 12.0), st.booleans())
def test_one_ogden_term_is_found_again(decades: float, exponent: float, pulled: bool) -> None:
    stretch = TENSION if pulled else COMPRESSION
    stress_Pa = 10.0**decades * ogden_shape(stretch, exponent)
    assume(np.abs(stress_Pa).max() <= 1e12)  # beyond, a record is refused
    fit = fit_ogden(stretch, stress_Pa)
    assert (fit.shear_modulus_Pa, fit.exponents[0]) == (
        pytest.approx(10.0**decades, rel=1e-4),
        pytest.approx(exponent, rel=1e-3),
    )
    assert fit.r2 > 1.0 - 1e-9


@pytest.mark.parametrize("exponent", [0.7, 2.0, 9.0])
def test_the_printed_law_is_found_again(exponent: float) -> None:
    fit = fit_thesis_ogden(COMPRESSION, 140e3 * thesis_shape(COMPRESSION, exponent))
    assert (fit.exponents[0], fit.shear_modulus_Pa) == (
        pytest.approx(exponent, rel=1e-5),
        pytest.approx(140e3, rel=1e-6),
    )


@pytest.mark.parametrize(
    ("file", "published_kPa"), [("Ecoflex_00-10", 7.4), ("Ecoflex_00-30", 15.1), ("Ecoflex_00-50", 20.8)]
)
def test_measured_silicones(recordings: Path, file: str, published_kPa: float) -> None:
    columns = ("Engineering Strain", "Engineering Stress (MPa)")
    strain, stress_MPa = read_columns(recordings / "srmd_silicone" / f"{file}.csv", columns, delimiter=";").values()
    chosen = (strain >= 0.05) & (strain <= 0.5)
    fit = fit_neo_hookean(1.0 + strain[chosen], 1e6 * stress_MPa[chosen])
    assert 1e-3 * fit.shear_modulus_Pa == pytest.approx(published_kPa, rel=0.01)
    chosen = (strain >= 0.05) & (strain <= 3.0)
    for terms, share in ((1, 0.997), (2, 0.9997)):
        assert fit_ogden(1.0 + strain[chosen], 1e6 * stress_MPa[chosen], terms).r2 > share


def test_treloars_rubber(recordings: Path) -> None:
    stretch, stress_MPa = read_columns(recordings / "hyperelastics_jl" / "uniaxial.csv", ("Stretch", "Stress")).values()
    assert fit_neo_hookean(stretch, 1e6 * stress_MPa).r2 < 0.9
    fit = fit_ogden(stretch, 1e6 * stress_MPa, terms=3)
    assert fit.r2 > 0.998
    assert 0.25e6 < fit.shear_modulus_Pa < 0.45e6


@pytest.mark.parametrize("fit", [fit_neo_hookean, fit_ogden, fit_thesis_ogden])
@pytest.mark.parametrize(
    ("stretch", "stress_Pa", "error", "said"),
    [
        (COMPRESSION, -1e4 * ogden_shape(COMPRESSION, 2.0), LabError, "no positive modulus"),
        (COMPRESSION, np.zeros_like(COMPRESSION), LabError, "vary"),
        (COMPRESSION[:1], COMPRESSION[:1], LabError, "pairs"),
        (np.array([1.0, 0.9, 0.0]), np.array([0.0, -1e3, -1e4]), DomainError, "stretch"),
        (np.array([1.0, 0.9, 0.8]), np.array([0.0, -1e3, np.nan]), DomainError, "stress_Pa"),
    ],
)
def test_curves_that_cannot_be_fitted(fit, stretch, stress_Pa, error, said) -> None:
    with pytest.raises(error, match=said):
        fit(stretch, stress_Pa)


MODULUS_PA, EXPONENT = 120e3, 3.0
SAMPLE = Sample()
SOFTENING = (1.5, 1.2, 1.05, 1.0, 0.99)


def cyclic_test(
    cycles: int = 4, strain: float = 0.25, rate_mm_min: float = 10.0, noise: float = 0.0, set_mm: float = 0.0
) -> CompressionRecord:
    """Triangles, stiffer in the first cycles and while loading; a set shifts later starts."""
    rng = np.random.default_rng(0)
    top_mm, dt_s = strain * SAMPLE.height_mm, 0.05
    half = round(top_mm / (rate_mm_min / 60.0) / dt_s)
    displacement, force = [0.0], [0.0]
    for cycle in range(cycles):
        low_mm = set_mm * cycle
        loading = np.linspace(low_mm, top_mm, half + 1)[1:]
        for path, share in ((loading, 1.0), (np.linspace(top_mm, low_mm + set_mm, half + 1)[1:], 0.85)):
            stretch = 1.0 - path / SAMPLE.height_mm
            displacement.extend(path)
            force.extend(-MODULUS_PA * ogden_shape(stretch, EXPONENT) * SAMPLE.area_m2 * share * SOFTENING[cycle])
    jitter = rng.normal(0.0, noise, (2, len(force)))
    return CompressionRecord(
        np.arange(len(force)) * dt_s, np.array(displacement) + 1e-2 * jitter[0], np.array(force) + jitter[1]
    )


def test_noise_and_set_make_no_cycles() -> None:
    record = cyclic_test(noise=0.5, set_mm=0.1)
    assert len(loading_halves(record)) == 4
    curve = evaluated_cycle(record, SAMPLE)
    assert fit_ogden(curve.stretch, curve.stress_Pa).shear_modulus_Pa == pytest.approx(120e3, rel=0.05)


def test_deviations_from_the_cycle_rules_are_told() -> None:
    assert deviations(cyclic_test(cycles=2, strain=0.4, rate_mm_min=50.0), Sample(29.2, 12.5)) == [
        "2 cycles: the method has 4 and evaluates the last",
        "cycle 1 goes to 40.0% strain: the method goes to 25%",
        "cycle 1 loads at 50 mm/min: the method loads at 10 mm/min",
        "cycle 2 goes to 40.0% strain: the method goes to 25%",
        "cycle 2 loads at 50 mm/min: the method loads at 10 mm/min",
    ]


def test_files_are_read_past_a_preamble_and_checked(tmp_path: Path) -> None:
    path = tmp_path / "test.csv"
    path.write_text("Machine;X\ntime_s, displacement_mm ,force_N,note\n0,0,0,a\n1,0.5,20,b\n\n2,1,45\n")
    assert read_compression(path).force_N.tolist() == [0.0, 20.0, 45.0]
    for text, said in (
        ("a,b\n1,2\n", "header: 'time_s' is missing.*needed is time_s,displacement_mm,force_N"),
        ("time_s,displacement_mm,force_N\n", "0 rows"),
        (
            "time_s,displacement_mm,force_N\n0,0,0\n1,nan,0\n",
            "row 3, displacement_mm: 'nan' .*only finite",
        ),
        ("time_s,displacement_mm,force_N\n0,0\n", "row 2, force_N: ''"),
        ("time_s,displacement_mm,force_N\n1,0,0\n1,1,1\n", "time_s does not rise"),
    ):
        path.write_text(text)
        with pytest.raises(LabError, match=said):
            read_compression(path)


SERIES = PronySeries((0.05, 0.04, 0.04), (8.0, 90.0, 900.0))
HOLD_S = np.concatenate(([0.0, 1e-3], 1e-3 + np.geomspace(0.05, 4000.0, 400)))


def record(time_s: np.ndarray, driving: np.ndarray, scale_N: float = 2.5, noise_N: float = 0.0) -> RelaxationRecord:
    state, forces = SERIES.relaxed(float(driving[0])), [SERIES.discretise(0.0).equilibrium_fraction * driving[0]]
    for dt_s, level in zip(np.diff(time_s), driving[1:], strict=True):
        force, state = SERIES.discretise(float(dt_s)).advance(state, float(level))
        forces.append(force)
    noise = np.random.default_rng(2).normal(0.0, noise_N, len(forces)) if noise_N else 0.0
    return RelaxationRecord(time_s, driving, scale_N * np.array(forces) + noise)


STEP = np.where(HOLD_S > 0.0, 1.0, 0.0)
RAMPS_S = np.arange(0.0, 4000.0, 5.0)
RAMPS = 2.0 + np.interp(RAMPS_S, [0, 20, 800, 900, 2000, 2010, 4000], [3, 0, 0, 2, 2, -1, -1])


@pytest.mark.parametrize(("time_s", "driving", "rel"), [(HOLD_S, STEP, 1e-4), (RAMPS_S, RAMPS, 1e-3)])
def test_a_step_and_ramps_give_the_spectrum_and_the_scale(time_s, driving, rel) -> None:
    fit = fit_relaxation(record(time_s, driving))
    found = (fit.scale_N, *fit.series.fractions, *fit.series.times_s)
    assert found == pytest.approx((2.5, *SERIES.fractions, *SERIES.times_s), rel=rel)
    assert fit.scale_N == pytest.approx(2.5, rel=1e-2 * rel)


def test_noise_is_left_over_and_not_fitted() -> None:
    fit = fit_relaxation(record(HOLD_S, STEP, noise_N=0.005))
    assert (fit.rms_N, sum(fit.series.fractions)) == (pytest.approx(0.005, rel=0.15), pytest.approx(0.13, abs=0.01))
    assert fit.r2 > 0.99


GOOD = record(HOLD_S, STEP)


@pytest.mark.parametrize(
    ("evaluated", "error", "said"),
    [
        (lambda: evaluated_cycle(cyclic_test(cycles=3), SAMPLE), LabError, "cycle 4 of 3"),
        (lambda: evaluated_cycle(cyclic_test(), Sample(height_mm=2.0)), LabError, "height"),
        (lambda: loading_halves(CompressionRecord(np.arange(5.0), np.zeros(5), np.zeros(5))), LabError, "no cycle"),
        (lambda: Sample(diameter_mm=0.0), DomainError, "diameter_mm"),
        (lambda: fit_ogden(COMPRESSION, COMPRESSION, terms=4), LabError, "terms = 4"),
        (lambda: fit_relaxation(RelaxationRecord(*(column[:10] for column in GOOD))), LabError, "14 rows"),
        (lambda: fit_relaxation(GOOD._replace(time_s=GOOD.time_s[::-1].copy())), LabError, "rise strictly"),
        (lambda: fit_relaxation(GOOD._replace(driving=np.ones_like(GOOD.driving))), LabError, "both change"),
        (lambda: fit_relaxation(GOOD._replace(force_N=-GOOD.force_N)), LabError, "equilibrium"),
        (lambda: fit_relaxation(GOOD, branches=7), LabError, "branches = 7"),
        (lambda: fit_relaxation(GOOD._replace(force_N=np.nan * GOOD.force_N)), DomainError, "force_N"),
    ],
)
def test_records_that_cannot_be_evaluated(evaluated: Callable[[], object], error: type[Exception], said: str) -> None:
    with pytest.raises(error, match=said):
        evaluated()


@pytest.fixture
def characterised(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., dict[str, Any]]:

    def run(kind: str, columns: Iterable[np.ndarray], names: str, *options: str) -> dict[str, Any]:
        path = tmp_path / "record.csv"
        np.savetxt(path, np.column_stack(tuple(columns)), delimiter=",", header=names, comments="")
        assert main(["characterise", "--json", kind, str(path), *options]) == 0
        found: dict[str, Any] = json.loads(capsys.readouterr().out)
        return found

    return run


def test_compression_gives_the_conditioned_modulus_of_the_fourth_cycle(characterised) -> None:
    found = characterised("compression", cyclic_test(), "time_s,displacement_mm,force_N")
    assert (found["cycle"], found["stretch"]) == (4, pytest.approx([0.75, 1.0]))
    assert found["deviations"] == ["diameter 30 mm: test piece A has 29 +- 0.5 mm"]
    assert found["ogden"]["shear_modulus_kPa"] == pytest.approx(120.0, rel=1e-3)
    assert found["thesis_eq_3"]["r2"] > 0.99


def test_tension_and_relaxation(characterised) -> None:
    strain = np.linspace(0.0, 1.0, 50)
    columns = (strain, 1e-6 * 15e3 * ogden_shape(1.0 + strain, 2.0))
    found = characterised("tension", columns, "strain,stress", "--strain", "strain", "--stress-mpa", "stress")
    assert found["neo_hookean"]["shear_modulus_kPa"] == pytest.approx(15.0)
    time_s = np.concatenate(([0.0, 1e-6], np.geomspace(0.1, 100.0, 40)))
    driving = np.where(time_s > 0.0, 1.0, 0.0)
    hold = (time_s, driving, driving * (2.0 + 0.4 * np.expm1(-time_s / 5.0)))
    found = characterised("relaxation", hold, "time_s,driving,force_N", "--branches", "1")
    assert (found["fractions"], found["times_s"]) == (pytest.approx([0.2], rel=1e-3), pytest.approx([5.0], rel=1e-3))


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
