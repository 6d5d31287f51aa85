"""The hand that feels, in virtual time: its energies, its rest, and what it does at each kind of brake."""

import itertools

import numpy as np
import pytest

from tormagd.simulation.hand import (
    FeltHand,
    Impedance,
    RecordedHand,
    SteadyHand,
    parse_hand,
)
from tormagd.simulation.parameters import PlantParameters, load_plant, standing
from tormagd.simulation.plant import Plant, element_of

STEP_S, END_S, GAP_MM = 1e-3, 4.0, 50.0
STROKE = RecordedHand((0.2, 1.0, 2.2, 3.0), (0.0, 15.0, 15.0, 0.0))
FINGER, WRIST, ARM = Impedance(0.005, 0.4, 0.005), Impedance(0.1, 0.4, 0.006), Impedance(1.0, 0.3, 0.02)
BRAKES = ("sample_1", "sample_2", "second")
at_each_brake = pytest.mark.parametrize("name", BRAKES)
with_each = pytest.mark.parametrize("impedance", [FINGER, WRIST, ARM], ids=["finger", "wrist", "arm"])


def at_gap(name: str) -> PlantParameters:
    return standing(load_plant(name), GAP_MM / 2.0, GAP_MM / 2.0)


def at_brake(name: str, hand: FeltHand, seconds: float = END_S) -> np.ndarray:
    """A row per step: place, mm, the brake's force and the hand's, N."""
    plant, rows = Plant(at_gap(name), hand), []
    for _ in range(round(seconds / STEP_S)):
        plant.advance(STEP_S)
        rows.append((plant.handle_mm, plant.element.force_N, hand.force_N))
    return np.array(rows)


def freely(hand: FeltHand) -> np.ndarray:
    return np.array([hand.moved_mm(step * STEP_S, lambda speed_mm_s: 0.0) for step in range(1, round(END_S / STEP_S))])


def swung_mm(place_mm: np.ndarray) -> float:
    return float(np.abs(np.diff(place_mm)).sum() - abs(place_mm[-1] - place_mm[0]))


def energies_mJ(rows: np.ndarray, impedance: Impedance) -> np.ndarray:
    """What the stroke put in, what friction and damper took, and what is in mass and spring."""
    (place_mm, resisting_N, hand_N), dt_s = rows.T, END_S / len(rows)
    meant_mm = np.interp(dt_s * np.arange(len(place_mm) + 1), STROKE.times_s, STROKE.positions_mm)
    place_mm = np.append(0.0, place_mm)
    moved_mm, drawn_mm = np.diff(place_mm), np.diff(meant_mm)
    apart_mm = meant_mm - place_mm
    damper_N = impedance.damping_N_s_mm * (drawn_mm - moved_mm) / dt_s
    speed_mm_s = moved_mm[-1] / dt_s
    stored = 0.5 * impedance.stiffness_N_mm * apart_mm[-1] ** 2 + 0.5e-3 * impedance.mass_kg * speed_mm_s**2
    return np.array([hand_N @ drawn_mm, resisting_N @ moved_mm, damper_N @ (drawn_mm - moved_mm), stored])


def finely(name: str, impedance: Impedance, intended: RecordedHand, dt_s: float = STEP_S / 20.0) -> np.ndarray:
    """The same equations by an explicit method in 20 times finer steps, with the rows of `at_brake`."""
    element = element_of(at_gap(name), GAP_MM, dt_s)
    meant_mm = np.interp(dt_s * np.arange(round(END_S / dt_s) + 1), intended.times_s, intended.positions_mm).tolist()
    place_mm = speed_mm_s = 0.0
    rows = []
    for step, (before_mm, after_mm) in enumerate(itertools.pairwise(meant_mm), 1):
        apart_mm = 0.5 * (before_mm + after_mm) - place_mm - 0.5 * dt_s * speed_mm_s
        hand_N = impedance.stiffness_N_mm * apart_mm
        hand_N += impedance.damping_N_s_mm * ((after_mm - before_mm) / dt_s - speed_mm_s)
        resisting_N = element.force_N
        speed_mm_s += dt_s * 1e3 / impedance.mass_kg * (hand_N - resisting_N)
        place_mm += dt_s * speed_mm_s
        element.advance(step * dt_s, GAP_MM, speed_mm_s)  # type: ignore[call-arg]
        rows.append((place_mm, resisting_N, hand_N))
    return np.array(rows)


@pytest.mark.parametrize("impedance", [WRIST, ARM], ids=["wrist", "arm"])
@at_each_brake
def test_the_energies_close_and_are_those_of_a_finer_integration(name: str, impedance: Impedance) -> None:
    found = energies_mJ(at_brake(name, FeltHand(STROKE, impedance)), impedance)
    put_in, *spent = found
    assert put_in == pytest.approx(sum(spent), rel=0.01)
    assert found == pytest.approx(energies_mJ(finely(name, impedance, STROKE), impedance), abs=0.01 * put_in)
    assert spent[0] > 0.5 * put_in


@with_each
@at_each_brake
def test_a_brake_makes_no_oscillation_that_the_hand_alone_does_not(name: str, impedance: Impedance) -> None:
    held = slice(1050, 2200)
    braked_mm = at_brake(name, FeltHand(STROKE, impedance))[held, 0]
    assert swung_mm(braked_mm) <= swung_mm(freely(FeltHand(STROKE, impedance))[held]) + 0.02
    assert np.ptp(braked_mm[-200:]) < 2e-3


@with_each
@at_each_brake
def test_a_hand_that_lets_go_comes_to_rest(name: str, impedance: Impedance) -> None:
    place_mm, _, hand_N = at_brake(name, FeltHand(SteadyHand(), impedance, lets_go_s=1.0), 3.0).T
    assert hand_N[995] > 1.0
    assert not np.any(hand_N[1000:])
    assert np.ptp(place_mm[-200:]) < 0.01
    # no further than its energy takes it against the brake, or the bristles throw it back
    assert -0.5 < place_mm[-1] - place_mm[999] < 1.5 * 0.5e-3 * impedance.mass_kg * 42.0**2 / 2.0 + 0.5


def test_what_sticks_breaks_away_as_in_finer_steps_however_light_the_hand() -> None:
    creeping = RecordedHand((0.0, END_S), (0.0, 4.0 * END_S))
    most_N = finely("sample_2", WRIST, creeping)[:, 1].max()
    assert most_N > 1.05 * np.median(at_brake("sample_2", FeltHand(SteadyHand(), WRIST))[-500:, 1])
    found_N = [at_brake("sample_2", FeltHand(creeping, impedance))[:, 1].max() for impedance in (FINGER, WRIST)]
    assert found_N == pytest.approx([most_N] * 2, rel=0.01)


def test_a_stiff_hand_goes_where_it_means_to() -> None:
    place_mm = at_brake("sample_1", FeltHand(STROKE, Impedance(0.1, 1000.0, 1.0)))[:, 0]
    assert place_mm == pytest.approx(
        np.array([STROKE.position_mm(STEP_S * (1 + row)) for row in range(4000)]), abs=0.05
    )


def test_it_moves_one_plant_only() -> None:
    hand = FeltHand(STROKE, WRIST)
    at_brake("sample_1", hand, 0.1)
    with pytest.raises(ValueError, match=r"time_s = 0\.001"):
        at_brake("sample_1", hand, 0.1)


def test_a_felt_hand_of_the_command_line_strokes_once_the_device_is_homed() -> None:
    hand = parse_hand("felt=push_mm_s=10,reach_mm=5,mass_kg=0.2")
    assert [hand.position_mm(t) for t in (0.0, 10.0, 10.25, 10.5, 11.5, 11.75, 12.0, 13.0, 13.25)] == [
        *(0.0, 0.0, 2.5, 5.0, 5.0, 2.5, 0.0, 0.0, 2.5),
    ]
    place_mm = at_brake("sample_1", hand, 13.0)[:, 0]
    # the brake's force is 3 N, the spring 0.4 N/mm: the handle stays behind
    assert place_mm[:10_000] == pytest.approx(0.0, abs=1e-9)
    assert place_mm.max() < 2.5
