"""A recorded session is read by stock CAN tools: cantools with the DBC, and python-can's own."""

import contextlib
import os
import select
import threading
import tty
from collections.abc import Iterator
from pathlib import Path

import can
import can.viewer
import cantools.database.can
import pytest
import serial

import firmware_protocol
from firmware_protocol.codec import (
    FUNCTION,
    Drive,
    DriveMode,
    Message,
    Sense,
    State,
    Status,
    decode,
    encode,
)
from firmware_protocol.framing import encode_frame
from tormagd.lab import wire_log
from tormagd.lab.main import main

DBC = Path(firmware_protocol.__file__).parent / "tormag.dbc"
SECONDS = 0.2
PATIENCE_S = 20.0


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The candump log of a session in virtual time."""
    path = tmp_path_factory.mktemp("session") / "session.log"
    assert main(["wire-log", "virtual", str(path), "--seconds", str(SECONDS)]) == 0
    return path


@pytest.fixture(scope="module")
def frames(session: Path) -> list[can.Message]:
    with can.LogReader(session) as reader:
        return list(reader)


@pytest.fixture(scope="module")
def database() -> cantools.database.can.Database:
    loaded = cantools.database.can.Database()
    loaded.add_dbc_file(DBC)
    return loaded


def ours(frame: can.Message) -> Message:
    return decode(frame.arbitration_id >> 4, bytes(frame.data))


def test_the_whole_conversation_is_in_the_log(frames: list[can.Message]) -> None:
    names = {type(ours(frame)).__name__ for frame in frames}
    assert names == {"Hello", "Identity", "Home", "Drive", "State", "Sense", "Status"}
    assert [frame.timestamp for frame in frames] == sorted(frame.timestamp for frame in frames)
    # each Drive was answered; the last answer may still be on its way
    count = {kind: sum(isinstance(ours(frame), kind) for frame in frames) for kind in (Drive, State, Sense)}
    assert {count[Drive] - count[State], count[State] - count[Sense]} <= {0, 1}
    ways = {(type(ours(frame)), frame.is_rx) for frame in frames if isinstance(ours(frame), Drive | Status)}
    assert ways == {(Drive, False), (Status, True)}


def test_cantools_decodes_every_frame_with_names_and_units(
    frames: list[can.Message], database: cantools.database.can.Database
) -> None:
    for frame in frames:
        message = ours(frame)
        signals = database.decode_message(frame.arbitration_id, frame.data, decode_choices=False)
        assert isinstance(signals, dict)
        for name in message.__match_args__:
            assert signals[name] == pytest.approx(float(getattr(message, name)))
    units = {s.name: s.unit for m in database.messages for s in m.signals}
    for name, unit in units.items():
        suffix = {"mm": "_mm", "s": "_s", "A": "_A", "N": "_N", "V": "_V", "degC": "_C"}
        assert unit is None or name.endswith(suffix[unit])
    assert (units["force_N"], units["left_position_mm"], units["supply_V"]) == ("N", "mm", "V")


def test_what_is_no_frame_is_counted_and_not_logged(tmp_path: Path) -> None:
    drive = encode(Drive(0.1, 0.2, DriveMode.RUN, 5))
    good = encode_frame(FUNCTION[Drive], 0, drive)
    with contextlib.closing(wire_log.WireLog(tmp_path / "session.log")) as log:
        for byte in good:
            log.add(1.5, bytes((byte,)), is_rx=False)
        log.add(2.0, good[:5] + b"\0", is_rx=False)
        log.add(2.5, encode_frame(0x80, 1, b"") + encode_frame(0, 2, b""), is_rx=False)
        assert (log.frames, log.damaged) == (1, 3)
    with can.LogReader(tmp_path / "session.log") as reader:
        (frame,) = reader
    assert (frame.timestamp, frame.arbitration_id, bytes(frame.data)) == (1.5, 0x021, drive)


class Tap:
    """A tap on a line whose two ends the test holds: `device` is the device's, `host` the daemon's."""

    def __init__(self, folder: Path) -> None:
        self.device, self._near = os.openpty()
        tty.setraw(self._near)
        self.port = serial.Serial(os.ttyname(self._near), timeout=0, exclusive=True)
        self.log = wire_log.WireLog(folder / "tapped.log")
        self.is_stopped = False
        self.error: OSError | None = None
        self._path = ""
        self._announced = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()
        assert self._announced.wait(PATIENCE_S)
        self.host = os.open(self._path, os.O_RDWR | os.O_NOCTTY)

    def read(self, descriptor: int, length: int) -> bytes:
        """The next so many bytes."""
        data = b""
        while len(data) < length:
            assert select.select([descriptor], [], [], PATIENCE_S)[0]
            data += os.read(descriptor, length - len(data))
        return data

    def end(self) -> None:
        """Stops it, once."""
        self.is_stopped = True
        self._thread.join(PATIENCE_S)
        assert not self._thread.is_alive()

    def close(self) -> None:
        self.end()
        self.port.close()
        self.log.close()
        for descriptor in (self.host, self._near, self.device):
            if descriptor >= 0:
                os.close(descriptor)

    def _run(self) -> None:
        try:
            wire_log.tap(self.port, self.log, self._announce, lambda: self.is_stopped)
        except OSError as error:
            self.error = error

    def _announce(self, path: str) -> None:
        self._path = path
        self._announced.set()


@pytest.fixture
def tapped(tmp_path: Path) -> Iterator[Tap]:
    tap = Tap(tmp_path)
    yield tap
    tap.close()


def test_a_tap_passes_every_byte_on_and_logs_the_frames(tapped: Tap) -> None:
    down = encode_frame(FUNCTION[Drive], 0, encode(Drive(0.1, 0.2, DriveMode.RUN, 5)))
    up = encode_frame(FUNCTION[State], 0, encode(State(1.0, 2.0, 0.1, 3)))
    noise = bytes(range(256))
    os.write(tapped.host, down + noise)
    assert tapped.read(tapped.device, len(down + noise)) == down + noise
    os.write(tapped.device, noise + b"\0" + up)
    assert tapped.read(tapped.host, len(noise) + 1 + len(up)) == noise + b"\0" + up
    tapped.end()
    assert (tapped.error, tapped.log.frames) == (None, 2)


def test_a_tap_does_not_wait_for_a_host_that_reads_nothing(tapped: Tap) -> None:
    state = encode_frame(FUNCTION[State], 0, encode(State(1.0, 2.0, 0.1, 3)))
    for _ in range(20):
        os.write(tapped.device, state * 100)
    drive = encode_frame(FUNCTION[Drive], 0, encode(Drive(0.1, 0.2, DriveMode.RUN, 5)))
    os.write(tapped.host, drive)
    assert tapped.read(tapped.device, len(drive)) == drive


def test_a_tap_ends_when_the_device_is_unplugged(tapped: Tap) -> None:
    os.close(tapped.device)
    tapped.device = -1
    tapped._thread.join(PATIENCE_S)
    assert isinstance(tapped.error, OSError)
