"""The rows that a bench sweep keeps, and the memory that is taken out of them. All records are synthetic."""

import numpy as np
import pytest

from tormagd.lab.training.bench_sweep import LOADED_MM, LOADED_STEP_MM, loading, sliding, strokes
from tormagd.lab.training.dataset import Dataset
from tormagd.lab.training.unremembered import identify
from tormagd.model.displacement import MOBILISED_MM
from tormagd.physics.friction import Friction

KINETIC_N, STIFFNESS_N_MM = 2.0, 8.0


@pytest.mark.parametrize("speed_mm_s", [0.6, 20.0, 300.0])
def test_displacement_counts_from_where_the_elastomer_bears_nothing(speed_mm_s: float) -> None:
    lasts_s = max(0.4, 4.0 / speed_mm_s)
    speeds = np.repeat([100.0, 0.0, -speed_mm_s, 0.0], [300, 300, round(1e3 * lasts_s), 300])
    friction, deflection_mm, forces = Friction(STIFFNESS_N_MM, 0.0, 1.0, 5.0), 0.0, []
    for speed in speeds.tolist():
        force_N, deflection_mm = friction.advance(deflection_mm, speed, KINETIC_N, 1e-3)
        forces.append(force_N)
    handle_mm, signed_N = np.cumsum(speeds) * 1e-3, np.array(forces)
    rate_mm_s, displacement_mm = loading(handle_mm, np.full(len(speeds), 60.0), signed_N)
    kept = np.flatnonzero(~np.isnan(displacement_mm) & (rate_mm_s < 0.0))
    found_mm = displacement_mm[kept]
    assert len(kept) >= min(LOADED_MM / LOADED_STEP_MM, 0.5 * LOADED_MM / (speed_mm_s * 1e-3))
    assert 0.0 <= found_mm.min() <= found_mm.max() <= LOADED_MM
    assert rate_mm_s[kept] == pytest.approx(-speed_mm_s, rel=1e-6)
    expected_N = KINETIC_N * -np.expm1(-STIFFNESS_N_MM * found_mm / KINETIC_N)
    # a tick of a fast handle is a part of the way
    assert -signed_N[kept] == pytest.approx(expected_N, abs=STIFFNESS_N_MM * speed_mm_s * 1e-3 * 0.1 + 1e-3)
    assert not sliding(handle_mm, np.full(len(speeds), 60.0))[1][kept].any()


def test_while_the_gap_moves_no_row_is_kept() -> None:
    handle_mm = np.cumsum(np.repeat([20.0, -20.0], 400)) * 1e-3
    signed_N = np.where(np.arange(800) < 500, 1.0, -1.0)
    assert not np.isnan(loading(handle_mm, np.full(800, 60.0), signed_N)[1]).all()
    assert np.isnan(loading(handle_mm, 60.0 + 5e-3 * np.arange(800), signed_N)[1]).all()


def test_a_stroke_mobilises_before_it_creeps() -> None:
    hand, ends_s = strokes(3, seed=1)
    assert len(ends_s) == 3
    positions = np.array([hand.position_mm(time_s) for time_s in np.arange(0.0, ends_s[-1], 1e-3).tolist()])
    assert positions.max() - positions[0] > 9.0
    assert ends_s == sorted(ends_s)


def test_what_inserts_of_one_matrix_remember_is_found_in_all_their_records() -> None:
    """A force that steps up, held: both relax alike, and the weaker field lags to its own scale."""
    fraction, time_s = 0.06, np.arange(0.0, 180.0, 1.0)
    records = []
    for iron, greatest_mT in ((20.0, 400.0), (40.0, 800.0)):
        for number in range(3):
            field_mT = greatest_mT * np.where((time_s + 20.0 * number) % 120.0 < 60.0, 0.4, 1.0 - 0.1 * number)
            level_N = 4.0 * (field_mT / 800.0) ** 2
            slow_N, away_N = level_N[0], []
            for drive_N in level_N.tolist():
                slow_N = drive_N + (slow_N - drive_N) * np.exp(-1.0 / 8.0)
                away_N.append(fraction * slow_N)
            ones = np.ones_like(time_s)
            rate = 20.0 + 60.0 * (time_s % 7.0)
            records.append((np.column_stack((MOBILISED_MM * ones, rate, field_mT, iron * ones)), level_N - away_N))
    features, force_N = (np.concatenate(part) for part in zip(*records, strict=True))
    cycle = np.repeat(np.arange(len(records)), len(time_s))
    memory, _ = identify(Dataset(features, force_N, cycle, np.tile(time_s, len(records))))
    assert memory.fractions[0] == pytest.approx(fraction, abs=0.01)
    assert memory.times_s[0] == pytest.approx(8.0, rel=0.2)
