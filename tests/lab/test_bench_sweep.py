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
    """Both relax alike; at one gap the weaker has half the field, and some rows are not yet mobilised."""
    fraction, random, time_s = 0.06, np.random.default_rng(0), np.arange(0.0, 160.0)
    records = []
    for iron, greatest_mT in ((20.0, 400.0), (40.0, 800.0), (20.0, 400.0), (40.0, 800.0)):
        shares = np.concatenate(([1.0], random.uniform(0.4, 1.0, 7)))
        field_mT = greatest_mT * np.repeat(shares, 20)
        level_N = 4.0 * (field_mT / 800.0) ** 2
        slow_N = last_N = level_N[0]
        for tick, drive_N in enumerate(level_N.tolist()):
            mean_N, last_N = (drive_N + last_N) / 2.0, drive_N
            slow_N = mean_N + (slow_N - mean_N) * np.exp(-1.0 / 8.0)
            level_N[tick] -= fraction * slow_N
        displacement_mm = np.where(time_s % 5.0 == 4.0, 0.2, MOBILISED_MM)
        borne_N = level_N * -np.expm1(-STIFFNESS_N_MM * displacement_mm / level_N)
        force_N = np.where(displacement_mm < MOBILISED_MM, borne_N, level_N)
        rate = 20.0 + 60.0 * (time_s % 7.0)
        records.append((np.column_stack((displacement_mm, rate, field_mT, np.full(160, iron))), force_N))
    features, forces_N = (np.concatenate(part) for part in zip(*records, strict=True))
    memory, free = identify(Dataset(features, forces_N, np.repeat(np.arange(4), 160), np.tile(time_s, 4)))
    assert (memory.fractions, memory.times_s[0]) == (
        pytest.approx((fraction, 0.0, 0.0), abs=0.002),
        pytest.approx(8.0, rel=0.05),
    )
    slid = features[:, 0] >= MOBILISED_MM
    fresh_N = 4.0 * (features[:, 2] / 800.0) ** 2
    assert free.force_N[slid] == pytest.approx(fresh_N[slid], rel=0.01)
