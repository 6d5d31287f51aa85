"""The twelve inserts against the thesis's tables."""

import msgspec
import numpy as np
import pytest

from tormagd.physics.errors import DomainError
from tormagd.physics.field import ThesisFieldLaw
from tormagd.physics.force import TORMAG, Elastomer, brake_force_N
from tormagd.physics.inserts import INSERTS, Insert, MeasuredForceRange, insert, relative_permeability


def modelled_range_N(item: Insert) -> float:
    near, far = brake_force_N(ThesisFieldLaw().radial_moment_Tm(np.array([45.0, 95.0])), item.elastomer, TORMAG)
    return float(near - far)


def test_twelve_inserts_three_matrices_by_four_fillings() -> None:
    assert sorted(INSERTS) == sorted(f"MRE-{shore}-{cip}" for shore in (10, 30, 50) for cip in (10, 20, 30, 40))
    assert all(insert(name).name == name for name in INSERTS)


def test_composition_reproduces_the_printed_masses() -> None:
    printed_g = {0.1: (83.2, 78.7), 0.2: (72.8, 157.4), 0.3: (62.4, 236.1), 0.4: (52.0, 314.8)}
    for item in INSERTS.values():
        masses_g = item.masses_g
        matrix_g, cip_g = printed_g[item.cip_fraction]
        assert masses_g["matrix"] == pytest.approx(matrix_g, abs=0.051)
        assert masses_g["cip"] == pytest.approx(cip_g, abs=0.051)
        assert masses_g["slacker"] == masses_g["thinner"] == pytest.approx(4.9, abs=0.051)


def test_permeability_is_linear_in_the_filling() -> None:
    assert [relative_permeability(cip) for cip in (0.1, 0.25, 0.4)] == pytest.approx([2.0, 3.0, 4.0])
    for outside in (0.09, 0.41, 40.0, float("nan")):
        with pytest.raises(DomainError, match="cip_fraction"):
            relative_permeability(outside)


def test_one_friction_coefficient_per_matrix_reproduces_the_measured_ranges() -> None:
    errors = [abs(modelled_range_N(item) / item.force_range.measured_N - 1.0) for item in INSERTS.values()]
    assert np.mean(errors) == pytest.approx(0.107, abs=0.001)
    assert max(errors) < 0.18


def test_the_range_grows_with_the_filling_as_measured() -> None:
    for shore in (10, 30, 50):
        ranges = [modelled_range_N(insert(f"MRE-{shore}-{cip}")) for cip in (10, 20, 30, 40)]
        assert ranges == sorted(ranges)


def test_printed_errors_that_do_not_follow_from_the_printed_ranges() -> None:
    for name, error_N, relative in (("MRE-10-30", 0.12, 0.055), ("MRE-50-30", 0.61, 0.172)):
        measured = insert(name).force_range
        gap_N = abs(measured.thesis_estimate_N - measured.measured_N)
        assert gap_N == pytest.approx(error_N, abs=0.005)
        assert gap_N / measured.measured_N == pytest.approx(relative, abs=0.0005)


def test_an_unknown_insert_lists_the_known() -> None:
    with pytest.raises(DomainError, match=r"insert = 'MRE-40' is not allowed: one of MRE-10-10, .*MRE-50-40"):
        insert("MRE-40")


def test_what_an_insert_states_itself_goes_before_its_matrix_and_eq_5() -> None:
    own = Insert("X", 50, 0.5, 310.0, relative_permeability=5.1, friction_coefficient=0.3)
    assert own.elastomer == Elastomer(310e3, 5.1, 0.3)
    usual = Insert("X", 50, 0.25, 160.0)
    assert usual.elastomer.relative_permeability == pytest.approx(3.0)
    assert usual.elastomer.friction_coefficient == insert("MRE-50-10").elastomer.friction_coefficient
    with pytest.raises(DomainError, match="measured"):
        _ = usual.force_range
    with pytest.raises(DomainError, match="estimate_N"):
        _ = MeasuredForceRange(3.1, 0.1).thesis_estimate_N


@pytest.mark.parametrize(
    "odd",
    [{"cip_fraction": 0.7}, {"cip_fraction": float("nan")}, {"shear_modulus_kPa": -1.0}, {"name": "a b"}, {"x": 1}],
)
def test_what_makes_no_sense_is_refused_by_its_key(odd: dict[str, object]) -> None:
    row = {"name": "X", "shore_hardness": 50, "cip_fraction": 0.2, "shear_modulus_kPa": 100.0}
    with pytest.raises(msgspec.ValidationError, match=next(iter(odd))):
        msgspec.convert(row | odd, Insert)
