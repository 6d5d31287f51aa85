"""Motor, gearbox, screw and carriage; element or pad, sensors; and the plant of all of them."""

import itertools
import math
import statistics
from collections.abc import Callable

import msgspec
import numpy as np
import pytest
from devices import SAMPLES
from hypothesis import given, settings, strategies as st

from tormagd.element.physics.force import TORMAG, brake_force_N
from tormagd.simulation.axis import Axis
from tormagd.simulation.element import TorqueElement
from tormagd.simulation.hand import ReversingHand, SteadyHand, pressing
from tormagd.simulation.parameters import PlantError, PlantParameters, changed, load_plant, standing
from tormagd.simulation.plant import SUBSTEP_S, Plant, element_of
from tormagd.simulation.second_element import SecondElement
from tormagd.simulation.static_laws import pull_of_magnets_N, radial_moment_Tm
from tormagd.simulation.tactile_pad import PressedPad

SAMPLE_1 = load_plant("sample_1")
LEAD_M_RAD = 8e-3 / math.tau
BACKLASH_M = 40e-6
STIFFNESS_N_M = 5e6


def an_axis(plant: PlantParameters = SAMPLE_1, drag_N: float = 0.0, start_mm: float = 40.0) -> Axis:
    return Axis(plant, drag_N, start_mm, 0.0, SUBSTEP_S)


def steps(duration_s: float) -> int:
    return round(duration_s / SUBSTEP_S)


def turn(axis: Axis, duration_s: float, volts: float | None, attraction_N: float = 0.0) -> None:
    for _ in range(steps(duration_s)):
        axis.step(volts, attraction_N)


def holding(plant: PlantParameters, gap_mm: float, wear: float = 1.0) -> tuple[float, float]:
    pull_N = float(pull_of_magnets_N(gap_mm, plant))
    screw_Nm = pull_N * plant.screw.friction_coefficient * 0.5e-3 * plant.assumed.screw_mean_diameter_mm
    friction_Nm = (plant.gear.output_friction_Nm + screw_Nm) / wear
    return pull_N, friction_Nm - pull_N * plant.screw.lead_mm * 1e-3 / math.tau


def test_speed_torque_and_currents_are_those_of_the_data_sheet() -> None:
    free, stalled = an_axis(), an_axis(changed(SAMPLE_1, "electronics", current_limit_A=20.0))
    turn(free, 0.2, 12.0)
    assert free.speed_rad_s * 60.0 / math.tau == pytest.approx(150.0, rel=0.05)
    assert free.current_A == pytest.approx(0.2, abs=0.03)
    # so slowly that only the torque pushes into the stop
    for step in range(steps(6.0)):
        stalled.step(min(12.0, step * SUBSTEP_S * 3.0), 0.0)
    assert (stalled.speed_rad_s, stalled.current_A) == (0.0, pytest.approx(5.5, rel=0.05))
    assert stalled.contact_N * (LEAD_M_RAD + stalled.screw_friction_m) == pytest.approx(2.65, rel=0.10)


@pytest.mark.parametrize(
    ("table", "key", "value"),
    [("motor", "inertia_kg_m2", 1e-10), ("screw", "stiffness_N_um", 1e9), ("motor", "back_emf_V_s_rad", 10.0)],
)
def test_a_plant_too_quick_for_the_substep_is_refused(table: str, key: str, value: float) -> None:
    with pytest.raises(PlantError, match=key):
        an_axis(changed(SAMPLE_1, table, **{key: value}))


def test_under_break_away_voltage_the_screw_truly_stands() -> None:
    axis = an_axis()
    break_away_V = SAMPLE_1.gear.output_friction_Nm / (70.0 * 0.011) * 2.2
    turn(axis, 0.5, 0.98 * break_away_V)
    assert (axis.speed_rad_s, axis.angle_rad) == (0.0, 0.0)
    turn(axis, 0.5, 1.05 * break_away_V)
    assert axis.angle_rad > 0.0


def test_lost_motion_on_reversal_is_backlash_and_twice_the_drag() -> None:
    drag_N = 6.0
    axis = an_axis(drag_N=drag_N)
    turn(axis, 0.1, 3.0)
    turn(axis, 0.1, None)
    turned_at, stood_at = axis.angle_rad, axis.position_m
    while axis.position_m == stood_at:
        axis.step(-1.0, 0.0)
    lost_m = (turned_at - axis.angle_rad) * LEAD_M_RAD
    assert lost_m == pytest.approx(BACKLASH_M + 2.0 * drag_N / STIFFNESS_N_M, abs=1e-6)


def test_the_stops_hold_against_full_drive_and_the_current_is_limited() -> None:
    for volts, stop_mm, limit_A in ((12.0, 48.0, 5.0), (-12.0, 22.0, -5.0)):
        axis = an_axis(start_mm=35.0)
        turn(axis, 2.0, volts, 30.0)
        assert axis.position_m * 1e3 == pytest.approx(stop_mm, abs=1e-9)
        assert axis.speed_rad_s == pytest.approx(0.0, abs=0.05)
        assert (axis.current_A, abs(axis.contact_N) < 2500.0) == (limit_A, True)


@pytest.mark.parametrize("name", SAMPLES)
def test_attraction_and_holding_margin_over_the_stroke(name: str) -> None:
    plant = load_plant(name)
    gaps_mm = [44.5 + 50.5 * index / 50 for index in range(51)]
    rows = [holding(plant, gap_mm) for gap_mm in gaps_mm]
    assert 50.0 < rows[0][0] < 80.0
    assert all(before > after for (before, _), (after, _) in itertools.pairwise(rows))
    assert all(margin_Nm > 0.05 for _, margin_Nm in rows)
    assert holding(plant, gaps_mm[0], wear=4.0)[1] < 0.0 < holding(plant, gaps_mm[-1], wear=4.0)[1]


@pytest.mark.parametrize("name", SAMPLES)
@pytest.mark.parametrize("wear", [1.0, 4.0])
@pytest.mark.parametrize("gap_mm", [45.5, 75.0, 94.0])
def test_with_the_power_off_the_magnets_close_the_gap_where_the_margin_is_negative(
    name: str, wear: float, gap_mm: float
) -> None:
    parameters = standing(load_plant(name), gap_mm / 2.0, gap_mm / 2.0)
    plant = Plant(parameters, SteadyHand())
    plant.wear(wear)
    plant.advance(3.0)
    if holding(parameters, gap_mm, wear)[1] < 0.0:
        assert plant.gap_mm < gap_mm - 1.0
    else:
        assert plant.gap_mm == pytest.approx(gap_mm, abs=1e-6)
        assert plant.left.angle_rad == plant.right.angle_rad == 0.0


Volts = tuple[float | None, float | None]
OPENING = "bridges that open"
HARD_MOTIONS: dict[str, Callable[[float], Volts]] = {
    "full voltage that turns round": lambda time_s: (12.0, 12.0) if time_s % 0.2 < 0.1 else (-12.0, -12.0),
    "slow reversals": lambda time_s: (2.0 * math.sin(7.5 * time_s),) * 2,
    "sticking": lambda time_s: (1.2 * math.sin(31.0 * time_s), -1.2 * math.sin(31.0 * time_s)),
    "both for themselves": lambda time_s: ((-12.0, 6.0), (6.0, -3.0), (0.0, 0.0), (12.0, -12.0))[int(time_s * 20) % 4],
    OPENING: lambda time_s: ((12.0, 12.0), (None, None), (-12.0, None), (None, -12.0))[int(time_s * 40) % 4],
}


@pytest.mark.parametrize("drag_left_N", [6.0, 50.0], ids=["one flank", "through the backlash"])
@pytest.mark.parametrize("motion", HARD_MOTIONS)
@pytest.mark.parametrize("name", SAMPLES)
def test_the_substep_is_fine_enough_for_hard_motion(name: str, motion: str, drag_left_N: float) -> None:
    parameters = standing(changed(load_plant(name), "screw", drag_left_N=drag_left_N), 30.0, 30.0)

    def path(substep_s: float) -> np.ndarray:
        """A row per tick: gap, um, force, mN, the left screw's way, um, and its current, mA."""
        plant, rows = Plant(parameters, ReversingHand(0.5), substep_s=substep_s), []
        for tick in range(400):
            plant.advance(0.13e-3)
            plant.drive(*HARD_MOTIONS[motion](tick * 1e-3))
            plant.advance(0.27e-3)
            (angle_rad, current_A), _ = plant.shafts
            plant.advance(0.60e-3)
            rows.append((plant.gap_mm, plant.truth.force_N, angle_rad * LEAD_M_RAD * 1e3, current_A))
        return 1e3 * np.array(rows)

    coarse, fine = path(SUBSTEP_S), path(1e-5)
    assert np.ptp(fine[:, 0]) > 30.0
    gap_um, force_mN, screw_um, current_mA = np.abs(coarse - fine).max(axis=0)
    # a bridge that opens at full speed opens up to half a substep late or early
    assert gap_um < (30.0 if motion == OPENING else 4.0)
    assert force_mN < (2.5 if motion == OPENING else 0.4)
    assert screw_um < (5.0 if motion == OPENING else 1.8)
    assert current_mA < 600.0


@settings(max_examples=25, deadline=None)
@given(
    volts=st.lists(st.one_of(st.none(), st.floats(-12.0, 12.0)), min_size=1, max_size=12),
    wear=st.sampled_from([1.0, 4.0]),
)
def test_no_energy_comes_from_nowhere(volts: list[float | None], wear: float) -> None:
    axis = an_axis(drag_N=6.0)
    axis.gear_friction_Nm /= wear
    axis.screw_friction_m /= wear
    inertia, attraction_N = SAMPLE_1.motor.inertia_kg_m2 * 70.0**2, 40.0
    put_in_J = throughput_J = 0.0
    for volt in volts:
        for _ in range(steps(0.03)):
            before_m, angle_rad = axis.position_m, axis.angle_rad
            axis.step(volt, attraction_N)
            electric_J = 0.77 * axis.current_A * (axis.angle_rad - angle_rad)
            magnetic_J = -attraction_N * (axis.position_m - before_m)
            put_in_J += electric_J + magnetic_J
            throughput_J += abs(electric_J) + abs(magnetic_J)
            stored_J = 0.5 * inertia * axis.speed_rad_s**2 + 0.5 * axis.contact_N**2 / STIFFNESS_N_M
            assert put_in_J + 0.01 * throughput_J + 1e-6 >= stored_J


STEP_S = 1e-3
SPEED_MM_S = 41.9


def without_memory(plant: PlantParameters) -> PlantParameters:
    """The constitutive law alone: no hysteresis, relaxation, drift, Stribeck or viscous part."""
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
    element = TorqueElement(plant, gap_mm, STEP_S)
    for step in range(400):
        element.advance(step * STEP_S, gap_mm, SPEED_MM_S)
    law_N = brake_force_N(float(radial_moment_Tm(np.array([gap_mm]), plant)[0]), plant.elastomer.law, TORMAG)
    assert element.force_N == pytest.approx(law_N, rel=1e-5)


def test_the_joined_field_law_is_smooth_and_falls() -> None:
    plant = load_plant("sample_2")
    gap_mm = np.linspace(44.0, 110.0, 66_001)
    slope = np.gradient(radial_moment_Tm(gap_mm, plant), gap_mm)
    assert np.all(slope < 1e-12)
    # the largest curvature of Eq. 7 is 1.206e-6 * 1.867 * 0.867 * x**-0.133: no kink where the laws meet
    assert np.max(np.abs(np.diff(slope)[45_000:])) < 5e-8


def test_force_relaxes_after_a_field_step_by_the_stated_share() -> None:
    element = TorqueElement(changed(SAMPLE_1, "thermal", drift_K_h=0.0), 94.0, 0.1)
    before_N = element.kinetic_N
    element.advance(0.0, 50.0, SPEED_MM_S)
    step_N = element.kinetic_N - before_N
    for _ in range(300):
        element.advance(0.0, 50.0, SPEED_MM_S)
    lost = (before_N + step_N - element.kinetic_N) / step_N
    expected = 0.05 * (1 - np.exp(-30 / 8)) + 0.04 * (1 - np.exp(-30 / 90)) + 0.04 * (1 - np.exp(-30 / 900))
    # the equilibrium level before the step carries its own lost share
    assert lost == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize(
    ("name", "volts", "stiffness_N_mm", "least_J"), [("sample_1", None, 8.0, 0.1), ("second", 8.0, math.inf, 0.05)]
)
def test_the_brake_gives_the_hand_no_energy_over_its_reversals(
    name: str, volts: float | None, stiffness_N_mm: float, least_J: float
) -> None:
    plant, work_J, directions = Plant(load_plant(name), ReversingHand(4.0)), 0.0, set()
    for step in range(8000):
        if volts is not None:
            plant.drive(*([-volts, -volts] if step % 1000 < 500 else [volts, volts]))
        before_mm = plant.handle_mm
        plant.advance(STEP_S)
        work_J += plant.truth.force_N * (plant.handle_mm - before_mm) * 1e-3
        assert work_J >= max(0.5 * plant.truth.force_N**2 / stiffness_N_mm * 1e-3 - 1e-6, 0.0)
        if abs(plant.handle_mm_s) > 35.0:
            assert plant.truth.force_N * plant.handle_mm_s > 0.0
            directions.add(plant.handle_mm_s > 0.0)
    assert work_J > least_J
    assert directions == {True, False}


@pytest.mark.parametrize("name", SAMPLES)
def test_force_sensor_noise_has_the_stated_spread_around_the_truth(name: str) -> None:
    parameters = load_plant(name)
    plant = Plant(parameters, SteadyHand(), seed=3)
    values = []
    for _ in range(4000):
        plant.advance(STEP_S)
        values.append(plant.force_sensor.reading_N)
    fresh = [after for before, after in itertools.pairwise(values[200:]) if after != before]
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
            assert plant.force_sensor.reading_N == forces[sampled_ms - 1]


def test_force_sensor_offset_drifts_at_the_stated_rate() -> None:
    drifting = changed(SAMPLE_1, "force_sensor", noise_mN=0.0, drift_mN_min=600.0, delay_ms=0.0)
    signs = set()
    for seed in range(6):
        plant = Plant(drifting, SteadyHand(), seed)
        plant.advance(2.0)
        offset_N = plant.force_sensor.reading_N - plant.truth.force_N
        assert abs(offset_N) == pytest.approx(0.02, rel=0.01)
        signs.add(offset_N > 0.0)
    assert signs == {True, False}


PADS = ("pad_1", "pad_2", "pad_3")


def force_N(plant_name: str, gap_mm: float, depth_mm: float, *, seconds: float = 0.0) -> float:
    element = PressedPad(load_plant(plant_name), gap_mm, STEP_S)
    for step in range(round(seconds / STEP_S) + 1):
        element.advance(step * STEP_S, gap_mm, depth_mm, 0.0)
    return element.force_N


@pytest.mark.parametrize("name", PADS)
def test_a_pad_pushes_harder_the_deeper_and_the_nearer_the_magnets_and_relaxes(name: str) -> None:
    depths = [force_N(name, 70.0, depth) for depth in (0.0, 0.5, 1.0, 2.0, 4.5, 6.0)]
    gaps = [force_N(name, gap, 2.0) for gap in (95.0, 80.0, 60.0, 45.0)]
    assert (depths[0], depths, gaps) == (0.0, sorted(depths), sorted(gaps))
    assert 3.0 < gaps[0] < 3.6 < 4.1 < gaps[-1] < 4.7
    # the plates meet: there is nothing deeper to press
    assert force_N(name, 70.0, 9.0) == depths[-1]
    assert force_N(name, 70.0, 2.0, seconds=3.0) < 0.98 * depths[3]


def test_the_device_feels_the_finger() -> None:
    plant = Plant(load_plant("pad_1"), pressing(1.5), seed=1)
    plant.advance(9.0)
    assert (plant.truth.handle_mm, plant.truth.force_N) == (0.0, 0.0)
    plant.advance(5.0)
    truth = plant.truth
    assert (truth.handle_mm, truth.handle_mm_s, truth.force_N > 1.5, plant.force_sensor.reading_N) == (
        1.5,
        0.0,
        True,
        pytest.approx(truth.force_N, abs=0.05),
    )


# -- the second plant's element ----------------------------------------------------------------------------------------


SLID_MM_S = 42.0
SECOND = load_plant("second")


def slid(
    gap_mm: float, plant: PlantParameters = SECOND, seconds: float = 0.2, speed_mm_s: float = SLID_MM_S
) -> SecondElement:
    element = SecondElement(plant, gap_mm, STEP_S)
    for _ in range(round(seconds / STEP_S)):
        element.advance(0.0, gap_mm, speed_mm_s)
    return element


def test_the_force_rises_as_the_gap_closes_and_is_of_the_order_of_the_samples() -> None:
    forces_N = [slid(gap_mm).force_N for gap_mm in (95.0, 85.0, 75.0, 65.0, 55.0, 45.0)]
    assert forces_N == sorted(forces_N)
    assert 0.3 < forces_N[0] < 0.6
    assert 3.0 < forces_N[-1] < 5.0


CREEPLESS = changed(SECOND, "second", creeping_share=0.0)


@pytest.mark.parametrize(
    ("plant", "apart"),
    [
        # 1% of the largest moment either way; F goes with its square
        (changed(without_memory(SAMPLE_1), "field", hysteresis_percent=1.0), 4 * 0.01 * (60.0 / 45.0) ** 1.3),
        (CREEPLESS, 0.032),
    ],
    ids=["sample_1", "second"],
)
def test_the_field_lags_and_does_not_depend_on_the_rate(plant: PlantParameters, apart: float) -> None:
    found = []
    for steps in (10, 1000):
        element = element_of(plant, 60.0, STEP_S)
        for start_mm, end_mm in ((60.0, 90.0), (90.0, 60.0), (60.0, 46.0), (46.0, 60.0)):
            for step in range(1, steps + 1):
                element.advance(0.0, start_mm + (end_mm - start_mm) * step / steps, SLID_MM_S)  # type: ignore[call-arg]
            found.append(element.kinetic_N)
    _, closing_N, _, opening_N = found[:4]
    assert found[4:] == pytest.approx(found[:4], rel=1e-9)
    assert opening_N / closing_N - 1.0 == pytest.approx(apart, rel=0.1)
    assert (opening_N + closing_N) / 2.0 == pytest.approx(element_of(plant, 60.0, STEP_S).kinetic_N, rel=0.01)


@pytest.mark.parametrize("plant", [without_memory(SAMPLE_1), CREEPLESS, load_plant("pad_1")])
def test_warming_weakens_the_force_and_levels_off(plant: PlantParameters) -> None:
    warming = (changed(plant, "thermal", drift_K_h=each_K_h) for each_K_h in (0.0, 1.0))
    cool, warm = (element_of(each, 50.0, STEP_S) for each in warming)
    for time_s, warmer_K in ((3600.0, 0.968), (1e7, 15.0)):
        for element in (cool, warm):
            element.advance(time_s, 50.0, *([2.0, 0.0] if plant.pad else [SLID_MM_S]))
        assert warm.warmth.temperature_C - 25.0 == pytest.approx(warmer_K, abs=1e-3)
        weaker = -0.004 * (warm.warmth.temperature_C - 25.0)
        assert warm.kinetic_N / cool.kinetic_N == pytest.approx(1.0 + weaker, rel=1e-9)


def test_a_step_creeps_with_the_logarithm_of_time_and_comes_to_an_end() -> None:
    element = SecondElement(SECOND, 90.0, 0.1)
    rested_N = element.kinetic_N
    element.advance(0.0, 48.0, SLID_MM_S)
    fresh_N, at_N = element.kinetic_N, []
    for step in range(1, 100_001):
        element.advance(0.0, 48.0, SLID_MM_S)
        if step in (10, 100, 1000, 100_000):
            at_N.append(element.kinetic_N)
    assert fresh_N > at_N[0] > at_N[1] > at_N[2] > at_N[3] > rested_N
    # at most V ln 10 a decade, 0.115 N
    assert (at_N[0] - at_N[1], at_N[1] - at_N[2]) == pytest.approx((0.11, 0.11), rel=0.1)
    assert at_N[3] == pytest.approx(SecondElement(SECOND, 48.0, 0.1).kinetic_N, rel=0.01)


def test_friction_grows_with_the_logarithm_of_speed_and_with_rest() -> None:
    slow_N, middle_N, fast_N = (slid(60.0, CREEPLESS, 12.0 / speed, speed).force_N for speed in (1.0, 10.0, 100.0))
    assert middle_N / slow_N == pytest.approx(fast_N / middle_N, rel=0.03)
    assert 1.02 < middle_N / slow_N < 1.06
    peaks_N = []
    for rests_s in (0.0, 30.0):
        element = slid(60.0, CREEPLESS)
        for _ in range(round(rests_s / STEP_S)):
            element.advance(0.0, 60.0, 0.0)
        peaks_N.append(0.0)
        for _ in range(20):
            element.advance(0.0, 60.0, SLID_MM_S)
            peaks_N[-1] = max(peaks_N[-1], element.force_N)
    assert 1.05 < peaks_N[1] / peaks_N[0] < 1.2
