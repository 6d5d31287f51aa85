"""Each port and bus beyond the contract: how it is chosen and opened, and how it fails."""

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
from unittest.mock import Mock

import can
import pytest
import serial

from firmware_protocol.codec import (
    DeviceFault,
    DeviceMode,
    Drive,
    DriveMode,
    Home,
    Message,
    Status,
    Switches,
)
from tormagd.config import Device, Rates
from tormagd.hardware.backend import ENTRY_POINTS, BackendError, choose, installed
from tormagd.hardware.can_backend import FRAMES_AT_ONCE, UNSENT_FRAMES, CanBackend, CanOptions
from tormagd.hardware.serial_backend import SerialOptions, latency_ms, make_prompt, open_serial
from tormagd.hardware.serial_port import SerialPort
from tormagd.hardware.streams import CanStream, FrameStream
from tormagd.simulation.can_device import ERROR_FLAG, CanFrame
from tormagd.simulation.can_port import to_socket
from tormagd_client.endpoints import ConfigError

STATUS = Status(DeviceMode.IDLE, Switches(0), DeviceFault(0), 23.0, 12.0, 0, 0)


# -- ports and buses ---------------------------------------------------------------------------------------------------


BUS_OFF = CanFrame(ERROR_FLAG | 0x40, bytes(8))
PASSIVE = CanFrame(ERROR_FLAG | 0x04, bytes((0, 0x30, 0, 0, 0, 0, 0, 0)))


def bus_frame(message: Message) -> CanFrame:
    return CanFrame(*CanStream(1).pack(message))


def opened(device: Device) -> CanBackend:
    backend = choose(device, Rates()).open()
    assert isinstance(backend, CanBackend)
    return backend


STATUS_FRAME = bus_frame(STATUS)


# -- on a serial line -------------------------------------------------------------------------------------------------


class Line(NamedTuple):
    far: int
    near: int
    device: Device

    @property
    def adapter(self) -> Device:
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
    with contextlib.closing(open_serial(line.device, SerialOptions())) as opened:
        yield opened


def test_bytes_from_before_the_opening_are_not_read(line: Line) -> None:
    os.write(line.far, b"half a frame of an earlier life")
    port = open_serial(line.device, SerialOptions())
    os.write(line.far, FrameStream().pack(STATUS))
    assert select.select([port._fd], [], [], 5.0)[0]
    assert (port.receive(), port.stream.statistics.corrupt) == ([STATUS], 0)
    port.close()


def test_what_the_driver_did_not_take_is_sent_before_the_next_frame(
    line: Line, port: SerialPort, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken = bytearray()
    room = iter([3, 0, 7, 0, 0, 100, 100])

    def write(descriptor: int, data: bytes) -> int:
        assert descriptor == port._fd
        count = next(room)
        if not count:
            raise BlockingIOError
        taken.extend(data[:count])
        return len(data[:count])

    monkeypatch.setattr(os, "write", write)
    for nonce in range(1, 8):
        port.send(Home(nonce))
    far = FrameStream()
    assert (far.unpack(bytes(taken)), far.statistics.lost) == ([Home(nonce) for nonce in range(1, 8)], 0)
    assert port.stream.statistics.unsent == 5, "after so many, bytes were left"


@pytest.mark.parametrize(
    ("module", "name", "error"),
    [
        (termios, "tcflush", termios.error(errno.EIO, "unplugged meanwhile")),
        (serial, "Serial", ValueError("Failed to set custom baud rate")),
    ],
)
def test_a_port_that_cannot_be_set_up_is_not_opened(
    line: Line, monkeypatch: pytest.MonkeyPatch, module: Any, name: str, error: Exception
) -> None:
    monkeypatch.setattr(module, name, Mock(side_effect=error))
    with pytest.raises(BackendError, match=f"cannot be opened: .*{error.args[-1]}"):
        open_serial(line.device, SerialOptions())


# -- on the simulator's bus ----------------------------------------------------------------------------------------


class Bus:
    def __init__(self, folder: Path) -> None:
        self.device = Device(backend="can", options={"interface": "tormagsim"}, port=str(folder / "can"))
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._listener.bind(self.device.port)
        self._listener.listen()
        self.backend = opened(self.device)
        self.far, _ = self._listener.accept()

    def put(self, *frames: CanFrame) -> None:
        for frame in frames:
            self.far.send(to_socket(frame))

    def close(self) -> None:
        self.backend.close()
        self.far.close()
        self._listener.close()


@pytest.fixture
def bus(tmp_path: Path) -> Iterator[Bus]:
    with contextlib.closing(Bus(tmp_path)) as made:
        yield made


@pytest.mark.parametrize(
    ("frames", "said", "remedy"),
    [
        ((STATUS_FRAME, BUS_OFF), "bus-off", "termination"),
        ((bus_frame(Drive(0.1, 0.1, DriveMode.RUN, 1)),), "another host drives node 1", "device.options.node"),
    ],
)
def test_what_ends_a_connection_on_a_bus_is_said_with_a_remedy(
    bus: Bus, frames: tuple[CanFrame, ...], said: str, remedy: str
) -> None:
    bus.put(*frames)
    with pytest.raises(BackendError, match=said) as caught:
        bus.backend.receive()
    assert bus.device.port in str(caught.value)
    assert remedy in caught.value.remedy


def test_an_error_frame_that_is_not_bus_off_is_counted(bus: Bus) -> None:
    bus.put(PASSIVE, STATUS_FRAME)
    assert (
        bus.backend.receive(),
        bus.backend.stream.statistics.corrupt,
        bus.backend.stream.statistics.resynchronisations,
    ) == (
        [STATUS],
        1,
        1,
    )


def test_no_more_frames_are_taken_at_once_than_the_loop_can_bear(bus: Bus) -> None:
    bus.far.setblocking(False)
    queued = 0
    with contextlib.suppress(BlockingIOError):
        for queued in range(2 * FRAMES_AT_ONCE):  # noqa: B007 - counts what the kernel takes
            bus.put(STATUS_FRAME)
    assert len(bus.backend.receive()) == min(queued, FRAMES_AT_ONCE)


OF_INTERFACE: dict[str, dict[str, Any]] = {
    "socketcan": {"can_filters": [{"can_id": 1, "can_mask": 0xF, "extended": False}]},
    "udp_multicast": {"hop_limit": 0, "fd": False},
    "tormagsim": {},
}
UP = "sudo ip link set can7 up type can bitrate 1000000 restart-ms 100"


@pytest.mark.parametrize(
    ("interface", "number", "said", "remedy"),
    [
        ("socketcan", errno.ENODEV, "there is no such interface", f"plug the adapter in, then {UP}"),
        ("socketcan", errno.EAFNOSUPPORT, "the kernel knows no CAN", f"sudo modprobe can_raw, then {UP}"),
        ("socketcan", errno.ENOMEM, os.strerror(errno.ENOMEM), ""),
        ("tormagsim", errno.ENODEV, os.strerror(errno.ENODEV), ""),
        ("udp_multicast", errno.ENODEV, os.strerror(errno.ENODEV), ""),
    ],
)
def test_an_interface_that_is_not_there_says_how_it_comes(
    monkeypatch: pytest.MonkeyPatch, interface: str, number: int, said: str, remedy: str
) -> None:
    monkeypatch.setattr(can, "Bus", bus := Mock(side_effect=OSError(number, os.strerror(number))))
    with pytest.raises(BackendError, match=f"^{interface} can7: cannot be opened: {said}$") as caught:
        opened(Device(backend="can", options={"interface": interface}, port="can7"))
    assert caught.value.remedy == remedy
    assert bus.call_args.kwargs == OF_INTERFACE[interface] | {
        **{"interface": interface, "channel": "can7", "bitrate": 1_000_000, "ignore_config": True}
    }


# -- behind an adapter on a serial line ----------------------------------------------------------------------------


@pytest.mark.parametrize("error", [BlockingIOError(errno.EAGAIN, "held"), can.CanInitializationError("no answer")])
def test_an_adapter_that_cannot_be_opened_is_let_go(
    line: Line, error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(can, "Bus", Mock(side_effect=error))
    before = set(Path("/proc/self/fd").iterdir())
    with pytest.raises(BackendError, match="another program" if isinstance(error, OSError) else "no answer"):
        opened(line.adapter)
    assert set(Path("/proc/self/fd").iterdir()) == before


# -- a bus that fails as told --------------------------------------------------------------------------------------


@pytest.fixture
def failing() -> Iterator[Callable[..., CanBackend]]:
    reads, writes = os.pipe()

    def make(*events: can.Message | Exception) -> CanBackend:
        bus = Mock(spec=can.BusABC)
        bus.fileno.return_value = writes  # always writable, never readable
        bus.recv.side_effect = [*events, None, None]
        bus.send.side_effect = events[0]
        return CanBackend("can0", CanOptions(interface="socketcan"), bus)

    yield make
    os.close(reads)
    os.close(writes)


def behind_python_cans(number: int) -> can.CanOperationError:
    """Return the error as python-can wraps it where it has no place for the number."""
    error = can.CanOperationError("Could not read from serial device")
    error.__cause__ = OSError(number, "Input/output error")
    return error


@pytest.mark.parametrize(
    ("error", "said", "remedy"),
    [
        (can.CanOperationError("Failed to transmit", errno.ENETDOWN), "is down", "ip link set can0 up"),
        (behind_python_cans(errno.EIO), os.strerror(errno.EIO), ""),
        (can.CanOperationError("fell off the table"), "fell off the table", ""),
    ],
)
def test_why_a_bus_fails_and_what_helps_is_said(
    failing: Callable[..., CanBackend], error: Exception, said: str, remedy: str
) -> None:
    backend = failing(error)
    for use in (backend.receive, lambda: backend.send(Home(1))):
        with pytest.raises(BackendError, match=said) as caught:
            use()
        assert remedy in caught.value.remedy


def test_a_full_queue_is_borne_for_as_long_as_the_device_would(failing: Callable[..., CanBackend]) -> None:
    backend = failing(can.CanOperationError("Failed to transmit", errno.ENOBUFS))
    for _ in range(UNSENT_FRAMES):
        backend.send(Home(1))
    with pytest.raises(BackendError, match="takes no frames"):
        backend.send(Home(1))


@pytest.mark.parametrize("flag", ["is_extended_id", "is_remote_frame", "is_fd"])
def test_other_kinds_of_frames_are_other_peoples(failing: Callable[..., CanBackend], flag: str) -> None:
    identifier, data = STATUS_FRAME.identifier, STATUS_FRAME.data
    flags = {"is_extended_id": False, "data": b"" if flag == "is_remote_frame" else data} | {flag: True}
    backend = failing(
        can.Message(arbitration_id=identifier, **flags),
        can.Message(arbitration_id=identifier, data=data, is_extended_id=False),
    )
    assert (backend.receive() + backend.receive(), backend.stream.statistics.corrupt) == ([STATUS], 0)


# -- finding one ---------------------------------------------------------------------------------------------------


FINE = "tormagd.hardware.serial_backend:DRIVER"


def install(monkeypatch: pytest.MonkeyPatch, **entries: str) -> None:
    points = [metadata.EntryPoint(name, value, ENTRY_POINTS) for name, value in entries.items()]
    monkeypatch.setattr(metadata, "entry_points", lambda group: points if group == ENTRY_POINTS else [])


SLOW = {"interface": "socketcan", "bitrate": 500_000}


@pytest.mark.parametrize(
    ("device", "rates", "options"),
    [
        (Device(options={"baud": 115_200}), Rates(), SerialOptions(baud=115_200)),
        (Device(backend="can", options={"interface": "tormagsim"}), Rates(), CanOptions(interface="tormagsim")),
        (Device(backend="can", options=SLOW, port="can0"), Rates(control_hz=850), CanOptions(**SLOW)),
    ],
)
def test_the_chosen_backend_has_its_options(device: Device, rates: Rates, options: SerialOptions | CanOptions) -> None:
    assert choose(device, rates).options == options


@pytest.mark.parametrize(("entries", "said"), [({"zeta": FINE, "alpha": FINE}, "alpha, zeta"), ({}, "none")])
def test_an_unknown_backend_names_the_installed_ones(
    monkeypatch: pytest.MonkeyPatch, entries: dict[str, str], said: str
) -> None:
    install(monkeypatch, **entries)
    with pytest.raises(ConfigError, match=rf"device\.backend = 'telepathy': installed are {said}"):
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


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({}, r"missing required field `interface` - at `\$\.device\.options`"),
        ({"interface": "socketcan", "node": 16}, r"<= 15 - at `\$\.device\.options\.node` \(it is 16\)"),
        ({"interface": "socketcan", "bitrate": 2_000_000}, r"<= 1000000 - at `\$\.device\.options\.bitrate` .*2000000"),
        ({"interface": "socketcan", "nod": 1}, r"unknown field `nod` - at `\$\.device\.options`"),
        ({"interface": "telepathy"}, r"device\.options\.interface = 'telepathy': .*installed are .*socketcan"),
        ({"interface": "virtual"}, r"device\.options\.interface = 'virtual': .*no descriptor to wait for"),
        ({"interface": "nican"}, r"device\.options\.interface = 'nican': .*no descriptor to wait for"),
        ({"interface": "broken"}, r"device\.options\.interface = 'broken': its driver does not load"),
        (
            SLOW,
            r"device\.options\.bitrate = 500000: allowed is from 564286 on at rates\.control_hz = 1000",
        ),
    ],
)
def test_options_that_cannot_work_are_refused_before_anything_is_opened(
    monkeypatch: pytest.MonkeyPatch, options: dict[str, Any], said: str
) -> None:
    monkeypatch.setitem(can.interfaces.BACKENDS, "broken", ("no_such_module_anywhere", "Bus"))
    with pytest.raises(ConfigError, match=said):
        choose(Device(backend="can", options=options, port="can0"), Rates())


# -- the latency timer of USB serial chips, on a directory that stands for sysfs ---------------------------------------


USB = "/dev/ttyUSB7"


def timer_of(port: str, sysfs: Path, text: str = "16\n") -> Path:
    timer = sysfs / Path(port).name / "latency_timer"
    timer.parent.mkdir()
    timer.write_text(text)
    return timer


@pytest.mark.parametrize(("text", "timer_ms"), [("16\n", 16), ("", None), ("soon", None), ("1.5", None)])
def test_the_timer_is_a_number_and_read_through_the_stable_name_too(
    tmp_path: Path, text: str, timer_ms: int | None
) -> None:
    timer_of(USB, tmp_path, text)
    link = tmp_path / "tormag"
    link.symlink_to(USB)
    assert [latency_ms(port, tmp_path) for port in (USB, str(link), "/dev/ttyACM0")] == [timer_ms, timer_ms, None]


@pytest.mark.parametrize("prompt_ms", [1, 0])
def test_a_driver_that_can_is_made_prompt_without_a_word(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, prompt_ms: int
) -> None:
    timer, port = timer_of(USB, tmp_path), Mock(port=USB)
    port.set_low_latency_mode.side_effect = lambda is_low: timer.write_text(f"{prompt_ms}")
    make_prompt(port, tmp_path)
    assert latency_ms(USB, tmp_path) == prompt_ms
    make_prompt(port, tmp_path)
    port.set_low_latency_mode.assert_called_once_with(True)  # what is prompt already is left alone
    assert caplog.records == []


@pytest.mark.parametrize("effect", [ValueError("Failed to update ASYNC_LOW_LATENCY flag"), None], ids=["no", "ignored"])
def test_one_that_will_not_is_a_plain_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, effect: Exception | None
) -> None:
    timer_of(USB, tmp_path)
    make_prompt(Mock(**{"port": USB, "set_low_latency_mode.side_effect": effect}), tmp_path)
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert [word for word in (USB, "16 ms", "tormagctl doctor") if word not in caplog.text] == []


@pytest.mark.parametrize("has_timer", [False, True])
def test_a_pty_refuses_and_is_not_asked_unless_it_is_said_to_have_a_timer(
    line: Line, tmp_path: Path, caplog: pytest.LogCaptureFixture, has_timer: bool
) -> None:
    if has_timer:
        timer_of(line.device.port, tmp_path)
    with serial.Serial(line.device.port) as port:
        make_prompt(port, tmp_path)
    assert (len(caplog.records), "Failed to update" in caplog.text) == (has_timer, has_timer)
