"""What the control tests share: one core, and a device that is described instead of simulated."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest

from firmware_protocol.codec import DeviceFault, DeviceMode, DriveMode, Switches
from tormagd.config import Config
from tormagd.control.assembly.build import Core, build_core
from tormagd.control.core import Planner, Stepper
from tormagd.control.records import Duty, Handle, Measured, Plan, TimedSetpoint
from tormagd.control.safety.codes import Fault
from tormagd.control.safety.operating_state import Conditions, OperatingState, RefusedError
from tormagd.element.model.displacement import MOBILISED_MM, Turn
from tormagd.element.model.memory import NO_MEMORY
from tormagd.element.model.model_file import ForceModel, load_model
from tormagd.hardware.measurement import DeviceRequest, Measurement
from tormagd.scenes.scene import Scene

MeasurementMaker = Callable[..., Measurement]
PERIOD_S, PLAN_PERIOD_S = 1e-3, 4e-3
READY = Conditions(connected=True, fresh=True, homed=True, busy=False, device_latched=False)


LOADED = "tormagd.control.assembly.build.load_model"


def load_forgetful(path: Path, **meant: str) -> ForceModel:
    """A model that remembers nothing, so that a gap and a force say the same at any time."""
    model = load_model(path, **meant)
    return replace(model, metadata=msgspec.structs.replace(model.metadata, memory=NO_MEMORY))


@pytest.fixture
def forgetful(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(LOADED, load_forgetful)


@pytest.fixture(scope="session")
def core() -> Core:
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(LOADED, load_forgetful)
        return build_core(Config())


@pytest.fixture
def planner(core: Core) -> Planner:
    return core.planner()


@pytest.fixture(scope="session")
def measure() -> MeasurementMaker:
    """Measurements of a healthy homed device, a millisecond apart, at a gap of 80 mm."""

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


class Bench:
    """A Stepper fed with described measurements, a millisecond apart."""

    def __init__(self, stepper: Stepper, measure: MeasurementMaker) -> None:
        self.stepper, self.move, self.watch, self.measure = stepper, stepper.move, stepper.watch, measure
        self.now_s, self.ticks = 0.0, 0
        self.output: Duty

    @property
    def faults(self) -> tuple[Fault, ...]:
        return self.stepper.safety.faults

    @property
    def driven(self) -> tuple[DriveMode, float, float]:
        return self.output.mode, self.output.left_duty, self.output.right_duty

    @property
    def is_off(self) -> bool:
        return self.driven == (DriveMode.OFF, 0.0, 0.0)

    @property
    def is_held(self) -> bool:
        return self.driven == (DriveMode.RUN, 0.0, 0.0)

    @property
    def opened_for(self) -> tuple[Fault, ...] | None:
        is_faulty = self.stepper.safety.operating_state is OperatingState.FAULT
        is_opened = is_faulty and self.is_off and self.output.request is DeviceRequest.RETRACT
        return self.faults if is_opened else None

    @property
    def there(self) -> dict[str, float]:
        return self.gap(self.move.reference.gap_mm)  # type: ignore[union-attr]

    @staticmethod
    def gap(gap_mm: float) -> dict[str, float]:
        return dict.fromkeys(("left_mm", "right_mm"), gap_mm / 2.0 - 47.5)

    def plan(self, gap_mm: float, **fields: object) -> Plan:
        at_rest = Plan(1, self.now_s, None, None, 0.0, None, 0.0, gap_mm, 0.0, 1.0, ())
        return at_rest.replaced(**fields)  # type: ignore[arg-type]

    def at(self, now_s: float, measurement: Measurement | None, aim: Plan | float = 80.0) -> Duty:
        self.now_s = now_s
        self.output = self.stepper.step(now_s, measurement, aim if isinstance(aim, Plan) else self.plan(aim))
        return self.output

    def step(self, aim: Plan | float = 80.0, count: int = 1, **changes: object) -> Duty:
        """Run some control periods with the same kind of measurement."""
        for _ in range(count):
            self.ticks += 1
            self.at(self.ticks * PERIOD_S, self.measure(self.ticks, **changes), aim)
        return self.output

    def silent(self, measurement: Measurement | None, count: int = 1) -> Duty:
        """Run some control periods in which this measurement stays the newest."""
        for _ in range(count):
            self.ticks += 1
            self.at(self.ticks * PERIOD_S, measurement)
        return self.output

    def command(self, name: str, **conditions: object) -> None:
        self.stepper.command(name, self.now_s, READY.replaced(**conditions))  # type: ignore[arg-type]

    def refused(self, name: str, **conditions: object) -> RefusedError:
        with pytest.raises(RefusedError) as caught:
            self.command(name, **conditions)
        return caught.value

    def enabled(self, **changes: object) -> "Bench":
        self.step(count=3, **changes)
        self.command("enable")
        return self

    def run_into(self, fault: Fault, aim: Plan | float = 80.0, **changes: object) -> int:
        """Return how many periods it takes until exactly this fault is latched."""
        start = self.ticks
        while not self.faults:
            self.step(aim, **changes)
            assert self.ticks - start < 1_000, f"no {fault}"
        assert self.opened_for == (fault,)
        return self.ticks - start


@pytest.fixture(scope="session")
def make_bench(core: Core, measure: MeasurementMaker) -> Callable[..., Bench]:
    def make(scene: Scene = core.scene, **sections: dict[str, object]) -> Bench:
        changed = {
            name: msgspec.structs.replace(getattr(core.config, name), **values) for name, values in sections.items()
        }
        return Bench(Stepper(msgspec.structs.replace(core.config, **changed), scene), measure)

    return make


@pytest.fixture
def bench(make_bench: Callable[..., Bench]) -> Bench:
    return make_bench()


@pytest.fixture
def running(bench: Bench) -> Bench:
    bench.enabled().step(count=3)
    assert bench.stepper.safety.operating_state is OperatingState.ENABLED
    return bench


@pytest.fixture(scope="session")
def moving() -> Callable[..., Measured]:
    """A homed device whose handle has long moved, which gives what the shipped model says."""

    def make(gap_mm: float = 78.1, force_N: float = 1.0871, **changes: object) -> Measured:
        half_mm, handle = gap_mm / 2.0, Handle(MOBILISED_MM, 42.0, Turn(1.0, 0.0, 100.0), 42.0)
        measured = Measured(1, True, 0.0, half_mm, half_mm, 0.0, 0.0, force_N, handle, 100.0, math.inf, 0.0)
        return measured.replaced(**changes)

    return make


@pytest.fixture(scope="session")
def planned() -> Callable[..., Plan]:
    def plan(planner: Planner, force_N: float, measured: Measured | None = None, **setpoint: object) -> Plan:
        now_s = planner.planned.time_s + PLAN_PERIOD_S
        if measured is not None:
            measured = measured.replaced(number=planner.believe.read + 1)
        return planner.plan(now_s, TimedSetpoint(force_N, now_s, 0.1).replaced(**setpoint), measured)

    return plan
