"""Ideal carriages, a second actuator in the same core: what a loop misses with them is the plan's."""

import math

import numpy as np
import pytest

from tormagd.assembly.build import Core, build_core
from tormagd.closed_loop import ClosedLoop
from tormagd.config import Config
from tormagd.control.core import Stepper
from tormagd.control.records import TimedSetpoint
from tormagd.lab.ideal_actuator import ideal_stepper
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.hand import SteadyHand
from tormagd.simulation.parameters import load_plant


def missed_N(core: Core, device: VirtualDevice, stepper: Stepper) -> float:
    """RMS error of a force that swings three times a second, live, once the gap has come there."""
    loop = ClosedLoop(core.config, stepper, core.planner(), device)
    loop.arm()
    errors_N = []
    for sample in loop.run(4.0, lambda now_s: TimedSetpoint(1.4 + 0.2 * math.sin(math.tau * 3.0 * now_s), now_s, 0.1)):
        assert sample.safety.faults == ()
        assert sample.truth.gap_mm > sample.plan.min_gap_mm - 0.01
        errors_N.append(sample.truth.force_N - 1.4 - 0.2 * math.sin(math.tau * 3.0 * sample.time_s))
    return float(np.sqrt(np.mean(np.square(errors_N[2_200:]))))


def test_the_same_core_misses_less_with_carriages_that_lose_no_time() -> None:
    core = build_core(Config())
    own, ideal = (VirtualDevice(load_plant("sample_1"), SteadyHand(), seed=1) for _ in range(2))
    assert (
        0.0
        < missed_N(core, ideal, ideal_stepper(core, ideal.messages.plant))
        < 0.9 * missed_N(core, own, core.stepper())
    )


@pytest.mark.parametrize("command", ["pause", "disable"])
def test_they_stand_where_nothing_is_planned_for(command: str) -> None:
    core, device = build_core(Config()), VirtualDevice(load_plant("sample_1"), SteadyHand(), seed=1)
    loop = ClosedLoop(core.config, ideal_stepper(core, device.messages.plant), core.planner(), device)
    loop.arm()
    list(loop.run(0.5, lambda now_s: TimedSetpoint(1.4, now_s, 0.1)))
    stood_mm = device.truth.gap_mm
    loop.command(command)
    list(loop.run(0.1))
    # the firmware opens a device that is disabled, by its own motors
    assert (device.truth.gap_mm > stood_mm + 0.3) is (command == "disable")
    assert device.truth.gap_mm > stood_mm - 0.01
