"""Stock CAN tools read a recorded session: cantools with the DBC, and python-can."""

import contextlib
import os
import select
import tty
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from io import FileIO
from pathlib import Path
from queue import Queue
from threading import Event
from typing import NamedTuple

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
        # tests/firmware_protocol/test_codec.py asserts that the values are alike
        assert set(ours(frame).__match_args__) <= set(database.decode_message(frame.arbitration_id, frame.data))
    units = {s.name: s.unit for m in database.messages for s in m.signals}
    for name, unit in units.items():
        suffix = {"mm": "_mm", "s": "_s", "A": "_A", "N": "_N", "V": "_V", "degC": "_C"}
        assert unit is None or name.endswith(suffix[unit])
    assert (units["force_N"], units["left_position_mm"], units["supply_V"]) == ("N", "mm", "V")


@pytest.mark.parametrize("ending", ["log", "db"])
def test_a_log_that_is_there_is_replaced(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"session.{ending}"
    for _ in range(2):
        with contextlib.closing(wire_log.WireLog(path)) as log:
            log.add(1.5, encode_frame(FUNCTION[Drive], 0, encode(Drive(0.1, 0.2, DriveMode.RUN, 5))), is_rx=False)
    with can.LogReader(path) as reader:
        assert len(list(reader)) == 1


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


class Tap(NamedTuple):
    """A tap on a line whose two ends, the device's and the daemon's, the test holds."""

    device: FileIO
    host: FileIO
    log: wire_log.WireLog
    stopped: Event
    running: Future[None]


def read(end: FileIO, length: int) -> bytes:
    data = b""
    while len(data) < length:
        assert select.select([end], [], [], PATIENCE_S)[0]
        data += os.read(end.fileno(), length - len(data))
    return data


@pytest.fixture
def tapped(tmp_path: Path) -> Iterator[Tap]:
    stopped, announced = Event(), Queue[str]()
    with contextlib.ExitStack() as ends:
        device, near = (ends.enter_context(FileIO(descriptor, "r+")) for descriptor in os.openpty())
        tty.setraw(near.fileno())
        port = ends.enter_context(serial.Serial(os.ttyname(near.fileno()), timeout=0, exclusive=True))
        log = ends.enter_context(contextlib.closing(wire_log.WireLog(tmp_path / "tapped.log")))
        thread = ends.enter_context(ThreadPoolExecutor(1))
        ends.callback(stopped.set)
        running = thread.submit(wire_log.tap, port, log, announced.put, stopped.is_set)
        host = os.open(announced.get(timeout=PATIENCE_S), os.O_RDWR | os.O_NOCTTY)
        yield Tap(device, ends.enter_context(FileIO(host, "r+")), log, stopped, running)


def test_a_tap_passes_every_byte_on_and_logs_the_frames(tapped: Tap) -> None:
    down = encode_frame(FUNCTION[Drive], 0, encode(Drive(0.1, 0.2, DriveMode.RUN, 5)))
    up = encode_frame(FUNCTION[State], 0, encode(State(1.0, 2.0, 0.1, 3)))
    noise = bytes(range(256))
    tapped.host.write(down + noise)
    assert read(tapped.device, len(down + noise)) == down + noise
    tapped.device.write(noise + b"\0" + up)
    assert read(tapped.host, len(noise) + 1 + len(up)) == noise + b"\0" + up
    tapped.stopped.set()
    assert (tapped.running.exception(PATIENCE_S), tapped.log.frames) == (None, 2)


def test_a_tap_does_not_wait_for_a_host_that_reads_nothing(tapped: Tap) -> None:
    state = encode_frame(FUNCTION[State], 0, encode(State(1.0, 2.0, 0.1, 3)))
    for _ in range(20):
        tapped.device.write(state * 100)
    drive = encode_frame(FUNCTION[Drive], 0, encode(Drive(0.1, 0.2, DriveMode.RUN, 5)))
    tapped.host.write(drive)
    assert read(tapped.device, len(drive)) == drive


def test_a_tap_ends_when_the_device_is_unplugged(tapped: Tap) -> None:
    tapped.device.close()
    assert isinstance(tapped.running.exception(PATIENCE_S), OSError)
