"""A host in virtual time, for talking to the simulated device as the daemon would."""

from collections.abc import Callable, Iterable
from typing import TypeVar

import msgspec
import pytest

from firmware_protocol.codec import (
    FUNCTION,
    PROTOCOL_VERSION,
    SCHEMA_HASH,
    DeviceFault,
    DeviceMode,
    Drive,
    DriveMode,
    Hello,
    Home,
    Identity,
    Message,
    State,
    Status,
    Switches,
    decode,
    encode,
)
from firmware_protocol.framing import FrameDecoder, encode_frame
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.faults import parse_fault
from tormagd.simulation.hand import Hand, SteadyHand
from tormagd.simulation.parameters import PlantParameters, load_plant

PERIOD_S = 1e-3
M = TypeVar("M", bound=Message)


class Host:
    """Exchanges messages with a device every millisecond of virtual time and keeps what came back."""

    def __init__(self, device: VirtualDevice) -> None:
        self.device = device
        self.ticks = 0
        self.received: list[tuple[float, Message]] = []
        self._decoder = FrameDecoder()
        self._sequence = 0
        self._counter = 0
        self._nonce = 0

    @property
    def time_s(self) -> float:
        return self.ticks * PERIOD_S

    def send(self, message: Message) -> None:
        self.device.receive(self.time_s, encode_frame(FUNCTION[type(message)], self._sequence, encode(message)))
        self._sequence = (self._sequence + 1) % 256

    def wait(self, seconds: float) -> None:
        """Silence for that time."""
        for _ in range(round(seconds / PERIOD_S)):
            self.ticks += 1
            for frame in self._decoder.feed(self.device.transmit(self.time_s)):
                self.received.append((self.time_s, decode(frame.function, frame.payload)))

    def drive(self, left: float, right: float, mode: DriveMode = DriveMode.RUN) -> None:
        self._counter = (self._counter + 1) % 256
        self.send(Drive(left, right, mode, self._counter))
        self.wait(PERIOD_S)

    def drive_until(self, time_s: float, left: float = 0.0, right: float = 0.0) -> None:
        while self.time_s < time_s:
            self.drive(left, right)

    def drive_while_running(self, left: float, right: float) -> None:
        while self.status.mode is DeviceMode.RUN:
            self.drive(left, right)
            assert self.time_s < 20.0

    def heartbeat(self, seconds: float) -> None:
        for _ in range(round(seconds / PERIOD_S)):
            self.drive(0.0, 0.0, DriveMode.OFF)

    def command(self, kind: Callable[[int], Message]) -> None:
        self._nonce += 1
        self.send(kind(self._nonce))
        self.wait(0.041)

    def acknowledged(self) -> bool:
        """Whether the last command's nonce came back."""
        return self.status.command_nonce == self._nonce

    def hello(self) -> Identity:
        self.send(Hello(SCHEMA_HASH, PROTOCOL_VERSION, 200))
        self.wait(0.005)
        return self.last(Identity)

    def last(self, kind: type[M]) -> M:
        return next(message for _, message in reversed(self.received) if isinstance(message, kind))

    @property
    def status(self) -> Status:
        return self.last(Status)

    def home(self) -> None:
        """Say hello, home, and check that it worked."""
        self.hello()
        self.command(Home)
        for _ in range(60):
            self.heartbeat(0.1)
            if self.status.mode is not DeviceMode.HOMING:
                break
        assert self.status.mode is DeviceMode.IDLE
        assert Switches.HOMED in self.status.switches
        assert self.status.faults == DeviceFault(0)

    def go_to(self, gap_mm: float, seconds: float = 1.5) -> None:
        """Run to a gap with a plain proportional loop on each carriage, starting homed."""
        target_mm = gap_mm / 2.0 - 47.5
        for _ in range(round(seconds / PERIOD_S)):
            state = self.last(State)
            errors = (target_mm - state.left_position_mm, target_mm - state.right_position_mm)
            left, right = (min(max(2.0 * error, -1.0), 1.0) for error in errors)
            self.drive(left, right)

    def wait_for(self, mode: DeviceMode, limit_s: float = 10.0) -> float:
        """Wait in silence until Status shows the mode; the time it took."""
        start_s = self.time_s
        while self.status.mode is not mode:
            self.wait(0.02)
            assert self.time_s - start_s < limit_s, f"{self.status} after {limit_s} s, {mode!r} expected"
        return self.time_s - start_s


HostMaker = Callable[..., Host]


@pytest.fixture(scope="session")
def sample_1() -> PlantParameters:
    return load_plant("sample_1")


@pytest.fixture
def make_host(sample_1: PlantParameters) -> HostMaker:
    def make(
        faults: Iterable[str] = (),
        plant: PlantParameters = sample_1,
        hand: Hand | None = None,
        seed: int = 0,
    ) -> Host:
        return Host(VirtualDevice(plant, hand or SteadyHand(), [parse_fault(fault) for fault in faults], seed))

    return make


@pytest.fixture
def running(make_host: HostMaker) -> HostMaker:
    """Like make_host, but homed and at a gap of 60 mm, in RUN, which is before 3.4 s."""

    def start(gap_mm: float, faults: Iterable[str], **keywords: object) -> Host:
        host = make_host(faults, **keywords)
        host.home()
        host.go_to(gap_mm)
        assert host.status.mode is DeviceMode.RUN
        assert host.time_s < 3.4
        assert host.device.truth.gap_mm == pytest.approx(gap_mm, abs=0.3)
        return host

    def near_home(name: str) -> PlantParameters:
        plant = load_plant(name)
        assumed = msgspec.structs.replace(plant.assumed, start_left_mm=46.0, start_right_mm=45.5)
        return msgspec.structs.replace(plant, assumed=assumed)

    def make(faults: Iterable[str] = (), *, gap_mm: float = 60.0, plant: str = "sample_1") -> Host:
        return start(gap_mm, faults, plant=near_home(plant))

    return make
