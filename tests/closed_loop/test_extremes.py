"""Extremes of the loop on the simulated device: clocks that roll over, configurations at the ends of what is accepted.

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
from tormagd.control.records import Duty, TimedSetpoint
from tormagd.control.safety.operating_state import Conditions, RefusedError
from tormagd.scenes.scene import load_scene
from tormagd.simulation.closed_loop import ClosedLoop, Sample
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.hand import SteadyHand
from tormagd.simulation.parameters import load_plant

CONFIG = Config()
SCENE = load_scene("coronary")


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
