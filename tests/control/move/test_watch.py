"""What is watched: every failure of a run ends it in time, and what a device may do does not."""

import msgspec
import pytest

from firmware_protocol.codec import DeviceFault, DeviceMode, Switches
from tormagd.config import Config
from tormagd.control.measure import UNSENSED_S
from tormagd.control.move.watch import SENSE_FAULT_S, STARTING_S, STATUS_FAULT_S
from tormagd.control.safety.codes import Fault, Limit
from tormagd.hardware.link_statistics import LinkQuality

PERIOD_S = 1e-3
CONFIG = Config()
TIMEOUT_S = CONFIG.device.measurement_timeout_ms * 1e-3


@pytest.mark.parametrize("bit", DeviceFault)
def test_a_fault_of_the_device_is_ours_while_disabled_too(running, make_bench, bit: DeviceFault) -> None:
    for bench in (running, make_bench()):
        assert bench.run_into(Fault(f"DEVICE_{bit.name}"), faults=bit, mode=DeviceMode.RETRACTING) == 1


@pytest.mark.parametrize(
    ("fault", "borne", "wrong"),
    [
        *(
            (Fault.DEVICE_NOT_RUNNING, {}, {"mode": mode})
            for mode in (DeviceMode.IDLE, DeviceMode.LATCHED, DeviceMode.HOMING, DeviceMode.RETRACTING)
        ),
        # a slow line
        (Fault.MEASUREMENT_STALE, {"delay_s": TIMEOUT_S - 1e-3}, {"delay_s": TIMEOUT_S + 1e-3}),
    ],
)
def test_a_device_that_stopped_running_or_answers_late(running, fault: Fault, borne: dict, wrong: dict) -> None:
    running.step(count=round(STARTING_S / PERIOD_S), **borne)
    assert not running.faults
    assert running.run_into(fault, **wrong) == 1


def test_a_device_may_take_a_moment_to_start(bench) -> None:
    bench.enabled(mode=DeviceMode.IDLE)
    bench.step(count=round(STARTING_S / PERIOD_S) - 1, mode=DeviceMode.IDLE)
    assert not bench.faults
    assert bench.run_into(Fault.DEVICE_NOT_RUNNING, mode=DeviceMode.IDLE) <= 3


@pytest.mark.parametrize(
    ("stream", "fault", "longest_s", "limits"),
    [
        ("sensed_s", Fault.SENSE_STALE, SENSE_FAULT_S, (Limit.SENSE_STALE,)),
        ("reported_s", Fault.STATUS_STALE, STATUS_FAULT_S, ()),
    ],
)
def test_a_stream_that_stops_is_a_fault_and_a_sense_first_a_limit(
    running, stream: str, fault: Fault, longest_s: float, limits: tuple[Limit, ...]
) -> None:
    running.step(count=200)
    last_s = running.now_s
    assert running.step(count=round(UNSENSED_S / PERIOD_S), **{stream: last_s}).limits == ()
    assert running.step(count=2, **{stream: last_s}).limits == limits
    running.run_into(fault, **{stream: last_s})
    assert running.now_s - last_s == pytest.approx(longest_s, abs=0.5 * PERIOD_S)


def test_a_scene_that_does_without_the_sensor_does_without_its_messages(core, make_bench) -> None:
    force = msgspec.structs.replace(core.scene.force, tolerance_rms_N=0.5 * core.scene.force.most_N)
    bench = make_bench(msgspec.structs.replace(core.scene, force=force)).enabled()
    bench.step(count=200)
    assert (bench.step(count=500, sensed_s=bench.now_s).limits, bench.faults) == ((Limit.SENSE_STALE,), ())


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_skew(running, side: float) -> None:
    def apart(skew_mm: float) -> dict[str, float]:
        return {"left_mm": -7.5 + side * skew_mm / 2.0, "right_mm": -7.5 - side * skew_mm / 2.0}

    allowed_mm = CONFIG.limits.skew_fault_mm
    for part in (*range(1, 41), *[40] * 20, 39.7, 39.3, 39.0, *[38.7] * 20):
        running.step(**apart(0.98 * allowed_mm * part / 40.0))
    assert not running.faults
    assert running.run_into(Fault.SKEW, **apart(1.02 * allowed_mm)) == 1


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_carriages_that_are_too_far_apart_are_not_enabled(bench, side: float) -> None:
    half_mm = side * CONFIG.limits.skew_fault_mm / 2.0
    bench.step(left_mm=-7.5 + 1.01 * half_mm, right_mm=-7.5 - 1.01 * half_mm)
    assert "1.01 mm apart: allowed is at most 1 mm" in str(bench.refused("enable"))
    bench.step(left_mm=-7.5 + 0.99 * half_mm, right_mm=-7.5 - 0.99 * half_mm)
    bench.command("enable")


@pytest.mark.parametrize("gap_mm", [-64.0, -40.0, -5.0, 0.0, 30.0, 100.5, 140.0])
def test_carriages_where_none_can_be_are_a_fault_before_anything_is_driven(bench, gap_mm: float) -> None:
    bench.step(count=20, switches=Switches.HOMED | Switches.LEFT_OPEN | Switches.RIGHT_OPEN, **bench.gap(99.5))
    assert not bench.faults, "an open switch may be overrun by a little"
    bench.stepper.lose_link()
    assert bench.run_into(Fault.OUT_OF_STROKE, **bench.gap(gap_mm)) == 1
    assert bench.stepper.safety.needs_homing


@pytest.mark.parametrize("side", ["LEFT", "RIGHT"])
@pytest.mark.parametrize(
    ("switch", "borne_mm", "wrong_mm"),
    [
        ("OPEN", -0.35, -0.45),
        ("", 0.35, 0.45),  # the open switch is dead, or the zero has shifted
        ("CLOSED", -24.0 - 0.05, -24.0 + 0.05),
    ],
)
def test_a_switch_that_its_carriage_contradicts_is_a_fault(
    bench, side: str, switch: str, borne_mm: float, wrong_mm: float
) -> None:
    other_mm = f"{'right' if side == 'LEFT' else 'left'}_mm"
    mm, switches = f"{side.lower()}_mm", Switches.HOMED | (Switches[f"{side}_{switch}"] if switch else Switches(0))
    bench.step(count=50, switches=switches, **{mm: borne_mm, other_mm: -20.0})
    assert not bench.faults
    # a carriage that moves is at another place by the next Status
    assert 1 < bench.run_into(Fault.OUT_OF_STROKE, switches=switches, **{mm: wrong_mm, other_mm: -20.0}) <= 20


def test_a_switch_that_is_newer_than_the_position_says_nothing(running) -> None:
    last = running.ticks
    running.silent(running.measure(last), 8)
    assert running.stepper.measure.sight.is_blind
    open_now = Switches.HOMED | Switches.RIGHT_OPEN
    running.silent(running.measure(last, switches=open_now, reported_s=running.now_s), 20)
    assert not running.faults


def test_a_gap_that_does_not_follow(make_bench) -> None:
    bench = make_bench(limits={"no_motion_time_s": 10.0}).enabled()
    while bench.watch.straying_s == 0.0:
        bench.step(50.0)
        assert bench.ticks < 1_000
    assert bench.run_into(Fault.FOLLOWING_ERROR, 50.0) * PERIOD_S == pytest.approx(
        CONFIG.limits.following_time_s, abs=2.5e-3
    )


def test_following_again_in_time_is_no_fault(running) -> None:
    away_mm = [80.0 - 3.5 * part / 16.0 for part in range(1, 17)]
    for _ in range(3):
        for gap_mm in (*away_mm, *[away_mm[-1]] * 20, *reversed(away_mm)):
            running.step(**running.gap(gap_mm))
        running.step(count=20)
    assert not running.faults


def test_a_carriage_that_is_driven_and_does_not_move(running) -> None:
    assert running.run_into(Fault.NO_MOTION, 60.0) * PERIOD_S < 0.25


@pytest.mark.parametrize("switch", [Switches.LEFT_OPEN, Switches.RIGHT_OPEN])
def test_one_carriage_at_its_switch_excuses_no_other(bench, switch: Switches) -> None:
    at_end = bench.gap(94.4)
    bench.enabled(**at_end)
    bench.run_into(Fault.NO_MOTION, 95.0, **at_end, switches=Switches.HOMED | switch)


def test_a_process_that_stood_still_saw_no_carriage_stand_still(running) -> None:
    running.step(60.0, count=30)
    assert running.watch.still_s > 0.0
    running.ticks += round(CONFIG.limits.no_motion_time_s / PERIOD_S)
    running.step(60.0, count=2)
    assert not running.faults


@pytest.mark.parametrize("target_mm", [60.0, 90.0])
def test_carriages_that_go_the_other_way_are_named(running, target_mm: float) -> None:
    at_mm = -7.5
    while not running.faults:
        output = running.step(target_mm, left_mm=at_mm, right_mm=at_mm)
        at_mm -= 15.0 * output.left_duty * PERIOD_S
        assert running.ticks < 300
    assert (running.opened_for[0], running.stepper.safety.needs_homing) == (Fault.WRONG_DIRECTION, True)
    assert abs(at_mm + 7.5) < 2.5


def test_a_carriage_that_goes_the_other_way_into_its_stop_is_named(running) -> None:
    at_mm = -7.5
    while not running.faults:
        running.step(60.0, left_mm=at_mm, right_mm=at_mm)
        at_mm = min(at_mm + 0.015, -7.0)
        assert running.ticks < 300
    assert running.faults in ((Fault.WRONG_DIRECTION,), (Fault.WRONG_DIRECTION, Fault.NO_MOTION))


@pytest.mark.parametrize("given", [(), ("pause",)])
def test_too_much_force_opens_and_is_then_a_fault(running, given: tuple[str, ...]) -> None:
    for command in given:
        running.command(command)
    limits = [running.step(force_N=3.0, **running.there).limits for _ in range(95)]
    assert [Limit.OVER_FORCE in limits[tick] for tick in (25, 35)] == [False, True]
    assert running.move.reference.gap_mm > 80.5
    assert running.run_into(Fault.OVER_FORCE, force_N=3.0, **running.there) < 20


def test_a_force_that_is_too_much_again_and_again_is_a_fault(running) -> None:
    for tick in range(240):
        limits = running.step(force_N=3.0 if tick % 120 < 60 else 1.0, **running.there).limits
        if running.faults:
            break
        assert Limit.OVER_FORCE not in limits or tick % 120 <= 60
    assert running.faults == (Fault.OVER_FORCE,)


@pytest.mark.parametrize(
    ("link", "limits"),
    [
        (LinkQuality(), ()),
        (LinkQuality(unanswered=0.019, damaged=0.019, unsent=0.019, round_trip_s=5e-3, clock_drift=0.0099), ()),
        (LinkQuality(unanswered=0.021), (Limit.LINK_DEGRADED,)),
        (LinkQuality(damaged=0.021), (Limit.LINK_DEGRADED,)),
        (LinkQuality(unsent=0.021), (Limit.LINK_DEGRADED,)),
        (LinkQuality(round_trip_s=7e-3), (Limit.LINK_DEGRADED,)),
        (LinkQuality(clock_drift=0.011), (Limit.CLOCK,)),
        (LinkQuality(clock_drift=-0.011), (Limit.CLOCK,)),
    ],
)
def test_a_wire_or_a_clock_that_is_not_what_it_should_be_is_a_limit(running, link: LinkQuality, limits) -> None:
    assert (running.step(count=50, link=link).limits, running.faults) == (limits, ())


@pytest.mark.parametrize(
    ("link", "fault", "code"),
    [
        (LinkQuality(round_trip_s=0.012), Fault.LINK_DEGRADED, "link_degraded"),
        (LinkQuality(clock_drift=0.11), Fault.CLOCK, "clock"),
        (LinkQuality(clock_drift=-1.0), Fault.CLOCK, "clock"),
    ],
)
def test_what_would_swing_is_opened_and_not_enabled_in_the_first_place(
    bench, link: LinkQuality, fault: Fault, code: str
) -> None:
    bench.step(count=3)
    refusal = bench.refused("enable", round_trip_s=link.round_trip_s, clock_drift=link.clock_drift)
    assert (refusal.code, "allowed is" in str(refusal)) == (code, True)
    bench.command("enable")
    bench.step(count=20)
    assert bench.run_into(fault, link=link) == 1
