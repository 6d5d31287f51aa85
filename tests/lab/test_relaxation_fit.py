"""Relaxation spectra from synthetic records with a known answer."""

import numpy as np
import pytest

from tormagd.lab.characterisation.relaxation import RelaxationRecord, fit_relaxation
from tormagd.lab.errors import LabError
from tormagd.physics.errors import DomainError
from tormagd.physics.relaxation import PronySeries

SERIES = PronySeries((0.05, 0.04, 0.04), (8.0, 90.0, 900.0))
HOLD_S = np.concatenate(([0.0, 1e-3], 1e-3 + np.geomspace(0.05, 4000.0, 400)))


def record(time_s: np.ndarray, driving: np.ndarray, scale_N: float = 2.5, noise_N: float = 0.0) -> RelaxationRecord:
    state, forces = SERIES.relaxed(float(driving[0])), [SERIES.discretise(0.0).equilibrium_fraction * driving[0]]
    for dt_s, level in zip(np.diff(time_s), driving[1:], strict=True):
        force, state = SERIES.discretise(float(dt_s)).advance(state, float(level))
        forces.append(force)
    noise = np.random.default_rng(2).normal(0.0, noise_N, len(forces)) if noise_N else 0.0
    return RelaxationRecord(time_s, driving, scale_N * np.array(forces) + noise)


def step() -> np.ndarray:
    return np.where(HOLD_S > 0.0, 1.0, 0.0)


def test_a_step_gives_the_spectrum_and_the_scale() -> None:
    fit = fit_relaxation(record(HOLD_S, step()))
    assert (fit.scale_N, fit.series.fractions, fit.series.times_s) == (
        pytest.approx(2.5, rel=1e-6),
        pytest.approx(SERIES.fractions, rel=1e-4),
        pytest.approx(SERIES.times_s, rel=1e-4),
    )


def test_ramps_down_and_up_give_the_same_spectrum() -> None:
    time_s = np.arange(0.0, 4000.0, 5.0)
    driving = 2.0 + np.interp(time_s, [0, 20, 800, 900, 2000, 2010, 4000], [3, 0, 0, 2, 2, -1, -1])
    fit = fit_relaxation(record(time_s, driving))
    found, expected = ((*series.fractions, *series.times_s) for series in (fit.series, SERIES))
    assert found == pytest.approx(expected, rel=1e-3)


def test_noise_is_left_over_and_not_fitted() -> None:
    fit = fit_relaxation(record(HOLD_S, step(), noise_N=0.005))
    assert (fit.rms_N, sum(fit.series.fractions)) == (pytest.approx(0.005, rel=0.15), pytest.approx(0.13, abs=0.01))
    assert fit.r2 > 0.99


GOOD = record(HOLD_S, step())


@pytest.mark.parametrize(
    ("record_", "branches", "error", "said"),
    [
        (RelaxationRecord(*(column[:10] for column in GOOD)), 3, LabError, "14 rows"),
        (GOOD._replace(time_s=GOOD.time_s[::-1].copy()), 3, LabError, "rise strictly"),
        (GOOD._replace(driving=np.ones_like(GOOD.driving)), 3, LabError, "both change"),
        (GOOD._replace(force_N=-GOOD.force_N), 3, LabError, "equilibrium"),
        (GOOD, 7, LabError, "branches = 7"),
        (GOOD._replace(force_N=np.where(GOOD.time_s > 1.0, np.nan, GOOD.force_N)), 3, DomainError, "force_N"),
    ],
)
def test_records_that_cannot_be_fitted(record_, branches, error, said) -> None:
    with pytest.raises(error, match=said):
        fit_relaxation(record_, branches)
