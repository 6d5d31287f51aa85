"""The force over time: what a scene's keys mean in numbers, and which recordings are none."""

from pathlib import Path

import numpy as np
import pytest

from tormagd.scenes.scene import Signal
from tormagd.scenes.signal import asked

RANGE_N = (0.5, 2.0)


def test_up_and_down_by_half_cosines_with_rests(tmp_path: Path) -> None:
    time_s, force_N = asked(Signal(bandwidth_hz=0.5, hold_s=1.0), tmp_path, RANGE_N, 100.0, 100)
    assert len(time_s) == len(force_N) == 400
    assert force_N[[0, 50, 100, 150, 200, 250, 300, 399]] == pytest.approx([0.5, 1.25, 2.0, 2.0, 2.0, 1.25, 0.5, 0.5])
    # pi f times the range is the steepest slope of such a cosine
    assert np.abs(np.diff(force_N)).max() * 100 == pytest.approx(np.pi * 0.5 * 1.5, rel=1e-3)


def test_steps_divide_the_range_evenly(tmp_path: Path) -> None:
    _, force_N = asked(Signal(bandwidth_hz=5.0, step_N=0.4, hold_s=0.4), tmp_path, RANGE_N, 100.0, 100)
    held_N = np.unique(np.round(force_N[1:][np.diff(force_N) == 0.0], 6))
    assert (held_N, len(force_N)) == (pytest.approx([0.5, 0.875, 1.25, 1.625, 2.0]), 8 * 50)


def test_a_long_hold_is_cut_where_nobody_looks_any_more(tmp_path: Path) -> None:
    time_s, force_N = asked(Signal(bandwidth_hz=1.0, hold_s=86_400.0), tmp_path, RANGE_N, 30.0, 100)
    assert (len(time_s), force_N[-1]) == (3_000, 2.0)


def test_a_recording_is_smooth_between_its_rows_and_keeps_to_the_range(tmp_path: Path) -> None:
    rows_s = np.arange(0.0, 2.001, 0.02)
    lines = [f"{time + 7.0:.3f},{1.2 + 0.9 * np.sin(2.0 * np.pi * time):.6f}" for time in rows_s]
    (tmp_path / "mine.csv").write_text("t_s,force_N\n" + "\n".join(lines) + "\n")
    time_s, force_N = asked(Signal(file="mine.csv"), tmp_path, RANGE_N, 100.0, 500)
    assert time_s[-1] == pytest.approx(2.0, abs=0.003)
    assert force_N == pytest.approx(np.clip(1.2 + 0.9 * np.sin(2.0 * np.pi * time_s), *RANGE_N), abs=5e-4)
