from importlib import resources
from pathlib import Path

import pytest

from tormagd.physics.errors import DomainError
from tormagd.physics.inserts import insert
from tormagd.simulation.parameters import PlantError, load_plant, plant_names, with_insert

SAMPLE_1 = resources.files("tormagd.simulation").joinpath("plants/sample_1.toml").read_text(encoding="utf-8")


def test_the_three_samples_of_the_plant_card_are_packaged() -> None:
    names = ["sample_1", "sample_2", "sample_3"]
    assert plant_names() == ("pad_1", "pad_2", "pad_3", *names)
    plants = [load_plant(name) for name in names]
    assert [plant.elastomer.shear_modulus_kPa for plant in plants] == [277.3, 255.0, 300.0]
    assert [plant.field.law for plant in plants] == ["power", "thesis", "power"]
    assert [plant.firmware.clock_ppm for plant in plants] == [30.0, -80.0, 120.0]
    assert [sum(plant.relaxation.fractions) for plant in plants] == pytest.approx([0.13, 0.18, 0.17])


def test_a_plant_loads_from_a_file_as_by_name(tmp_path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(SAMPLE_1, encoding="utf-8")
    assert load_plant(path) == load_plant(str(path)) == load_plant("sample_1")


def written(folder: Path, text: str) -> Path:
    path = folder / "bench.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_assumptions_can_be_overridden_one_by_one(tmp_path) -> None:
    plant = load_plant(written(tmp_path, SAMPLE_1 + "\n[assumed]\nretract_mm_s = 5.0\n"))
    assert plant.assumed.retract_mm_s == 5.0
    assert plant.assumed.homing_mm_s == load_plant("sample_1").assumed.homing_mm_s


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
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
    tmp_path, old: str, new: str, said: list[str]
) -> None:
    assert old in SAMPLE_1
    with pytest.raises(PlantError) as refusal:
        load_plant(written(tmp_path, SAMPLE_1.replace(old, new, 1)))
    for word in ["bench.toml", *said]:
        assert word in str(refusal.value)


def test_a_missing_plant_names_the_known_ones(tmp_path) -> None:
    with pytest.raises(PlantError, match="sample_1, sample_2, sample_3"):
        load_plant(tmp_path / "none.toml")
    with pytest.raises(PlantError, match="sample_9"):
        load_plant("sample_9")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(PlantError, match="not UTF-8"):
        load_plant(tmp_path / "binary.toml")


def test_another_insert_keeps_what_the_sample_is_off_its_kind() -> None:
    """Sample 1 has the registry's own MRE-50-40; sample 2 is softer by 8 %, and stays so."""
    soft = insert("MRE-10-10").elastomer
    first = with_insert(load_plant("sample_1"), "MRE-10-10")
    assert first.elastomer.shear_modulus_kPa == pytest.approx(1e-3 * soft.shear_modulus_Pa)
    assert first.elastomer.relative_permeability == pytest.approx(soft.relative_permeability)
    assert first.elastomer.kinetic_friction == pytest.approx(soft.friction_coefficient)
    second = with_insert(load_plant("sample_2"), "MRE-10-10")
    assert second.elastomer.shear_modulus_kPa == pytest.approx(1e-3 * soft.shear_modulus_Pa * 255.0 / 277.3)
    assert second.motor == load_plant("sample_2").motor
    assert with_insert(load_plant("sample_2"), "MRE-50-40") == load_plant("sample_2")
    with pytest.raises(DomainError, match="MRE-99-99"):
        with_insert(load_plant("sample_1"), "MRE-99-99")
