"""The whole Stepper: deterministic, what ends a run opens the device, no input asks for more than the whole duty."""

import math

import pytest

from firmware_protocol.codec import DeviceFault, DeviceMode, DriveMode, Switches
from tormagd.control.measure import BLIND_S, LEAP_MM
from tormagd.control.move.watch import STARTING_S
from tormagd.control.safety.codes import Fault, Limit
from tormagd.control.safety.operating_state import CLEARING_S, OperatingState
from tormagd.ground.plain_values import plain
from tormagd.hardware.measurement import DeviceRequest

PERIOD_S = 1e-3


def test_enabling_is_bumpless(running) -> None:
    running.step(60.0, count=50)
    running.command("disable")
    running.step(count=3)
    running.command("enable")
    assert [running.step().left_duty for _ in range(20)] == pytest.approx([0.0] * 20, abs=1e-9)
    assert running.move.left.integral == pytest.approx(0.0, abs=1e-12)


def test_enabling_wants_a_measurement(bench) -> None:
    refused = bench.refused("enable").code
    assert (refused, bench.stepper.safety.operating_state) == ("not_fresh", OperatingState.DISABLED)


@pytest.mark.parametrize("jump_mm", [0.0018, 0.05, 0.4, -0.4])
def test_counts_that_jump_and_come_back_do_no_harm(running, jump_mm: float) -> None:
    pushed = running.step(left_mm=-7.5 + jump_mm)
    if abs(jump_mm) < LEAP_MM:
        assert -1.0 <= pushed.left_duty * math.copysign(1.0, jump_mm) < 0.0
    else:
        assert (running.is_held, pushed.limits) == (True, (Limit.ENCODER,))
    settled = running.step(count=400)
    assert not running.faults
    assert max(abs(settled.left_duty), abs(running.move.left.integral)) < 0.05


@pytest.mark.parametrize("sides", [("left_mm",), ("right_mm",), ("left_mm", "right_mm")])
@pytest.mark.parametrize("jump_mm", [-120.0, -37.4, -4.0, 0.5, 1.5, 8.0])
def test_counts_that_jump_away_are_held_and_a_fault(running, sides: tuple[str, ...], jump_mm: float) -> None:
    jumped = dict.fromkeys(sides, -7.5 + jump_mm)
    output = running.step(**jumped, reported_s=0.0)
    assert (output.limits, running.is_held, running.faults) == ((Limit.ENCODER,), True, ()), "it may have been reset"
    assert running.run_into(Fault.ENCODER, **jumped) == 1
    assert running.stepper.safety.needs_homing


def test_counts_that_a_reset_sets_back_are_the_resets(running) -> None:
    running.step(count=round(STARTING_S / PERIOD_S))
    running.step(left_mm=0.0, right_mm=0.0, reported_s=running.now_s, count=10)
    assert not running.faults
    running.step(count=200, left_mm=0.0, right_mm=0.0, mode=DeviceMode.IDLE, switches=Switches(0))
    assert running.faults == (Fault.DEVICE_NOT_RUNNING,)


@pytest.mark.parametrize("speed_mm_s", [-19.0, 19.0])
@pytest.mark.parametrize("missing", [1, 5, 40])
def test_what_a_carriage_does_at_full_speed_is_no_leap(bench, speed_mm_s: float, missing: int) -> None:
    at_mm = -7.5
    for _ in range(10):
        bench.ticks += missing - 1
        at_mm = min(max(at_mm + missing * PERIOD_S * speed_mm_s, -24.0), 0.0)
        bench.step(left_mm=at_mm, right_mm=at_mm)
    assert (bench.stepper.measure.leap, bench.faults) == (None, ())


def test_after_an_encoder_fault_positions_are_unknown_until_the_device_has_homed(running) -> None:
    running.run_into(Fault.ENCODER, left_mm=-5.0)
    assert not running.stepper.measured.is_homed
    for name in ("clear-fault", "home"):
        running.command(name)
        running.step(count=5)
        assert (running.stepper.measured.is_homed, running.refused("enable").code) == (False, "not_homed")
    running.step(count=30, mode=DeviceMode.HOMING, switches=Switches.LEFT_OPEN | Switches.RIGHT_OPEN)
    assert not running.stepper.measured.is_homed
    running.step(count=2)
    assert running.stepper.measured.is_homed
    running.command("enable")
    assert running.step().mode is DriveMode.RUN


def test_homing_forgets_the_motion_before_it(bench) -> None:
    bench.step(count=5)
    for tick in range(5):
        bench.step(mode=DeviceMode.HOMING, left_mm=float(tick), right_mm=float(tick), switches=Switches(0))
    bench.step(left_mm=0.0, right_mm=0.0)
    # the origin jumped with the last homing state: one period's filtered jump is not carried further
    bench.step(left_mm=0.0, right_mm=0.0, mode=DeviceMode.RETRACTING)
    assert bench.stepper.measured.left_mm_s == 0.0


@pytest.mark.parametrize("names", [[], ["pause"]])
@pytest.mark.parametrize("is_between", [False, True], ids=["nothing measured", "between two steps"])
def test_a_lost_link_is_a_fault_while_driven(running, names: list[str], is_between: bool) -> None:
    for name in names:
        running.command(name)
    if is_between:
        running.stepper.lose_link()
    else:
        running.silent(None)
    safety, measured = running.stepper.safety, running.stepper.measured
    assert (safety.faults, safety.request, measured) == ((Fault.LINK_LOST,), DeviceRequest.RETRACT, None)
    running.stepper.lose_link()
    assert running.stepper.safety == safety
    running.step(count=5)
    assert running.opened_for == (Fault.LINK_LOST,)


def test_a_number_that_is_not_finite(running) -> None:
    running.step(math.nan)
    assert running.opened_for == (Fault.NOT_FINITE,)
    running.command("clear-fault")
    running.step(count=3)
    running.command("enable")
    running.step(79.0, count=10)
    assert all(math.isfinite(duty) for duty in running.driven[1:])


def test_a_cleared_fault_has_time_to_go_and_comes_back_if_it_stays(bench) -> None:
    broken = {"faults": DeviceFault.OVERCURRENT, "mode": DeviceMode.LATCHED, "left_mm": 0.0, "right_mm": 0.0}
    bench.step(**broken)
    bench.command("clear-fault", device_latched=True)
    assert (bench.step(**broken).request, bench.faults) == (DeviceRequest.CLEAR, ())
    assert bench.run_into(Fault.DEVICE_OVERCURRENT, **broken) * PERIOD_S == pytest.approx(CLEARING_S, abs=2e-3)


def test_a_latched_fault_asks_once_and_stays(running) -> None:
    running.run_into(Fault.DEVICE_SKEW, faults=DeviceFault.SKEW, mode=DeviceMode.RETRACTING)
    number = running.output.request_number
    assert running.step(faults=DeviceFault.SKEW, mode=DeviceMode.LATCHED, count=100).request_number == number
    running.step(count=100)
    assert running.opened_for == (Fault.DEVICE_SKEW,)


@pytest.fixture
def make_moving(make_bench):
    def make():
        moving = make_bench().enabled()
        for _ in range(10):
            moving.step(60.0, **moving.there)
        return moving

    return make


@pytest.mark.parametrize(("elapsed_s", "periods"), [(0.0, 1.0), (-1e-3, 1.0), (-1e6, 1.0), (2e-3, 2.1)])
def test_a_period_is_as_long_as_it_was_and_an_ordinary_one_where_the_clock_stands_still(
    make_moving, elapsed_s: float, periods: float
) -> None:
    moved_mm = []
    for after_s in (PERIOD_S, elapsed_s):
        moving = make_moving()
        before_mm, later_s = moving.move.reference.gap_mm, moving.now_s + after_s
        moving.at(later_s, moving.measure(moving.ticks + 1, received_s=later_s, **moving.there), 60.0)
        moved_mm.append(moving.move.reference.gap_mm - before_mm)
    assert moved_mm[0] < -0.01
    assert moved_mm[1] == pytest.approx(periods * moved_mm[0], rel=0.05)


@pytest.mark.parametrize("elapsed_s", [BLIND_S + 1e-4, 0.011, 0.048, 1.0, 1e9])
@pytest.mark.parametrize(
    "has_more", [False, True], ids=["nothing came", "what came before the stall was read after it"]
)
def test_after_a_stall_one_drive_asks_and_moves_nothing(make_moving, elapsed_s: float, has_more: bool) -> None:
    moving = make_moving()
    move, watch, later_s = plain(moving.move), moving.watch, moving.now_s + elapsed_s
    times_s = (watch.still_s, watch.straying_s)
    received_s = later_s if has_more else moving.now_s
    old = moving.measure(moving.ticks + has_more, received_s=received_s, **moving.there)
    assert (moving.at(later_s, old, 60.0).limits, moving.is_held, moving.faults, plain(moving.move)) == (
        (Limit.HOST_STALL,),
        True,
        (),
        move,
    )
    assert (watch.still_s, watch.straying_s) == times_s
    assert moving.stepper.measure.sight.stall_s == pytest.approx(elapsed_s)


@pytest.mark.parametrize("came_mm", [0.0, -1.7, 1.0])
def test_the_answer_to_it_is_gone_on_from_without_a_kick(make_moving, came_mm: float) -> None:
    moving = make_moving()
    # carriages that are at once where they are wanted pass for lively, and those are braked harder
    moving.move.acceleration_scale = 1.0
    integral, came_mm = moving.move.left.integral, moving.move.reference.gap_mm + came_mm
    for number, at_s in enumerate((moving.now_s + 0.045, moving.now_s + 0.046), moving.ticks):
        answer = moving.measure(number, received_s=at_s, device_time_s=at_s, **moving.gap(came_mm))
        output = moving.at(at_s, answer, came_mm)
    assert (moving.faults, moving.move.reference.gap_mm) == ((), pytest.approx(came_mm, abs=0.1))
    assert abs(output.left_duty) < 0.6
    assert moving.move.left.integral == pytest.approx(integral, abs=0.02)
    assert Limit.HOST_STALL in output.limits


def test_a_slow_loop_takes_no_period_of_its_own_for_a_stall(make_bench) -> None:
    bench = make_bench(rates={"control_hz": 100, "telemetry_hz": 50, "inference_hz": 100})
    for tick in range(1, 8):
        output = bench.at(0.01 * tick, bench.measure(tick, received_s=0.01 * tick), 79.0)
        if tick == 3:
            bench.command("enable")
    assert output.left_duty < 0.0
    assert Limit.HOST_STALL not in output.limits
    assert bench.at(bench.now_s + 0.06, bench.measure(tick), 79.0).limits == (Limit.HOST_STALL,)


def test_a_silent_device_is_held_where_it_is_and_named(running) -> None:
    running.step(79.0, count=10)
    newest, integral = running.measure(running.ticks), running.move.left.integral
    running.silent(newest, count=round(BLIND_S / PERIOD_S) + 1)
    held = plain(running.move)
    assert {(running.silent(newest).limits, running.is_held) for _ in range(30)} == {((Limit.DEVICE_SILENT,), True)}
    assert plain(running.move) == held
    assert abs(running.move.left.integral - integral) < 0.05
    back = running.step()
    assert Limit.DEVICE_SILENT not in back.limits
    assert abs(back.left_duty) < 0.2
    assert not running.faults


@pytest.mark.parametrize(("stall_ms", "fault"), [(83, Fault.HOST_STALL), (36, Fault.DEVICE_COMMAND_TIMEOUT)])
def test_a_device_that_opened_because_of_a_stall_is_told_as_that(running, stall_ms: int, fault: Fault) -> None:
    running.ticks += stall_ms
    running.step(count=16)
    assert not running.faults
    opened = {"faults": DeviceFault.COMMAND_TIMEOUT, "mode": DeviceMode.RETRACTING}
    assert running.run_into(fault, **opened) == 1
    running.step(count=300, **opened | {"mode": DeviceMode.LATCHED})
    assert running.opened_for == (fault,)
