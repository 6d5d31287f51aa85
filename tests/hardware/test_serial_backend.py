"""The serial backend over a real pseudo-terminal, and how a backend is found."""

import contextlib
import errno
import os
import select
import termios
import tty
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

import pytest

from firmware_protocol.codec import DeviceFault, DeviceMode, Home, Status, Switches
from tormagd.config import Device, Rates
from tormagd.hardware import backend as backends
from tormagd.hardware.backend import BackendError, choose, installed
from tormagd.hardware.frame_stream import FrameStream
from tormagd.hardware.serial_backend import SerialOptions, open_serial
from tormagd.hardware.serial_port import SerialPort
from tormagd_client.endpoints import ConfigError

STATUS = Status(DeviceMode.IDLE, Switches(0), DeviceFault(0), 23.0, 12.0, 0, 0)


class Line(NamedTuple):
    """A pseudo-terminal whose far end the test holds."""

    far: int
    near: int
    device: Device


@pytest.fixture
def line() -> Iterator[Line]:
    far, near = os.openpty()
    tty.setraw(near)
    os.set_blocking(far, False)
    yield Line(far, near, Device(port=os.ttyname(near)))
    for descriptor in (far, near):
        with contextlib.suppress(OSError):  # a test that unplugs has closed it already
            os.close(descriptor)


@pytest.fixture
def port(line: Line) -> Iterator[SerialPort]:
    opened = open_serial(line.device, SerialOptions())
    yield opened
    opened.close()


def wait_readable(port: SerialPort) -> None:
    assert select.select([port.fileno()], [], [], 5.0)[0]


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


# -- finding one ---------------------------------------------------------------------------------------------------


FINE = "tormagd.hardware.serial_backend:DRIVER"


def install(monkeypatch: pytest.MonkeyPatch, **entries: str) -> None:
    """Pretends that these plugins are installed."""
    points = [metadata.EntryPoint(name, value, backends.ENTRY_POINTS) for name, value in entries.items()]
    monkeypatch.setattr(metadata, "entry_points", lambda group: points if group == backends.ENTRY_POINTS else [])


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
