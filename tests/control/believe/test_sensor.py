"""Who is right where the readings leave the believed device (synthetic).

The gap follows whichever explanation has more force, and doubt never presses harder.
"""

from collections.abc import Callable

import pytest

from tormagd.control.believe.believe import Believe
from tormagd.control.believe.freshness import FROZEN_S
from tormagd.control.believe.handle import HandleWatch
from tormagd.control.believe.sensor import (
    AGREES_S,
    DRIFTS_S,
    EXCUSED_N,
    MOVED_N,
    RELAXED,
    RISES_N_S,
    TRUSTED_AGAIN_S,
    WRONG_S,
)
from tormagd.control.core import Planner
from tormagd.control.records import Handle
from tormagd.control.safety.codes import Limit
from tormagd.element.model.displacement import MOBILISED_MM, Turn

MODEL_N = 1.0871
"What the model says at the gap of `moving`."
NEW_WAY = {"handle": Handle(MOBILISED_MM, 42.0, Turn(-1.0, 0.0, 100.0), 42.0)}
CLOSER = {"gap_mm": 70.0, "handle_mm": 110.0, "handle": Handle(MOBILISED_MM, 42.0, Turn(1.0, 0.0, 110.0), 42.0)}


def force_N(believe: Believe) -> float:
    return believe.device.force_N(MODEL_N)


@pytest.fixture
def known(planner: Planner, hear: Callable[..., Planner], moving) -> Planner:
    return hear(planner, 2.0, moving())


@pytest.mark.parametrize("share", [0.75, 0.3, 0.0, -1.0])
def test_readings_that_fall_move_nothing_however_long(known, hear, moving, share: float) -> None:
    for _ in range(5):
        believe = hear(known, 1.0, moving(force_N=share * MODEL_N)).believe
        assert force_N(believe) == pytest.approx(MODEL_N, abs=0.03)
    assert {Limit.DEVICE_OR_SENSOR, Limit.SENSOR} & set(known.planned.limits)


def test_readings_that_rise_are_followed_at_a_bounded_rate(known, hear, moving) -> None:
    assert force_N(hear(known, 0.08, moving(force_N=1.4 * MODEL_N)).believe) - MODEL_N < MOVED_N + 0.08 * RISES_N_S
    assert (force_N(hear(known, 0.5, moving(force_N=1.4 * MODEL_N)).believe), known.planned.limits) == (
        pytest.approx(1.4 * MODEL_N, abs=0.01),
        (Limit.DEVICE_OR_SENSOR,),
    )


def test_readings_of_no_device_open_nothing_and_name_the_sensor(known, hear, moving) -> None:
    believe = hear(known, 2.0 * WRONG_S, moving(force_N=10.0 * MODEL_N)).believe
    assert Limit.SENSOR in known.planned.limits
    assert force_N(believe) == pytest.approx(MODEL_N, abs=0.03)
    assert hear(known, 3.0, moving(force_N=10.0 * MODEL_N)).planned.sensor_doubted_s > 2.9


@pytest.mark.parametrize("share", [0.0, 0.7, 1.3, 10.0])
def test_readings_that_come_back_end_it_and_the_device_is_what_it_was(known, hear, moving, share: float) -> None:
    sd_N = known.believe.zero.sd_N(known.planned.time_s)
    hear(known, 0.2, moving(force_N=share * MODEL_N))
    believe = hear(known, 0.2 + (TRUSTED_AGAIN_S if share in (0.0, 10.0) else AGREES_S), moving()).believe
    assert (known.planned.limits, believe.sensor.is_disputed) == ((), False)
    assert (force_N(believe), believe.zero.sd_N(known.planned.time_s)) == (
        pytest.approx(MODEL_N, abs=0.03),
        pytest.approx(sd_N, abs=1e-3),
    )


def test_a_zero_that_a_reversal_tells_ends_it(known, hear, moving) -> None:
    hear(known, 1.0, moving(force_N=MODEL_N - 0.3))
    assert known.planned.limits == (Limit.DEVICE_OR_SENSOR,)
    hear(known, 1.0, moving(force_N=MODEL_N + 0.3, **NEW_WAY))
    assert (known.planned.limits, known.believe.zero.zero_N) == ((Limit.SENSOR_ZERO,), pytest.approx(-0.3, abs=0.02))


@pytest.mark.parametrize(("wrong", "share", "limits"), [("device", 0.75, ()), ("sensor", 1.0, (Limit.SENSOR,))])
def test_an_operator_says_whether_device_or_sensor_has_changed(
    known, hear, moving, wrong: str, share: float, limits: tuple[Limit, ...]
) -> None:
    hear(known, 1.0, moving(force_N=0.75 * MODEL_N))
    known.confirm(wrong)
    hear(known, 0.5, moving(force_N=0.75 * MODEL_N))
    assert (force_N(known.believe), known.planned.limits) == (pytest.approx(share * MODEL_N, abs=0.02), limits)


def test_without_a_dispute_there_is_nothing_to_confirm(known) -> None:
    before = known.believe.device
    for wrong in ("sensor", "device"):
        known.confirm(wrong)
    assert (known.believe.device, known.believe.sensor.is_doubted) == (before, False)


@pytest.mark.parametrize(("share", "is_learned"), [(0.65, True), (1.7, True), (0.3, False), (2.6, False)])
def test_a_device_that_has_not_slid_is_learned_within_the_bounds(
    planner, hear, moving, share: float, is_learned: bool
) -> None:
    believe = hear(planner, 1.0, moving(force_N=share * MODEL_N)).believe
    assert (force_N(believe) == pytest.approx(share * MODEL_N, abs=0.03)) is is_learned
    assert (Limit.SENSOR in planner.planned.limits) is not is_learned


@pytest.mark.parametrize(
    ("off_N", "changes", "is_disputed"),
    [
        (0.08, {}, False),
        (-0.08, {}, False),
        (0.16, {}, True),
        (-0.16, {}, True),
        (-0.16, NEW_WAY, False),
        (-0.16, CLOSER, False),
        (-0.6, CLOSER, True),
    ],
)
def test_what_has_changed_around_the_device_may_explain_a_leap(
    core, known, hear, moving, off_N: float, changes: dict[str, object], is_disputed: bool
) -> None:
    here_N = core.portrait.force_N_at(70.0) if changes is CLOSER else MODEL_N
    known.believe.handle = HandleWatch()
    assert hear(known, 0.3, moving(**{"force_N": here_N + off_N, **changes})).believe.sensor.is_disputed is is_disputed


@pytest.mark.parametrize("share", [0.7, 1.0, 1.5])
def test_what_relaxes_is_followed_and_what_goes_on_falling_is_not(planner, hear, moving, share: float) -> None:
    own_N, fallen_N = share * MODEL_N, 0.0
    hear(planner, 2.0, moving(force_N=own_N))
    for _ in range(100):
        fallen_N += 0.01 * own_N
        hear(planner, 1.0, moving(force_N=own_N - fallen_N))
        if planner.believe.sensor.is_disputed:
            break
    assert fallen_N == pytest.approx(MOVED_N + RELAXED * own_N, abs=0.025)


def test_a_drift_is_not_hidden_by_a_force_that_steps(core, known, hear, moving) -> None:
    levels = (moving(), MODEL_N), (moving(**CLOSER), core.portrait.force_N_at(70.0))
    drifted_N = 0.0
    while not known.believe.sensor.is_disputed and drifted_N < 1.0:
        for measured, model_N in levels:
            known.believe.handle = HandleWatch()
            for _ in range(20):
                drifted_N += 1e-3
                hear(known, 0.1, measured.replaced(force_N=model_N - drifted_N))
    assert drifted_N < MOVED_N + EXCUSED_N + RELAXED * levels[1][1] + 0.05


def test_a_step_ends_no_dispute(core, known, hear, moving) -> None:
    hear(known, 0.3, moving(force_N=MODEL_N - 0.14))
    known.believe.handle = HandleWatch()
    assert hear(known, 1.0, moving(force_N=core.portrait.force_N_at(70.0) - 0.14, **CLOSER)).believe.sensor.is_disputed


def test_readings_that_left_slowly_have_to_agree_for_ten_seconds_and_no_longer(known, hear, moving) -> None:
    reading_N = MODEL_N
    while not known.believe.sensor.is_disputed:  # an elastomer may win back as much in half a minute
        reading_N += 0.0014
        hear(known, 0.1, moving(force_N=reading_N))
        if known.believe.sensor.leaves_s > 2.0 * DRIFTS_S:
            hear(known, 0.3, moving(force_N=reading_N + 0.4))
    agreeing_N = force_N(known.believe) - known.believe.sensor.lead_N
    assert hear(known, 0.9 * DRIFTS_S, moving(force_N=agreeing_N)).believe.sensor.is_disputed
    assert not hear(known, 0.2 * DRIFTS_S, moving(force_N=agreeing_N)).believe.sensor.is_disputed


def test_a_fit_that_swings_is_the_same_device_still(known, hear, moving) -> None:
    for swing in range(12):
        hear(known, 2.5, moving(force_N=MODEL_N + 0.07 * (-1) ** swing))
        assert not known.believe.sensor.is_disputed


def test_a_sensor_that_stands_still_is_wrong_only_where_it_should_not(known, hear, moving) -> None:
    assert Limit.SENSOR in hear(known, 2.0 * FROZEN_S, moving(), 0.0).planned.limits


def test_a_sensor_without_noise_may_stand_still_while_the_force_does(planner, hear, moving) -> None:
    assert Limit.SENSOR not in hear(planner, 5.0, moving(), 0.0).planned.limits
    planner.believe.handle = HandleWatch()
    assert Limit.SENSOR in hear(planner, 0.3, moving(**CLOSER), 0.0).planned.limits
