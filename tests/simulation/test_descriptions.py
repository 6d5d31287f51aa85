"""How a simulated device, the hand at it and its faults are described, and which descriptions are refused."""

import itertools
import math
from collections.abc import Callable
from importlib import resources
from pathlib import Path

import pytest

from tormagd.element.physics.errors import DomainError
from tormagd.element.physics.inserts import insert
from tormagd.ground.table import TableError
from tormagd.simulation.faults import KNOWN, SIZED, Fault, FaultError, parse_fault
from tormagd.simulation.hand import HandError, ReversingHand, SteadyHand, parse_hand, pressing
from tormagd.simulation.parameters import PlantError, changed, load_plant, plant_names, with_insert

SAMPLE_1_TEXT, SECOND_TEXT = (
    resources.files("tormagd.simulation").joinpath(f"plants/{name}.toml").read_text(encoding="utf-8")
    for name in ("sample_1", "second")
)


def written(folder: Path, text: str, name: str = "bench.toml") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def refused(folder: Path, text: str, *said: str) -> None:
    with pytest.raises(PlantError) as refusal:
        load_plant(written(folder, text))
    assert [word for word in said if word not in str(refusal.value)] == []


def test_the_three_samples_of_the_plant_card_are_packaged() -> None:
    names = ["sample_1", "sample_2", "sample_3"]
    assert plant_names() == ("pad_1", "pad_2", "pad_3", *names, "second")
    plants = [load_plant(name) for name in names]
    assert [plant.elastomer.shear_modulus_kPa for plant in plants] == [277.3, 255.0, 300.0]
    assert [plant.field.law for plant in plants] == ["power", "thesis", "power"]
    assert [plant.firmware.clock_ppm for plant in plants] == [30.0, -80.0, 120.0]
    assert [sum(plant.relaxation.fractions) for plant in plants] == pytest.approx([0.13, 0.18, 0.17])


def test_a_plant_loads_from_a_file_as_by_name_and_each_assumption_may_be_another(tmp_path) -> None:
    assert load_plant(written(tmp_path, SAMPLE_1_TEXT)) == load_plant("sample_1")
    slower = load_plant(written(tmp_path, SAMPLE_1_TEXT + "\n[assumed]\nretract_mm_s = 5.0\n"))
    assert slower == changed(load_plant("sample_1"), "assumed", retract_mm_s=5.0)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (
            "play_shares = [0.4, 0.4]",
            "play_shares = [0.4]",
            ["play_shares = (0.4,): allowed is one for each of (2.0, 6.0)"],
        ),
        (
            "play_shares = [0.4, 0.4]",
            "play_shares = [0.5, 0.6]",
            ["play_shares = (0.5, 0.6): allowed is a sum under 1"],
        ),
        ("[0.2, 0.3, 0.5]", "[0.2, 0.3, 0.4]", ["spring_shares = (0.2, 0.3, 0.4): allowed is a sum of 1"]),
        ("creep_s = 900.0", "", ["missing required field `creep_s`"]),
        ("ratio = 70.0", "ratio = -70.0", ["gear.ratio", "-70.0", ">= 1"]),
        ("ratio = 70.0", "ratio = nan", ["gear.ratio", "nan", "finite"]),
        ("supply_V = 12.0", "supply_V = inf", ["electronics.supply_V", "inf", "finite"]),
        ("ratio = 70.0", 'ratio = "70"', ["gear.ratio", "'70'", "float"]),
        ("ratio = 70.0", "ration = 70.0", ["gear", "ration"]),
        ("ratio = 70.0", "", ["gear", "ratio"]),
        ("[gear]", "[gears]", ["gears"]),
        ('law = "power"', 'law = "cubic"', ["field.law", "cubic"]),
        ("[0.05, 0.04, 0.04]", "[0.05, 1.04, 0.04]", ["relaxation.fractions[1]", "1.04", "< 1"]),
        ("[0.05, 0.04, 0.04]", "[0.5, 0.4, 0.4]", ["relaxation", "fractions", "0.5", "sum under 1"]),
        ("[0.05, 0.04, 0.04]", "[0.05, 0.04]", ["relaxation", "fractions", "(0.05, 0.04)", "one for each of (8.0"]),
        ("pwm_bits = 10", "pwm_bits = 10.5", ["electronics.pwm_bits", "10.5"]),
        ("rate_Hz = 1000.0", "rate_Hz = 1001.0", ["force_sensor.rate_Hz", "1001.0", "<= 1000"]),
        ("current_limit_A = 5.0", "current_limit_A = 2.0", ["overcurrent_A", "3.0", "2.0"]),
        ("[gear]", "[assumed]\nstart_left_mm = 60.0\n[gear]", ["start_left_mm", "60.0", "22.25 .. 47.5"]),
        ("[gear]", "[assumed]\nclosed_mm = 50.0\n[gear]", ["closed_mm", "50.0", "47.5"]),
        ("[gear]", "[assumed]\nwarm_C = 10.0\n[gear]", ["warm_C", "10.0", "25.0"]),
        ("[gear]", "[gear", ["not TOML"]),
    ],
)
def test_a_bad_plant_is_refused_with_key_value_and_what_is_allowed(
    tmp_path: Path, old: str, new: str, said: list[str]
) -> None:
    (text,) = (text for text in (SAMPLE_1_TEXT, SECOND_TEXT) if old in text)
    refused(tmp_path, text.replace(old, new, 1), "bench.toml", *said)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('carriages = "sample_9"\n[pad]\n', "carriages = 'sample_9': allowed is a file or one of pad_1"),
        ('carriages = ""\n[pad]\n', "carriages = '': allowed is a file or one of pad_1"),
        ('carriages = "sample_1"\n[pad]\n[motor]\n', "unknown field `motor`"),
        ('carriages = "sample_1"\n', "carriages = 'sample_1': allowed is a plant with one of [pad] and [second]"),
        ('carriages = "sample_1"\n[pad]\nmodulus_kPa = -1.0\n', ">= 1.0 - at `$.pad.modulus_kPa` (it is -1.0) (line"),
        ('carriages = "sample_1"\n[pad]\nstrength = 1.0\n', "strength"),
        (
            'carriages = "sample_1"\n[pad]\n[pad.relaxing]\nfractions = [0.1, 0.2]\ntimes_s = [1.0]\n',
            "fractions = (0.1, 0.2): allowed is one for each of (1.0,) - at `$.pad.relaxing`",
        ),
    ],
)
def test_a_pads_file_is_read_as_strictly_as_any(tmp_path: Path, text: str, said: str) -> None:
    good = "cip_percent = 45.0\nmodulus_kPa = 281.0\nfull_field_modulus_kPa = 592.0\nbreakdown = 0.85\n"
    keys = "".join(line + "\n" for line in good.splitlines() if line.split(" ")[0] not in text)
    refused(tmp_path, text.replace("[pad]\n", f"[pad]\n{keys}"), said)


def test_another_insert_keeps_what_the_sample_is_off_its_kind() -> None:
    soft = insert("MRE-10-10").elastomer
    first = with_insert(load_plant("sample_1"), "MRE-10-10")
    assert (
        first.elastomer.shear_modulus_kPa,
        first.elastomer.relative_permeability,
        first.elastomer.kinetic_friction,
    ) == pytest.approx((1e-3 * soft.shear_modulus_Pa, soft.relative_permeability, soft.friction_coefficient))
    second = with_insert(load_plant("sample_2"), "MRE-10-10")
    assert (second.elastomer.shear_modulus_kPa, second.motor) == (
        pytest.approx(1e-3 * soft.shear_modulus_Pa * 255.0 / 277.3),
        load_plant("sample_2").motor,
    )
    assert with_insert(load_plant("sample_2"), "MRE-50-40") == load_plant("sample_2")
    with pytest.raises(DomainError, match="MRE-99-99"):
        with_insert(load_plant("sample_1"), "MRE-99-99")


def test_the_default_hand_turns_the_roller_at_42_mm_s() -> None:
    hand = parse_hand("steady")
    assert hand == SteadyHand(20.0)
    assert hand.position_mm(10.0) / 10.0 == pytest.approx(41.888, abs=1e-3)
    assert [parse_hand(spec) for spec in ("pressing", "pressing=3.5")] == [pressing(2.0), pressing(3.5)]
    assert parse_hand("steady=-10").position_mm(1.0) == pytest.approx(-20.944, abs=1e-3)


def test_the_reversing_hand_stops_reverses_and_repeats_without_a_jump() -> None:
    hand = ReversingHand(4.0)
    step_s = 1e-3
    path = [hand.position_mm(index * step_s) for index in range(9000)]
    rates = [(after - before) / step_s for before, after in itertools.pairwise(path)]
    assert max(rates) == pytest.approx(-min(rates), rel=1e-6)
    assert 30.0 < max(rates) < 50.0
    assert sum(rate == 0.0 for rate in rates) > 0.25 * len(rates)
    assert max(abs(after - before) for before, after in itertools.pairwise(rates)) < 0.5
    assert path[4100] == pytest.approx(path[100], abs=1e-9)


def test_a_recording_is_interpolated_and_held_at_its_ends(tmp_path) -> None:
    hand = parse_hand(str(written(tmp_path, "t_s,position_mm\n1.0,0\n2.0,10\n4.0,-10\n", "hand.csv")))
    found_mm = {t: hand.position_mm(t) for t in (0.0, 1.0, 1.5, 2.0, 3.0, 4.0, 9.0)}
    assert found_mm == {0.0: 0.0, 1.0: 0.0, 1.5: 5.0, 2.0: 10.0, 3.0: 0.0, 4.0: -10.0, 9.0: -10.0}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("t_s,x\n1,2\n", "displacement_mm"),
        ("t_s,position_mm\n", "no numbers stand"),
        ("t_s,position_mm\n0,0\n0,1\n", "row 3"),
        ("t_s,position_mm\n0,nan\n", "row 2"),
        ("t_s,position_mm\n0,abc\n", "row 2"),
        ("t_s,position_mm\n0\n", "row 2"),
    ],
)
def test_a_bad_recording_is_refused_with_its_line(tmp_path, text: str, said: str) -> None:
    with pytest.raises(TableError, match=said):
        parse_hand(str(written(tmp_path, text, "hand.csv")))


BAD_HANDS = ("", "fast", "steady=x", "steady=nan", "steady=1e9", "reversing=0", "missing.csv", "felt=mass_kg")
BAD_FAULTS = (
    *("", "reset@", "reset@x", "reset@1.2.3", "reset=5%"),
    *("drag_left", "drag_left=5", "drag_left=-101%", "clock", "clock=-100%"),
)


@pytest.mark.parametrize(
    ("read", "spec", "said"),
    [
        *((parse_hand, spec, "") for spec in BAD_HANDS),
        (parse_hand, "pressing=9", r"pressing=9.*0\.1 to 6"),
        (parse_hand, "felt=rest_s=1,mass_kg=0", r"mass_kg=0.*0\.001 to 20"),
        (parse_hand, "felt=weight=1", r"'weight'.*mass_kg, stiffness_N_mm"),
        *((parse_fault, spec, "") for spec in BAD_FAULTS),
        *((parse_fault, "gremlins", known) for known in KNOWN),
    ],
)
def test_a_bad_hand_or_fault_is_refused(read: Callable[[str], object], spec: str, said: str) -> None:
    with pytest.raises((HandError, TableError) if read is parse_hand else FaultError, match=said or r"\w"):
        read(spec)


def test_fault_specifications() -> None:
    meant = {
        "worn_gearbox": Fault("worn_gearbox", 0.0, 0.0),
        "drag_left=+50%@5": Fault("drag_left", 5.0, 50.0),
        "drag_left=-20.5%": Fault("drag_left", 0.0, -20.5),
        "encoder_stuck_left@3.25": Fault("encoder_stuck_left", 3.25, 0.0),
    }
    assert {text: parse_fault(text) for text in meant} == meant
    assert all(math.isfinite(parse_fault(f"{name}=1%@1" if name in SIZED else name).at_s) for name in KNOWN)
