import math
from typing import Any

import pytest

from tormagd.control.assembly.build import Core
from tormagd.control.believe.strength import DeviceFit
from tormagd.control.records import Outside, Plan
from tormagd.control.safety.codes import Limit
from tormagd.control.safety.operating_state import OperatingState
from tormagd.daemon.verdict import ARRIVES, CANNOT, FIELD, RENDERED, Judged, judged
from tormagd.element.model.features import FEATURES

CARRIAGES = {"gap_speed_mm_s": 40.0, "lag_s": 0.01, "tolerance_N": 0.05, "release_N_s": 2.0}
STRONG = DeviceFit(scale=1.25)
NOTHING: tuple[Limit, ...] = ()


def plan(asked_N: float | None = 1.5, limits: tuple[Limit, ...] = NOTHING, **fields: Any) -> Plan:
    known: dict[str, Any] = {"predicted_N": None, "field_mT": 90.0, "gap_mm": math.nan, "gap_speed_mm_s": 0.0}
    return Plan(1, 1.0, asked_N, 0.01, asked_N or 0.5, confidence=1.0, limits=limits, **known | fields)


def found(
    core: Core,
    planned: Plan,
    shown_N: float = 1.0,
    state: OperatingState = OperatingState.ENABLED,
    device: DeviceFit = STRONG,
) -> Judged:
    gap_mm = core.portrait.gap_mm_at(device.model_N(shown_N))
    if math.isnan(planned.gap_mm):
        planned = planned.replaced(gap_mm=core.portrait.gap_mm_at(device.model_N(planned.governed_N)))
    return judged(planned, state, gap_mm, core.portrait, device, **CARRIAGES)


@pytest.mark.parametrize(("shown_N", "is_rendered"), [(1.449, False), (1.451, True), (1.549, True), (1.551, False)])
def test_it_is_rendered_within_what_the_scene_tolerates(core: Core, shown_N: float, is_rendered: bool) -> None:
    judgement = found(core, plan(1.5), shown_N)
    assert (judgement == Judged(RENDERED, 0.0), judgement.outcome == ARRIVES) == (is_rendered, not is_rendered)


def test_the_gap_is_held_against_the_plans_with_the_elements_memory_in_it(core: Core) -> None:
    planned_mm = core.portrait.gap_mm_at(STRONG.model_N(1.5)) - 3.0
    planned = plan(1.5, gap_mm=planned_mm)
    assert judged(planned, OperatingState.ENABLED, planned_mm, core.portrait, STRONG, **CARRIAGES).outcome == RENDERED
    judgement = judged(planned, OperatingState.ENABLED, planned_mm + 8.0, core.portrait, STRONG, **CARRIAGES)
    assert judgement == (ARRIVES, pytest.approx(1e3 * (8.0 / 40.0 + 0.01), abs=0.051), ())


def test_it_arrives_when_the_gap_has_gone_there_and_the_carriages_have_come(core: Core) -> None:
    way_mm = core.portrait.gap_mm_at(0.8) - core.portrait.gap_mm_at(1.2)
    judgement = found(core, plan(1.5), 1.0)
    assert judgement == (ARRIVES, pytest.approx(1e3 * (way_mm / 40.0 + 0.01), abs=0.051), ())
    assert found(core, plan(1.0), 1.5).arrives_ms == judgement.arrives_ms
    # the ramp begins where the gap is open
    on_its_way = plan(1.5, (Limit.TAKEOVER, Limit.F_MIN)).replaced(governed_N=0.5)
    assert found(core, on_its_way, 0.5).arrives_ms == pytest.approx(1e3 * (1.0 / 2.0 + 0.01))


@pytest.mark.parametrize(
    ("asked_N", "limits", "why"),
    [
        (3.0, (Limit.RANGE,), ("RANGE",)),
        (3.0, (Limit.RANGE, Limit.F_MAX, Limit.RATE), ("RANGE", "F_MAX")),
        (3.0, (Limit.STANDBY, Limit.OTHER_SOURCE), ("STANDBY",)),
        (0.1, (Limit.F_MIN,), ("F_MIN",)),
        (None, (Limit.STALE, Limit.SENSOR), ("STALE",)),
        (None, (Limit.STALE, Limit.OTHER_SOURCE), ("STALE", "OTHER_SOURCE")),
    ],
)
def test_it_cannot_where_a_limit_holds_it(
    core: Core, asked_N: float | None, limits: tuple[Limit, ...], why: tuple[str, ...]
) -> None:
    assert found(core, plan(asked_N, limits)) == (CANNOT, None, why)


@pytest.mark.parametrize("limit", [Limit.RATE, Limit.TAKEOVER, Limit.OTHER_SOURCE, Limit.LOW_CONFIDENCE])
def test_what_only_makes_it_late_or_concerns_others_holds_nothing(core: Core, limit: Limit) -> None:
    assert found(core, plan(1.5, (limit,))).outcome == ARRIVES


def test_the_ceiling_holds_what_is_beyond_it_and_not_what_it_lets_pass(core: Core) -> None:
    held = {"min_gap_mm": core.portrait.gap_mm_at(STRONG.model_N(1.6)), "limits": (Limit.CEILING,)}
    assert found(core, plan(1.8, **held)) == (CANNOT, None, ("CEILING",))
    assert found(core, plan(1.5, **held)).outcome == ARRIVES


def test_the_models_range_holds_where_its_field_was_not_followed(core: Core) -> None:
    assert FEATURES[2] == FIELD
    limits = (Limit.MODEL_RANGE,)
    assert found(core, plan(1.5, limits, outside=(Outside("rate_mm_s", 300.0, 84.0),))).outcome == ARRIVES
    assert found(core, plan(1.5, limits, outside=(Outside(FIELD, 120.0, 100.0),))) == (CANNOT, None, ("MODEL_RANGE",))


@pytest.mark.parametrize("state", [OperatingState.DISABLED, OperatingState.PAUSED, OperatingState.FAULT])
def test_a_device_that_does_not_follow_says_its_state(core: Core, state: OperatingState) -> None:
    assert found(core, plan(1.5), 1.5, state) == (CANNOT, None, (str(state),))
    assert judged(plan(1.5), state, None, core.portrait, STRONG, **CARRIAGES).why == (str(state),)
