"""Extremes of the loop on the simulated device: uneven screws and clocks, targets that flip, magnets that pull.

All data here are synthetic: the device is the simulator's.
"""

import contextlib
import math
from collections.abc import Iterator
from typing import Any, get_type_hints

import msgspec
import pytest
from hypothesis import example, given, settings, strategies as st
from leaves import leaves

from tormagd.config import Config
from tormagd.control.assembly.build import Core, build_core
from tormagd.control.move.carriages import MAX_ACCELERATION_SCALE
from tormagd.control.records import Duty, TimedSetpoint
from tormagd.control.safety.operating_state import Conditions, RefusedError
from tormagd.scenes.scene import load_scene
from tormagd.simulation.closed_loop import ClosedLoop, Sample
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.hand import RecordedHand, SteadyHand
from tormagd.simulation.parameters import load_plant

CONFIG = Config()
SCENE = load_scene("coronary")


AT_REST = RecordedHand((0.0,), (0.0,))
"A handle that moves would bring a force over the scene's, and a fault."


def test_the_gap_opens_no_faster_than_the_magnets_let_it(arm) -> None:
    lags_mm, overshoots_mm = [], []
    for pull_V in (CONFIG.motor.pull_V, 0.0):
        config = msgspec.structs.replace(CONFIG, motor=msgspec.structs.replace(CONFIG.motor, pull_V=pull_V))
        loop = arm(hand=AT_REST, planned=False, config=config, core=build_core(config))
        list(loop.hold(47.0, 2.5))
        move = loop.stepper.move
        seen = [
            (abs(move.expected.gap_mm - sample.measured.gap_mm), sample.truth.gap_mm) for sample in loop.hold(70.0, 1.2)
        ]
        lags_mm.append(max(lag for lag, _ in seen))
        overshoots_mm.append(max(gap for _, gap in seen) - 70.0)
    assert lags_mm[0] < 0.1
    assert lags_mm[0] < 0.3 * lags_mm[1]
    assert overshoots_mm[0] < 0.01 < overshoots_mm[1]


def test_a_step_knows_nothing_of_the_stroke_before_it(arm) -> None:
    loop = arm(hand=AT_REST, planned=False)
    list(loop.hold(57.0, 2.0))
    assert max(abs(loop.stepper.move.left.integral), abs(loop.stepper.move.right.integral)) < 0.002
    gaps_mm = [sample.measured.gap_mm for sample in (*loop.hold(58.0, 0.4), *loop.hold(57.8, 0.4))]
    assert max(gaps_mm) < 58.0 + 1e-3
    assert min(gaps_mm[400:]) > 57.8 - 0.005


@pytest.mark.parametrize(
    ("sample", "least", "most"),
    [("sample_1", 1.0, 1.4), ("sample_2", 1.0, 1.0), ("sample_3", 1.6, MAX_ACCELERATION_SCALE)],
)
def test_lively_motors_are_asked_for_more_and_weak_ones_for_no_less(
    arm, sample: str, least: float, most: float
) -> None:
    loop = arm(sample, AT_REST, planned=False)
    for stroke in range(6):
        list(loop.hold(60.0 if stroke % 2 else 80.0, 0.8))
    move = loop.stepper.move
    assert loop.stepper.safety.faults == ()
    assert least <= move.acceleration_scale <= most
    resting = [move.acceleration_scale for _ in loop.hold(80.0, 0.5)]
    assert resting[-1] == resting[250]


# -- rollovers ---------------------------------------------------------------------------------------------------------


LASTS_S, BEFORE_S = 1.5, 0.7
"How long a repeated run takes, and how long before the rollover it begins."
SENT_HZ = 137.3
"Out of step with the forecast's grid, where the last digit of a stamp would decide."
SAME_DUTY = 1e-4
"One step on the wire: a clock of coarser floats may change as much."
READY = Conditions(True, True, True, False, False)


def swinging(now_s: float) -> TimedSetpoint:
    at_s = math.floor(now_s * SENT_HZ) / SENT_HZ
    return TimedSetpoint(1.3 + 0.4 * math.sin(3.0 * at_s), at_s, 0.1)


@pytest.fixture(scope="module")
def recorded(arm) -> list[Sample]:
    return list(arm().run(LASTS_S, swinging))


def duties(core: Core, recorded: list[Sample], device_s: float, host_s: float) -> list[Duty]:
    begins_s = host_s + recorded[0].time_s
    stepper, planner = core.stepper(begins_s), core.planner(begins_s)
    found: list[Duty] = []
    for tick, sample in enumerate(recorded):
        now_s, setpoint = host_s + sample.time_s, swinging(sample.time_s)
        shifted = sample.measurement.replaced(
            received_s=host_s + sample.measurement.received_s,
            sensed_s=host_s + sample.measurement.sensed_s,
            reported_s=host_s + sample.measurement.reported_s,
            device_time_s=device_s + sample.measurement.device_time_s,
        )
        found.append(stepper.step(now_s, shifted, planner.planned))
        if tick == 3:
            stepper.command("enable", now_s, READY)
        if tick % 4 == 0:
            planner.plan(now_s, setpoint.replaced(stamp_s=host_s + setpoint.stamp_s), stepper.measured)
            planner.governor.foresee()
    return found


@pytest.mark.parametrize(
    ("device_s", "host_s"),
    [
        pytest.param(2.0**32 * 1e-6, BEFORE_S, id="device clock through 2^32 us"),
        pytest.param(2.0**32 * 1e-3, BEFORE_S, id="device clock through 2^32 ms"),
        pytest.param(BEFORE_S, 2.0**32 * 1e-6, id="host clock through 2^32 us"),
        pytest.param(BEFORE_S, 2.0**53 * 1e-9, id="host clock through 2^53 ns"),
        pytest.param(2.0**53 * 1e-9, 2.0**53 * 1e-9, id="both through 2^53 ns"),
    ],
)
def test_a_rollover_changes_no_duty(core: Core, recorded: list[Sample], device_s: float, host_s: float) -> None:
    usual = duties(core, recorded, 0.0, 0.0)
    assert max(abs(duty.left_duty) for duty in usual) > 0.1
    for ours, duty in zip(duties(core, recorded, device_s - BEFORE_S, host_s - BEFORE_S), usual, strict=True):
        assert (ours.left_duty, ours.right_duty) == pytest.approx((duty.left_duty, duty.right_duty), abs=SAME_DUTY)


# -- configurations at the ends of what is accepted --------------------------------------------------------------------


End = tuple[str, str, float]
"A key at one end, of the configuration, the scene's `insert`, or the device's `electronics`."


def ends() -> Iterator[End]:
    """Yield both ends of every number that shapes control."""
    for section in ("motor", "position", "trim", "limits", "rates", "device", "insert"):
        struct = type(getattr(SCENE if section == "insert" else CONFIG, section))
        for key, hint in get_type_hints(struct, include_extras=True).items():
            for meta in getattr(hint, "__metadata__", ()):
                if isinstance(meta, msgspec.Meta) and meta.le is not None:
                    least = meta.ge if meta.ge is not None else math.nextafter(meta.gt or 0.0, math.inf)
                    yield from ((section, key, least), (section, key, meta.le))


OF_DEVICE = {"encoder_counts_per_rev": (16, 1_000_000), "supply_V": (3.0, 25.0)}
ENDS = [*ends(), *(("electronics", key, value) for key, both in OF_DEVICE.items() for value in both)]


def at_ends(case: list[End]) -> ClosedLoop:
    """Return a loop with these keys at their ends; raise ValueError where that is refused."""
    scene = msgspec.structs.replace(SCENE, signal=None)
    parts: dict[str, Any] = {"": CONFIG, "insert": scene, "electronics": load_plant("sample_1")}
    for section, key, value in case:
        of = section if section in parts else ""
        changed = msgspec.structs.replace(getattr(parts[of], section), **{key: value})
        parts[of] = msgspec.structs.replace(parts[of], **{section: changed})
    config, scene, plant = parts.values()
    made = build_core(config, scene)
    assert all(map(math.isfinite, made.margins))
    return ClosedLoop(config, made.stepper(), made.planner(), VirtualDevice(plant, SteadyHand(), seed=1))


@pytest.mark.long
@settings(max_examples=settings.default.max_examples // 2, deadline=None)
@example(case=[("motor", "supply_V", 60.0)])
@example(case=[("limits", "skew_fault_mm", 10.0)])
@example(case=[("electronics", "encoder_counts_per_rev", 1_000_000)])
@given(case=st.lists(st.sampled_from(ENDS), min_size=1, max_size=2, unique_by=lambda end: end[:2]))
def test_at_its_ends_a_configuration_is_refused_by_name_or_runs_on_numbers(case: list[End]) -> None:
    refused = ""
    try:
        loop = at_ends(case)
    except ValueError as error:
        refused = str(error)
    if refused:
        assert "allowed" in refused
        return
    with contextlib.suppress(RuntimeError, RefusedError):  # what may not be enabled says so
        loop.arm()
    for sample in loop.run(0.1, swinging):
        found = leaves([sample.output, sample.plan, sample.measured])
        assert [path for path, value in found if not math.isfinite(value) and not path.endswith("stamp_s")] == []
