"""What may teach which estimator, and what of it the next plans are made with."""

import math

import msgspec
import pytest

from tormagd.control.believe.believe import AHEAD_S, NOTHING_LEARNED, UNTARED_N, Learned
from tormagd.control.believe.carriage_lag import AGE_S, MAX_LAG_S
from tormagd.control.believe.handle import BRISTLES_N_MM
from tormagd.control.believe.sensor_zero import MAX_SD_N, UNKNOWN_SD_N
from tormagd.control.believe.strength import DeviceFit
from tormagd.control.core import Planner
from tormagd.control.records import Handle, TimedSetpoint
from tormagd.control.safety.codes import Limit
from tormagd.element.model.displacement import MOBILISED_MM, MOVING_MM_S, Turn
from tormagd.element.physics.friction import Friction
from tormagd.ground.plain_values import plain, restore
from tormagd.record.stream import KNOWN

PERIOD_S = 0.004
TURN = Turn(1.0, 0.0, 100.0)
RESTING = {"handle": Handle(MOBILISED_MM, 0.0, TURN, 42.0)}
CREEPING = {"handle": Handle(MOBILISED_MM, 1.0, TURN, 1.0)}


def test_the_device_is_learned_from_measured_over_predicted_force(core, hear, moving) -> None:
    plan = hear(core.planner(), 8.0, moving(force_N=1.2 * 1.08)).planned
    assert (plan.predicted_N, plan.trim) == (pytest.approx(1.2 * 1.08, rel=0.01), pytest.approx(1.2, rel=0.02))
    assert Limit.TRIM not in plan.limits
    # a model that is too low in force is corrected by a wider gap
    assert plan.gap_mm > hear(core.planner(), 8.0, moving()).planned.gap_mm + 3.0


def test_what_friction_has_not_followed_yet_is_no_weak_device(core, hear, planned, moving) -> None:
    planner, friction = hear(core.planner(), 2.0, moving(sensed_s=0.0)), Friction(BRISTLES_N_MM, 0.0, 1.0, 1.0)
    known, bent_mm = planner.believe.device, 1.0871 / BRISTLES_N_MM
    for step in range(1, 60):
        gap_mm, at_mm = 78.1 - 0.5 * step, 100.0 + 42.0 * PERIOD_S * step
        force_N, bent_mm = friction.advance(bent_mm, 42.0, core.portrait.force_N_at(gap_mm), PERIOD_S)
        there = {"handle_mm": at_mm, "handle": Handle(MOBILISED_MM, 42.0, Turn(1.0, 0.0, at_mm), 42.0)}
        planned(planner, 1.0, moving(gap_mm, force_N, sensed_s=planner.planned.time_s + PERIOD_S, **there))
    assert planner.believe.device.force_N(3.0) == pytest.approx(known.force_N(3.0), abs=0.02)


@pytest.mark.parametrize("is_known", [True, False])
def test_a_force_is_a_pull_only_where_the_sensors_zero_is_known(planner, planned, moving, is_known: bool) -> None:
    if not is_known:
        planner.believe.zero.variance_N2 = MAX_SD_N**2
    planned(planner, 1.0, moving(force_N=-0.15, **RESTING))
    assert planner.way.travel.is_pushing is not is_known


def test_a_ripple_is_asked_for_where_the_handle_will_be(core, hear, moving) -> None:
    believe = hear(core.planner(), 2.0, moving()).believe
    believe.ripple.shares = [0.1 * math.sin(0.1 * place) for place in range(len(believe.ripple.shares))]
    belief, there_mm = believe.update(2.0, moving()), moving().handle_mm + 42.0 * AHEAD_S
    assert belief.device.scale / belief.at_speed.scale == pytest.approx(1.0 + believe.ripple.share(there_mm / 20.0))


@pytest.mark.parametrize("static", [0.95, 1.12])
def test_a_reading_just_above_a_creep_teaches_the_force_there(planner, hear, moving, static: float) -> None:
    planner.believe.teach(Learned(slow_factor=static, slow_learned=1.0))
    plan = hear(planner, 8.0, moving(force_N=0.9 * 1.0871, handle=Handle(MOBILISED_MM, 6.0, TURN, 6.0))).planned
    assert plan.predicted_N == pytest.approx(0.9 * 1.0871, abs=6e-3)


@pytest.mark.parametrize(
    "changes",
    [
        None,
        {"is_homed": False},
        {"handle": Handle(MOBILISED_MM - 0.01, 42.0, TURN)},
        {"handle": Handle(MOBILISED_MM, MOVING_MM_S - 0.01, TURN)},
        {"handle": Handle(MOBILISED_MM, 0.0, TURN)},
        {"sensed_s": -1.0},
        {"handle_mm": 99.9},
    ],
    ids=["no measurement", "not homed", "not mobilised", "too slow", "at rest", "an old force", "turning back"],
)
def test_what_teaches_nothing_leaves_the_device_as_it_is(planner, planned, moving, changes) -> None:
    known = DeviceFit(scale=1.1, scale_variance=1e-4)
    planner.believe.teach(Learned(known))
    for _ in range(20):
        planned(planner, 1.0, None if changes is None else moving(force_N=1.4, **changes))
    assert planner.believe.device == known


def test_without_learning_no_reading_teaches_and_the_sensor_is_judged_all_the_same(planner, hear, moving) -> None:
    learned = Learned(DeviceFit(1.1, 0.02, 1e-4), 1.05, 0.5, 0.01, 0.02)
    planner.believe.teach(learned)
    planner.believe.learns = False
    back = Handle(MOBILISED_MM, -42.0, Turn(-1.0, 0.0, 100.0), 42.0)
    for changes in ({}, {"handle": back}, CREEPING):
        hear(planner, 0.4, moving(force_N=1.4, **changes))
    assert planner.believe.learned() == learned
    assert Limit.SENSOR in hear(planner, 0.4, moving(force_N=9.0)).planned.limits
    assert not planner.believe.knows_zero(planner.planned.time_s)


@pytest.mark.parametrize(
    ("rate_mm_s", "sliding_mm_s", "teaches"),
    [(2.0, 5.9, True), (2.1, 6.1, False), (1.0, 2.9, True), (1.0, 3.5, False), (0.2, 0.2, False)],
    ids=["slow", "was faster", "slower", "comes to rest", "may stand"],
)
def test_a_creep_is_a_handle_that_is_slow_and_has_been(
    planner, hear, moving, rate_mm_s: float, sliding_mm_s: float, teaches: bool
) -> None:
    handle = Handle(MOBILISED_MM, rate_mm_s, TURN, sliding_mm_s)
    assert (hear(planner, 0.2, moving(force_N=1.4, handle=handle)).believe.slow.factor != 1.0) is teaches


@pytest.mark.parametrize(("force_N", "teaches"), [(0.8, False), (1.4, True)])
def test_before_it_is_mobilised_only_more_force_than_expected_teaches(
    planner, hear, moving, force_N: float, teaches: bool
) -> None:
    slow = hear(planner, 0.2, moving(force_N=force_N, handle=Handle(MOBILISED_MM - 0.01, 1.0, TURN, 1.0))).believe.slow
    assert (slow.learned > 0.0, slow.factor > 1.0) == (teaches, teaches)


@pytest.mark.parametrize("goes_on", [False, True])
def test_a_handle_that_has_stopped_teaches_nothing_of_a_gap_that_goes_on(
    planner, hear, planned, moving, goes_on: bool
) -> None:
    devices = []
    hear(planner, 2.0, moving(sensed_s=0.0))
    for number in range(20):
        now_s = planner.planned.time_s + PERIOD_S
        at_mm, gap_mm = 100.0 + 5.0 * PERIOD_S * number * goes_on, 78.1 - 0.3 * number
        slower = Handle(MOBILISED_MM, 5.0, Turn(1.0, 0.0, at_mm), 42.0)
        read_N = 1.0871 + 1e-3 * number
        planned(planner, 1.0, moving(gap_mm, read_N, sensed_s=now_s, handle_mm=at_mm, handle=slower))
        devices.append(planner.believe.device)
    assert (devices[10] == devices[-1]) is not goes_on


def test_one_reading_teaches_once(planner, planned, moving) -> None:
    planned(planner, 1.0, moving(force_N=1.4))
    known = planner.believe.device
    planner.plan(2.0 * PERIOD_S, None, moving(force_N=1.4, number=planner.believe.read))
    assert planner.believe.device == known != DeviceFit()


def test_what_a_creep_shows_is_learned_of_the_creep_alone_and_what_speed_shows_of_the_device(
    core, hear, moving
) -> None:
    crept = hear(core.planner(), 1.0, moving(force_N=1.4, **CREEPING)).believe
    assert crept.slow.factor > 1.05
    assert crept.device == DeviceFit()
    sped = hear(core.planner(), 1.0, moving(force_N=1.4)).believe
    assert sped.device.scale > 1.05
    assert (sped.slow.factor, sped.slow.learned) == (1.0, 0.0)


def test_of_a_sensor_whose_zero_nothing_told_for_long_nothing_is_learned(planner, hear, moving) -> None:
    planner.believe.zero.variance_N2 = (1.01 * UNKNOWN_SD_N) ** 2
    hear(planner, 0.2, moving(force_N=1.2))
    hear(planner, 0.2, moving(force_N=1.2, **CREEPING))
    assert planner.believe.learned() == NOTHING_LEARNED
    assert Limit.OFFSET_UNKNOWN in planner.planned.limits


def test_a_scene_that_tolerates_more_goes_on_learning(core, hear, moving) -> None:
    force = msgspec.structs.replace(core.scene.force, tolerance_rms_N=0.17)
    planner = core._replace(scene=msgspec.structs.replace(core.scene, force=force)).planner()
    planner.believe.zero.variance_N2 = (1.01 * UNKNOWN_SD_N) ** 2
    assert hear(planner, 0.2, moving(force_N=1.2)).believe.learned() != NOTHING_LEARNED
    assert Limit.OFFSET_UNKNOWN not in planner.planned.limits
    planner.believe.zero.variance_N2 = 0.18**2
    assert Limit.OFFSET_UNKNOWN in hear(planner, 0.2, moving(force_N=1.2)).planned.limits


def test_what_its_zero_is_off_by_is_no_part_of_what_a_sensor_teaches_and_is_said(planner, hear, moving) -> None:
    planner.believe.teach(Learned(sensor_zero_N=1.1 * UNTARED_N))
    plan = hear(planner, 1.0, moving(force_N=1.0871 + 1.1 * UNTARED_N)).planned
    assert plan.trim == pytest.approx(1.0, abs=0.01)
    assert Limit.SENSOR_ZERO in plan.limits


def test_what_its_zero_is_off_by_is_no_friction_at_a_creep(core, planner, hear, moving) -> None:
    right = hear(core.planner(), 0.5, moving(force_N=1.3, **CREEPING)).believe.slow.factor
    planner.believe.teach(Learned(sensor_zero_N=0.1))
    assert hear(planner, 0.5, moving(force_N=1.4, **CREEPING)).believe.slow.factor == pytest.approx(right)
    assert right != 1.0


def test_a_device_that_has_shown_nothing_is_taken_for_a_strong_one(core, hear, planned, moving) -> None:
    new = planned(core.planner(), 2.0, moving(**RESTING))
    assert Limit.CEILING in new.limits
    assert new.gap_mm == new.min_gap_mm
    known = planned(hear(core.planner(), 2.0, moving()), 2.0, moving(**RESTING))
    assert Limit.CEILING not in known.limits
    assert known.gap_mm < new.gap_mm - 0.5


@pytest.mark.parametrize(
    "changes",
    [{"is_homed": False}, {"handle": Handle(MOBILISED_MM - 0.01, 42.0, TURN)}],
    ids=["unhomed", "unmobilised"],
)
def test_what_a_force_says_before_homing_and_before_break_away_is_not_predicted(core, planned, moving, changes) -> None:
    assert planned(core.planner(), 1.0, moving(**changes)).predicted_N is None
    assert planned(core.planner(), 1.0, moving()).predicted_N is not None


@pytest.mark.parametrize(
    ("changes", "is_doubted"),
    [(RESTING, False), ({}, False), ({"force_N": 20.0}, True)],
    ids=["at rest", "sliding", "a sensor that is not believed"],
)
def test_what_is_known_of_the_lag_outlasts_what_the_sensor_teaches(planner, hear, moving, changes, is_doubted) -> None:
    planner.believe.teach(Learned(lag_s=0.02))
    believed = hear(planner, 1.2, moving(**changes)).believe
    assert (believed.sensor.is_doubted, believed.read, believed.carriages.lag_s) == (is_doubted, 299, 0.02)


@pytest.fixture
def swing(core, moving):
    """A planner after a swing that the gap follows too late, and a handle that rests and teaches nothing."""
    gap_mm_at = core.portrait.gap_mm_at

    def swung(late_s: float, *, is_known: bool, seconds: float = 10.0, learns: bool = True) -> Planner:
        # late carriages are only sent along swings that they can follow
        planner, swings_Hz = core.planner(), 1.0 if is_known else 2.0
        planner.believe.learns = learns

        def force_N(time_s: float) -> float:
            return 1.5 + 0.1 * math.sin(2.0 * math.pi * swings_Hz * time_s)

        for tick in range(1, round(seconds / PERIOD_S)):
            now_s = tick * PERIOD_S
            come_s = now_s - AGE_S - late_s + planner.believe.carriages.lag_s
            gap_mm = gap_mm_at(force_N(come_s))
            side_mm_s = (gap_mm - gap_mm_at(force_N(come_s - 1e-3))) / 2e-3
            ahead_N = tuple(force_N(now_s + 2e-3 * k) for k in range(1, 40)) if is_known else ()
            setpoint = TimedSetpoint(force_N(now_s), now_s, 0.1, preview_N=ahead_N, preview_dt_s=2e-3)
            planner.plan(now_s, setpoint, moving(gap_mm, left_mm_s=side_mm_s, right_mm_s=side_mm_s, **RESTING))
            planner.governor.foresee()
        return planner

    return swung


@pytest.mark.long
@pytest.mark.parametrize(("late_s", "learned_s"), [(0.015, 0.017), (0.0, 0.002), (-0.01, 0.0), (0.06, MAX_LAG_S)])
def test_a_lag_is_learned_where_what_comes_is_known(swing, late_s: float, learned_s: float) -> None:
    assert swing(late_s, is_known=True).believe.carriages.lag_s == pytest.approx(learned_s, abs=1e-3)
    assert swing(late_s, is_known=True, seconds=1.0, learns=False).believe.carriages.lag_s == 0.0


@pytest.mark.long
def test_without_a_preview_a_lag_is_learned_once_the_swing_is_foreseen(swing) -> None:
    early = swing(0.015, is_known=False, seconds=1.0)
    assert (early.planned.foresight, early.believe.carriages.lag_s) == (0.0, 0.0)
    late = swing(0.015, is_known=False, seconds=20.0)
    assert late.planned.foresight > 0.9
    assert late.believe.carriages.lag_s == pytest.approx(0.015, abs=2e-3)


def test_what_is_taught_is_known_until_it_begins_afresh(planner) -> None:
    learned = Learned(DeviceFit(1.1, 0.02, 1e-4), 1.05, 0.5, 0.01, 0.02)
    planner.believe.teach(learned)
    assert planner.believe.learned() == learned
    planner.afresh(3.0)
    assert planner.believe.learned() == NOTHING_LEARNED
    assert (planner.planned.number, planner.planned.gap_mm, planner.planned.time_s) == (1, 95.0, 3.0)


@pytest.mark.long
def test_a_replay_and_what_is_read_back_plan_the_same(core, swing, planned, moving) -> None:
    first, again = (swing(0.015, is_known=False, seconds=3.0) for _ in range(2))
    assert first.planned.foresight > 0.0
    assert plain(first) == plain(again)
    read = core.planner()
    restore(read, plain(first), KNOWN)
    assert planned(read, 1.3, moving()) == planned(first, 1.3, moving())
    assert plain(read) == plain(first) != plain(again)
