"""Who is right where the readings leave the believed device (synthetic).

The gap follows whichever explanation has more force, and doubt never presses harder.
"""

import pytest

from tormagd.config import Config
from tormagd.control.believe.believe import Believe, Learned
from tormagd.control.believe.freshness import FROZEN_S
from tormagd.control.believe.handle import HandleWatch
from tormagd.control.believe.sensor import (
    DOUBTED_S,
    KNOWN_N,
    NAMED_S,
    SLACK_N,
    WRONG_S,
)
from tormagd.control.believe.strength import DeviceFit
from tormagd.control.records import Handle
from tormagd.control.safety.codes import Limit
from tormagd.element.model.displacement import MOBILISED_MM, Turn

MODEL_N = 1.0871
"What the model says at the gap of `moving`."
END_N = (1.0 - Config().trim.leash) * MODEL_N - SLACK_N
"Of the leash."
NEW_WAY = {"handle": Handle(MOBILISED_MM, 42.0, Turn(-1.0, 0.0, 100.0), 42.0)}
CLOSER = {"gap_mm": 70.0, "handle_mm": 110.0, "handle": Handle(MOBILISED_MM, 42.0, Turn(1.0, 0.0, 110.0), 42.0)}


def force_N(believe: Believe) -> float:
    return believe.device.force_N(MODEL_N)


@pytest.fixture
def known(planner, hear, moving):
    return hear(planner, 4.0, moving())


@pytest.mark.parametrize("share", [1.0, 0.95, 0.89])
def test_readings_that_fall_are_followed_within_the_leash(known, hear, moving, share: float) -> None:
    assert force_N(hear(known, 2.0, moving(force_N=share * MODEL_N)).believe) == pytest.approx(
        share * MODEL_N, abs=0.01
    )
    assert known.planned.limits == ()


@pytest.mark.parametrize(
    ("share", "end_N"), [(0.85, END_N), (0.75, END_N), (0.65, MODEL_N), (0.3, MODEL_N), (0.0, MODEL_N), (-1.0, MODEL_N)]
)
def test_readings_that_fall_further_are_followed_to_its_end_or_not_at_all_and_named(
    known, hear, moving, share: float, end_N: float
) -> None:
    for _ in range(5):
        assert force_N(hear(known, 1.0, moving(force_N=share * MODEL_N)).believe) > end_N - 0.01
    assert {Limit.DEVICE_OR_SENSOR, Limit.SENSOR} & set(known.planned.limits)


@pytest.mark.parametrize(("rate_mm_s", "less_N"), [(42.0, 0.0), (25.0, 0.02)], ids=["steady", "the model gives less"])
def test_readings_that_fade_are_followed_to_its_end_however_often_the_handle_turns(
    known, hear, moving, rate_mm_s: float, less_N: float
) -> None:
    named_N = None
    for turn in range(12):
        way = Turn(-1.0, 0.0, 100.0) if turn % 2 else Turn(1.0, 0.0, 100.0)
        for step in range(10):
            shown_N = MODEL_N * (1.0 - 0.002 * (10 * turn + step))
            hear(known, 0.2, moving(force_N=shown_N, handle=Handle(MOBILISED_MM, rate_mm_s, way, rate_mm_s)))
            if named_N is None and Limit.DEVICE_OR_SENSOR in known.planned.limits:
                named_N = shown_N
    assert force_N(known.believe) == pytest.approx(END_N, abs=0.01)
    assert named_N == pytest.approx(END_N - KNOWN_N - less_N, abs=0.01)


@pytest.mark.parametrize("seconds", [0.02, 0.1, 0.5])
def test_a_glitch_presses_no_more_than_noise_does(known, hear, moving, seconds: float) -> None:
    assert force_N(hear(known, seconds, moving(force_N=0.8 * MODEL_N)).believe) > MODEL_N - SLACK_N - 0.01
    assert force_N(hear(known, 0.5, moving()).believe) == pytest.approx(MODEL_N, abs=5e-3)


def test_readings_that_rise_are_followed_at_once(known, hear, moving) -> None:
    assert force_N(hear(known, 0.3, moving(force_N=1.4 * MODEL_N)).believe) == pytest.approx(1.4 * MODEL_N, abs=0.01)
    assert Limit.DEVICE_OR_SENSOR in known.planned.limits


def test_a_small_surprise_is_followed_as_soon_and_noise_is_none(known, hear, moving) -> None:
    assert force_N(hear(known, 0.15, moving(force_N=MODEL_N + 0.1)).believe) > MODEL_N + 0.08
    assert force_N(hear(known, 10.0, moving(), 0.01).believe) == pytest.approx(MODEL_N, abs=2e-3)


def test_readings_of_no_device_open_nothing_and_name_the_sensor(known, hear, moving) -> None:
    believe = hear(known, 2.0 * WRONG_S, moving(force_N=10.0 * MODEL_N)).believe
    assert Limit.SENSOR in known.planned.limits
    assert force_N(believe) == pytest.approx(MODEL_N, abs=0.03)
    assert hear(known, 3.0, moving(force_N=10.0 * MODEL_N)).planned.sensor_doubted_s > 2.9


@pytest.mark.parametrize("share", [0.0, 0.7, 1.3, 10.0])
def test_readings_that_come_back_end_it_and_the_device_is_what_it_was(known, hear, moving, share: float) -> None:
    hear(known, 0.2, moving(force_N=share * MODEL_N))
    believe = hear(known, 0.1 + (1.2 * DOUBTED_S if share in (0.0, 10.0) else 2.4 * NAMED_S), moving()).believe
    assert (known.planned.limits, believe.sensor.is_disputed) == ((), False)
    assert force_N(believe) == pytest.approx(MODEL_N, abs=5e-3)


def test_a_zero_that_a_reversal_tells_ends_it(known, hear, moving) -> None:
    hear(known, 1.0, moving(force_N=MODEL_N - 0.3))
    assert known.planned.limits == (Limit.DEVICE_OR_SENSOR,)
    hear(known, 1.0, moving(force_N=MODEL_N + 0.3, **NEW_WAY))
    assert (known.planned.limits, known.believe.zero.zero_N) == ((Limit.SENSOR_ZERO,), pytest.approx(-0.3, abs=0.02))


def test_a_reading_of_no_device_teaches_nothing_even_while_the_mean_is_one_of_a_device(known, hear, moving) -> None:
    for _ in range(5):
        hear(known, 0.004, moving(force_N=5.0 * MODEL_N))
        assert force_N(hear(known, 0.1, moving()).believe) == pytest.approx(MODEL_N, abs=0.01)


@pytest.mark.parametrize(("wrong", "share", "limits"), [("device", 0.75, ()), ("sensor", 1.0, (Limit.SENSOR,))])
def test_an_operator_says_whether_device_or_sensor_has_changed(
    known, hear, moving, wrong: str, share: float, limits: tuple[Limit, ...]
) -> None:
    hear(known, 1.0, moving(force_N=0.75 * MODEL_N))
    known.believe.confirm(wrong)
    hear(known, 0.5, moving(force_N=0.75 * MODEL_N))
    assert (force_N(known.believe), known.planned.limits) == (pytest.approx(share * MODEL_N, abs=0.02), limits)


def test_without_a_dispute_there_is_nothing_to_confirm(known) -> None:
    before = known.believe.device
    for wrong in ("sensor", "device"):
        known.believe.confirm(wrong)
    assert (known.believe.device, known.believe.sensor.is_doubted) == (before, False)


@pytest.mark.parametrize(("share", "is_learned"), [(0.65, True), (1.7, True), (0.3, False), (2.6, False)])
def test_a_device_that_has_not_slid_is_learned_within_the_bounds(
    planner, hear, moving, share: float, is_learned: bool
) -> None:
    assert (
        force_N(hear(planner, 1.0, moving(force_N=share * MODEL_N)).believe) == pytest.approx(share * MODEL_N, abs=0.03)
    ) is is_learned
    assert (Limit.SENSOR in planner.planned.limits) is not is_learned


@pytest.mark.parametrize(
    ("rounds", "learned"), [([(0.93, 4.0, 0.93)], 1.0), ([(0.99, 0.8, 1.0), (0.99, 4.0, 1.05)], 1.05)]
)
def test_at_a_new_force_what_has_fallen_at_a_known_one_has_fallen_and_what_is_more_is_learned(
    core, known, hear, moving, rounds, learned: float
) -> None:
    here_N = core.portrait.force_N_at(70.0)
    for share, seconds, share_here in rounds:
        hear(known, 2.0, moving(force_N=share * MODEL_N))
        known.believe.handle = HandleWatch()
        anchor = hear(known, seconds, moving(force_N=share_here * here_N, **CLOSER)).believe.sensor.anchor
    assert anchor.force_N(here_N) == pytest.approx(learned * here_N, abs=0.02)


@pytest.mark.parametrize(
    ("before_s", "share", "learned_N"), [(0.0, 0.96, -0.042), (0.8, 0.96, -0.028), (0.8, 1.04, 0.032)]
)
def test_a_calibration_is_learned_anew_at_once_and_then_less(
    planner, hear, moving, before_s: float, share: float, learned_N: float
) -> None:
    planner.believe.teach(Learned(DeviceFit(scale_variance=0.0, offset_variance_N2=0.0)))
    hear(planner, before_s, moving())
    anchor = hear(planner, 4.0, moving(force_N=share * MODEL_N)).believe.sensor.anchor
    assert anchor.force_N(MODEL_N) - MODEL_N == pytest.approx(learned_N, abs=6e-3)


@pytest.mark.parametrize(("seconds", "is_known"), [(4.0, True), (0.3, False)])
def test_at_a_new_force_the_device_may_be_another(core, known, hear, moving, seconds: float, is_known: bool) -> None:
    known.believe.handle = HandleWatch()  # the handle has gone on
    here_N = core.portrait.force_N_at(60.0)
    there = {**CLOSER, "gap_mm": 60.0}
    hear(known, seconds, moving(force_N=here_N - 0.1, **there))
    believe = hear(known, 0.3, moving(force_N=here_N - 0.4, **there)).believe
    assert believe.sensor.is_disputed
    assert (believe.device.force_N(here_N) > 0.92 * (here_N - 0.1) - SLACK_N - 0.02) or not is_known


def test_a_fit_that_swings_is_the_same_device_still(known, hear, moving) -> None:
    for swing in range(12):
        hear(known, 2.5, moving(force_N=MODEL_N + 0.07 * (-1) ** swing))
        assert not known.believe.sensor.is_disputed


@pytest.mark.parametrize("strength", [1.0, 1.5])
def test_the_ceiling_stands_on_what_the_device_first_showed(core, planner, hear, moving, strength: float) -> None:
    hear(planner, 4.0, moving(force_N=strength * MODEL_N))
    least_mm = planner.planned.min_gap_mm
    anchor = hear(planner, 5.0, moving(force_N=0.9 * strength * MODEL_N)).believe.sensor.anchor
    assert planner.planned.min_gap_mm == pytest.approx(least_mm, abs=0.3)
    sure_N = 2.15 + 2.0 * max(anchor.deviation_N(core.portrait.force_N_at(least_mm)) - 2.0 * KNOWN_N, 0.0)
    assert anchor.force_N(core.portrait.force_N_at(least_mm)) == pytest.approx(sure_N, abs=0.05)


def test_a_sensor_that_stands_still_is_wrong_only_where_it_should_not(known, hear, moving) -> None:
    assert Limit.SENSOR in hear(known, 2.0 * FROZEN_S, moving(), 0.0).planned.limits


def test_a_sensor_without_noise_may_stand_still_while_the_force_does(planner, hear, moving) -> None:
    assert Limit.SENSOR not in hear(planner, 5.0, moving(), 0.0).planned.limits
    planner.believe.handle = HandleWatch()
    assert Limit.SENSOR in hear(planner, 0.3, moving(**CLOSER), 0.0).planned.limits
