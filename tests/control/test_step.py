"""`step`: deterministic, every way a run can fail ends it, and no input whatever asks for more than the whole duty."""

import math

import msgspec
import pytest
from hypothesis import given, settings, strategies as st

from firmware_protocol.codec import DeviceFault, DeviceMode, DriveMode, Switches
from tormagd.config import Config
from tormagd.control.core import Core
from tormagd.control.estimate import Estimate
from tormagd.control.motor import delay_margin_s, electrical_time_s
from tormagd.control.plan import Plan
from tormagd.control.plausible import LEAP_MM
from tormagd.control.sight import BLIND_S, UNSENSED_S
from tormagd.control.step import (
    CARRY_S,
    EXCHANGE_S,
    NEVER,
    SENSE_FAULT_S,
    SENSOR_FAULT_S,
    STARTING_S,
    STATUS_FAULT_S,
    Acted,
    StepOutput,
    Stepper,
    StepState,
)
from tormagd.control.trajectory import APPROACH_S, Reference
from tormagd.hardware.link_quality import LinkQuality
from tormagd.hardware.measurement import Measurement
from tormagd.safety.codes import Fault, Limit
from tormagd.safety.operating_state import CLEARING_S, Conditions, DeviceRequest, OperatingState, RefusedError

PERIOD_S = 1e-3
CONFIG = Config()
READY = Conditions(
    connected=True, fresh=True, homed=True, busy=False, device_latched=False, requested_N=None, neutral_N=0.5
)
OFF = (DriveMode.OFF, 0.0, 0.0)


def gap_plan(gap_mm: float, time_s: float = 0.0, gap_speed_mm_s: float = 0.0) -> Plan:
    """A plan for a gap."""
    return Plan(1, time_s, None, None, 0.0, None, 0.0, gap_mm, gap_speed_mm_s, 1.0, ())


class Bench:
    """A stepper fed with described measurements, a millisecond apart."""

    def __init__(self, stepper: Stepper, measure) -> None:
        self._stepper, self._measure = stepper, measure
        self.state = stepper.start(0.0)
        self.ticks = 0
        self.output = StepOutput(*OFF, DeviceRequest.NONE, 0, ())

    @property
    def now_s(self) -> float:
        return self.ticks * PERIOD_S

    @property
    def reference(self) -> Reference:
        """Where the gap is led."""
        assert self.state.reference is not None
        return self.state.reference

    @property
    def estimate(self) -> Estimate:
        """What is believed of the device."""
        assert self.state.estimate is not None
        return self.state.estimate

    @property
    def faults(self) -> tuple[Fault, ...]:
        return self.state.safety.faults

    def step(self, plan: Plan | None = None, count: int = 1, **changes: object) -> StepOutput:
        """Some control periods with the same kind of measurement."""
        for _ in range(count):
            self.ticks += 1
            measurement = self._measure(self.ticks, **changes)
            self.state, self.output = self._stepper.step(
                self.state, self.now_s, measurement, plan or gap_plan(80.0, self.now_s)
            )
        return self.output

    def silent(self, measurement: Measurement | None, count: int = 1) -> StepOutput:
        """Some control periods in which this same measurement is the newest."""
        for _ in range(count):
            self.ticks += 1
            self.state, self.output = self._stepper.step(
                self.state, self.now_s, measurement, gap_plan(80.0, self.now_s)
            )
        return self.output

    def command(self, name: str, conditions: Conditions = READY) -> None:
        self.state = self._stepper.command(self.state, name, self.now_s, conditions)

    def enabled(self, **changes: object) -> "Bench":
        """Enabled after three periods of this kind."""
        self.step(count=3, **changes)
        self.command("enable")
        return self

    def run_into(self, fault: Fault, plan: Plan | None = None, **changes: object) -> int:
        """Periods until exactly this fault is latched, and so the drives off and the device asked to open."""
        start = self.ticks
        while not self.faults:
            self.step(plan, **changes)
            assert self.ticks - start < 1_000, f"no {fault}"
        assert self.faults == (fault,)
        assert is_opened(self)
        return self.ticks - start


@pytest.fixture
def bench(core: Core, measure) -> Bench:
    return Bench(core.stepper, measure)


@pytest.fixture
def running(bench: Bench) -> Bench:
    """Enabled at a gap of 80 mm, and at rest there."""
    bench.enabled().step(count=3)
    assert bench.state.safety.operating_state is OperatingState.ENABLED
    return bench


def driven(output: StepOutput) -> tuple[DriveMode, float, float]:
    """What the bridges are told."""
    return output.mode, output.left_duty, output.right_duty


def is_opened(bench: Bench) -> bool:
    """Whether the drives are off and the device has been asked to open."""
    return (driven(bench.output), bench.output.request) == (OFF, DeviceRequest.RETRACT) and (
        bench.state.safety.operating_state is OperatingState.FAULT
    )


def test_disabled_means_off(bench: Bench) -> None:
    output = bench.step(gap_plan(45.0), count=10)
    assert driven(output) == OFF
    assert (output.request, output.request_number, output.limits) == (DeviceRequest.NONE, 0, ())


def test_enabling_is_bumpless(running: Bench) -> None:
    """At the planned gap, at rest: the first duties are none, whatever was learned in an earlier run."""
    running.step(gap_plan(60.0), count=50)
    running.command("disable")
    running.step(count=3)
    running.command("enable")
    for _ in range(20):
        assert running.step().left_duty == pytest.approx(0.0, abs=1e-9)
    assert running.state.left.integral == pytest.approx(0.0, abs=1e-12)


def test_enabling_wants_an_estimate(bench: Bench) -> None:
    with pytest.raises(RefusedError) as caught:
        bench.command("enable")
    assert caught.value.code == "not_fresh"
    assert bench.state.safety.operating_state is OperatingState.DISABLED


def test_the_duty_pushes_towards_the_planned_gap(running: Bench) -> None:
    closing = running.step(gap_plan(79.0), count=20)
    assert closing.mode is DriveMode.RUN
    assert closing.left_duty < 0.0
    assert closing.right_duty == pytest.approx(closing.left_duty)
    opening = running.step(gap_plan(81.0), count=60)
    assert opening.left_duty > 0.0


def test_skew_pulls_the_carriages_together(core: Core, measure) -> None:
    """Synchronisation adds its share of the skew to either carriage's own error, towards each other."""
    duties = []
    for synchronisation in (0.0, 1.0):
        position = msgspec.structs.replace(CONFIG.position, synchronisation=synchronisation)
        bench = Bench(Stepper(msgspec.structs.replace(CONFIG, position=position), core.scene), measure).enabled()
        bench.step()
        duties.append(bench.step(left_mm=-7.49, right_mm=-7.51))
    own, both = duties
    assert own.left_duty < 0.0 < own.right_duty
    pull = CONFIG.position.proportional_per_mm * 0.02 / 2.0
    assert both.left_duty == pytest.approx(own.left_duty - pull, rel=1e-6)
    assert both.right_duty == pytest.approx(own.right_duty + pull, rel=1e-6)


def test_a_plans_gap_is_carried_forward_along_its_speed_but_not_for_long(running: Bench) -> None:
    plan = gap_plan(80.0, running.now_s, gap_speed_mm_s=-10.0)
    running.step(plan, count=60)
    # the reference has come to where the plan leads in CARRY_S, although the plan is much older, and closes in on it
    # with the plan's own speed, which the closing speed makes up for APPROACH_S away
    lag_s = EXCHANGE_S + electrical_time_s(CONFIG.motor)
    led_mm = 80.0 - 10.0 * (CARRY_S + lag_s)
    assert running.reference.gap_mm == pytest.approx(led_mm - 10.0 * APPROACH_S, abs=0.02)


@pytest.mark.parametrize("gap_mm", [-1e9, 0.0, 300.0, 1e9])
def test_the_reference_stays_in_the_gap_range(core: Core, measure, gap_mm: float) -> None:
    """Carriages that follow exactly, sooner than any do; the plan asks for a gap that does not exist."""
    limits = msgspec.structs.replace(CONFIG.limits, no_motion_time_s=10.0)
    stepper = Stepper(msgspec.structs.replace(CONFIG, limits=limits), core.scene)
    state = stepper.start(0.0)
    state, _ = stepper.step(state, 0.001, measure(1), gap_plan(80.0))
    state = stepper.command(state, "enable", 0.001, READY)
    for tick in range(2, 3_000):
        side_mm = -7.5 if state.reference is None else state.reference.gap_mm / 2.0 - 47.5
        exact = measure(tick, left_mm=side_mm, right_mm=side_mm)
        state, _ = stepper.step(state, tick * PERIOD_S, exact, gap_plan(gap_mm, tick * PERIOD_S))
        assert state.reference is not None
        assert 45.0 - 1e-3 <= state.reference.gap_mm <= 95.0 + 1e-3
    assert state.reference.gap_mm == pytest.approx(min(max(gap_mm, 45.0), 95.0), abs=0.01)


@pytest.mark.parametrize("jump_mm", [0.0018, 0.05, 0.4, -0.4])
def test_counts_that_jump_and_come_back_do_no_harm(running: Bench, jump_mm: float) -> None:
    """A burst on an encoder line, shorter than any motion: a push where a carriage may have gone so far, none where no
    carriage goes; no fault, and nothing left of it soon."""
    pushed = running.step(left_mm=-7.5 + jump_mm)
    if abs(jump_mm) < LEAP_MM:
        assert -1.0 <= pushed.left_duty * math.copysign(1.0, jump_mm) < 0.0
    else:
        assert (driven(pushed), pushed.limits) == ((DriveMode.RUN, 0.0, 0.0), (Limit.ENCODER,))
    settled = running.step(count=400)
    assert not running.faults
    assert abs(settled.left_duty) < 0.05
    assert abs(running.state.left.integral) < 0.05


@pytest.mark.parametrize("jump_mm", [-120.0, -37.4, 1.5, 8.0])
def test_counts_that_jump_away_are_a_fault(running: Bench, jump_mm: float) -> None:
    """A lost or wrapped counter is not followed, and is a fault as soon as the device says that it was not reset."""
    held = running.step(left_mm=-7.5 + jump_mm)
    assert (driven(held), held.limits) == ((DriveMode.RUN, 0.0, 0.0), (Limit.ENCODER,))
    assert running.run_into(Fault.ENCODER, left_mm=-7.5 + jump_mm) == 1


@pytest.mark.parametrize("side", ["left_mm", "right_mm"])
def test_counts_of_either_side_that_jump_are_held_at_once(running: Bench, side: str) -> None:
    assert running.step(**{side: -6.6}).limits == (Limit.ENCODER,), "less than is skew"


@pytest.mark.parametrize("jump_mm", [-4.0, 0.5, 4.0])
def test_counts_of_both_sides_that_jump_alike_are_a_fault_too(running: Bench, jump_mm: float) -> None:
    """No skew shows them, and a gap that seems 8 mm wider is closed by as much."""
    running.step(left_mm=-7.5 + jump_mm, right_mm=-7.5 + jump_mm, reported_s=0.0)
    assert not running.faults, "it may have been reset"
    running.run_into(Fault.ENCODER, left_mm=-7.5 + jump_mm, right_mm=-7.5 + jump_mm)
    assert running.state.safety.needs_homing


def test_counts_that_a_reset_sets_back_are_the_resets(running: Bench) -> None:
    running.step(count=round(STARTING_S / PERIOD_S))
    running.step(left_mm=0.0, right_mm=0.0, reported_s=running.now_s, count=10)
    assert not running.faults
    running.step(count=200, left_mm=0.0, right_mm=0.0, mode=DeviceMode.IDLE, switches=Switches(0))
    assert running.faults == (Fault.DEVICE_NOT_RUNNING,)


@pytest.mark.parametrize("speed_mm_s", [-19.0, 19.0])
@pytest.mark.parametrize("missing", [1, 5, 40])
def test_what_a_carriage_does_at_full_speed_is_no_leap(bench: Bench, speed_mm_s: float, missing: int) -> None:
    """Also where States are missing in between."""
    at_mm = -7.5
    for _ in range(10):
        bench.ticks += missing - 1
        at_mm += missing * PERIOD_S * speed_mm_s
        at_mm = min(max(at_mm, -24.0), 0.0)
        bench.step(left_mm=at_mm, right_mm=at_mm)
    assert bench.state.leap is None
    assert not bench.faults


def apart(running: Bench, skew_mm: float) -> None:
    """The carriages come apart, no faster than carriages do."""
    start_mm = running.estimate.skew_mm
    for part in range(1, 41):
        side_mm = (start_mm + (skew_mm - start_mm) * part / 40.0) / 2.0
        if not running.faults:
            running.step(left_mm=-7.5 + side_mm, right_mm=-7.5 - side_mm)


def test_less_supply_takes_more_duty(core: Core, measure) -> None:
    duties = {}
    for supply_V in (9.0, 12.0, 14.5, 3.0, 0.0):
        bench = Bench(core.stepper, measure).enabled()
        bench.step(count=3, supply_V=supply_V)
        duties[supply_V] = bench.step(left_mm=-7.49, right_mm=-7.49, supply_V=supply_V).left_duty
    assert -0.5 < duties[12.0] < 0.0
    assert duties[9.0] == pytest.approx(duties[12.0] * 12.0 / 9.0)
    assert duties[14.5] == pytest.approx(duties[12.0] * 12.0 / 14.5)
    # a supply that is not there does not make the duty boundless
    assert duties[0.0] == duties[3.0] == pytest.approx(duties[12.0] * 2.0)


def test_limits_name_what_holds_back(running: Bench) -> None:
    assert running.step().limits == ()
    assert Limit.SKEW in running.step(left_mm=-7.35, right_mm=-7.65).limits
    far = [running.step(gap_plan(50.0)).limits for _ in range(40)]
    assert Limit.RATE in far[20]
    assert Limit.SATURATED in far[-1]
    assert Limit.SKEW not in far[-1]
    assert not running.faults


def test_each_stage_of_the_output_is_counted_when_it_acts(running: Bench, core: Core, measure) -> None:
    running.step(count=5)
    assert running.state.acted == NEVER, "a gap that is where it should be is held back by nothing"
    running.step(gap_plan(79.95))
    assert running.state.acted == Acted(slew=1), "a short way takes no speed, but the reference does not leap"
    for _ in range(40):  # and is not followed: the duty grows beyond what may be given
        running.step(gap_plan(50.0))
    far = running.state.acted
    assert 0 < far.rate < far.slew + far.rate <= 2 * 41
    assert 0 < far.range <= 40
    assert far.not_finite == 0
    before = far.range
    _, *duties = driven(running.step(gap_plan(50.0), supply_V=6.0))
    assert duties == [-CONFIG.position.duty_limit] * 2, "and is cut, whatever the supply would take"
    assert running.state.acted.range == before + 1
    running.step(gap_plan(math.nan))
    assert running.state.acted.not_finite == 1, "counters outlive a start afresh"
    assert running.state.acted.range == before + 1
    running.command("clear-fault")
    running.step(count=3)
    running.command("enable")
    running.command("pause")
    held = running.state.acted
    running.step(gap_plan(50.0), count=5)
    assert running.state.acted == held, "where the gap stands there is nothing to hold back"


# -- every way a run can fail --------------------------------------------------------------------------------------


@pytest.mark.parametrize("bit", DeviceFault)
def test_a_fault_of_the_device_is_ours(running: Bench, bit: DeviceFault) -> None:
    assert running.run_into(Fault(f"DEVICE_{bit.name}"), faults=bit, mode=DeviceMode.RETRACTING) == 1


@pytest.mark.parametrize("bit", DeviceFault)
def test_a_fault_of_the_device_is_ours_while_disabled_too(bench: Bench, bit: DeviceFault) -> None:
    bench.step(faults=bit)
    assert bench.faults == (Fault(f"DEVICE_{bit.name}"),)


def test_a_stale_measurement(running: Bench) -> None:
    newest = running._measure(running.ticks)
    timeout = round(CONFIG.device.measurement_timeout_ms)
    running.silent(newest, count=timeout - 1)
    assert not running.faults
    running.silent(newest, count=1)
    assert running.faults == (Fault.MEASUREMENT_STALE,)
    assert is_opened(running)


def test_a_measurement_over_a_slow_line(running: Bench) -> None:
    """Each state comes at once after the last, but answers a drive of long ago: a loop around that would swing."""
    timeout_s = CONFIG.device.measurement_timeout_ms * 1e-3
    running.step(count=5, delay_s=timeout_s - 1e-3)
    assert not running.faults
    assert running.run_into(Fault.MEASUREMENT_STALE, delay_s=timeout_s + 1e-3) == 1


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_skew(running: Bench, side: float) -> None:
    allowed = CONFIG.limits.skew_fault_mm
    apart(running, side * 0.98 * allowed)
    most = {"left_mm": -7.5 + side * 0.49 * allowed, "right_mm": -7.5 - side * 0.49 * allowed}
    running.step(count=20, **most)
    for back_mm in (0.004, 0.008, 0.012, 0.016):  # as the loop wants it, so that nothing goes the wrong way
        back = {"left_mm": most["left_mm"] - side * back_mm, "right_mm": most["right_mm"] + side * back_mm}
        running.step(**back)
    running.step(count=20, **back)
    assert not running.faults
    more = {"left_mm": -7.5 + side * 0.51 * allowed, "right_mm": -7.5 - side * 0.51 * allowed}
    assert running.run_into(Fault.SKEW, **more) == 1


def test_a_gap_that_does_not_follow(core: Core, measure) -> None:
    """The carriages creep, so that they do move, but by far too little."""
    config = msgspec.structs.replace(CONFIG, limits=msgspec.structs.replace(CONFIG.limits, no_motion_time_s=10.0))
    bench = Bench(Stepper(config, core.scene), measure).enabled()
    while bench.state.straying_s == 0.0:
        bench.step(gap_plan(50.0))
        assert bench.ticks < 1_000
    took_s = bench.run_into(Fault.FOLLOWING_ERROR, gap_plan(50.0)) * PERIOD_S
    assert took_s == pytest.approx(CONFIG.limits.following_time_s, abs=2.5e-3)


def test_following_again_in_time_is_no_fault(running: Bench) -> None:
    away_mm = [-7.5 - 1.75 * part / 16.0 for part in range(1, 17)]
    for _ in range(3):
        # the gap is 3.5 mm away from where the reference rests, for less than the time allowed
        for side_mm in (*away_mm, *[away_mm[-1]] * 20, *reversed(away_mm)):
            running.step(left_mm=side_mm, right_mm=side_mm)
        running.step(count=20)
    assert not running.faults


def test_a_carriage_that_is_driven_and_does_not_move(running: Bench) -> None:
    assert running.run_into(Fault.NO_MOTION, gap_plan(60.0)) * PERIOD_S < 0.25


def test_a_carriage_that_the_firmware_holds_at_its_open_switch_is_not_driven(bench: Bench) -> None:
    """The switch lies 0.2 mm before the end asked for: nothing is learned there, and closing takes no longer."""
    at_end = {"left_mm": -0.2, "right_mm": -0.2}
    switches = Switches.HOMED | Switches.LEFT_OPEN | Switches.RIGHT_OPEN
    bench.enabled(**at_end)
    for _ in range(2_000):
        output = bench.step(gap_plan(95.0, bench.now_s), **at_end, switches=switches)
        assert (output.left_duty, output.right_duty) == (0.0, 0.0)
        assert Limit.SATURATED not in output.limits
    assert not bench.faults
    assert bench.state.left.integral <= 0.0
    pushed = [bench.step(gap_plan(90.0, bench.now_s), **at_end, switches=switches).left_duty for _ in range(30)]
    assert max(pushed[5:]) < 0.0


@pytest.mark.parametrize("side", ["left", "right"])
def test_one_carriage_at_its_switch_excuses_no_other(bench: Bench, side: str) -> None:
    switches = Switches.HOMED | (Switches.RIGHT_OPEN if side == "left" else Switches.LEFT_OPEN)
    at_end = {"left_mm": -0.3, "right_mm": -0.3}
    bench.enabled(**at_end)
    bench.run_into(Fault.NO_MOTION, gap_plan(95.0), **at_end, switches=switches)


def test_after_an_encoder_fault_positions_are_unknown_until_the_device_has_homed(running: Bench) -> None:
    running.run_into(Fault.ENCODER, left_mm=-5.0)
    assert not running.estimate.is_homed
    running.command("clear-fault")
    for name in ("enable", "home", "enable"):
        running.step(count=5)
        assert not running.estimate.is_homed
        if name == "home":
            running.command(name)
            continue
        with pytest.raises(RefusedError) as caught:
            running.command(name)
        assert caught.value.code == "not_homed"
    running.step(count=30, mode=DeviceMode.HOMING, switches=Switches.LEFT_OPEN | Switches.RIGHT_OPEN)
    assert not running.estimate.is_homed
    running.step(count=2)
    assert running.estimate.is_homed
    running.command("enable")
    assert running.step().mode is DriveMode.RUN


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_carriages_that_are_too_far_apart_are_not_enabled(bench: Bench, side: float) -> None:
    half_mm = side * CONFIG.limits.skew_fault_mm / 2.0
    bench.step(left_mm=-7.5 + 1.01 * half_mm, right_mm=-7.5 - 1.01 * half_mm)
    with pytest.raises(RefusedError, match=r"1.01 mm apart: allowed is at most 1 mm") as caught:
        bench.command("enable")
    assert (caught.value.code, caught.value.hint) == ("skewed", "tormagctl home")
    bench.step(left_mm=-7.5 + 0.99 * half_mm, right_mm=-7.5 - 0.99 * half_mm)
    bench.command("enable")
    assert not bench.faults


def test_a_process_that_stood_still_saw_no_carriage_stand_still(running: Bench) -> None:
    """One look before the pause and one after it say nothing of what the carriages did between."""
    running.step(gap_plan(60.0), count=30)
    assert running.state.still_s > 0.0
    running.ticks += round(CONFIG.limits.no_motion_time_s / PERIOD_S)
    running.step(gap_plan(60.0), count=2)
    assert not running.faults


@pytest.mark.parametrize("mode", [DeviceMode.IDLE, DeviceMode.LATCHED, DeviceMode.HOMING, DeviceMode.RETRACTING])
def test_a_device_that_stopped_running(running: Bench, mode: DeviceMode) -> None:
    running.step(count=round(STARTING_S / PERIOD_S))
    assert not running.faults
    assert running.run_into(Fault.DEVICE_NOT_RUNNING, mode=mode) == 1


def test_a_device_may_take_a_moment_to_start(bench: Bench) -> None:
    bench.enabled(mode=DeviceMode.IDLE)
    bench.step(count=round(STARTING_S / PERIOD_S) - 1, mode=DeviceMode.IDLE)
    assert not bench.faults
    assert bench.run_into(Fault.DEVICE_NOT_RUNNING, mode=DeviceMode.IDLE) <= 3


@pytest.mark.parametrize("name", ["pause", None])
def test_a_lost_link_is_a_fault_while_driven(running: Bench, core: Core, name: str | None) -> None:
    if name:
        running.command(name)
    state = core.stepper.lose_link(running.state)
    assert state.safety.faults == (Fault.LINK_LOST,)
    assert state.safety.request is DeviceRequest.RETRACT
    assert state.estimate is None
    assert core.stepper.lose_link(state).safety == state.safety


@pytest.mark.parametrize("name", ["pause", None])
def test_a_link_without_measurements_is_a_lost_one(running: Bench, name: str | None) -> None:
    """However the link went: nothing that was armed is still armed when measurements come back."""
    if name:
        running.command(name)
    assert driven(running.silent(None)) == OFF
    assert running.faults == (Fault.LINK_LOST,)
    running.step(count=5)
    assert driven(running.output) == OFF


def test_a_lost_link_is_no_fault_while_disabled(bench: Bench, core: Core) -> None:
    bench.step()
    assert bench.silent(None, count=5) == StepOutput(DriveMode.OFF, 0.0, 0.0, DeviceRequest.NONE, 0, ())
    assert bench.faults == ()
    assert core.stepper.lose_link(bench.state).safety.faults == ()
    assert bench.state.estimate is None


def test_a_number_that_is_not_finite(running: Bench) -> None:
    running.step(gap_plan(math.nan))
    assert running.faults == (Fault.NOT_FINITE,)
    assert is_opened(running)
    running.command("clear-fault")
    running.step(count=3)
    running.command("enable")
    assert all(math.isfinite(duty) for duty in driven(running.step(gap_plan(79.0), count=10))[1:])


@pytest.mark.parametrize("name", ["left_mm", "right_mm", "supply_V", "device_time_s"])
def test_a_measurement_that_is_not_finite_reaches_no_duty(running: Bench, name: str) -> None:
    for value in (math.nan, math.inf, -math.inf):
        output = running.step(gap_plan(79.0), **{name: value})
        assert all(abs(duty) <= 1.0 for duty in driven(output)[1:])


# -- commands ------------------------------------------------------------------------------------------------------


def test_pause_holds_the_gap_and_resume_goes_on(running: Bench) -> None:
    running.step(gap_plan(79.0), count=8)
    running.command("pause")
    running.step(gap_plan(50.0), count=100)
    held = running.reference
    assert held.speed_mm_s == pytest.approx(0.0, abs=1e-6)
    running.step(gap_plan(50.0), count=50)
    assert running.reference.gap_mm == pytest.approx(held.gap_mm, abs=1e-6)
    assert running.output.mode is DriveMode.RUN
    assert not running.faults
    running.command("resume")
    running.step(gap_plan(78.0), count=30)
    assert running.reference.gap_mm < held.gap_mm - 0.2


def test_disable_and_stop_open(running: Bench) -> None:
    running.command("disable")
    output = running.step()
    assert (driven(output), output.request) == (OFF, DeviceRequest.RETRACT)
    assert not running.faults
    running.command("stop")
    running.step()
    assert running.faults == (Fault.STOPPED,)
    assert is_opened(running)


def test_a_cleared_fault_has_time_to_go_and_comes_back_if_it_stays(bench: Bench) -> None:
    bench.step(faults=DeviceFault.OVERCURRENT, mode=DeviceMode.LATCHED)
    bench.command("clear-fault", READY.replaced(device_latched=True))
    output = bench.step(faults=DeviceFault.OVERCURRENT, mode=DeviceMode.LATCHED)
    assert output.request is DeviceRequest.CLEAR
    assert bench.faults == ()
    cleared = bench.ticks
    assert bench.run_into(Fault.DEVICE_OVERCURRENT, faults=DeviceFault.OVERCURRENT, mode=DeviceMode.LATCHED)
    assert (bench.ticks - cleared) * PERIOD_S == pytest.approx(CLEARING_S, abs=2e-3)


def test_a_latched_fault_asks_once_and_stays(running: Bench) -> None:
    running.run_into(Fault.DEVICE_SKEW, faults=DeviceFault.SKEW, mode=DeviceMode.RETRACTING)
    number = running.output.request_number
    output = running.step(faults=DeviceFault.SKEW, mode=DeviceMode.LATCHED, count=100)
    assert output.request_number == number
    running.step(count=100)
    assert running.faults == (Fault.DEVICE_SKEW,)
    assert is_opened(running)


def test_homing_forgets_the_motion_before_it(bench: Bench) -> None:
    bench.step(count=5)
    for tick in range(5):
        bench.step(mode=DeviceMode.HOMING, left_mm=float(tick), right_mm=float(tick), switches=Switches(0))
    bench.step(left_mm=0.0, right_mm=0.0)
    # the origin jumped by 4 mm with the last homing state: one period's filtered jump is not carried further
    bench.step(left_mm=0.0, right_mm=0.0, mode=DeviceMode.RETRACTING)
    assert bench.estimate.left_mm_s == 0.0


# -- any input -----------------------------------------------------------------------------------------------------

measurements = st.none() | st.builds(
    Measurement,
    number=st.integers(0, 5),
    received_s=st.floats(-1.0, 1.0),
    device_time_s=st.floats(0.0, 1.0),
    left_mm=st.floats(-60.0, 10.0),
    right_mm=st.floats(-60.0, 10.0),
    left_current_A=st.floats(-32.0, 32.0),
    right_current_A=st.floats(-32.0, 32.0),
    force_N=st.floats(-32.0, 32.0),
    handle_mm=st.floats(-1e4, 1e4),
    mode=st.sampled_from(DeviceMode),
    switches=st.sampled_from([Switches.HOMED, Switches(0), Switches.HOMED | Switches.LEFT_OPEN]),
    faults=st.sampled_from([DeviceFault(0), DeviceFault(0), DeviceFault(0), *DeviceFault]),
    temperature_C=st.floats(-40.0, 125.0),
    supply_V=st.floats(0.0, 25.5),
    sensed_s=st.floats(0.0, 1.0),
    reported_s=st.floats(0.0, 1.0),
)
plans = st.builds(
    gap_plan, gap_mm=st.floats(45.0, 95.0), time_s=st.floats(-1.0, 1.0), gap_speed_mm_s=st.floats(-38.0, 38.0)
)
elapsed = st.sampled_from([0.0, 1e-3, 1e-3, 1e-5, 0.1, 5.0, 3_600.0, -1e-3, -10.0])
commands = st.none() | st.sampled_from(["enable", "disable", "pause", "resume", "home", "stop", "clear-fault"])


@settings(max_examples=200, deadline=None)
@given(
    history=st.lists(st.tuples(elapsed, measurements, plans, commands), min_size=1, max_size=25),
    limit=st.floats(0.1, 1.0),
)
def test_any_history_keeps_duties_in_bounds_and_repeats_itself(core: Core, history, limit: float) -> None:
    config = msgspec.structs.replace(CONFIG, position=msgspec.structs.replace(CONFIG.position, duty_limit=limit))
    runs = []
    for stepper in (Stepper(config, core.scene), Stepper(config, core.scene)):
        state, now_s, trace = stepper.start(0.0), 0.0, []
        number = 0
        for elapsed_s, measurement, plan, name in history:
            now_s += elapsed_s
            if name is not None:
                state = _commanded(stepper, state, name, now_s)
            state, output = stepper.step(state, now_s, measurement, plan)
            assert all(abs(duty) <= limit for duty in driven(output)[1:])
            is_driven = state.safety.operating_state in (OperatingState.ENABLED, OperatingState.PAUSED)
            assert (output.mode is DriveMode.RUN) == is_driven
            assert is_driven or driven(output) == OFF
            assert output.request_number >= number
            number = output.request_number
            trace.append((state, output))
        runs.append(trace)
    assert runs[0] == runs[1]


def _commanded(stepper: Stepper, state: StepState, name: str, now_s: float) -> StepState:
    try:
        return stepper.command(state, name, now_s, READY)
    except RefusedError:
        return state


def following(measure, state: StepState, number: int, now_s: float) -> Measurement:
    """Carriages that are where they are wanted."""
    assert state.reference is not None
    side_mm = state.reference.gap_mm / 2.0 - 47.5
    return measure(number, received_s=now_s, left_mm=side_mm, right_mm=side_mm)


@pytest.fixture
def moving(core: Core, measure) -> tuple[StepState, float]:
    """On the way from 80 to 60 mm, and when that is."""
    state = core.stepper.start(1.0 - PERIOD_S)
    state, _ = core.stepper.step(state, 1.0, measure(1, received_s=1.0), gap_plan(80.0, 1.0))
    state = core.stepper.command(state, "enable", 1.0, READY)
    for tick in range(2, 12):
        now_s = 1.0 + tick * PERIOD_S
        state, _ = core.stepper.step(state, now_s, following(measure, state, tick, now_s), gap_plan(60.0, now_s))
    return state, now_s


@pytest.mark.parametrize("elapsed_s", [0.0, -1e-3, -1e6])
def test_a_clock_that_stands_still_is_one_ordinary_period(core: Core, measure, moving, elapsed_s: float) -> None:
    state, now_s = moving
    assert state.reference is not None
    moved_mm = []
    for later_s in (now_s + PERIOD_S, now_s + elapsed_s):
        later, _ = core.stepper.step(state, later_s, following(measure, state, 12, later_s), gap_plan(60.0, later_s))
        assert later.reference is not None
        moved_mm.append(later.reference.gap_mm - state.reference.gap_mm)
    assert moved_mm[0] < -0.01
    assert moved_mm[1] == pytest.approx(moved_mm[0])


# -- stalls --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("elapsed_s", [BLIND_S + 1e-4, 0.011, 0.048, 1.0, 1e9])
@pytest.mark.parametrize(
    "has_more", [False, True], ids=["nothing came", "what came before the stall was read after it"]
)
def test_after_a_stall_one_drive_asks_and_moves_nothing(
    core: Core, measure, moving, elapsed_s: float, has_more: bool
) -> None:
    """Whatever is found then is older than the stall. The reference waits, and nothing is learned or concluded."""
    state, now_s = moving
    old = following(measure, state, 11 + has_more, now_s + (elapsed_s if has_more else 0.0))
    after, output = core.stepper.step(state, now_s + elapsed_s, old, gap_plan(60.0, now_s))
    assert driven(output) == (DriveMode.RUN, 0.0, 0.0)
    assert output.limits == (Limit.HOST_STALL,)
    assert not after.safety.faults
    assert (after.reference, after.left, after.right) == (state.reference, state.left, state.right)
    assert (after.still_s, after.straying_s) == (state.still_s, state.straying_s)
    assert after.sight.stall_s == pytest.approx(elapsed_s)


@pytest.mark.parametrize("came_mm", [0.0, -1.7, 1.0])
def test_the_answer_to_it_is_gone_on_from_without_a_kick(core: Core, measure, moving, came_mm: float) -> None:
    """The device went on with its last duty meanwhile, and is not where it was wanted before."""
    state, now_s = moving
    assert state.reference is not None
    # carriages that are where they are wanted at once pass for lively, and those are braked harder
    state = state.replaced(liveliness=1.0)
    came = state.reference.replaced(gap_mm=state.reference.gap_mm + came_mm)
    integral = state.left.integral
    for later in (0.045, 0.046):
        at_s = now_s + later
        answer = following(measure, state.replaced(reference=came), 11 + (later > 0.045), at_s)
        answer = answer.replaced(device_time_s=at_s)
        state, output = core.stepper.step(state, at_s, answer, gap_plan(came.gap_mm, at_s))
    assert not state.safety.faults
    assert state.reference is not None
    assert state.reference.gap_mm == pytest.approx(came.gap_mm, abs=0.1)
    assert abs(output.left_duty) < 0.6
    assert state.left.integral == pytest.approx(integral, abs=0.02)
    assert Limit.HOST_STALL in output.limits


def test_without_an_answer_in_time_the_measurement_is_stale(running: Bench) -> None:
    """The device is given some milliseconds, whatever the stall has left of the timeout, and no more."""
    newest = running._measure(running.ticks)
    running.ticks += round(CONFIG.device.measurement_timeout_ms) - 2
    ticks = 0
    while not running.faults:
        assert driven(running.silent(newest))[1:] == (0.0, 0.0)
        ticks += 1
        assert ticks < 100
    assert running.faults == (Fault.MEASUREMENT_STALE,)
    assert ticks == pytest.approx(2.0 * BLIND_S / PERIOD_S, abs=2)
    assert is_opened(running)


def test_a_slow_loop_takes_no_period_of_its_own_for_a_stall(core: Core, measure) -> None:
    rates = msgspec.structs.replace(CONFIG.rates, control_hz=100, telemetry_hz=50, inference_hz=100)
    stepper = Stepper(msgspec.structs.replace(CONFIG, rates=rates), core.scene)
    state = stepper.start(0.0)
    for tick in range(1, 8):
        state, output = stepper.step(state, 0.01 * tick, measure(tick, received_s=0.01 * tick), gap_plan(79.0))
        if tick == 3:
            state = stepper.command(state, "enable", 0.01 * tick, READY)
    assert output.left_duty < 0.0
    assert Limit.HOST_STALL not in output.limits
    state, output = stepper.step(state, 0.01 * tick + 0.06, measure(tick), gap_plan(79.0))
    assert output.limits == (Limit.HOST_STALL,)


def test_a_silent_device_is_held_where_it_is_and_named(running: Bench) -> None:
    running.step(gap_plan(79.0), count=10)
    newest, before = running._measure(running.ticks), running.state
    for _ in range(round(BLIND_S / PERIOD_S) + 1):
        running.silent(newest)
    held = running.state
    for _ in range(30):
        output = running.silent(newest)
        assert driven(output) == (DriveMode.RUN, 0.0, 0.0)
        assert output.limits == (Limit.DEVICE_SILENT,)
    assert (running.state.reference, running.state.left) == (held.reference, held.left)
    assert abs(held.left.integral - before.left.integral) < 0.05
    back = running.step(gap_plan(80.0, running.now_s))
    assert Limit.DEVICE_SILENT not in back.limits
    assert abs(back.left_duty) < 0.2
    assert not running.faults


@pytest.mark.parametrize(("stall_ms", "fault"), [(83, Fault.HOST_STALL), (36, Fault.DEVICE_COMMAND_TIMEOUT)])
def test_a_device_that_opened_because_of_a_stall_is_told_as_that(running: Bench, stall_ms: int, fault: Fault) -> None:
    """One fault, though the device goes on saying that it heard nothing; a shorter stall cannot have done it."""
    running.ticks += stall_ms
    running.step()
    running.step(count=15)
    assert not running.faults
    opened = {"faults": DeviceFault.COMMAND_TIMEOUT, "mode": DeviceMode.RETRACTING}
    assert running.run_into(fault, **opened) == 1
    running.step(count=500, **opened | {"mode": DeviceMode.LATCHED})
    assert running.faults == (fault,)
    assert is_opened(running)


@settings(max_examples=60, deadline=None)
@given(stalls_ms=st.lists(st.tuples(st.integers(6, 49), st.integers(3, 40)), min_size=1, max_size=8))
def test_stalls_that_the_device_survives_are_never_a_fault(
    core: Core, measure, stalls_ms: list[tuple[int, int]]
) -> None:
    """However they follow each other, held or moving; the duty right after each is none."""
    bench = Bench(core.stepper, measure).enabled()
    for stall_ms, ran_ms in stalls_ms:
        bench.ticks += stall_ms
        assert driven(bench.step(gap_plan(79.9, bench.now_s))) == (DriveMode.RUN, 0.0, 0.0)
        bench.step(gap_plan(79.9, bench.now_s), count=ran_ms)
        assert not bench.faults
        assert abs(bench.state.left.integral) < 0.3


@pytest.mark.parametrize("gap_mm", [-64.0, -40.0, -5.0, 0.0, 30.0, 100.5, 140.0])
def test_carriages_where_none_can_be_are_a_fault_before_anything_is_driven(bench: Bench, gap_mm: float) -> None:
    bench.step(left_mm=gap_mm / 2.0 - 47.5, right_mm=gap_mm / 2.0 - 47.5)
    assert bench.faults == (Fault.OUT_OF_STROKE,)
    assert is_opened(bench)
    assert bench.state.safety.needs_homing


def test_a_least_gap_ends_a_motion_towards_it(running: Bench) -> None:
    """A path that closes at 38 mm/s, well beyond the gap that this device allows."""
    lowest_mm = math.inf
    for tick in range(1, 300):
        closing = gap_plan(80.0 - 0.038 * tick, running.now_s, gap_speed_mm_s=-38.0)
        followed_mm = (running.reference.gap_mm - 95.0) / 2.0
        running.step(closing.replaced(least_gap_mm=76.0), left_mm=followed_mm, right_mm=followed_mm)
        lowest_mm = min(lowest_mm, running.reference.gap_mm)
    assert 76.0 - 1e-3 < lowest_mm < 76.01


@pytest.mark.parametrize("least_gap_mm", [0.0, 79.8])
def test_the_gap_is_closed_no_further_than_this_device_allows(running: Bench, least_gap_mm: float) -> None:
    running.step(gap_plan(50.0).replaced(least_gap_mm=least_gap_mm), count=40)
    assert (running.reference.gap_mm >= 79.7) == (least_gap_mm > 0.0)


def test_too_much_force_opens_and_is_then_a_fault(running: Bench) -> None:
    limits = [running.step(force_N=3.0).limits for _ in range(35)]
    assert Limit.OVER_FORCE not in limits[5]
    assert Limit.OVER_FORCE in limits[30]
    assert running.reference.gap_mm > 80.0
    assert running.run_into(Fault.OVER_FORCE, force_N=3.0) < 20


def test_a_sensor_that_stays_doubted_is_a_fault(running: Bench) -> None:
    running.step(gap_plan(80.0).replaced(sensor_doubted_s=SENSOR_FAULT_S))
    assert not running.faults
    running.step(gap_plan(80.0).replaced(sensor_doubted_s=1.01 * SENSOR_FAULT_S))
    assert running.faults == (Fault.SENSOR,)


@pytest.mark.parametrize("switch", [Switches.LEFT_OPEN, Switches.RIGHT_OPEN])
def test_an_open_switch_far_from_where_its_carriage_reads_is_a_fault(running: Bench, switch: Switches) -> None:
    """Counts were lost, or the switch is stuck: then nothing is driven by either."""
    assert running.run_into(Fault.OUT_OF_STROKE, switches=Switches.HOMED | switch) == 1


def test_a_switch_that_is_newer_than_the_position_says_nothing(running: Bench, measure) -> None:
    """Status comes without a State, too: by then the carriage may have come to its switch."""
    last = running.ticks
    running.silent(measure(last), 8)
    assert running.state.sight.is_blind
    open_now = Switches.HOMED | Switches.RIGHT_OPEN
    running.silent(measure(last, switches=open_now, reported_s=running.now_s), 20)
    assert not running.faults


@pytest.mark.parametrize("gap_mm", [40.5, 42.0, 44.9])
def test_carriages_beyond_the_closed_end_are_driven_back(bench: Bench, gap_mm: float) -> None:
    there = {"left_mm": gap_mm / 2.0 - 47.5, "right_mm": gap_mm / 2.0 - 47.5}
    bench.enabled(**there)
    for _ in range(30):
        output = bench.step(gap_plan(70.0, bench.now_s), **there)
        assert bench.reference.speed_mm_s >= 0.0
    assert min(output.left_duty, output.right_duty) > 0.5


# -- streams, wire and directions ------------------------------------------------------------------------------------


def test_a_sense_that_stops_is_a_limit_and_then_a_fault_where_the_scene_needs_it(running: Bench) -> None:
    running.step(count=200)
    last_s = running.now_s
    assert Limit.SENSE_STALE not in running.step(count=round(UNSENSED_S / PERIOD_S), sensed_s=last_s).limits
    assert running.step(count=2, sensed_s=last_s).limits == (Limit.SENSE_STALE,)
    running.run_into(Fault.SENSE_STALE, sensed_s=last_s)
    assert running.now_s - last_s == pytest.approx(SENSE_FAULT_S, abs=0.5 * PERIOD_S)


def test_a_scene_that_does_without_the_sensor_does_without_its_messages(core: Core, measure) -> None:
    force = msgspec.structs.replace(core.scene.force, tolerance_rms_N=0.5 * core.scene.force.most_N)
    bench = Bench(Stepper(CONFIG, msgspec.structs.replace(core.scene, force=force)), measure).enabled()
    bench.step(count=200)
    assert bench.step(count=500, sensed_s=bench.now_s).limits == (Limit.SENSE_STALE,)
    assert not bench.faults


def test_a_status_that_stops_is_a_fault(running: Bench) -> None:
    running.step(count=200)
    last_s = running.now_s
    running.step(count=round(STATUS_FAULT_S / PERIOD_S) - 1, reported_s=last_s)
    assert not running.faults
    assert running.run_into(Fault.STATUS_STALE, reported_s=last_s) == 1


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
def test_a_wire_or_a_clock_that_is_not_what_it_should_be_is_a_limit(running: Bench, link, limits) -> None:
    assert running.step(count=50, link=link).limits == limits
    assert not running.faults


@pytest.mark.parametrize(
    ("link", "fault", "code"),
    [
        (LinkQuality(round_trip_s=0.012), Fault.LINK_DEGRADED, "link_degraded"),
        (LinkQuality(clock_drift=0.11), Fault.CLOCK, "clock"),
        (LinkQuality(clock_drift=-1.0), Fault.CLOCK, "clock"),
    ],
)
def test_what_would_swing_is_opened_and_not_enabled_in_the_first_place(
    bench: Bench, link: LinkQuality, fault: Fault, code: str
) -> None:
    bench.step(count=3)
    with pytest.raises(RefusedError) as caught:
        bench.command("enable", READY.replaced(round_trip_s=link.round_trip_s, clock_drift=link.clock_drift))
    assert caught.value.code == code
    assert "allowed is" in str(caught.value)
    bench.command("enable")
    bench.step(count=20)
    assert bench.run_into(fault, link=link) == 1


def test_the_round_trip_that_is_refused_is_within_what_the_loop_bears(core: Core) -> None:
    bears_s = delay_margin_s(CONFIG.motor, CONFIG.position, PERIOD_S)
    assert 0.005 < bears_s < 0.05
    assert bears_s == pytest.approx(core.margins.phase_margin_deg / 360.0 / core.margins.crossover_Hz)


@pytest.mark.parametrize("target_mm", [60.0, 90.0])
def test_carriages_that_go_the_other_way_are_named(running: Bench, target_mm: float) -> None:
    """Both, so that nothing skews; what the loop does about it makes it worse."""
    at_mm = -7.5
    while not running.faults:
        output = running.step(gap_plan(target_mm, running.now_s), left_mm=at_mm, right_mm=at_mm)
        at_mm -= 15.0 * output.left_duty * PERIOD_S
        assert running.ticks < 300
    assert running.faults[0] is Fault.WRONG_DIRECTION
    assert abs(at_mm + 7.5) < 2.5
    assert is_opened(running)
    assert running.state.safety.needs_homing


def test_a_carriage_that_goes_the_other_way_into_its_stop_is_named(running: Bench) -> None:
    at_mm = -7.5
    while not running.faults:
        running.step(gap_plan(60.0, running.now_s), left_mm=at_mm, right_mm=at_mm)
        at_mm = min(at_mm + 0.015, -7.0)
        assert running.ticks < 300
    assert set(running.faults) <= {Fault.WRONG_DIRECTION, Fault.NO_MOTION}
    assert running.faults[0] is Fault.WRONG_DIRECTION


def test_a_homing_that_presses_shut_is_ended_and_named(bench: Bench) -> None:
    at_mm = -7.5
    bench.step(count=3)
    bench.command("home")
    while not bench.faults:
        at_mm -= 0.012
        bench.step(left_mm=at_mm, right_mm=-7.5, mode=DeviceMode.HOMING, switches=Switches(0))
        assert at_mm > -12.0
    assert bench.faults == (Fault.WRONG_DIRECTION,)
    assert bench.output.request is DeviceRequest.RETRACT
    assert bench.state.homing is not None
    assert bench.state.homing.went_back_mm[0] > 2.9
