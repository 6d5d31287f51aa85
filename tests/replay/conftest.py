"""One core, and one flight that ended with a fault."""

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from flight import Flight, asked

from tormagd.config import Config
from tormagd.control.assembly.build import Core, build_core
from tormagd.simulation.can_device import CanDevice
from tormagd.simulation.closed_loop import VirtualBus
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.faults import parse_fault
from tormagd.simulation.hand import ReversingHand
from tormagd.simulation.parameters import load_plant

Fly = Callable[..., Flight]


@pytest.fixture(scope="session")
def core() -> Core:
    return build_core(Config())


@pytest.fixture(scope="session")
def fly(core: Core) -> Fly:
    shipped = core

    def make(
        *faults: str, until_s: float, silent_s: float = 0.0, config: Config | None = None, bus: bool = False
    ) -> Flight:
        core = shipped if config is None else build_core(config)
        config = config or Config()
        device = VirtualDevice(load_plant("sample_1"), ReversingHand(2.0), [parse_fault(it) for it in faults], 1)
        flight = Flight(config, core, VirtualBus(CanDevice(device.messages)) if bus else device)
        flight.arm()
        while flight.loop.now_s < until_s:
            flight.tick(asked(flight.loop.now_s))
        for _ in range(round(silent_s * 1e3)):
            flight.loop.skip()
        for _ in range(200 if silent_s else 0):
            flight.tick(asked(flight.loop.now_s))
        return flight

    return make


@pytest.fixture(scope="session")
def ended(fly: Fly) -> Flight:
    return fly("encoder_jump@3.5", until_s=4.0)


@pytest.fixture(scope="session")
def path(ended: Flight, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return ended.write(tmp_path_factory.mktemp("boxes") / "ended.mcap")
