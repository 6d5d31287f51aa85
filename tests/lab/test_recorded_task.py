from pathlib import Path

import numpy as np
import pytest

from tormagd.lab.design.recorded_task import read_task, task_of
from tormagd.physics.errors import DomainError


def write(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def test_rate_of_an_unevenly_sampled_force(tmp_path: Path) -> None:
    times = np.cumsum(np.random.default_rng(3).uniform(5e-4, 2e-3, 2000))
    rows = "\n".join(f"{t},{1.0 + 0.2 * np.sin(6.0 * t)},7" for t in times)
    task = read_task(write(tmp_path / "task.csv", f"t_s,force_N,rate_mm_s\n{rows}\n"))
    assert task.rate_N_s[5:-5] == pytest.approx(1.2 * np.cos(6.0 * task.time_s[5:-5]), abs=1e-4)


def test_low_pass_keeps_the_signal_and_drops_the_noise() -> None:
    times = np.arange(0.0, 4.0, 1e-3)
    clean = 1.0 + 0.2 * np.sin(6.0 * times)
    noisy = clean + np.random.default_rng(1).normal(0.0, 0.01, len(times))
    raw, smooth = task_of(times, noisy), task_of(times, noisy, cutoff_Hz=20.0)
    true_rate = 1.2 * np.cos(6.0 * times)
    middle = slice(200, -200)
    assert np.std(raw.rate_N_s[middle] - true_rate[middle]) > 5.0
    assert np.std(smooth.rate_N_s[middle] - true_rate[middle]) < 0.25


def test_a_short_record_can_be_filtered() -> None:
    assert len(task_of(np.arange(5) * 0.01, np.ones(5), cutoff_Hz=10.0).force_N) == 5


def test_two_rows_are_no_task(tmp_path: Path) -> None:
    with pytest.raises(DomainError, match="3 times or more"):
        read_task(write(tmp_path / "task.csv", "t_s,force_N\n0,1\n1,1\n"))


@pytest.mark.parametrize("cutoff", [0.0, 50.0, float("nan")])
def test_impossible_cutoffs_are_refused(cutoff: float) -> None:
    with pytest.raises(DomainError, match="cutoff_Hz"):
        task_of(np.arange(50) * 0.01, np.ones(50), cutoff_Hz=cutoff)
