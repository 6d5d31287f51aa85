"""What the closed loops share: one core, devices behind it, and what is asked of them. All of it is synthetic."""

from collections.abc import Callable, Iterable, Iterator

import pytest

from tormagd.config import Config
from tormagd.control.assembly.build import Core
from tormagd.control.records import TimedSetpoint
from tormagd.simulation.closed_loop import ClosedLoop, Sample, gap_plan
from tormagd.simulation.device import VirtualDevice
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
        config: Config | None = None,
        core: Core = core,
    ) -> ClosedLoop:
        parameters = load_plant(plant) if isinstance(plant, str) else plant
        device = VirtualDevice(parameters, hand or SteadyHand(), [parse_fault(fault) for fault in faults], seed)
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
def gap_ticks() -> Callable[[ClosedLoop, float, float], Iterator[Sample]]:
    """The ticks, one by one, while a gap is asked for."""

    def ticks(loop: ClosedLoop, gap_mm: float, seconds: float) -> Iterator[Sample]:
        for _ in range(round(1e3 * seconds)):
            yield loop.tick(plan=gap_plan(gap_mm, loop.now_s))

    return ticks


@pytest.fixture(scope="session")
def hold_gap(gap_ticks: Callable[..., Iterator[Sample]]) -> Callable[[ClosedLoop, float, float], list[Sample]]:
    return lambda *asked: list(gap_ticks(*asked))


@pytest.fixture(scope="session")
def render() -> Callable[[ClosedLoop, float, float], list[Sample]]:
    def rendered(loop: ClosedLoop, asked_N: float, seconds: float) -> list[Sample]:
        return list(loop.run(seconds, lambda now_s: TimedSetpoint(asked_N, now_s, VALID_S)))

    return rendered
