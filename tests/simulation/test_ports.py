"""The simulator's doors: a process of its own, and hosts that open them as the daemon or python-can do."""

import contextlib
import csv
import itertools
import math
import os
import select
import socket
import subprocess
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import can
import pytest

from firmware_protocol.codec import (
    FUNCTION,
    PROTOCOL_VERSION,
    SCHEMA_HASH,
    Hello,
    Identity,
    Message,
    Status,
    can_identifier,
    encode,
)
from tormagd.config import Device, Rates
from tormagd.ctl.processes import begun, end, first_line
from tormagd.hardware.backend import choose
from tormagd.simulation.__main__ import main
from tormagd.simulation.can_bus import SimulatorBus
from tormagd.simulation.can_device import ERROR_FLAG, CanDevice, CanFrame
from tormagd.simulation.can_port import MAX_HOSTS, SOCKET_FRAME, CanPort, from_socket, to_socket
from tormagd.simulation.device import MessageDevice
from tormagd.simulation.hand import SteadyHand
from tormagd.simulation.parameters import load_plant
from tormagd.simulation.pty_port import LONGEST_COMMAND, SlcanAdapter

LIMIT_S = 20.0
HELLO = Hello(SCHEMA_HASH, PROTOCOL_VERSION, 1)
IDENTITY = can_identifier(FUNCTION[Identity])
STATUS = can_identifier(FUNCTION[Status])


def meet(device: Device) -> None:
    seen: set[type[Message]] = set()
    deadline_s = time.monotonic() + LIMIT_S
    with contextlib.closing(choose(device, Rates()).open()) as backend:
        while not {Identity, Status} <= seen:
            assert time.monotonic() < deadline_s, f"only {seen} in {LIMIT_S} s"
            backend.send(HELLO)
            select.select([backend._fd], [], [], 0.1)  # type: ignore[attr-defined]
            seen |= {type(message) for message in backend.receive()}


def test_hosts_come_and_go_on_the_simulators_bus_and_the_truth_is_kept(tmp_path: Path) -> None:
    truth, simulator = tmp_path / "truth.csv", ("-m", "tormagd.simulation", "--can", "--seed", "3", "--truth")
    with contextlib.ExitStack() as stack:
        process = begun(stack, tmp_path / "log", *simulator, str(truth))
        path = first_line(process)
        is_granted = subprocess.run(["chrt", "--fifo", "1", "true"], capture_output=True).returncode == 0
        assert os.sched_getscheduler(process.pid) & os.SCHED_FIFO == is_granted * os.SCHED_FIFO
        assert {"interface": "tormagsim", "channel": path} in can.detect_available_configs(["tormagsim"])
        for _ in range(2):
            meet(Device(backend="can", options={"interface": "tormagsim"}, port=path))
        assert (end(process), process.stdout.read(), Path(path).exists()) == (0, "", False)
    with truth.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == [
        "t_ns", "force_N", "gap_mm", "left_mm", "right_mm", "handle_mm", "handle_mm_s", "temperature_C",
        "kinetic_N",
    ]  # fmt: skip
    assert len(rows) > 20
    assert all(int(after["t_ns"]) > int(before["t_ns"]) for before, after in itertools.pairwise(rows))
    assert abs(int(rows[0]["t_ns"]) - time.time_ns()) < 120e9
    assert float(rows[-1]["gap_mm"]) == pytest.approx(79.0)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((), "--pty"),
        (("--pty", "--plant", "nowhere.toml"), "sample_1"),
        (("--pty", "--fault", "gremlins"), "worn_gearbox"),
        (("--pty", "--hand", "third"), "reversing"),
        (("--pty", "--plant", "pad_1", "--hand", "felt"), "pressing"),
        (("--pty", "--baud", "7"), "1200"),
        (("--pty", "--truth", "/proc/none/truth.csv"), "/proc/none"),
        (("--pty", "--truth", "{there}"), "--truth {there}: this exists; allowed is a new file"),
        (("--pty", "--truth", "{pipe}"), "allowed is a new file"),
        (("--can", "{there}"), "{there}: cannot be served: it is there and not a socket"),
        (("--can", "{pipe}"), "not a socket"),
        (("--can", "{link}"), "not a socket"),
        (("--can", "--bitrate", "7"), "10000"),
        (("--can", "--node", "16"), "16"),
        (("--can", "/proc/none/can"), "/proc/none"),
        (("--can", "--pty"), "not allowed"),
    ],
)
@pytest.mark.usefixtures("usual_slices")
def test_a_wrong_call_says_what_is_right_and_exits_with_2(
    arguments: tuple[str, ...], said: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    there = {name: tmp_path / name for name in ("there", "pipe", "link")}
    there["there"].write_text("precious")
    os.mkfifo(there["pipe"])
    there["link"].symlink_to("there")
    before = [each.lstat() for each in there.values()]
    with pytest.raises(SystemExit, match="2"):
        main([argument.format(**there) for argument in arguments])
    output, errors = capsys.readouterr()
    assert output == ""
    assert said.format(**there) in errors
    assert before == [each.lstat() for each in there.values()]


class Served:
    def __init__(self, path: Path) -> None:
        self.device = CanDevice(MessageDevice(load_plant("sample_1"), SteadyHand(), seed=1))
        self.door = CanPort(self.device, path)
        self.now_s = 0.0
        self.opened = contextlib.ExitStack()
        self.opened.callback(self.door.close)

    def host(self) -> socket.socket:
        host = self.opened.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET))
        host.settimeout(LIMIT_S)
        host.connect(self.door.address)
        self.exchange(0.0)
        return host

    def exchange(self, duration_s: float) -> None:
        until_s = self.now_s + duration_s
        while True:
            readable, _, _ = select.select(self.door.descriptors(), [], [], 0.0)
            self.door.exchange(self.now_s, readable)
            if self.now_s >= until_s:
                return
            self.now_s += 1e-3


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    made = Served(tmp_path / "can")
    with made.opened:
        yield made


def test_what_somebody_serves_stays_and_what_a_killed_simulator_left_is_replaced(served: Served) -> None:
    path = Path(served.door.address)
    with pytest.raises(OSError, match=f"{path}: cannot be served"):
        CanPort(served.device, path)
    served.door._listener.close()
    with contextlib.closing(CanPort(served.device, path)) as second:
        assert second.address == served.door.address


def test_what_is_no_frame_ends_that_host_and_no_other(served: Served) -> None:
    good = served.host()
    none = ((0x21, 9, False, bytes(8), 0.0), (0x800, 0, False, b"", 0.0), (0x21, 0, False, b"", math.nan))
    lengths = (1, SOCKET_FRAME.size - 1, SOCKET_FRAME.size + 1)
    packets = (*map(bytes, lengths), *(SOCKET_FRAME.pack(*one) for one in none), to_socket(CanFrame(ERROR_FLAG, b"")))
    for packet in packets:
        bad = served.host()
        bad.send(packet)
        served.exchange(0.002)
        while bad.recv(64):
            pass
    good.send(to_socket(CanFrame(0x081, encode(HELLO))))
    served.exchange(0.005)
    while (heard := from_socket(good.recv(64))) is not None and heard.frame.identifier != IDENTITY:
        assert heard.frame.identifier == STATUS
    assert heard is not None


def test_a_frame_carries_its_time_and_comes_back_where_its_sender_asks(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("time.time", lambda: 1.7e9 + served.now_s)
    with contextlib.ExitStack() as stack:
        one, other, itself = (
            stack.enter_context(SimulatorBus(served.door.address, receive_own_messages=is_own))
            for is_own in (False, False, True)
        )
        served.exchange(0.003)
        assert other.recv(0) is None
        for data in (b"123", b"12345678"):
            for number, bus in enumerate((one, itself)):
                bus.send(can.Message(arbitration_id=0x300 + number, data=data, is_extended_id=False))
            served.exchange(0.002)
        for refused in ({"is_extended_id": True}, {"is_extended_id": False, "arbitration_id": 0x800}):
            with pytest.raises(can.CanOperationError, match="11-bit"):
                one.send(can.Message(**refused))
        heard = {bus: list(iter(partial(bus.recv, 0), None)) for bus in (one, other, itself)}
    assert [(message.arbitration_id, bytes(message.data), message.is_rx) for message in heard[itself]] == [
        *[(0x300, b"123", True), (0x301, b"123", False)],
        *[(0x300, b"12345678", True), (0x301, b"12345678", False)],
    ]
    assert [message.arbitration_id for message in heard[one]] == [0x301] * 2
    times_s = [message.timestamp for message in heard[other]]
    assert [message.timestamp for message in heard[itself]] == times_s
    ends_us = [time_s * 1e6 for time_s in (0.003071, 0.003142, 0.005111, 0.005222)]
    assert [(time_s - 1.7e9) * 1e6 for time_s in times_s] == pytest.approx(ends_us, abs=1.0)


def test_no_more_hosts_than_a_bus_has_places(served: Served) -> None:
    hosts = [served.host() for _ in range(MAX_HOSTS)]
    assert served.host().recv(64) == b""
    hosts[0].close()
    served.exchange(0.001)
    again = served.host()
    served.exchange(0.03)
    assert from_socket(again.recv(64)) is not None


def test_a_host_that_does_not_read_holds_nobody_up(served: Served) -> None:
    _, busy = served.host(), served.host()
    busy.setblocking(False)
    heard = 0
    for tick in range(3_000):
        busy.send(to_socket(CanFrame(0x7F2, bytes((tick % 256,)))))
        served.exchange(0.001)
        with contextlib.suppress(BlockingIOError):
            while busy.recv(64):
                heard += 1
    assert heard > 100, "a Status every 20 ms"


DAMAGED_FRAMES = (
    *(b"t", b"t80", b"t8000", b"t0219", b"t02170", b"t021700\xff", b"t 2100", b"t0_100", b"t02120102030"),
)


@pytest.mark.parametrize(
    ("said", "answer"),
    [
        (b"O\r", b"\r"),
        (b"O\rO\r", b"\r\a"),
        (b"S8\r", b"\r"),
        (b"S9\r", b"\a"),
        (b"O\rS8\r", b"\r\a"),
        (b"C\rC\r", b"\r\r"),
        (b"V\rN\rF\r", b"V1013\rNSIM1\rF00\r"),
        (b"\r\r", b"\r\r"),
        (b"t0210\r", b"\a"),
        (b"L\r", b"\a"),
        (b"T000000210\r", b"\a"),
        (b"x" * 10_000 + b"\r", b"\a"),
        *((b"O\r" + damaged + b"\r", b"\r\a") for damaged in DAMAGED_FRAMES),
    ],
)
def test_the_adapter_answers_as_the_manual_says(said: bytes, answer: bytes) -> None:
    assert SlcanAdapter().feed(said) == (answer, [])


@pytest.mark.parametrize("cut", [1, 3, 100])
def test_frames_come_out_however_they_are_cut(cut: int) -> None:
    adapter = SlcanAdapter()
    said = b"O\rt0217E204D20401C865\rt7FF0\r"
    frames = [frame for at in range(0, len(said), cut) for frame in adapter.feed(said[at : at + cut])[1]]
    assert frames == [CanFrame(0x021, bytes.fromhex("e204d20401c865")), CanFrame(0x7FF, b"")]
    assert adapter.line(frames[0]) == b"t0217E204D20401C865\r"


def test_a_command_without_an_end_takes_no_memory() -> None:
    adapter = SlcanAdapter()
    for _ in range(100):
        adapter.feed(b"t" * 1_000)
    assert len(adapter._pending) <= LONGEST_COMMAND + 1
