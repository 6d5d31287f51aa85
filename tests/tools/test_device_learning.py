"""The measures of how well a device is known, on errors made by hand; the runs themselves are a tool's."""

import itertools

import device_learning
import numpy as np
import pytest
from device_learning import ARRIVES_S, LATER_S, SPEEDS_MM_S, STEP_S, Course

from tormagd.control.plan import NOTHING_SHOWN

BEGINS_S, IDEAL_S = 4.0, 0.9


def course(*errors: tuple[float, float, float]) -> Course:
    """Ten seconds without an error, but for these: from, to, s, and how much, N."""
    time_s = 1e-3 * np.arange(10_000)
    error_N = np.zeros_like(time_s)
    for from_s, to_s, much_N in errors:
        error_N[(time_s >= from_s) & (time_s < to_s)] = much_N
    return Course(time_s, error_N, np.zeros(len(time_s), dtype=np.bool_), (), NOTHING_SHOWN)


def test_a_step_is_judged_once_it_arrived_a_second_later_and_by_its_greatest() -> None:
    arrives_s = BEGINS_S + IDEAL_S + ARRIVES_S
    found = course(
        (BEGINS_S, BEGINS_S + IDEAL_S, -1.3),  # on its way
        (arrives_s, arrives_s + 0.1, -0.05),
        (arrives_s + LATER_S, arrives_s + LATER_S + 0.1, 0.02),
        (arrives_s + 0.5, arrives_s + 0.6, 0.09),
        (BEGINS_S + STEP_S, 10.0, 1.3),  # the next step
    )
    figures = device_learning.step_figures(found, BEGINS_S, IDEAL_S, 1.0)
    assert figures == pytest.approx({"arrived_N": -0.05, "later_N": 0.02, "overshoot_N": 0.09})
    # downwards what falls short of the force asked is beyond it
    assert device_learning.step_figures(found, BEGINS_S, IDEAL_S, -1.0)["overshoot_N"] == pytest.approx(0.05)


def test_the_worst_is_of_means_in_between() -> None:
    found = course((3.0, 3.2, -0.4), (5.0, 5.001, 5.0), (8.0, 9.0, 1.0))
    assert found.worst_N(2.0, 4.0) == pytest.approx(0.4)
    assert found.worst_N(4.5, 6.0) == pytest.approx(0.1)  # one reading of fifty


def test_every_speed_follows_every_other_once() -> None:
    pairs = list(itertools.pairwise(device_learning.tour()))
    assert sorted(pairs) == sorted(itertools.permutations(SPEEDS_MM_S, 2))


def test_the_worst_device_is_named() -> None:
    assert (
        device_learning.worst({"draw 40": 0.01, "sample_2": 0.03, "draw 41": 0.02}) == "  30 mN (sample_2), median  20"
    )
