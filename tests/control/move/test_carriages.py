"""The carriages: duties towards where the plan leads, within the limits; and which limits are reported."""

import math

import pytest

from firmware_protocol.codec import Switches
from tormagd.config import Config
from tormagd.control.move.actuator import CARRY_S
from tormagd.control.move.carriages import APPROACH_S, EXCHANGE_S, MAX_ACCELERATION_SCALE
from tormagd.control.move.motor import electrical_time_s
from tormagd.control.safety.codes import Limit

CONFIG = Config()


def test_skew_pulls_the_carriages_together(make_bench) -> None:
    duties = []
    for synchronisation in (0.0, 1.0):
        bench = make_bench(position={"synchronisation": synchronisation}).enabled()
        bench.step()
        duties.append(bench.step(left_mm=-7.49, right_mm=-7.51))
    own, both = duties
    assert own.left_duty < 0.0 < own.right_duty
    pull = CONFIG.position.proportional_per_mm * 0.02 / 2.0
    assert (both.left_duty, both.right_duty) == pytest.approx((own.left_duty - pull, own.right_duty + pull), rel=1e-6)


def test_a_plans_gap_is_carried_forward_along_its_speed_but_not_for_long(running) -> None:
    running.step(running.plan(80.0, gap_speed_mm_s=-10.0), count=60)
    # the reference closes in on where the plan leads in CARRY_S with the plan's own speed, which the closing speed
    # makes up for APPROACH_S away
    led_mm = 80.0 - 10.0 * (CARRY_S + EXCHANGE_S + electrical_time_s(CONFIG.motor))
    assert running.move.reference.gap_mm == pytest.approx(led_mm - 10.0 * APPROACH_S, abs=0.02)


@pytest.mark.parametrize("gap_mm", [-1e9, 0.0, 300.0, 1e9])
def test_the_reference_stays_in_the_gap_range(make_bench, gap_mm: float) -> None:
    bench = make_bench(limits={"no_motion_time_s": 10.0}).enabled()
    for _ in range(3_000):
        bench.step(gap_mm, **bench.there)
        assert 45.0 - 1e-3 <= bench.move.reference.gap_mm <= 95.0 + 1e-3
    assert bench.move.reference.gap_mm == pytest.approx(min(max(gap_mm, 45.0), 95.0), abs=0.01)


def test_a_least_gap_ends_a_motion_towards_it(running) -> None:
    lowest_mm = math.inf
    for tick in range(1, 300):
        running.step(running.plan(80.0 - 0.038 * tick, gap_speed_mm_s=-38.0, min_gap_mm=76.0), **running.there)
        lowest_mm = min(lowest_mm, running.move.reference.gap_mm)
    assert 76.0 - 1e-3 < lowest_mm < 76.01


@pytest.mark.parametrize("gap_mm", [40.5, 42.0, 44.9])
def test_carriages_beyond_the_closed_end_are_driven_back(bench, gap_mm: float) -> None:
    bench.enabled(**bench.gap(gap_mm))
    for _ in range(30):
        output = bench.step(70.0, **bench.gap(gap_mm))
        assert bench.move.reference.speed_mm_s >= 0.0
    assert min(output.left_duty, output.right_duty) > 0.5


def test_a_carriage_that_the_firmware_holds_at_its_open_switch_is_not_driven(bench) -> None:
    at_end = bench.gap(94.6)
    switches = Switches.HOMED | Switches.LEFT_OPEN | Switches.RIGHT_OPEN
    bench.enabled(**at_end)
    for _ in range(2_000):
        output = bench.step(95.0, **at_end, switches=switches)
        assert bench.is_held
        assert Limit.SATURATED not in output.limits
    assert not bench.faults
    assert bench.move.left.integral <= 0.0
    pushed = [bench.step(90.0, **at_end, switches=switches).left_duty for _ in range(30)]
    assert max(pushed[5:]) < 0.0


def test_less_supply_takes_more_duty(make_bench) -> None:
    duties = {}
    for supply_V in (9.0, 12.0, 14.5, 3.0, 0.0):
        bench = make_bench().enabled()
        bench.step(count=3, supply_V=supply_V)
        duties[supply_V] = bench.step(left_mm=-7.49, right_mm=-7.49, supply_V=supply_V).left_duty
    assert -0.5 < duties[12.0] < 0.0
    assert (duties[9.0], duties[14.5]) == pytest.approx((duties[12.0] * 12.0 / 9.0, duties[12.0] * 12.0 / 14.5))
    # a supply that is not there does not make the duty boundless
    assert duties[0.0] == duties[3.0] == pytest.approx(duties[12.0] * 2.0)


def test_limits_name_what_holds_back(running) -> None:
    assert running.step().limits == ()
    assert Limit.SKEW in running.step(left_mm=-7.35, right_mm=-7.65).limits
    far = [running.step(50.0).limits for _ in range(40)]
    assert Limit.RATE in far[20]
    assert {Limit.SATURATED, Limit.SKEW} & set(far[-1]) == {Limit.SATURATED}
    assert not running.faults


def test_only_carriages_that_gain_speed_sooner_than_expected_are_asked_for_more(make_bench) -> None:
    lively, weak = make_bench().enabled(), make_bench().enabled()
    for _ in range(400):
        lively.step(79.0, **lively.there)
        weak.step(79.0, **weak.gap(80.0))
    scale = lively.move.acceleration_scale
    assert 1.01 < scale < MAX_ACCELERATION_SCALE
    assert weak.move.acceleration_scale == 1.0
    lively.step(79.0, count=400, **lively.there)
    assert lively.move.acceleration_scale == scale, "what rests shows nothing"
    lively.stepper.lose_link()
    assert lively.move.acceleration_scale == 1.0, "another device may come"


def test_each_stage_of_the_output_is_counted_when_it_acts(running) -> None:
    acted = running.move.acted
    running.step(count=5)
    assert (acted.rate, acted.slew, acted.range) == (0, 0, 0), "nothing holds a gap back where it should be"
    running.step(79.95)
    assert (acted.rate, acted.slew, acted.range) == (0, 1, 0), "a short way takes no speed, but no leap either"
    running.step(50.0, count=40)
    cut = acted.range
    assert 0 < acted.rate < acted.slew <= 41
    assert 0 < cut <= 40
    running.step(50.0, supply_V=6.0)
    assert (running.output.left_duty, acted.range) == (-CONFIG.position.duty_limit, cut + 1)
    running.step(math.nan)
    assert (acted.not_finite, acted.range) == (1, cut + 1), "counters outlive a start afresh"
