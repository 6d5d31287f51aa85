import numpy as np
import pytest

from tormagd.lab.design.range_fit import (
    fit_exponent,
    fit_friction,
    frictionless_range_N,
    mean_relative_error,
)
from tormagd.physics.field import FieldLaw, PowerFieldLaw, ThesisFieldLaw
from tormagd.physics.force import TORMAG, brake_force_N
from tormagd.physics.inserts import INSERTS

ALL = list(INSERTS.values())
LAWS = (ThesisFieldLaw(), PowerFieldLaw())


@pytest.mark.parametrize("law", LAWS)
def test_table_2_4_within_the_thesis_error(law: FieldLaw) -> None:
    assert mean_relative_error(fit_friction(ALL, law), ALL) <= 0.102
    assert mean_relative_error(fit_exponent(ALL, law), ALL) <= 0.075


def test_no_other_friction_has_a_smaller_mean_error() -> None:
    fit = fit_friction(ALL, ThesisFieldLaw())
    for shore, best in fit.friction.items():
        matrix = [item for item in ALL if item.shore_hardness == shore]
        least = mean_relative_error(fit, matrix)
        others = [fit._replace(friction={shore: float(other)}) for other in np.linspace(0.5 * best, 2.0 * best, 301)]
        assert min(mean_relative_error(other, matrix) for other in others) >= least - 1e-12


def test_the_registrys_friction_is_the_least_squares_of_the_relative_errors() -> None:
    """With the thesis's field; it is given there to three digits."""
    for matrix in (ALL[:4], ALL[4:8], ALL[8:]):
        ratios = np.array([frictionless_range_N(item, LAWS[0]) / item.force_range.measured_N for item in matrix])
        least = ratios.sum() / (ratios**2).sum()
        assert {item.elastomer.friction_coefficient for item in matrix} == {round(float(least), 3)}


def test_exponent_one_is_the_force_law_itself() -> None:
    item, law = INSERTS["MRE-50-20"], PowerFieldLaw()
    forces = brake_force_N(law.radial_moment_Tm(np.array([45.0, 95.0])), item.elastomer, TORMAG)
    friction = item.elastomer.friction_coefficient
    assert friction * frictionless_range_N(item, law) == pytest.approx(forces[0] - forces[1], rel=1e-12)
