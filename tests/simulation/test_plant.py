"""Element or pad, sensors, and the plant of all of it together."""

import itertools
import statistics

import msgspec
import numpy as np
import pytest

from tormagd.physics.force import TORMAG, Elastomer, brake_force_N
from tormagd.simulation.element import Element
from tormagd.simulation.hand import PressingHand, ReversingHand, SteadyHand
from tormagd.simulation.parameters import PlantParameters, load_plant
from tormagd.simulation.plant import SUBSTEP_S, Plant
from tormagd.simulation.pressed_pad import PressedPad
from tormagd.simulation.static_laws import radial_moment_Tm

# -- motor, gearbox, screw and carriage: against the data sheet, against closed forms, and for passivity ---------------


SAMPLES = ("sample_1", "sample_2", "sample_3")

SAMPLE_1 = load_plant("sample_1")


def steps(duration_s: float) -> int:
    return round(duration_s / SUBSTEP_S)


def changed(plant: PlantParameters, table: str, **values: object) -> PlantParameters:
    """With these values in one of its tables."""
    return msgspec.structs.replace(plant, **{table: msgspec.structs.replace(getattr(plant, table), **values)})


# -- element and sensors -----------------------------------------------------------------------------------------------


STEP_S = 1e-3
SPEED_MM_S = 41.9


def without_memory(plant: PlantParameters) -> PlantParameters:
    """The plant with its constitutive law alone: no hysteresis, relaxation, drift, Stribeck or viscous part."""
    replace = msgspec.structs.replace
    return replace(
        plant,
        field=replace(plant.field, hysteresis_percent=0.0),
        relaxation=replace(plant.relaxation, fractions=(0.0, 0.0, 0.0)),
        thermal=replace(plant.thermal, drift_K_h=0.0),
        friction=replace(plant.friction, static_to_kinetic=1.0, viscous_N_s_mm=0.0),
    )


@pytest.mark.parametrize("name", SAMPLES)
@pytest.mark.parametrize("gap_mm", [45.0, 60.0, 94.9])
def test_without_memory_the_force_is_the_constitutive_law_at_the_true_gap(name: str, gap_mm: float) -> None:
    plant = without_memory(load_plant(name))
    element = Element(plant, gap_mm, STEP_S)
    for step in range(400):
        element.advance(step * STEP_S, gap_mm, SPEED_MM_S)
    of = plant.elastomer
    insert = Elastomer(of.shear_modulus_kPa * 1e3, of.relative_permeability, of.kinetic_friction)
    law_N = brake_force_N(float(radial_moment_Tm(np.array([gap_mm]), plant)[0]), insert, TORMAG)
    assert element.force_N == pytest.approx(law_N, rel=1e-5)


def test_the_joined_field_law_is_smooth_and_falls() -> None:
    plant = load_plant("sample_2")
    gap_mm = np.linspace(44.0, 110.0, 66_001)
    slope = np.gradient(radial_moment_Tm(gap_mm, plant), gap_mm)
    assert np.all(slope < 1e-12)
    # largest curvature of Eq. 7 is 1.206e-6 * 1.867 * 0.867 * x**-0.133: no kink where the laws meet
    assert np.max(np.abs(np.diff(slope)[45_000:])) < 5e-8


@pytest.mark.parametrize("steps", [10, 1000])
def test_hysteresis_lags_and_does_not_depend_on_the_rate(steps: int) -> None:
    quiet = without_memory(SAMPLE_1)
    element = Element(changed(quiet, "field", hysteresis_percent=1.0), 60.0, STEP_S)

    def sweep(start_mm: float, end_mm: float) -> float:
        for step in range(1, steps + 1):
            element.advance(0.0, start_mm + (end_mm - start_mm) * step / steps, SPEED_MM_S)
        return element.kinetic_N

    sweep(60.0, 90.0)
    closing_N = sweep(90.0, 60.0)
    sweep(60.0, 46.0)
    opening_N = sweep(46.0, 60.0)
    assert opening_N > closing_N
    # 1% of the largest moment to either side, with F about proportional to the square of the moment
    assert opening_N / closing_N - 1.0 == pytest.approx(4 * 0.01 * (60.0 / 45.0) ** 1.3, rel=0.1)
    assert (opening_N + closing_N) / 2.0 == pytest.approx(Element(quiet, 60.0, STEP_S).kinetic_N, rel=0.01)


def test_force_relaxes_after_a_field_step_by_the_stated_share() -> None:
    element = Element(changed(SAMPLE_1, "thermal", drift_K_h=0.0), 94.0, 0.1)
    before_N = element.kinetic_N
    element.advance(0.0, 50.0, SPEED_MM_S)
    step_N = element.kinetic_N - before_N
    for _ in range(300):
        element.advance(0.0, 50.0, SPEED_MM_S)
    lost = (before_N + step_N - element.kinetic_N) / step_N
    expected = 0.05 * (1 - np.exp(-30 / 8)) + 0.04 * (1 - np.exp(-30 / 90)) + 0.04 * (1 - np.exp(-30 / 900))
    # the equilibrium level before the step carries its own lost share
    assert lost == pytest.approx(expected, rel=0.05)


def test_warming_weakens_the_force_and_levels_off() -> None:
    element = Element(without_memory(SAMPLE_1), 50.0, STEP_S)
    warm = Element(msgspec.structs.replace(without_memory(SAMPLE_1), thermal=SAMPLE_1.thermal), 50.0, STEP_S)
    for one in (element, warm):
        one.advance(3600.0, 50.0, SPEED_MM_S)
    assert warm.temperature_C == pytest.approx(25.97, abs=0.01)
    assert warm.kinetic_N / element.kinetic_N == pytest.approx(1.0 - 0.004 * (warm.temperature_C - 25.0), rel=1e-9)
    warm.advance(1e7, 50.0, SPEED_MM_S)
    assert warm.temperature_C == pytest.approx(40.0)


def test_the_brake_gives_the_hand_no_energy_over_its_reversals() -> None:
    plant = Plant(SAMPLE_1, ReversingHand(4.0))
    work_J = 0.0
    directions = set()
    for _ in range(8000):
        before_mm = plant.handle_mm
        plant.advance(STEP_S)
        work_J += plant.truth.force_N * (plant.handle_mm - before_mm) * 1e-3
        assert work_J >= 0.5 * plant.truth.force_N**2 / 8.0 * 1e-3 - 1e-6
        if abs(plant.handle_mm_s) > 35.0:
            assert plant.truth.force_N * plant.handle_mm_s > 0.0
            directions.add(plant.handle_mm_s > 0.0)
    assert work_J > 0.1
    assert directions == {True, False}


def readings(plant: Plant, milliseconds: int) -> list[float]:
    values = []
    for _ in range(milliseconds):
        plant.advance(STEP_S)
        values.append(plant.sensed_force_N)
    return values


@pytest.mark.parametrize("name", SAMPLES)
def test_force_sensor_noise_has_the_stated_spread_around_the_truth(name: str) -> None:
    parameters = load_plant(name)
    plant = Plant(parameters, SteadyHand(), seed=3)
    values = readings(plant, 4000)[200:]
    fresh = [after for before, after in itertools.pairwise(values) if after != before]
    assert len(fresh) == pytest.approx(3.8 * parameters.force_sensor.rate_Hz, abs=3)
    assert statistics.stdev(fresh) == pytest.approx(parameters.force_sensor.noise_mN * 1e-3, rel=0.08)
    assert statistics.fmean(fresh) == pytest.approx(plant.truth.force_N, abs=3e-3)


@pytest.mark.parametrize(("delay_ms", "rate_Hz"), [(0.0, 1000.0), (1.0, 1000.0), (7.0, 1000.0), (4.0, 250.0)])
def test_force_sensor_shows_the_force_of_its_delay_ago(delay_ms: float, rate_Hz: float) -> None:
    plant = Plant(
        changed(SAMPLE_1, "force_sensor", noise_mN=0.0, drift_mN_min=0.0, delay_ms=delay_ms, rate_Hz=rate_Hz),
        ReversingHand(2.0),
    )
    forces = []
    period_ms = round(1000.0 / rate_Hz)
    for millisecond in range(1, 600):
        plant.advance(STEP_S)
        forces.append(plant.truth.force_N)
        sampled_ms = (millisecond - round(delay_ms)) // period_ms * period_ms
        if sampled_ms >= period_ms:
            assert plant.sensed_force_N == forces[sampled_ms - 1]


def test_force_sensor_offset_drifts_at_the_stated_rate() -> None:
    drifting = changed(SAMPLE_1, "force_sensor", noise_mN=0.0, drift_mN_min=600.0, delay_ms=0.0)
    signs = set()
    for seed in range(6):
        plant = Plant(drifting, SteadyHand(), seed)
        plant.advance(2.0)
        offset_N = plant.sensed_force_N - plant.truth.force_N
        assert abs(offset_N) == pytest.approx(0.02, rel=0.01)
        signs.add(offset_N > 0.0)
    assert signs == {True, False}


def test_time_may_be_cut_in_any_way() -> None:
    whole, pieces = Plant(SAMPLE_1, SteadyHand(), seed=1), Plant(SAMPLE_1, SteadyHand(), seed=1)
    for plant in (whole, pieces):
        plant.drive(-6.0, -5.0)
    whole.advance(0.3)
    for _ in range(3000):
        pieces.advance(0.3 / 3000 / 3)
        pieces.advance(0.3 / 3000 * 2 / 3)
    assert (pieces.truth, pieces.sensed_force_N) == (whole.truth, whole.sensed_force_N)


# -- the pad -----------------------------------------------------------------------------------------------------------


PADS = ("pad_1", "pad_2", "pad_3")


def force_N(plant_name: str, gap_mm: float, depth_mm: float, *, seconds: float = 0.0) -> float:
    """At once, or after being held."""
    element = PressedPad(load_plant(plant_name), gap_mm, STEP_S)
    for step in range(round(seconds / STEP_S) + 1):
        element.advance(step * STEP_S, gap_mm, depth_mm, 0.0)
    return element.force_N


@pytest.mark.parametrize("name", PADS)
def test_a_pad_pushes_harder_the_deeper_and_the_nearer_the_magnets(name: str) -> None:
    depths = [force_N(name, 70.0, depth) for depth in (0.0, 0.5, 1.0, 2.0, 4.5, 6.0)]
    gaps = [force_N(name, gap, 2.0) for gap in (95.0, 80.0, 60.0, 45.0)]
    assert (depths[0], depths, gaps) == (0.0, sorted(depths), sorted(gaps))
    assert 3.0 < gaps[0] < 3.6 < 4.1 < gaps[-1] < 4.7
    # the plates meet: deeper there is nothing to press
    assert force_N(name, 70.0, 9.0) == depths[-1]


def test_a_held_pad_relaxes_and_a_warm_one_is_softer() -> None:
    assert force_N("pad_1", 70.0, 2.0, seconds=3.0) < 0.98 * force_N("pad_1", 70.0, 2.0)
    plant = load_plant("pad_1")
    cold, hot = (PressedPad(made, 70.0, STEP_S) for made in (plant, changed(plant, "thermal", drift_K_h=20.0)))
    for element in (cold, hot):
        element.advance(3600.0, 70.0, 2.0, 0.0)
    assert hot.force_N < 0.96 * cold.force_N


def test_the_device_feels_the_finger() -> None:
    plant = Plant(load_plant("pad_1"), PressingHand(1.5), seed=1)
    plant.advance(9.0)
    assert (plant.truth.handle_mm, plant.truth.force_N) == (0.0, 0.0)
    plant.advance(5.0)
    truth = plant.truth
    assert (truth.handle_mm, truth.handle_mm_s) == (1.5, 0.0)
    assert truth.force_N > 1.5
    assert plant.sensed_force_N == pytest.approx(truth.force_N, abs=0.05)
