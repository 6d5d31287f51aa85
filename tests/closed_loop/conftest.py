"""What the closed loops share: one core, devices behind it, and what is asked of them. All of it is synthetic."""

from collections.abc import Callable, Iterable

import pytest

from tormagd.config import Config
from tormagd.control.assembly.build import Core
from tormagd.control.records import TimedSetpoint
from tormagd.simulation.can_device import CanDevice
from tormagd.simulation.closed_loop import ClosedLoop, Sample, VirtualBus, gap_plan
from tormagd.simulation.device import MessageDevice, VirtualDevice
from tormagd.simulation.faults import parse_fault
from tormagd.simulation.hand import Hand, SteadyHand
from tormagd.simulation.parameters import PlantParameters, load_plant, standing

OPEN_MM = 95.0
VALID_S = 0.2
Maker = Callable[..., ClosedLoop]


@pytest.fixture(scope="session")
def make(core: Core) -> Maker:
    def build(
        plant: str | PlantParameters = "sample_1",
        hand: Hand | None = None,
        faults: Iterable[str] = (),
        seed: int = 1,
        *,
        planned: bool = True,
        is_on_bus: bool = False,
        config: Config | None = None,
        core: Core = core,
    ) -> ClosedLoop:
        parameters = load_plant(plant) if isinstance(plant, str) else plant
        made = parameters, hand or SteadyHand(), [parse_fault(fault) for fault in faults], seed
        device = VirtualBus(CanDevice(MessageDevice(*made))) if is_on_bus else VirtualDevice(*made)
        return ClosedLoop(config or Config(), core.stepper(), core.planner() if planned else None, device)

    return build


@pytest.fixture(scope="session")
def arm(make: Maker) -> Maker:
    def armed(
        plant: str | PlantParameters = "sample_1", *hand: Hand, planned: bool = True, **options: object
    ) -> ClosedLoop:
        parameters = load_plant(plant) if isinstance(plant, str) else plant
        loop = make(standing(parameters, 47.0, 46.5), *hand, planned=planned, **options)
        loop.arm(None if planned else gap_plan(OPEN_MM))
        return loop

    return armed


@pytest.fixture
def armed(arm: Maker) -> ClosedLoop:
    return arm()


@pytest.fixture(scope="session")
def render() -> Callable[[ClosedLoop, float, float], list[Sample]]:
    def rendered(loop: ClosedLoop, asked_N: float, seconds: float) -> list[Sample]:
        return list(loop.run(seconds, lambda now_s: TimedSetpoint(asked_N, now_s, VALID_S)))

    return rendered
