"""What the control tests share: one core, and a device that is described instead of simulated."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest

from firmware_protocol.codec import DeviceFault, DeviceMode, Switches
from tormagd.assembly.build import Core, build_core
from tormagd.config import Config
from tormagd.control.core import Planner
from tormagd.control.records import Handle, Measured, Plan, TimedSetpoint
from tormagd.hardware.measurement import Measurement
from tormagd.model.displacement import MOBILISED_MM, Turn
from tormagd.model.memory import NO_MEMORY
from tormagd.model.model_file import ForceModel, load_model

MeasurementMaker = Callable[..., Measurement]
PERIOD_S = 0.004
"Between plans."


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


@pytest.fixture(scope="session")
def moving() -> Callable[..., Measured]:
    """A homed device whose handle has long moved, which gives what the shipped model says. Its Sense never ages."""

    def make(gap_mm: float = 78.1, force_N: float = 1.0871, **changes: object) -> Measured:
        half_mm, handle = gap_mm / 2.0, Handle(MOBILISED_MM, 42.0, Turn(1.0, 0.0, 100.0), 42.0)
        measured = Measured(1, True, 0.0, half_mm, half_mm, 0.0, 0.0, force_N, handle, 100.0, math.inf, 0.0)
        return measured.replaced(**changes)

    return make


@pytest.fixture(scope="session")
def planned() -> Callable[..., Plan]:
    """The planner's next plan, a period later, for a setpoint of that moment. What was measured is news."""

    def plan(planner: Planner, force_N: float, measured: Measured | None = None, **setpoint: object) -> Plan:
        now_s = planner.planned.time_s + PERIOD_S
        if measured is not None:
            measured = measured.replaced(number=planner.believe.read + 1)
        return planner.plan(now_s, TimedSetpoint(force_N, now_s, 0.1).replaced(**setpoint), measured)

    return plan
