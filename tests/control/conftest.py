"""What the control tests share: one core, and a device that is described instead of simulated."""

from collections.abc import Callable

import pytest

from firmware_protocol.codec import DeviceFault, DeviceMode, Switches
from tormagd.config import Config
from tormagd.control.core import Core, build_core
from tormagd.hardware.measurement import Measurement

MeasurementMaker = Callable[..., Measurement]


@pytest.fixture(scope="session")
def config() -> Config:
    return Config()


@pytest.fixture(scope="session")
def core(config: Config) -> Core:
    """The core of the shipped coronary scene; nothing in it changes."""
    return build_core(config)


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
