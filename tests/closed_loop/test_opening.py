"""After `disable`, `stop` or a fault the gap opens, on both buses; where it does not, that is named in time."""

import math
from collections.abc import Callable

import pytest

from firmware_protocol.codec import DeviceMode
from tormagd.control.safety.codes import Fault
from tormagd.simulation.closed_loop import ClosedLoop, gap_plan
from tormagd.simulation.device import MessageDevice
from tormagd.simulation.firmware import Firmware
from tormagd.simulation.hand import SteadyHand
from tormagd.simulation.parameters import PlantParameters, changed, load_plant

CLOSED_MM, HALF_MM, OPEN_MM = 48.0, 70.0, 95.0
NAMED_S = 0.5
MM_S = 20.0
"More than the weakest device closes the gap by."
Spoils = Callable[[MessageDevice, float], None]
Opens = Callable[..., ClosedLoop]


@pytest.fixture(scope="module")
def closed(make: Opens) -> Opens:
    def build(bus: str, plant: str | PlantParameters = "sample_1", gap_mm: float = HALF_MM, faults=()) -> ClosedLoop:
        loop = make(plant, SteadyHand(0.0), faults, planned=False, is_on_bus=bus == "can")
        loop.arm(gap_plan(OPEN_MM))
        list(loop.hold(gap_mm, 0.6 + (OPEN_MM - gap_mm) / MM_S))
        assert loop.stepper.safety.faults == ()
        return loop

    return build


def named_s(loop: ClosedLoop, spoils: Spoils | None = None, seconds: float = 6.0) -> float:
    """Return after how long NOT_OPENING is latched; `spoils` runs after each tick."""
    begins_s = loop.now_s
    for sample in loop.hold(CLOSED_MM, seconds):
        if Fault.NOT_OPENING in sample.safety.faults:
            return loop.now_s - begins_s
        if spoils is not None:
            spoils(loop.simulated, loop.now_s)
    return math.inf


def never_begins(device: MessageDevice, time_s: float) -> None:
    assert isinstance(device.firmware, Firmware)
    if device.firmware.mode is DeviceMode.RETRACTING:
        device.firmware._rest(time_s, DeviceMode.IDLE)


@pytest.mark.parametrize(
    ("bus", "ends"),
    [
        ("serial", lambda loop: loop.command("disable")),
        ("can", lambda loop: loop.command("stop")),
        ("serial", lambda loop: loop.stepper.latch(Fault.PLAN_FAILED)),
    ],
    ids=["disable", "stop", "a fault"],
)
def test_a_retract_that_does_not_begin_is_named(closed: Opens, bus: str, ends: Callable[[ClosedLoop], None]) -> None:
    loop = closed(bus)
    ends(loop)
    assert named_s(loop, never_begins) <= NAMED_S
    assert loop.simulated.truth.gap_mm < HALF_MM + 2.0


SAMPLES = {name: load_plant(name) for name in ("sample_1", "sample_2", "sample_3")}
HEALTHY = {
    **{bus: (bus, SAMPLES["sample_1"]) for bus in ("serial", "can")},
    **{f"{name} at 9.1 V": ("serial", changed(plant, "electronics", supply_V=9.1)) for name, plant in SAMPLES.items()},
    "14.9 V": ("serial", changed(SAMPLES["sample_2"], "electronics", supply_V=14.9)),
    **{
        f"{ambient_C:g} C": ("serial", changed(SAMPLES["sample_1"], "assumed", ambient_C=ambient_C))
        for ambient_C in (5.0, 40.0)
    },
    "slow clock": ("serial", SAMPLES["sample_1"], "clock=-5%"),
    "worn": ("serial", SAMPLES["sample_1"], "worn_gearbox"),
}


@pytest.mark.parametrize("case", HEALTHY)
def test_a_healthy_opening_is_no_fault(closed: Opens, case: str) -> None:
    bus, plant, *faults = HEALTHY[case]
    loop = closed(bus, plant, CLOSED_MM, faults)
    list(loop.hold(70.0, 1.5))
    list(loop.hold(CLOSED_MM, 0.3))
    loop.command("disable")
    assert (named_s(loop, seconds=3.0), loop.stepper.safety.faults) == (math.inf, ())
    assert loop.simulated.truth.gap_mm > OPEN_MM - 1.0
    for gap_mm, closes_s, opens_s in ((94.0, 0.3, 1.0), (60.0, 1.0, 2.0)):
        loop.command("enable")
        list(loop.hold(gap_mm, closes_s))
        loop.command("disable")
        assert named_s(loop, seconds=opens_s) == math.inf
