import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from tormagd.lab.design.brake import Brake
from tormagd.lab.design.phase_portrait import PhasePortrait, Region
from tormagd.physics.errors import DomainError
from tormagd.physics.field import FieldLaw, PowerFieldLaw, ThesisFieldLaw
from tormagd.physics.force import TORMAG, Elastomer

SPEEDS = (25.0 / 3.0, 40.0)


def count_points(portrait: PhasePortrait, region: Region, *, true: bool, side: int = 500) -> float:
    """Coverage by counting a grid of points in the region: slow, and without an integral."""
    force, share = np.meshgrid((np.arange(side) + 0.5) / side, (np.arange(side) + 0.5) / side)
    force = region.least_N + force * (region.most_N - region.least_N)
    # rows of equal share of the rate have unequal height: weigh each point with it
    required = region.rate_N_s(force)
    judge = portrait.true_cloud if true else portrait.trapezoid_cloud
    covered = judge(force.ravel(), (share * required).ravel()).covered.reshape(force.shape)
    return float(np.sum(covered * required) / np.sum(required))


@pytest.mark.parametrize("speed", SPEEDS)
def test_coverage_agrees_with_counted_points(
    brake: Brake, use_case_1: Region, use_case_2: Region, speed: float
) -> None:
    portrait = PhasePortrait(brake, speed)
    for region in (use_case_1, use_case_2):
        counted = [count_points(portrait, region, true=true) for true in (True, False)]
        assert [portrait.true_coverage(region), portrait.trapezoid_coverage(region)] == pytest.approx(counted, abs=1e-3)


def test_a_region_out_of_reach_is_not_covered_and_one_inside_is_whole(brake: Brake) -> None:
    portrait = PhasePortrait(brake, 40.0)
    for region, share in ((Region(brake.most_N, 0.1, brake.most_N + 1.0, 0.1), 0.0), (Region(2.0, 0.1, 3.0, 0.1), 1.0)):
        assert (portrait.true_coverage(region), portrait.trapezoid_coverage(region)) == pytest.approx(
            (share, share), abs=1e-12
        )


@settings(max_examples=60, deadline=None)
@given(
    least=st.floats(0.0, 5.0),
    width=st.floats(0.01, 5.0),
    rates=st.tuples(st.floats(0.0, 10.0), st.floats(0.01, 10.0)),
    speed=st.floats(0.1, 100.0),
)
def test_coverage_is_a_share_that_grows_with_the_gap_speed(
    brake: Brake, least: float, width: float, rates: tuple[float, float], speed: float
) -> None:
    region = Region(least, rates[0], least + width, rates[1])
    slow, fast = PhasePortrait(brake, speed), PhasePortrait(brake, 2.0 * speed)
    for name in ("true_coverage", "trapezoid_coverage"):
        assert 0.0 <= getattr(slow, name)(region) <= getattr(fast, name)(region) + 1e-9 <= 1.0 + 1e-9


def test_cloud_says_which_points_fail_and_why(brake: Brake) -> None:
    portrait = PhasePortrait(brake, 40.0)
    limit = 40.0 * brake.slope_N_mm(brake.gap_mm(2.0))
    force = np.array([2.0, 2.0, 2.0, 0.5 * brake.least_N, brake.most_N + 0.1])
    cloud = portrait.true_cloud(force, np.array([0.99 * limit, 1.01 * limit, -1.01 * limit, 0.0, 0.0]))
    said = [cloud.covered, cloud.too_fast, cloud.below_least_force, cloud.above_most_force]
    assert [np.flatnonzero(points).tolist() for points in said] == [[0], [1, 2], [3], [4]]
    assert cloud.share == pytest.approx(0.2)


@pytest.mark.parametrize("g0_Pa", [20e3, 79.5e3, 185.5e3, 277.3e3])
@pytest.mark.parametrize("law", [ThesisFieldLaw(), PowerFieldLaw()])
def test_end_forces_come_back_as_end_gaps(law: FieldLaw, g0_Pa: float) -> None:
    device = Brake(law, Elastomer(g0_Pa, 2.7, 0.2), TORMAG, 45.0, 95.0)
    ends = [device.most_N, device.least_N]
    # Eq. 7 is flat at 95 mm: its inverse has half of the digits there
    assert [device.gap_mm(force) for force in ends] == pytest.approx([45.0, 95.0], abs=1e-4)
    assert device.gap_mm(np.array(ends)) == pytest.approx([45.0, 95.0], abs=1e-4)


SOFT, USUAL = Elastomer(5e3, 3.8, 0.2), Elastomer(300e3, 3.8, 0.2)


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (lambda _: Region(0.5, 0.1, 0.5, 0.1), "^most_N "),
        (lambda _: Region(-0.1, 0.1, 0.5, 0.1), "^least_N "),
        (lambda _: Region(0.0, math.nan, 0.5, 0.1), "^least_rate_N_s "),
        (lambda _: Region(0.0, 0.0, math.inf, 0.1), "^most_N "),
        (lambda _: Region(0.0, 0.0, 0.5, 0.0), "^most_rate_N_s "),
        (lambda _: Brake(PowerFieldLaw(), USUAL, TORMAG, 95.0, 45.0), "open_mm"),
        (lambda _: Brake(ThesisFieldLaw(), USUAL, TORMAG, 45.0, 120.0), "open_mm = 120"),
        (lambda _: Brake(PowerFieldLaw(), SOFT, TORMAG, 5.0, 95.0), "radial_moment_Tm"),
        (lambda brake: PhasePortrait(brake, 0.0), "gap_speed_mm_s"),
        (lambda brake: brake.gap_mm(2.0 * brake.most_N), "force_N"),
    ],
)
def test_impossible_regions_brakes_and_speeds_are_refused(
    brake: Brake, made: Callable[[Brake], object], said: str
) -> None:
    with pytest.raises(DomainError, match=said):
        made(brake)
