"""The pad as a plant: its file, the finger, the force over gap and depth."""

from pathlib import Path

import msgspec
import pytest

from tormagd.simulation.hand import HandError, PressingHand, parse_hand
from tormagd.simulation.parameters import PlantError, load_plant
from tormagd.simulation.plant import Plant
from tormagd.simulation.pressed_pad import PressedPad

STEP_S = 1e-3
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
    assert depths[0] == 0.0
    assert depths == sorted(depths)
    assert gaps == sorted(gaps)
    assert 3.0 < gaps[0] < 3.6 < 4.1 < gaps[-1] < 4.7
    # the plates meet: deeper there is nothing to press
    assert force_N(name, 70.0, 9.0) == depths[-1]


def test_a_held_pad_relaxes_and_a_warm_one_is_softer() -> None:
    assert force_N("pad_1", 70.0, 2.0, seconds=3.0) < 0.98 * force_N("pad_1", 70.0, 2.0)
    plant = load_plant("pad_1")
    hot = msgspec.structs.replace(plant, thermal=msgspec.structs.replace(plant.thermal, drift_K_h=20.0))
    cold_N: list[float] = []
    hot_N: list[float] = []
    for made, forces in ((plant, cold_N), (hot, hot_N)):
        element = PressedPad(made, 70.0, STEP_S)
        element.advance(3600.0, 70.0, 2.0, 0.0)
        forces.append(element.force_N)
    assert hot_N[0] < 0.96 * cold_N[0]


def test_the_device_feels_the_finger() -> None:
    plant = Plant(load_plant("pad_1"), PressingHand(1.5), seed=1)
    plant.advance(9.0)
    assert plant.truth.handle_mm == 0.0
    assert plant.truth.force_N == 0.0
    plant.advance(5.0)
    truth = plant.truth
    assert (truth.handle_mm, truth.handle_mm_s) == (1.5, 0.0)
    assert truth.force_N > 1.5
    assert plant.sensed_force_N == pytest.approx(truth.force_N, abs=0.05)


def test_fingers_are_named_on_the_command_line() -> None:
    assert parse_hand("pressing") == PressingHand(2.0)
    assert parse_hand("pressing=3.5") == PressingHand(3.5)
    with pytest.raises(HandError, match=r"pressing=9.*0\.1 to 6"):
        parse_hand("pressing=9")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('carriages = "sample_9"\n[pad]\n', "carriages = 'sample_9': allowed is a file or one of pad_1"),
        ('carriages = "sample_1"\n[pad]\n[motor]\n', "unknown field `motor`"),
        ('carriages = "sample_1"\n[pad]\nmodulus_kPa = -1.0\n', ">= 1.0 - at `$.pad.modulus_kPa` (it is -1.0) (line"),
        ('carriages = "sample_1"\n[pad]\nstrength = 1.0\n', "strength"),
    ],
)
def test_a_pads_file_is_read_as_strictly_as_any(tmp_path: Path, text: str, said: str) -> None:
    good = "cip_percent = 45.0\nmodulus_kPa = 281.0\nfull_field_modulus_kPa = 592.0\nbreakdown = 0.85\n"
    keys = "".join(line + "\n" for line in good.splitlines() if line.split(" ")[0] not in text)
    path = tmp_path / "pad.toml"
    path.write_text(text.replace("[pad]\n", f"[pad]\n{keys}"), encoding="utf-8")
    with pytest.raises(PlantError) as caught:
        load_plant(path)
    assert said in str(caught.value)


def test_a_pads_series_have_one_fraction_for_each_time(tmp_path: Path) -> None:
    text = 'carriages = "sample_1"\n[pad]\ncip_percent = 45.0\nmodulus_kPa = 281.0\nfull_field_modulus_kPa = 592.0\n'
    text += "breakdown = 0.85\n[pad.relaxing]\nfractions = [0.1, 0.2]\ntimes_s = [1.0]\n"
    path = tmp_path / "pad.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(PlantError, match=r"fractions = \(0\.1, 0\.2\): allowed is one for each of .*pad\.relaxing`"):
        load_plant(path)
