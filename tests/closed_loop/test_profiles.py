"""A profile is a prior for tracking, never for the ceiling: it presses no harder than any device may (synthetic)."""

import random

import pytest

from tormagd.control.believe.believe import Learned
from tormagd.control.believe.strength import DeviceFit
from tormagd.safety.codes import Fault
from tormagd.simulation.hand import RecordedHand

MOST_N = 2.0
RESTS_S, GOES_MM_S = 4.0, (0.0, 1.0, 42.0)
SCALES, OFFSETS_N = (0.1, 2.0), (-1.0, 1.0)


@pytest.mark.parametrize("goes_mm_s", GOES_MM_S)
@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("offset_N", OFFSETS_N)
def test_a_profile_that_lies_never_presses_over_the_ceiling(
    make, render, goes_mm_s: float, scale: float, offset_N: float
) -> None:
    """Tampered, of another insert or outdated; the handle rests, then creeps or slides, or goes on resting."""
    draw = random.Random(f"{goes_mm_s} {scale} {offset_N}")
    hand = RecordedHand((0.0, RESTS_S, RESTS_S + 30.0), (0.0, 0.0, 30.0 * goes_mm_s))
    loop = make(f"sample_{draw.randint(1, 3)}", hand)
    fit = DeviceFit(scale, offset_N, draw.choice((1e-6, 1e-2)), 0.0, 1e-4)
    loop.planner.teach(Learned(fit, draw.uniform(0.7, 1.2), 1.0, draw.uniform(-0.3, 0.3)))
    loop.arm()
    samples = render(loop, MOST_N, 6.0)
    assert max(abs(sample.truth.force_N) for sample in samples) < 1.25 * MOST_N + 0.1
    assert set(samples[-1].safety.faults) <= {Fault.SENSOR}
