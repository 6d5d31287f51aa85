"""What the element remembers, beside the laws that it follows: a Prony series, and a lag of the field."""

from collections.abc import Callable

import msgspec
import pytest

from tormagd.config import Config
from tormagd.control.aim.aim import Element
from tormagd.control.assembly.build import build_core
from tormagd.control.believe.memory import ElementMemory
from tormagd.control.records import Handle, Measured
from tormagd.element.model.displacement import Turn
from tormagd.element.model.force_curve import within
from tormagd.element.model.memory import NO_MEMORY, Memory
from tormagd.element.physics.relaxation import PronySeries
from tormagd.ground.plain_values import plain

MEMORY = Memory(fractions=(0.05, 0.04, 0.04), times_s=(8.0, 90.0, 900.0), lag_mT=8.0, turn_mT=80.0)
STEADY = msgspec.structs.replace(MEMORY, lag_mT=0.0)
GAPS_MM = (45.0, 95.0)
FAR_MM, NEAR_MM = 70.0, 48.0


@pytest.fixture(scope="session")
def element() -> Element:
    return build_core(Config()).element


@pytest.fixture(scope="session")
def follow(element: Element) -> Callable[..., ElementMemory]:
    def remembering(*measured: Measured, memory: Memory = MEMORY) -> ElementMemory:
        remembered = ElementMemory(memory, element.nominal, element.field, GAPS_MM)
        for place, each in enumerate(measured):
            remembered.update(0.5 * place, each)
        return remembered

    return remembering


def found(gap_mm: float, *, depth_mm: float = 0.0, is_homed: bool = True) -> Measured:
    handle = Handle(depth_mm, 0.0, Turn(1.0, 0.0, 0.0))
    return Measured(1, is_homed, 0.0, gap_mm / 2.0, gap_mm / 2.0, 0.0, 0.0, 0.0, handle, 0.0, 0.0, 0.0)


@pytest.mark.parametrize("memory", [STEADY, MEMORY], ids=["steady", "lagging"])
def test_it_relaxes_as_its_series_does_of_the_force_of_its_own_field(follow, element: Element, memory: Memory) -> None:
    curve, series, remembered = (
        element.nominal.only,
        PronySeries(MEMORY.fractions, MEMORY.times_s),
        follow(found(FAR_MM), memory=memory),
    )
    before_N, after_mT = curve.force_N(element.field.field_mT(FAR_MM)), element.field.field_mT(NEAR_MM)
    assert remembered.relaxed_N == pytest.approx(before_N * 0.13)
    lag_mT, state = remembered.lag_at_mT(after_mT), series.relaxed(before_N)
    assert (lag_mT > 1.0) is (memory is MEMORY)
    after_N = curve.force_N(after_mT - lag_mT)
    for place in range(41):
        true_N, state = series.discretise(0.5 if place else 0.0).advance(state, after_N)
        remembered.update(0.5 * place, found(NEAR_MM))
        assert remembered.lag_mT == lag_mT
        assert (after_N - remembered.relaxed_N, remembered.force_N(curve)) == pytest.approx((true_N, true_N), abs=1e-12)


def test_the_open_gap_gives_more_on_the_way_back(follow, element: Element) -> None:
    open_mm, curve = max(GAPS_MM), element.nominal.only
    rested, closed = follow(found(open_mm)), follow(found(open_mm), found(NEAR_MM))
    opened = follow(found(open_mm), found(NEAR_MM), found(open_mm))
    assert closed.open_N() == pytest.approx(opened.force_N(curve) + opened.relaxed_N, abs=3e-4)
    assert closed.open_N() > rested.open_N() + 0.01


def test_what_the_field_adds_relaxes_by_fractions_of_its_own() -> None:
    pad = build_core(Config(scene="radial_pulse")).element
    memory = Memory(fractions=(0.05, 0.04), times_s=(1.0, 30.0), field_fractions=(0.1, 0.02))
    remembered, pressed = ElementMemory(memory, pad.nominal, pad.field, GAPS_MM), found(NEAR_MM, depth_mm=2.0)
    remembered.update(5.0, pressed)
    assert remembered.relaxed_N == pytest.approx(0.0)
    remembered.update(1e4, pressed)
    curve = pad.nominal.now(pressed)
    free_N = curve.force_N(within(0.0, pad.nominal.fields_mT))
    added_N = curve.force_N(pad.field.field_mT(NEAR_MM)) - free_N
    assert remembered.relaxed_N == pytest.approx(0.09 * free_N + 0.12 * added_N)


def test_time_that_goes_back_ages_nothing(follow) -> None:
    remembered = follow(found(FAR_MM), found(NEAR_MM))
    relaxed_N = remembered.relaxed_N
    remembered.update(0.0, found(NEAR_MM))
    assert remembered.relaxed_N == pytest.approx(relaxed_N)


def test_the_field_lags_along_its_way_and_not_in_time(follow) -> None:
    remembered = follow()
    assert remembered.lag_at_mT(500.0) == 0.0
    remembered.field_mT, remembered.lag_mT, remembered.time_s = 400.0, 3.0, 0.0
    assert (remembered.lag_at_mT(400.0), remembered.lag_at_mT(2_000.0), remembered.lag_at_mT(-2_000.0)) == (
        3.0,
        pytest.approx(8.0),
        pytest.approx(-8.0),
    )
    at_once_mT, halfway_mT = remembered.lag_at_mT(460.0), remembered.lag_at_mT(430.0)
    remembered.field_mT, remembered.lag_mT = 430.0, halfway_mT
    assert remembered.lag_at_mT(460.0) == pytest.approx(at_once_mT)


@pytest.mark.parametrize(("gaps_mm", "memory"), [((), MEMORY), ((FAR_MM, NEAR_MM), NO_MEMORY)])
def test_an_element_without_memory_or_a_past_is_as_its_gap(follow, gaps_mm: tuple[float, ...], memory: Memory) -> None:
    remembered = follow(*[found(gap_mm) for gap_mm in gaps_mm], memory=memory)
    assert (remembered.lag_mT, remembered.relaxed_N) == (0.0, 0.0)


RELAXED = 0.13
"Share that the shipped model's element has relaxed after a long rest."


@pytest.mark.parametrize("before", [[], [found(900.0, is_homed=False)]], ids=["nothing", "a gap that no device has"])
def test_a_device_that_is_found_homed_has_rested_there(follow, element: Element, before: list[Measured]) -> None:
    remembered = follow(*before, found(95.0), memory=element.memory)
    assert (remembered.relaxed_N, remembered.lag_mT) == (pytest.approx(RELAXED * 0.62, rel=0.1), 0.0)


@pytest.mark.parametrize("rested_mm", [79.0, 44.0])
def test_one_that_has_to_be_homed_has_rested_where_it_was_switched_on(
    follow, element: Element, rested_mm: float
) -> None:
    on_its_way = [found(95.0 + opened_mm, is_homed=False) for opened_mm in (0.0, 10.0, 95.0 - rested_mm, 15.5, 0.0)]
    remembered = follow(*on_its_way, found(95.0), memory=element.memory)
    assert remembered.relaxed_N == pytest.approx(follow(found(rested_mm), memory=element.memory).relaxed_N, rel=0.02)
    assert remembered.lag_mT < 0.0


def test_a_brake_that_loses_its_position_remembers_what_it_knew(follow, element: Element) -> None:
    known = follow(found(95.0), found(60.0), memory=element.memory)
    assert plain(follow(found(95.0), found(60.0), found(45.0, is_homed=False), memory=element.memory)) == plain(known)
