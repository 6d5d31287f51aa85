"""The daemon's side of the black box: it waits for nobody, and what is lost is said."""

import contextlib
import socket
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from unittest.mock import Mock, patch

import msgspec
import pytest

from firmware_protocol.codec import PROTOCOL_VERSION, SCHEMA_HASH, Hello
from tormagd.config import Config
from tormagd.control.assembly.build import Core
from tormagd.control.records import TimedSetpoint
from tormagd.control.safety.operating_state import RefusedError
from tormagd.daemon.black_box import MAX_REQUESTED, PART_TICKS, BlackBox
from tormagd.daemon.profiles import state_folder
from tormagd.ground.plain_values import plain
from tormagd.hardware.connection import Connection
from tormagd.hardware.frame_stream import FrameStream
from tormagd.record.journal import MAX_ENTRIES, PLAN, STEP, TEACH, Journal
from tormagd.record.keeper import Begin, End, Part, Said, Write, Written
from tormagd.record.telemetry import Moment
from tormagd.simulation.closed_loop import ClosedLoop
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.hand import ReversingHand
from tormagd.simulation.parameters import load_plant


def closed_loop(core: Core) -> ClosedLoop:
    return ClosedLoop(
        Config(), core.stepper(), core.planner(), VirtualDevice(load_plant("sample_1"), ReversingHand(2.0))
    )


class Rig:
    """A black box, whose other process is this one."""

    def __init__(self, core: Core, connection: Connection | None = None) -> None:
        self.process = Mock()
        self.stepper, self.planner = core.stepper(), core.planner()
        self.output = self.stepper.step(1.0, None, self.planner.planned)
        with patch("tormagd.daemon.child_process.start_child", self.start):
            self.box = BlackBox(Path("/boxes"), {"format": "1"}, 1_000)
        connection = connection or Connection(Config().device, lambda: pytest.fail("nobody opens it"), lambda: None)
        self.box.begin(self.stepper, self.planner, connection)

    def start(self, _module: str, its: socket.socket):
        self.its = its.dup()
        self.its.setblocking(False)
        return self.process

    def tick(self, times: int = 1) -> None:
        for _ in range(times):
            self.box.journal.note(STEP)
            self.box.ticked(
                Moment(self.stepper, self.output, self.planner.planned, None, 0.0, 0.0), self.stepper, self.planner
            )

    def heard(self) -> list[Said]:
        said: list[Said] = []
        with contextlib.suppress(BlockingIOError):
            while data := self.its.recv(4_000_000):
                said.append(msgspec.msgpack.decode(data, type=Said))
        return said


@pytest.fixture
def rig(core: Core) -> Rig:
    return Rig(core)


def names(part: Part) -> list[str]:
    return [
        each if isinstance(each, str) else each[0] if isinstance(each[0], str) else "tick"
        for each in msgspec.msgpack.decode(part.entries)
    ]


def test_parts_have_the_ticks_in_their_order_and_a_state_every_second(rig: Rig) -> None:
    rig.tick(PART_TICKS // 2 - 1)
    rig.box.journal.note(PLAN, 1.0, TimedSetpoint(1.5, 1.0, 0.1))
    first, *parts = rig.heard()
    for _ in range(302):
        rig.tick(10)
        parts += rig.heard()
    assert (first, {type(part) for part in parts}) == (Begin("/boxes", {"format": "1"}), {Part})
    assert (names(parts[0])[:3], names(parts[0])[-3:]) == (["state", "step", "tick"], ["plan", "step", "tick"])
    assert [number for number, part in enumerate(parts) if "state" in names(part)] == [0, 100, 200, 300]
    assert [each for part in parts for each in names(part)].count("tick") == 3_015
    rig.box.begin_scene({"format": "2"}, rig.stepper, rig.planner)
    assert rig.heard()[-1] == Begin("/boxes", {"format": "2"})


def test_nothing_stays_of_what_was_handed_over(rig: Rig) -> None:
    stays_bytes: list[int] = []
    tracemalloc.start()
    for part in range(100):
        rig.tick(PART_TICKS)
        rig.heard()
        if part in (49, 99):
            stays_bytes.append(tracemalloc.get_traced_memory()[0])
    tracemalloc.stop()
    assert stays_bytes[1] - stays_bytes[0] < 100_000


def test_what_passes_between_daemon_and_device_is_kept_in_its_order(core: Core) -> None:
    loop = closed_loop(core)
    rig = Rig(core, loop.connection)
    for _ in range(PART_TICKS):
        loop.tick()
        rig.tick()
    _, part = rig.heard()
    assert names(part)[:6] == ["state", "wrote", "step", "tick", "read", "wrote"]
    state, (_, time_s, sent, unsent), *_ = msgspec.msgpack.decode(part.entries)
    assert (state[3]["stream"], time_s, sent, unsent) == (
        plain(FrameStream()),
        1e-3,
        [FrameStream().pack(Hello(SCHEMA_HASH, PROTOCOL_VERSION, 255))],
        0,
    )


def test_what_the_other_process_does_not_take_is_counted_and_control_goes_on(rig: Rig) -> None:
    while not rig.box.report().dropped:
        rig.tick(PART_TICKS)
    rig.heard()
    rig.tick(2 * PART_TICKS)
    after = rig.heard()
    assert names(after[0])[:2] == ["missing", "state"]
    assert "state" not in names(after[1])


def test_a_request_waits_for_a_process_that_is_held_up(rig: Rig) -> None:
    while not rig.box.report().dropped:
        rig.tick(PART_TICKS)
    path = rig.box.write("SKEW", 2.0, {"firmware": "1.0"})
    assert path.match("/boxes/*Z-SKEW.mcap")
    assert not any(isinstance(said, Write) for said in rig.heard())
    rig.box.look()
    assert rig.heard() == [Write(path.name, "SKEW", 2.0, {"firmware": "1.0"})]
    for written in (Written(path.name), Written("b.mcap", "No space left on device")):
        rig.its.send(msgspec.msgpack.encode(written))
        rig.box.look()
        assert (rig.box.report().newest, rig.box.report().refusal) == (path.name, written.refusal)


def test_requests_take_no_place_of_a_fault(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("time.time_ns", iter(range(0, 10**12, 10**6)).__next__)
    for number in range(1_000):
        with contextlib.nullcontext() if number < MAX_REQUESTED else pytest.raises(RefusedError, match="8 black boxes"):
            rig.box.write("REQUEST", 0.0, {})
        if number % 50 == 0:
            rig.box.write("SKEW", 2.0, {})
    assert [said.reason for said in rig.heard() if isinstance(said, Write)].count("SKEW") == 20
    rig.its.send(msgspec.msgpack.encode(Written("19700101T000000.000Z-REQUEST.mcap")))
    rig.box.look()
    rig.box.write("REQUEST", 0.0, {})


@pytest.mark.parametrize(
    "notices", [lambda rig: rig.box.look(), lambda rig: rig.tick(PART_TICKS), lambda rig: rig.box.close()]
)
def test_a_process_that_ends_is_named_and_nothing_piles_up(rig: Rig, notices: Callable[[Rig], None]) -> None:
    rig.its.close()
    notices(rig)
    assert "ended" in rig.box.report().refusal
    rig.tick(100)
    assert rig.box.journal.take() == []
    with pytest.raises(RefusedError, match="has ended"):
        rig.box.write("REQUEST", 0.0, {})
    rig.box.close()


@pytest.mark.parametrize("is_heard", [False, True])
def test_a_keeper_that_ended_is_replaced_and_keeps_on_from_a_state(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, is_heard: bool
) -> None:
    rig.box.is_heard = is_heard
    monkeypatch.setattr("tormagd.daemon.child_process.start_child", rig.start)
    waits: list[float] = []
    for _ in range(4):
        rig.its.close()
        ended_s = time.monotonic()
        rig.box.look()
        waits.append(round(rig.box._due_s - ended_s))
        rig.tick(3)
        monkeypatch.setattr(rig.box, "_due_s", ended_s)
        rig.box.look()
    assert (waits, rig.box.report().refusal) == ([1] * 4, "")
    rig.tick(PART_TICKS + 1)
    begun, part = rig.heard()
    assert begun == Begin("/boxes", {"format": "1"}, is_again=True)
    assert isinstance(part, Part)
    assert names(part)[:4] == ["missing", "state", "step", "tick"]
    rig.its.close()
    rig.box.look()
    path = rig.box.write("SKEW", 0.0, {})
    monkeypatch.setattr(rig.box, "_due_s", ended_s)
    assert rig.box.is_missing
    rig.box.look()
    rig.box.look()
    assert (rig.heard()[1:], rig.box.is_missing) == ([Write(path.name, "SKEW", 0.0, {})], False)


def test_an_entry_that_cannot_be_written_ends_the_box_and_not_control(rig: Rig) -> None:
    rig.box.journal._entries.append((TEACH, object()))
    rig.tick(PART_TICKS)
    assert "cannot be written" in rig.box.report().refusal
    rig.tick(100)


def test_it_says_when_it_ends(rig: Rig) -> None:
    rig.heard()
    rig.box.close()
    assert (rig.heard(), rig.process.wait.call_count) == ([End()], 1)


def test_without_a_folder_nothing_is_kept(core: Core, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    assert state_folder("", "blackbox") is None
    box = BlackBox(None, {}, 1_000)
    box.begin(core.stepper(), core.planner(), closed_loop(core).connection)
    box.journal.note(STEP)
    assert box.journal.take() == []
    with pytest.raises(RefusedError, match="no folder is named"):
        box.write("REQUEST", 0.0, {})
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/tormag:/more")
    assert state_folder("", "blackbox") == Path("/var/lib/tormag/blackbox")
    assert state_folder("/elsewhere", "blackbox") == Path("/elsewhere")


@pytest.mark.parametrize(
    ("name", "fails", "says"),
    [
        (
            "tormagd.daemon.child_process.start_child",
            Mock(side_effect=OSError(11, "Try again")),
            "did not start: Try again",
        ),
        ("importlib.util.find_spec", lambda _name: None, "mcap is not installed: pip install 'tormagd[record]'"),
    ],
)
def test_what_is_not_there_is_named_and_no_reason_not_to_run(
    monkeypatch: pytest.MonkeyPatch, name: str, fails: object, says: str
) -> None:
    monkeypatch.setattr(name, fails)
    box = BlackBox(Path("/boxes"), {}, 1_000)
    assert (says in box.report().refusal, box.journal.is_kept) == (True, False)
    box.close()


def test_a_journal_that_nobody_takes_is_bounded_and_says_so() -> None:
    journal = Journal()
    for _ in range(3 * MAX_ENTRIES + 5):
        journal.note(STEP)
    entries = journal.take()
    assert (entries[0], len(entries) < MAX_ENTRIES) == (("missing",), True)
