"""The tactile pad: what is printed of the thesis's pads holds, and what such a pad must do."""

import numpy as np
import pytest

from tormagd.lab.tactile.pads import FIELDS_MT, PADS, cyclic_records, holding_records
from tormagd.physics.errors import DomainError
from tormagd.simulation.tactile_pad import TactilePad, cycling_program, worked_pad

AREA_M2 = np.pi / 4 * 0.030**2


def elastic(pad: TactilePad, displacement_mm: float, field_mT: float, rate_mm_s: float = 0.0) -> float:
    return sum(pad.elastic_parts_N(displacement_mm, rate_mm_s, field_mT))


@pytest.mark.parametrize(
    ("name", "modulus_kPa", "full_kPa", "scale_N"),
    [("MRE-A", 81, 130, 65), ("MRE-B", 183, 341, 141), ("MRE-C", 281, 592, 186)],
)
def test_moduli_and_full_scales_are_the_thesis_s(
    name: str, modulus_kPa: float, full_kPa: float, scale_N: float
) -> None:
    pad = worked_pad(PADS[name])
    for field_mT, wanted in ((0.0, modulus_kPa), (365.0, full_kPa)):
        strain = 1e-4
        measured = elastic(pad, strain * 12.5, field_mT) / AREA_M2 / strain / 1e3
        assert measured == pytest.approx(wanted, rel=0.01)
    assert elastic(pad, 4.5, 365.0) == pytest.approx(scale_N, rel=0.03)


@pytest.mark.parametrize("name", PADS)
def test_force_rises_with_indentation_and_with_field(name: str) -> None:
    pad = worked_pad(PADS[name])
    depths, fields = np.linspace(0.05, 4.5, 40), np.linspace(0.0, 365.0, 40)
    forces = np.array([[elastic(pad, depth, field) for field in fields] for depth in depths])
    assert (np.diff(forces, axis=0) > 0).all()
    assert (np.diff(forces, axis=1) > 0).all()


def test_field_stiffening_saturates() -> None:
    pad = worked_pad(PADS["MRE-C"])
    slopes = [elastic(pad, 4.5, field + 5) - elastic(pad, 4.5, field) for field in (0.0, 150.0, 350.0)]
    assert slopes[0] < slopes[2] < slopes[1]


def test_faster_is_stiffer_and_unloading_softer() -> None:
    pad = worked_pad(PADS["MRE-B"])
    assert (np.diff([elastic(pad, 3.0, 100.0, rate) for rate in (-4.0, -0.5, 0.0, 0.5, 4.0)]) > 0).all()


def test_a_new_pad_is_stiffer_and_becomes_the_worked_one() -> None:
    pad = TactilePad(PADS["MRE-C"])
    fresh = elastic(pad, 2.0, 0.0)
    time_s, displacement_mm, rate_mm_s, _ = cycling_program(50)
    pad.run(time_s, displacement_mm, rate_mm_s, np.zeros_like(time_s))
    assert fresh == pytest.approx(1.15 * elastic(pad, 2.0, 0.0), rel=0.001)


def test_a_held_pad_relaxes_in_three_decades() -> None:
    held = holding_records(PADS["MRE-C"], 0.0, 0, fields_mT=(182.5,), samples=200)
    assert held.data.time_s is not None
    after_s = held.data.time_s - 4.5
    force = np.interp([0.1, 10, 100, 1000], after_s, held.true_force_N)
    lost = -np.diff(force) / force[0]
    assert (lost > 0.01).all()
    assert 0.05 < lost.sum() < 0.12


def test_plates_do_not_pull() -> None:
    pad = worked_pad(PADS["MRE-C"])
    for _ in range(60):
        pad.advance(10.0, 4.5, 0.0, 365.0)
    assert pad.advance(0.1, 0.05, -40.0, 365.0) == 0.0


def test_the_data_have_the_thesis_s_size_and_a_lab_s_noise() -> None:
    data, true_force_N = cyclic_records(0.5, 3)
    assert data.features.shape == (69300, 4)
    assert sorted(set(data.features[:, 2])) == sorted(FIELDS_MT)
    assert set(data.features[:, 3]) == {25.0, 35.0, 45.0}
    assert len(set(data.cycle)) == 3 * 11 * 12
    noise = data.force_N - true_force_N
    assert noise.std() == pytest.approx(0.5, rel=0.02)
    assert abs(noise.mean()) < 0.01


@pytest.mark.parametrize(("place", "name"), [((-0.1, 0, 0), "displacement_mm"), ((1, float("nan"), 0), "rate_mm_s")])
def test_impossible_places_are_refused(place: tuple[float, float, float], name: str) -> None:
    with pytest.raises(DomainError, match=name):
        TactilePad(PADS["MRE-A"]).advance(0.1, *place)
