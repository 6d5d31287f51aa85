"""What each backend is besides the contract: a serial port, the simulator's bus, a slcan adapter, a bus that fails."""

import contextlib
import errno
import os
import select
import socket
import termios
import tty
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import can
import pytest

from firmware_protocol.codec import DeviceFault, DeviceMode, Drive, DriveMode, Home, Message, Status, Switches
from tormagd.config import Device, Rates
from tormagd.hardware.backend import ENTRY_POINTS, Backend, BackendError, choose, installed
from tormagd.hardware.can_backend import FRAMES_AT_ONCE, UNSENT_FRAMES, CanBackend, CanOptions
from tormagd.hardware.can_stream import CanStream
from tormagd.hardware.frame_stream import FrameStream
from tormagd.hardware.serial_backend import SerialOptions, open_serial
from tormagd.hardware.serial_port import SerialPort
from tormagd.simulation.can_frame import ERROR_FLAG, CanFrame, to_socket
from tormagd_client.endpoints import ConfigError

STATUS = Status(DeviceMode.IDLE, Switches(0), DeviceFault(0), 23.0, 12.0, 0, 0)
BUS_OFF = CanFrame(ERROR_FLAG | 0x40, bytes(8))
PASSIVE = CanFrame(ERROR_FLAG | 0x04, bytes((0, 0x30, 0, 0, 0, 0, 0, 0)))


def frame_of(message: Message) -> CanFrame:
    return CanFrame(*CanStream(1).pack(message))


def opened(device: Device) -> CanBackend:
    """The backend that the configuration asks for."""
    backend = choose(device, Rates()).open()
    assert isinstance(backend, CanBackend)
    return backend


def wait_readable(backend: Backend) -> None:
    assert select.select([backend.fileno()], [], [], 5.0)[0]


def next_of(backend: CanBackend) -> list[Message]:
    """What comes next, together."""
    while not (received := backend.receive()):
        wait_readable(backend)
    return received


# -- on a serial line -------------------------------------------------------------------------------------------------


class Line(NamedTuple):
    """A pseudo-terminal whose far end the test holds."""

    far: int
    near: int
    device: Device

    @property
    def adapter(self) -> Device:
        """What is there where it is a slcan adapter's."""
        return Device(backend="can", options={"interface": "slcan"}, port=self.device.port)


@pytest.fixture
def line() -> Iterator[Line]:
    far, near = os.openpty()
    tty.setraw(near)
    yield Line(far, near, Device(port=os.ttyname(near)))
    os.close(far)
    os.close(near)


@pytest.fixture
def port(line: Line) -> Iterator[SerialPort]:
    opened = open_serial(line.device, SerialOptions())
    yield opened
    opened.close()


def test_bytes_from_before_the_opening_are_not_read(line: Line) -> None:
    os.write(line.far, b"half a frame of an earlier life")
    port = open_serial(line.device, SerialOptions())
    os.write(line.far, FrameStream().pack(STATUS))
    wait_readable(port)
    assert port.receive() == [STATUS]
    assert port.statistics.corrupt == 0
    port.close()


def test_end_of_file_is_a_device_that_was_unplugged(port: SerialPort, monkeypatch: pytest.MonkeyPatch) -> None:
    """A real USB port reads nothing, for ever, once its device is gone."""
    monkeypatch.setattr(os, "read", lambda descriptor, count: b"")
    with pytest.raises(BackendError, match="unplugged"):
        port.receive()


def test_what_the_driver_did_not_take_is_sent_before_the_next_frame(
    line: Line, port: SerialPort, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken = b""
    room = iter([3, 0, 7, 0, 0, 100, 100])

    def write(descriptor: int, data: bytes) -> int:
        nonlocal taken
        assert descriptor == port.fileno()
        count = next(room)
        if not count:
            raise BlockingIOError
        taken += data[:count]
        return len(data[:count])

    monkeypatch.setattr(os, "write", write)
    for nonce in range(1, 8):
        port.send(Home(nonce))
    far = FrameStream()
    assert far.unpack(taken) == [Home(nonce) for nonce in range(1, 8)]
    assert far.statistics.lost == 0


def test_a_port_that_goes_while_it_is_set_up_is_not_opened(line: Line, monkeypatch: pytest.MonkeyPatch) -> None:
    def gone(descriptor: int) -> None:
        raise termios.error(errno.EIO, "Input/output error")

    monkeypatch.setattr(termios, "tcgetattr", gone)
    with pytest.raises(BackendError, match="Input/output error"):
        open_serial(line.device, SerialOptions())


# -- on the simulator's bus ----------------------------------------------------------------------------------------


class Bus:
    """A served bus whose far end the test holds."""

    def __init__(self, folder: Path) -> None:
        self.device = Device(backend="can", options={"interface": "tormagsim"}, port=str(folder / "can"))
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._listener.bind(self.device.port)
        self._listener.listen()
        self.backend = opened(self.device)
        self.far, _ = self._listener.accept()

    def put(self, *frames: CanFrame) -> None:
        """Frames that the backend finds on the bus."""
        for frame in frames:
            self.far.send(to_socket(frame))

    def close(self) -> None:
        """Takes everything away."""
        self.backend.close()
        self.far.close()
        self._listener.close()


@pytest.fixture
def bus(tmp_path: Path) -> Iterator[Bus]:
    with contextlib.closing(Bus(tmp_path)) as made:
        yield made


def test_bus_off_is_said_by_its_name(bus: Bus) -> None:
    bus.put(frame_of(STATUS), BUS_OFF)
    with pytest.raises(BackendError, match="bus-off") as caught:
        bus.backend.receive()
    assert bus.device.port in str(caught.value)
    assert "termination" in caught.value.remedy


def test_an_error_frame_that_is_not_bus_off_is_counted(bus: Bus) -> None:
    bus.put(PASSIVE, frame_of(STATUS))
    assert bus.backend.receive() == [STATUS]
    assert (bus.backend.statistics.corrupt, bus.backend.statistics.resynchronisations) == (1, 1)


def test_another_host_on_the_same_node_ends_the_connection(bus: Bus) -> None:
    bus.put(frame_of(Drive(0.1, 0.1, DriveMode.RUN, 1)))
    with pytest.raises(BackendError, match="another host drives node 1") as caught:
        bus.backend.receive()
    assert "device.options.node" in caught.value.remedy


def test_no_more_frames_are_taken_at_once_than_the_loop_can_bear(bus: Bus) -> None:
    bus.far.setblocking(False)
    queued = 0
    with contextlib.suppress(BlockingIOError):
        for queued in range(2 * FRAMES_AT_ONCE):  # noqa: B007 - counts what the kernel takes
            bus.put(frame_of(STATUS))
    assert len(bus.backend.receive()) == min(queued, FRAMES_AT_ONCE)


@pytest.mark.parametrize(
    ("number", "said", "first"),
    [(errno.ENODEV, "no such interface", "plug"), (errno.EAFNOSUPPORT, "knows no CAN", "sudo modprobe")],
)
def test_an_interface_that_is_not_there_says_how_it_comes(
    monkeypatch: pytest.MonkeyPatch, number: int, said: str, first: str
) -> None:
    def absent(**_options: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(can, "Bus", absent)
    with pytest.raises(BackendError, match=f"socketcan can7: cannot be opened: .*{said}") as caught:
        opened(Device(backend="can", options={"interface": "socketcan"}, port="can7"))
    assert caught.value.remedy.startswith(first)
    assert "ip link set can7 up type can bitrate 1000000" in caught.value.remedy


# -- behind an adapter on a serial line ----------------------------------------------------------------------------


def test_lines_of_an_adapter_pass_both_ways(line: Line) -> None:
    backend = opened(line.adapter)
    backend.send(Home(7))
    said = b""
    while not said.endswith(b"t061107\r"):
        said += os.read(line.far, 100)
    assert said.startswith(b"C\rS8\r")
    status = frame_of(STATUS)
    os.write(line.far, b"\rz\r\at%03X8%s\r" % (status.identifier, status.data.hex().encode()))
    assert next_of(backend) == [STATUS]
    backend.close()


@pytest.mark.parametrize("damaged", [b"t07x8\r", b"t0718zz\r", b"t071\r", b"\xff\xfe071\r", b"t0719\r", b"tttt\r"])
def test_a_damaged_line_is_counted_and_the_next_is_read(line: Line, damaged: bytes) -> None:
    backend = opened(line.adapter)
    os.write(line.far, damaged)
    while not backend.statistics.corrupt:
        wait_readable(backend)
        assert backend.receive() == []
    os.write(line.far, b"t0718%s\r" % frame_of(STATUS).data.hex().encode())
    assert next_of(backend) == [STATUS]
    assert backend.statistics.resynchronisations == 1
    backend.close()


# -- a bus that fails as told --------------------------------------------------------------------------------------


class FailingBus(can.BusABC):
    """Hands out what it is given, and raises what it is given."""

    def __init__(self, *events: can.Message | Exception) -> None:
        self.events = list(events)
        self._fd, self._other = os.pipe()
        if events:
            os.write(self._other, b"x")
        super().__init__(channel="none")

    def fileno(self) -> int:
        return self._other  # always writable, never readable

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        event = self.events.pop(0) if self.events else None
        if isinstance(event, Exception):
            raise event
        return event, False

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        event = self.events.pop(0) if len(self.events) > 1 else self.events[0]
        assert isinstance(event, Exception)
        raise event

    def shutdown(self) -> None:
        super().shutdown()
        os.close(self._fd)
        os.close(self._other)


@pytest.fixture
def failing() -> Iterator[Callable[..., CanBackend]]:
    with contextlib.ExitStack() as opened:

        def make(*events: can.Message | Exception) -> CanBackend:
            backend = CanBackend("can0", CanOptions(interface="socketcan"), FailingBus(*events))
            opened.callback(backend.close)
            return backend

        yield make


def test_an_interface_that_is_down_says_how_to_bring_it_up(failing: Callable[..., CanBackend]) -> None:
    backend = failing(can.CanOperationError("Failed to transmit", errno.ENETDOWN))
    with pytest.raises(BackendError, match="is down") as caught:
        backend.send(Home(1))
    assert "ip link set can0 up" in caught.value.remedy


def test_a_full_queue_is_borne_for_as_long_as_the_device_would(failing: Callable[..., CanBackend]) -> None:
    backend = failing(can.CanOperationError("Failed to transmit", errno.ENOBUFS))
    for _ in range(UNSENT_FRAMES):
        backend.send(Home(1))
    with pytest.raises(BackendError, match="takes no frames"):
        backend.send(Home(1))


def test_the_systems_reason_is_found_behind_python_cans(failing: Callable[..., CanBackend]) -> None:
    wrapped = can.CanOperationError("Could not read from serial device")
    wrapped.__cause__ = OSError(errno.EIO, "Input/output error")
    with pytest.raises(BackendError, match=os.strerror(errno.EIO)):
        failing(wrapped).receive()
    with pytest.raises(BackendError, match="fell off the table"):
        failing(can.CanOperationError("fell off the table")).receive()


@pytest.mark.parametrize("flag", ["is_extended_id", "is_remote_frame", "is_fd"])
def test_other_kinds_of_frames_are_other_peoples(failing: Callable[..., CanBackend], flag: str) -> None:
    status = frame_of(STATUS)
    flags = {"is_extended_id": False} | {flag: True}
    data = b"" if flag == "is_remote_frame" else status.data
    other = can.Message(arbitration_id=status.identifier, data=data, **flags)
    plain = can.Message(arbitration_id=status.identifier, data=status.data, is_extended_id=False)
    backend = failing(other, plain)
    assert backend.receive() + backend.receive() == [STATUS]
    assert backend.statistics.corrupt == 0


# -- finding one ---------------------------------------------------------------------------------------------------


FINE = "tormagd.hardware.serial_backend:DRIVER"


def install(monkeypatch: pytest.MonkeyPatch, **entries: str) -> None:
    """Pretends that these plugins are installed."""
    points = [metadata.EntryPoint(name, value, ENTRY_POINTS) for name, value in entries.items()]
    monkeypatch.setattr(metadata, "entry_points", lambda group: points if group == ENTRY_POINTS else [])


def test_the_serial_backend_is_installed() -> None:
    chosen = choose(Device(options={"baud": 115_200}), Rates())
    assert chosen.options == SerialOptions(baud=115_200)


def test_an_unknown_backend_names_the_installed_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch, zeta=FINE, alpha=FINE)
    with pytest.raises(ConfigError, match=r"device\.backend = 'telepathy': installed are alpha, zeta"):
        choose(Device(backend="telepathy"), Rates())
    install(monkeypatch)
    with pytest.raises(ConfigError, match="installed are none"):
        choose(Device(backend="telepathy"), Rates())


def test_a_broken_plugin_is_named_and_stops_nobody_else(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    (tmp_path / "half_a_plugin.py").write_text("def open(device:\n")
    (tmp_path / "angry_plugin.py").write_text("raise RuntimeError('not on a Friday')\n")
    monkeypatch.syspath_prepend(tmp_path)
    broken = {
        "function": ("os:getpid", "allowed is a tormagd.hardware.backend.Driver"),
        "absent": ("no_such_module_anywhere:open", "ModuleNotFoundError"),
        "nameless": ("os:no_such_attribute", "AttributeError"),
        "half": ("half_a_plugin:open", "SyntaxError"),
        "angry": ("angry_plugin:open", "not on a Friday"),
    }
    install(monkeypatch, fine=FINE, **{name: value for name, (value, _) in broken.items()})
    found = installed()
    assert (list(found), found["fine"]) == (sorted([*broken, "fine"]), "")
    assert [record.levelname for record in caplog.records] == ["WARNING"] * len(broken)
    for name, (_, said) in broken.items():
        assert said in found[name]
        with pytest.raises(ConfigError, match=rf"device\.backend = '{name}': the plugin does not load"):
            choose(Device(backend=name), Rates())
    assert choose(Device(backend="fine"), Rates()).options == SerialOptions()


def can_device(interface: str) -> Device:
    return Device(backend="can", options={"interface": interface}, port="can0")


def test_the_can_backend_is_installed_and_so_is_the_simulators_bus() -> None:
    assert choose(can_device("tormagsim"), Rates()).options == CanOptions(interface="tormagsim")
    assert installed()["can"] == ""


@pytest.mark.parametrize(
    ("interface", "said"),
    [
        ("telepathy", "installed are .*socketcan"),
        ("virtual", "no descriptor to wait for"),
        ("nican", "no descriptor to wait for"),
    ],
)
def test_an_interface_that_cannot_work_is_refused_before_anything_is_opened(interface: str, said: str) -> None:
    with pytest.raises(ConfigError, match=f"device.options.interface = '{interface}': .*{said}"):
        choose(can_device(interface), Rates())


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({}, r"missing required field `interface` - at `\$\.device\.options`"),
        ({"interface": "socketcan", "node": 16}, r"<= 15 - at `\$\.device\.options\.node` \(it is 16\)"),
        ({"interface": "socketcan", "bitrate": 2_000_000}, r"<= 1000000 - at `\$\.device\.options\.bitrate` .*2000000"),
        ({"interface": "socketcan", "nod": 1}, r"unknown field `nod` - at `\$\.device\.options`"),
        (
            {"interface": "socketcan", "bitrate": 500_000},
            r"device\.options\.bitrate = 500000: allowed is from 564286 on at rates\.control_hz = 1000",
        ),
    ],
)
def test_options_that_cannot_work_are_refused_before_anything_is_opened(options: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        choose(Device(backend="can", options=options, port="can0"), Rates())


def test_a_slower_bus_carries_a_slower_loop() -> None:
    slow = Device(backend="can", options={"interface": "socketcan", "bitrate": 500_000}, port="can0")
    assert choose(slow, Rates(control_hz=850)).options == CanOptions(interface="socketcan", bitrate=500_000)


def test_a_driver_that_does_not_load_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(can.interfaces.BACKENDS, "broken", ("no_such_module_anywhere", "Bus"))
    with pytest.raises(ConfigError, match=r"device\.options\.interface = 'broken': its driver does not load"):
        choose(can_device("broken"), Rates())
