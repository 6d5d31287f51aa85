"""One suite for every transport: the daemon's core, link and backend against a device at the end of a bad line.

Everything is real but the time: the far end hands what the device has sent to the kernel's pty or socket when the
virtual clock says so, spoiled by a seeded line, and waits until it is readable. So every case is the same every time.
"""

import contextlib
import fcntl
import math
import os
import select
import socket
import struct
import termios
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import can
import numpy as np
import pytest
from bad_lines import (
    MakeTransfer,
    damaging,
    delaying,
    doubling,
    frame_of,
    in_bursts,
    losing,
    reordering,
    unit_of,
    whole,
)
from leaves import leaves

from firmware_protocol.codec import Drive, DriveMode, Home, Message
from tormagd.config import Config, Device
from tormagd.control.assembly.build import Core
from tormagd.control.safety.codes import Fault, Limit
from tormagd.control.safety.operating_state import OperatingState
from tormagd.hardware.backend import Backend, BackendError, choose
from tormagd.hardware.link import LinkState
from tormagd.hardware.streams import FrameStream
from tormagd.simulation.can_device import DEVICE, CanDevice, CanFrame
from tormagd.simulation.can_port import from_socket, to_socket
from tormagd.simulation.closed_loop import ClosedLoop, Sample, stream
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.hand import SteadyHand
from tormagd.simulation.parameters import load_plant, standing
from tormagd.simulation.pty_port import Pty, PtyPort, SlcanPort

CONFIG = Config()
PATIENCE_S = 10.0
"Only a failure waits so long."
MOVING_S = 0.3
OPENING_S = 2.4
"The slower of two openings, with the device's own timeout before it."
FORCE_N = 1.4
CLOSED_MM, OPEN_MM = 46.9, 95.1
SETTLED_TICKS = 200
"At the end of a case, when the gap has long arrived."
MIN_NUMBERS = 30
"One sample holds more in its nested values, even of a device that is not there."
COASTING_MM = 8.0
"How far the carriages may still close after a fault on a late line."


def descriptor(backend: Any) -> int:
    return int(backend._fd)


class Case(NamedTuple):
    way: MakeTransfer = whole
    tolerance_N: float = math.inf
    faults: frozenset[Fault] = frozenset()
    named: frozenset[Fault | Limit] = frozenset()
    link: LinkState = LinkState.RUNNING
    losses: int = 0
    bad_s: float = 0.5
    is_bytewise: bool = False
    counted: tuple[str, ...] = ()
    uncounted: tuple[str, ...] = ()


TOO_LATE = frozenset({Fault.MEASUREMENT_STALE, Fault.DEVICE_COMMAND_TIMEOUT, Fault.LINK_LOST})
CASES = {
    "clean": Case(tolerance_N=0.05),
    "one byte at a time": Case(tolerance_N=0.05, is_bytewise=True),
    "20% loss": Case(partial(losing, 0.2), tolerance_N=0.05, counted=("lost",)),
    # State carries a CRC everywhere, Sense and Status only on serial: there a force or a fault bit may be wrong
    "5% corruption": Case(
        partial(damaging, 0.05), tolerance_N=0.5, faults=frozenset(Fault), counted=("corrupt", "resynchronisations")
    ),
    "duplicates": Case(doubling, tolerance_N=0.05),
    "reordering": Case(partial(reordering, 0.2), tolerance_N=0.05, uncounted=("lost", "corrupt")),
    # what the device says answers a drive of 60 ms ago, and a loop around that would swing
    "30 ms delay": Case(partial(delaying, 0.03), faults=TOO_LATE, named=TOO_LATE),
    "burst": Case(partial(in_bursts, 0.06), faults=TOO_LATE, named=TOO_LATE),
    # lost, and since then the port was opened again and the device asked who it is
    "cut": Case(partial(losing, 1.0), faults=TOO_LATE, named=TOO_LATE, link=LinkState.IDENTIFYING, losses=1),
}


class PtyEnd(Pty):
    end: bytes
    carried = said = arrived = b""

    def read(self) -> bytes:
        return self.carried

    def write(self, data: bytes) -> None:
        self.said += data

    def units(self, now_s: float) -> list[bytes]:
        self.exchange(now_s, ())  # type: ignore[attr-defined]
        *units, self.said = self.said.split(self.end)
        return [unit + self.end for unit in units]

    def take(self, now_s: float, unit: bytes) -> None:
        self.carried = unit
        self.exchange(now_s, self.descriptors())  # type: ignore[attr-defined]

    def hear(self) -> bytes:
        while self.end not in self.arrived:
            assert select.select(self.descriptors(), [], [], PATIENCE_S)[0], "the backend sent nothing"
            self.arrived += Pty.read(self)
        unit, _, self.arrived = self.arrived.partition(self.end)
        return unit + self.end

    def say(self, unit: bytes, backend: Backend) -> None:
        expected = _waiting(descriptor(backend)) + len(unit)
        os.write(self.descriptors()[0], unit)
        while _waiting(descriptor(backend)) < expected:
            assert select.select([descriptor(backend)], [], [], PATIENCE_S)[0], "the backend gets nothing"


class SerialEnd(PtyEnd, PtyPort):
    end = b"\x00"

    @property
    def configured(self) -> Device:
        return Device(port=self.address)


class SlcanEnd(PtyEnd, SlcanPort):
    end = b"\r"

    @property
    def configured(self) -> Device:
        return Device(backend="can", options={"interface": "slcan"}, port=self.address)

    def units(self, now_s: float) -> list[bytes]:
        while not self._adapter.is_open:  # python-can opens the channel when it opens the port
            self.take(now_s, self.hear())
        return super().units(now_s)


class PacketEnd:
    def __init__(self, device: VirtualDevice) -> None:
        self.device = CanDevice(device.messages)

    def units(self, now_s: float) -> list[bytes]:
        return [unit_of(frame) for sender, frame, _ in self.device.transmit(now_s) if sender == DEVICE]

    def take(self, now_s: float, unit: bytes) -> None:
        self.device.receive(now_s, frame_of(unit))


class TormagsimEnd(PacketEnd):
    def __init__(self, device: VirtualDevice, folder: Path) -> None:
        super().__init__(device)
        path = str(folder / "can")
        self.configured = Device(backend="can", options={"interface": "tormagsim"}, port=path)
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._listener.bind(path)
        self._listener.listen()
        self._listener.settimeout(PATIENCE_S)
        self._host: socket.socket | None = None

    def hear(self) -> bytes:
        return unit_of(from_socket(self._connected().recv(64)).frame)

    def say(self, unit: bytes, backend: Backend) -> None:
        self._connected().send(to_socket(frame_of(unit)))

    def close(self) -> None:
        self._listener.close()
        if self._host is not None:
            self._host.close()

    def _connected(self) -> socket.socket:
        if self._host is None:
            self._host, _ = self._listener.accept()
        return self._host


class BusEnd(PacketEnd):
    def __init__(self, device: VirtualDevice, interface: str, channel: str, **options: object) -> None:
        super().__init__(device)
        self.configured = Device(backend="can", options={"interface": interface}, port=channel)
        self.bus = can.Bus(interface=interface, channel=channel, ignore_config=True, **options)
        self._echoes: list[bytes] = []

    def hear(self) -> bytes:
        while (message := self.bus.recv(PATIENCE_S)) is not None:
            unit = unit_of(CanFrame(message.arbitration_id, bytes(message.data)))
            if unit not in self._echoes:
                return unit
            self._echoes.remove(unit)
        raise AssertionError("the backend sent nothing")

    def say(self, unit: bytes, backend: Backend) -> None:
        frame = frame_of(unit)
        self._echoes = [*self._echoes[-64:], unit]
        self.bus.send(can.Message(arbitration_id=frame.identifier, data=frame.data, is_extended_id=False), timeout=0)
        assert select.select([descriptor(backend)], [], [], PATIENCE_S)[0], "the backend gets nothing"

    def close(self) -> None:
        self.bus.shutdown()


FarEnd: TypeAlias = SerialEnd | SlcanEnd | TormagsimEnd | BusEnd


def udp_end(device: VirtualDevice, folder: Path) -> FarEnd:
    try:
        end = BusEnd(device, "udp_multicast", "239.74.163.77", hop_limit=0, fd=False)
        end.bus.send(can.Message(arbitration_id=0x7FF, is_extended_id=False), timeout=0)
    except (can.CanError, OSError) as error:
        pytest.skip(f"no UDP multicast: {error}")
    if end.bus.recv(1.0) is None:
        end.close()
        pytest.skip("UDP multicast does not come back on this machine")
    return end


TRANSPORTS: dict[str, Callable[[VirtualDevice, Path], FarEnd]] = {
    "serial": lambda device, folder: SerialEnd(device),
    "slcan": lambda device, folder: SlcanEnd(CanDevice(device.messages)),
    "tormagsim": TormagsimEnd,
    "udp_multicast": udp_end,
    "socketcan": lambda device, folder: BusEnd(device, "socketcan", "vcan0"),
}


MARKS = {
    # all hosts of this group on a machine hear each other: these tests do not run beside one another
    "udp_multicast": pytest.mark.live,
    "socketcan": pytest.mark.skipif(
        not Path("/sys/class/net/vcan0").exists(),
        reason="no vcan0 (sudo ip link add vcan0 type vcan; sudo ip link set vcan0 up)",
    ),
}
EVERY_TRANSPORT = [pytest.param(name, marks=MARKS.get(name, ())) for name in TRANSPORTS]


def _waiting(fd: int) -> int:
    return int(struct.unpack("i", fcntl.ioctl(fd, termios.FIONREAD, bytes(4)))[0])


class Line:
    """The closed loop's device: the real backend, a bad line, and the device behind it."""

    def __init__(self, far: FarEnd, device: VirtualDevice, case: Case) -> None:
        self.far, self.messages = far, device.messages
        self.backend = choose(far.configured, CONFIG.rates).open()
        self._bytewise = case.is_bytewise
        self._up, self._down = case.way(), case.way()
        self._to_host, self._from_host = FrameStream(), FrameStream()

    def transmit(self, now_s: float) -> bytes:
        units = self._up(now_s, self.far.units(now_s))
        for unit in self._down(now_s, []):
            self.far.take(now_s, unit)
        messages: list[Message] = []
        for unit in units:
            for piece in self._pieces(unit):
                self.far.say(piece, self.backend)
                if self._bytewise or isinstance(self.far, BusEnd):
                    messages += self.backend.receive()
        return b"".join(self._to_host.pack(message) for message in (*messages, *self.backend.receive()))

    def receive(self, now_s: float, data: bytes) -> None:
        for message in self._from_host.unpack(data):
            self.backend.send(message)
            for unit in self._down(now_s, [self.far.hear()]):
                for piece in self._pieces(unit):
                    self.far.take(now_s, piece)

    def close(self) -> None:
        self.backend.close()
        self.far.close()

    def _pieces(self, unit: bytes) -> list[bytes]:
        return [bytes((byte,)) for byte in unit] if self._bytewise and isinstance(self.far, PtyEnd) else [unit]


def a_device() -> VirtualDevice:
    return VirtualDevice(standing(load_plant("sample_1"), 46.0, 45.5), SteadyHand(), (), 1)


@pytest.fixture
def moving(core: Core) -> ClosedLoop:
    loop = ClosedLoop(CONFIG, core.stepper(), core.planner(), a_device())
    loop.arm()
    list(loop.run(MOVING_S, publisher(loop.now_s)))
    return loop


def publisher(from_s: float) -> Callable[[float], object]:
    return stream(from_s + np.arange(1_000) * 0.01, np.full(1_000, FORCE_N))


@pytest.fixture
def lines(tmp_path: Path) -> Iterator[Callable[..., Line]]:
    with contextlib.ExitStack() as opened:

        def make(transport: str, device: VirtualDevice, case: Case) -> Line:
            line = Line(TRANSPORTS[transport](device, tmp_path), device, case)
            opened.callback(line.close)
            return line

        yield make


def ticks(loop: ClosedLoop, seconds: float, is_last: Callable[[Sample], bool]) -> list[Sample]:
    """Return ticks up to the last, each checked for its duty, its numbers and the carriages' places."""
    samples = []
    for number, sample in enumerate(loop.run(seconds, publisher(loop.now_s))):
        assert max(abs(sample.output.left_duty), abs(sample.output.right_duty)) <= CONFIG.position.duty_limit
        assert CLOSED_MM < sample.truth.gap_mm < OPEN_MM
        if number % 20 == 0:
            found = [number for _, number in leaves([sample, loop.stepper])]
            assert len(found) > MIN_NUMBERS
            assert not any(map(math.isnan, found))
        samples.append(sample)
        if is_last(sample):
            break
    return samples


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
@pytest.mark.parametrize("transport", EVERY_TRANSPORT)
def test_on_any_line_the_output_keeps_its_limits_and_what_is_wrong_has_a_name(
    transport: str, case: Case, moving: ClosedLoop, lines: Callable[..., Line]
) -> None:
    line = lines(transport, moving.port.device, case)
    moving.port.device = line  # type: ignore[assignment]
    samples = ticks(moving, case.bad_s, lambda sample: sample.safety.faults != ())
    last = samples[-1]
    if last.safety.faults:
        assert last.safety.faults[0] in case.faults
        opening = ticks(moving, OPENING_S, lambda sample: sample.truth.gap_mm > OPEN_MM - 2.0)
        assert all(sample.output.mode is DriveMode.OFF for sample in (last, *opening))
        assert all(sample.safety.operating_state is OperatingState.FAULT for sample in opening)
        assert opening[-1].truth.gap_mm > OPEN_MM - 2.0
        assert min(sample.truth.gap_mm for sample in opening) > last.truth.gap_mm - COASTING_MM
    else:
        assert last.truth.force_N == pytest.approx(FORCE_N, abs=case.tolerance_N)
        assert case.tolerance_N > 0.05 or Limit.SATURATED not in last.output.limits
    assert (moving.connection.state, moving.connection.losses) == (case.link, case.losses)
    if case.named:
        settled = samples[-SETTLED_TICKS:]
        assert case.named & {name for sample in settled for name in (*sample.safety.faults, *sample.output.limits)}
    assert [name for name in case.counted if getattr(line.backend.stream.statistics, name) == 0] == []
    # at most what is on its way at the end
    assert [name for name in case.uncounted if getattr(line.backend.stream.statistics, name) > 1] == []


def open_descriptors() -> list[Path]:
    """Return all but regular files, which the watch of the host opens and closes meanwhile."""
    return [path for path in Path("/proc/self/fd").iterdir() if not path.is_file() and path.exists()]


@pytest.mark.parametrize(("transport", "said"), [("serial", ": unplugged"), ("slcan", ""), ("tormagsim", "")])
def test_a_device_that_goes_is_said_by_reading_and_writing_and_leaves_nothing_open(
    transport: str, said: str, tmp_path: Path
) -> None:
    before = open_descriptors()
    far = TRANSPORTS[transport](a_device(), tmp_path)
    backend = choose(far.configured, CONFIG.rates).open()
    far.close()
    with pytest.raises(BackendError, match=far.configured.port + said):
        backend.receive()
    with pytest.raises(BackendError, match=far.configured.port):
        backend.send(Home(1))
    backend.close()
    backend.close()
    assert open_descriptors() == before


@pytest.mark.parametrize(
    ("transport", "said", "remedy"),
    [("serial", "nobody reads", ""), ("tormagsim", "nobody acknowledges", "bit rate")],
)
def test_a_far_end_that_takes_nothing_is_noticed(
    transport: str, said: str, remedy: str, lines: Callable[..., Line]
) -> None:
    backend = lines(transport, a_device(), CASES["clean"]).backend

    def send_for_long() -> None:
        for counter in range(20_000):
            backend.send(Drive(0.0, 0.0, DriveMode.OFF, counter % 256))

    with pytest.raises(BackendError, match=said) as caught:
        send_for_long()
    assert remedy in caught.value.remedy


@pytest.mark.parametrize("second", ["serial", "slcan"])
@pytest.mark.parametrize("first", ["serial", "slcan"])
def test_a_port_belongs_to_one(first: str, second: str, lines: Callable[..., Line]) -> None:
    line = lines(first, a_device(), CASES["clean"])
    port = line.far.configured.port
    wanted = Device(**{} if second == "serial" else {"backend": "can", "options": {"interface": second}}, port=port)
    with pytest.raises(BackendError, match=f"{port}: .*another (process|program) holds it") as caught:
        choose(wanted, CONFIG.rates).open()
    assert "tormagctl ports" in caught.value.remedy
    line.backend.close()
    choose(wanted, CONFIG.rates).open().close()


@pytest.mark.parametrize("name", ["absent", "folder", "file", "pipe", "long" * 30])
@pytest.mark.parametrize("interface", ["", "tormagsim", "slcan"])
def test_what_is_no_port_and_no_channel_is_not_opened(interface: str, name: str, tmp_path: Path) -> None:
    configured = {"backend": "can", "options": {"interface": interface}} if interface else {}
    path = tmp_path / name
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "file").write_text("")
    with pytest.raises(BackendError, match="cannot be opened") as caught:
        choose(Device(**configured, port=str(path)), CONFIG.rates).open()
    assert (str(caught.value).count(str(path)), "Success" in str(caught.value)) == (1, False)
    is_told = name in ("file", "pipe") and interface != "tormagsim"
    assert str(caught.value).endswith("allowed is a serial port; this is none") is is_told
