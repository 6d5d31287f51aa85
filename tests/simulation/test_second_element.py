"""The second plant's element: what any brake of its kind does, whatever its laws are."""

import msgspec
import pytest

from tormagd.simulation.parameters import PlantParameters, load_plant
from tormagd.simulation.second_element import SecondElement

STEP_S = 1e-3
SPEED_MM_S = 42.0
SECOND = load_plant("second")


def of(**values: object) -> PlantParameters:
    assert SECOND.second is not None
    return msgspec.structs.replace(SECOND, second=msgspec.structs.replace(SECOND.second, **values))


def slid(
    gap_mm: float, plant: PlantParameters = SECOND, seconds: float = 0.2, speed_mm_s: float = SPEED_MM_S
) -> SecondElement:
    element = SecondElement(plant, gap_mm, STEP_S)
    for _ in range(round(seconds / STEP_S)):
        element.advance(0.0, gap_mm, speed_mm_s)
    return element


def test_the_force_rises_as_the_gap_closes_and_is_of_the_order_of_the_samples() -> None:
    forces_N = [slid(gap_mm).force_N for gap_mm in (95.0, 85.0, 75.0, 65.0, 55.0, 45.0)]
    assert forces_N == sorted(forces_N)
    assert 0.3 < forces_N[0] < 0.6
    assert 3.0 < forces_N[-1] < 5.0


def test_the_field_lags_by_its_play_and_does_not_depend_on_the_rate() -> None:
    found = []
    for steps in (10, 1000):
        element = SecondElement(of(creeping_share=0.0), 90.0, STEP_S)
        for start_mm, end_mm in ((90.0, 60.0), (60.0, 50.0), (50.0, 60.0)):
            for step in range(1, steps + 1):
                element.advance(0.0, start_mm + (end_mm - start_mm) * step / steps, SPEED_MM_S)
            found.append(element.kinetic_N)
    closing_N, _, opening_N = found[:3]
    assert found[3:] == pytest.approx(found[:3], rel=1e-9)
    assert 1.01 < opening_N / closing_N < 1.1


def test_a_step_creeps_with_the_logarithm_of_time_and_comes_to_an_end() -> None:
    element = SecondElement(SECOND, 90.0, 0.1)
    rested_N = element.kinetic_N
    element.advance(0.0, 48.0, SPEED_MM_S)
    fresh_N, at_N = element.kinetic_N, []
    for step in range(1, 100_001):
        element.advance(0.0, 48.0, SPEED_MM_S)
        if step in (10, 100, 1000, 100_000):
            at_N.append(element.kinetic_N)
    assert fresh_N > at_N[0] > at_N[1] > at_N[2] > at_N[3] > rested_N
    # at most V ln 10 a decade, 0.115 N
    assert (at_N[0] - at_N[1], at_N[1] - at_N[2]) == pytest.approx((0.11, 0.11), rel=0.1)
    assert at_N[3] == pytest.approx(SecondElement(SECOND, 48.0, 0.1).kinetic_N, rel=0.01)


def test_friction_grows_with_the_logarithm_of_speed_and_with_rest() -> None:
    quiet = of(creeping_share=0.0)
    speeds = (1.0, 10.0, 100.0)
    slow_N, middle_N, fast_N = (slid(60.0, quiet, 12.0 / speed, speed).force_N for speed in speeds)
    assert middle_N / slow_N == pytest.approx(fast_N / middle_N, rel=0.03)
    assert 1.02 < middle_N / slow_N < 1.06
    peaks_N = []
    for rests_s in (0.0, 30.0):
        element = slid(60.0, quiet)
        for _ in range(round(rests_s / STEP_S)):
            element.advance(0.0, 60.0, 0.0)
        peaks_N.append(0.0)
        for _ in range(20):
            element.advance(0.0, 60.0, SPEED_MM_S)
            peaks_N[-1] = max(peaks_N[-1], element.force_N)
    assert 1.05 < peaks_N[1] / peaks_N[0] < 1.2


def test_warmth_weakens_it() -> None:
    element = SecondElement(SECOND, 60.0, STEP_S)
    element.advance(0.0, 60.0, SPEED_MM_S)
    cool_N = element.kinetic_N
    element.advance(1e7, 60.0, SPEED_MM_S)
    assert element.temperature_C == pytest.approx(40.0)
    assert element.kinetic_N < 0.96 * cool_N
