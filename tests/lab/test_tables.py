"""Tables 2.4 and 2.5 of the thesis: the fits of the ranges, and what serves which task."""

from pathlib import Path

import numpy as np
import pytest

from tormagd.lab.design.range_fit import (
    fit_exponent,
    fit_friction,
    frictionless_range_N,
    mean_relative_error,
)
from tormagd.lab.thesis import page, table_2_5
from tormagd.lab.thesis.values import TABLE_2_5
from tormagd.physics.field import FieldLaw, PowerFieldLaw, ThesisFieldLaw
from tormagd.physics.force import TORMAG, brake_force_N
from tormagd.physics.inserts import INSERTS

# -- table 2.4: friction and exponent fitted to the measured ranges ----------------------------------------------------


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


# -- table 2.5 in both readings: what the thesis names matches by width, no brake gives the least forces ---------------


FOUND = table_2_5.table_2_5()


def test_every_insert_stands_before_every_task_in_both_readings() -> None:
    for (task, _), found in zip(TABLE_2_5, FOUND["tasks"], strict=True):
        assert {row["insert"] for row in found["ranked"]} == set(INSERTS)
        for row in found["ranked"]:
            wide = INSERTS[row["insert"]].force_range.measured_N >= task.most_N - task.least_N
            assert (row["matched_share"] == 1.0) == wide
            assert not row["serves"]  # every task begins at 0 N


def test_of_what_the_thesis_names_one_is_not_wide_enough() -> None:
    rows = [dict(zip(table_2_5.COLUMNS, row, strict=True)) for row in table_2_5.readings(FOUND)]
    assert len(rows) == sum(len(named) for _, named in TABLE_2_5)
    short = [row for row in rows if row["range matched"] != "100%"]
    assert [row["insert the thesis names"] for row in short] == ["MRE-30-30"]
    assert "0.67 N of the width" in short[0]["missed"]
    named = {row["task"].split(",")[0]: row["narrowest that matches"] for row in rows}
    assert all(named[task.name] in inserts for task, inserts in TABLE_2_5)


def test_the_page_has_it() -> None:
    """`tormag-lab reproduce-thesis --out docs` writes it."""
    assert page.table_2_5(FOUND) in Path(__file__).parents[2].joinpath("docs/reproduction.md").read_text("utf-8")
