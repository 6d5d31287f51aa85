"""What the control tests share: one core, and a device that is described instead of simulated."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest

from firmware_protocol.codec import DeviceFault, DeviceMode, Switches
from tormagd.config import Config
from tormagd.assembly.build import Core, build_core
from tormagd.hardware.measurement import Measurement
from tormagd.model.memory import NO_MEMORY
from tormagd.model.model_file import ForceModel, load_model

MeasurementMaker = Callable[..., Measurement]


@pytest.fixture(scope="session")
def config() -> Config:
    return Config()


LOADED = "tormagd.assembly.build.load_model"


def load_forgetful(path: Path, **meant: str) -> ForceModel:
    """A model that remembers nothing: with it a gap and a force say the same at any time. What is remembered has tests
    of its own."""
    model = load_model(path, **meant)
    return replace(model, metadata=msgspec.structs.replace(model.metadata, memory=NO_MEMORY))


@pytest.fixture
def forgetful(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cores are built with such a model."""
    monkeypatch.setattr(LOADED, load_forgetful)


@pytest.fixture(scope="session")
def make_core(config: Config) -> Callable[[], Core]:
    """Makes cores of the shipped coronary scene, with such a model."""

    def make() -> Core:
        with pytest.MonkeyPatch.context() as patched:
            patched.setattr(LOADED, load_forgetful)
            return build_core(config)

    return make


@pytest.fixture(scope="session")
def core(make_core: Callable[[], Core]) -> Core:
    """Such a core, in which nothing changes."""
    return make_core()


@pytest.fixture(scope="session")
def measure() -> MeasurementMaker:
    """A healthy homed device's measurement `number`, a millisecond apart, at a gap of 80 mm. All streams come."""

    def make(number: int, **changes: object) -> Measurement:
        healthy = Measurement(
            number=number,
            received_s=number * 1e-3,
            device_time_s=number * 1e-3,
            left_mm=-7.5,
            right_mm=-7.5,
            left_current_A=0.1,
            right_current_A=0.1,
            force_N=0.6,
            handle_mm=0.042 * number,
            mode=DeviceMode.RUN,
            switches=Switches.HOMED,
            faults=DeviceFault(0),
            temperature_C=23.0,
            supply_V=12.0,
            sensed_s=number * 1e-3,
            reported_s=number * 1e-3,
        )
        came = dict.fromkeys(("sensed_s", "reported_s"), changes.get("received_s", healthy.received_s))
        return healthy.replaced(**{**came, **changes})  # type: ignore[arg-type]

    return make
