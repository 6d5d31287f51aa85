"""What a hand feels of a wall, in virtual time, near its bound."""

import math

import numpy as np
import pytest
from devices import device
from judge.contact import LATER_MS, WORSE, WORSE_N, held_ms, judged, kept
from judge.following import VALID_S, armed
from judge.touching import Case, Touch, core_of

from tormagd.control.records import TimedSetpoint
from tormagd.simulation.hand import FeltHand, Impedance


@pytest.fixture(scope="module")
def rows() -> dict[str, dict]:
    return {mode: judged(Case("draw 100", 0.3, 0.25, 30.0, 100.0, mode)) for mode in ("force", "way", "law_standby")}


def test_a_wall_is_felt_when_carriages_of_this_speed_make_it(rows) -> None:
    for row in rows.values():
        assert row["onset_lag_ms"] <= row["onset_bound_ms"] + LATER_MS
        assert row["rms_N"] <= WORSE * row["rms_bound_N"] + WORSE_N
        assert (row["faults"], row["swings"]) == ([], 0)


def test_a_law_with_a_standby_is_felt_in_half_the_time_and_not_before(rows) -> None:
    assert rows["law_standby"]["felt_1_2_N_ms"] < 0.45 * rows["force"]["felt_1_2_N_ms"]
    assert rows["law_standby"]["tip_depth_mm"] < 0.8 * rows["force"]["tip_depth_mm"]
    assert max(row["early_N"] for row in rows.values()) < 0.13
    assert rows["law_standby"]["free_drag_N"] == pytest.approx(rows["law_standby"]["standby_N"], abs=0.06)


def test_a_hand_that_draws_back_is_let_go(rows) -> None:
    assert rows["way"]["withdrawal_held_ms"] < 0.75 * rows["force"]["withdrawal_held_ms"]
    for mode in ("way", "law_standby"):
        least_ms = rows[mode]["withdrawal_bound_ms"]
        assert least_ms <= rows[mode]["withdrawal_held_ms"] <= least_ms + 50.0


def test_a_handle_that_only_sticks_at_the_waiting_level_is_not_held() -> None:
    time_s, nothing = np.arange(4.0), np.zeros(4)
    touch = Touch(time_s, nothing, nothing, np.array([0.6, 0.6, 0.9, 0.6]), np.full(4, -0.75), nothing, (), ())
    assert held_ms(touch, 0.6) == 1.0


def test_what_is_kept_is_told_by_mode(rows) -> None:
    assert list(kept(list(rows.values()))) == list(rows)


class Trembling:
    def position_mm(self, time_s: float) -> float:
        onset_s = max(time_s - 12.0, 0.0)
        return 15.0 * min(time_s, 12.0) + 5.0 * min(onset_s, 1.0) + 0.5 * math.sin(math.tau * 8.0 * onset_s)


def test_a_tremor_changes_no_way() -> None:
    loop = armed(
        core_of(Case("sample_1", 0.3, 0.25, 30.0, 0.0, "way")),
        device("sample_1"),
        FeltHand(Trembling(), Impedance(0.15, 0.3, 0.01)),
    )
    run = loop.run(15.5 - loop.now_s, lambda now_s: TimedSetpoint(1.5, now_s, VALID_S, withdraw_N=0.5))
    kinetic_N = [sample.truth.kinetic_N for sample in run if sample.time_s > 13.5]
    assert max(kinetic_N) - min(kinetic_N) < 0.1
    assert min(kinetic_N) > 1.3
