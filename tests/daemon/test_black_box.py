"""The daemon's side of the black box: it waits for nobody, and what is lost is said."""

import contextlib
import os
import socket
import time
import tracemalloc
from concurrent.futures import ThreadPoolExecutor
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
from tormagd.hardware.streams import FrameStream
from tormagd.record.keeper import End, Part, Ring, Write, Written, in_shared_memory
from tormagd.record.stream import MAX_ENTRIES, PLAN, STEP, TEACH, Journal, Moment
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
        nowhere = patch("tormagd.record.keeper.SHARED_MEMORY", "/nowhere")
        with nowhere, patch("tormagd.daemon.child_process.start_child", self.start):
            self.box = BlackBox(Path("/boxes"), {"format": "1"}, 1_000)
        connection = connection or Connection(Config().device, lambda: pytest.fail("nobody opens it"), lambda: None)
        self.box.begin(self.stepper, self.planner, connection)

    def start(self, _module: str, its: socket.socket, file: int):
        self.its, self.ring = its.dup(), Ring(file)
        self.its.setblocking(False)
        return self.process

    def tick(self, times: int = 1) -> None:
        for _ in range(times):
            self.box.journal.note(STEP)
            self.box.ticked(
                Moment(self.stepper, self.output, self.planner.planned, None, 0.0, 0.0), self.stepper, self.planner
            )

    def heard(self) -> list[Write | End]:
        said: list[Write | End] = []
        with contextlib.suppress(BlockingIOError):
            while data := self.its.recv(4_000_000):
                said.append(msgspec.msgpack.decode(data, type=Write | End))
        return said

    def parts(self) -> list[Part]:
        return [part for _, part in self.ring.kept()]


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
    rig.tick(3_020)
    parts = rig.parts()
    assert [header for header, _ in rig.ring.kept()] == [{"format": "1", "folder": "/boxes"}] * len(parts)
    assert (names(parts[0])[:3], names(parts[0])[-3:]) == (["state", "step", "tick"], ["plan", "step", "tick"])
    assert [number for number, part in enumerate(parts) if "state" in names(part)] == [0, 100, 200, 300]
    assert [each for part in parts for each in names(part)].count("tick") == 3_015
    rig.box.begin_scene({"format": "2"}, rig.stepper, rig.planner)
    rig.tick(PART_TICKS)
    header, part = rig.ring.kept()[-1]
    assert (header, names(part)[:3]) == ({"format": "2", "folder": "/boxes"}, ["missing", "state", "step"])


def test_nothing_stays_of_what_was_handed_over(rig: Rig) -> None:
    stays_bytes: list[int] = []
    tracemalloc.start()
    for part in range(100):
        rig.tick(PART_TICKS)
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
    (part,) = rig.parts()
    assert names(part)[:6] == ["state", "wrote", "step", "tick", "read", "wrote"]
    state, (_, time_s, sent, unsent), *_ = msgspec.msgpack.decode(part.entries)
    assert (state[3]["stream"], time_s, sent, unsent) == (
        plain(FrameStream()),
        1e-3,
        [FrameStream().pack(Hello(SCHEMA_HASH, PROTOCOL_VERSION, 255))],
        0,
    )


def test_what_finds_no_room_is_counted_and_control_goes_on(rig: Rig) -> None:
    with patch("os.pwrite", side_effect=OSError(28, "No space left on device")):
        rig.tick(2 * PART_TICKS)
    assert (rig.box.report().dropped, "No space" in rig.box.report().refusal, rig.parts()) == (2, True, [])
    rig.tick(3 * PART_TICKS)
    after = [names(part) for part in rig.parts()]
    assert [told[0] for told in after] == ["missing", "state", "step"]
    assert [told.count("state") for told in after] == [0, 1, 0]


def test_a_request_waits_for_a_process_that_is_held_up(rig: Rig) -> None:
    while rig.box._beside.send(b"x"):
        pass
    path = rig.box.write("SKEW", 0.0, {"firmware": "1.0"})
    assert path.match("/boxes/*Z-SKEW.mcap")
    with contextlib.suppress(BlockingIOError):
        while rig.its.recv(1_000) == b"x":
            pass
    rig.box.look()
    assert rig.heard() == [Write(str(path), "SKEW", {"format": "1", "folder": "/boxes", "firmware": "1.0"})]
    for written in (Written(path.name), Written("b.mcap", "No space left on device")):
        rig.its.send(msgspec.msgpack.encode(written))
        rig.box.look()
        assert (rig.box.report().newest, rig.box.report().refusal) == (path.name, written.refusal)


def answered(rig: Rig) -> list[Write]:
    found: list[Write] = []
    while said := rig.heard():
        (asked,) = said
        found.append(asked)
        rig.its.send(msgspec.msgpack.encode(Written(Path(asked.path).name)))
        rig.box.look()
    return found


def test_a_name_that_a_clock_gives_again_holds_up_no_other(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("time.time_ns", iter([10**9, 10**9, 2 * 10**9]).__next__)
    for _ in range(3):
        rig.box.write("REQUEST", 0.0, {})
        assert [each.reason for each in answered(rig)] == ["REQUEST"]


def test_requests_take_no_place_of_a_fault(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("time.time_ns", iter(range(0, 10**12, 10**6)).__next__)
    for number in range(1_000):
        with contextlib.nullcontext() if number < MAX_REQUESTED else pytest.raises(RefusedError, match="8 black boxes"):
            rig.box.write("REQUEST", 0.0, {})
        if number % 50 == 0:
            rig.box.write("SKEW", 0.0, {})
    with pytest.raises(RefusedError, match="20 black boxes"):  # of a keeper that never answers
        rig.box.write("SKEW", 0.0, {})
    assert "20 black boxes" in rig.box.report().refusal
    assert [each.reason for each in answered(rig)] == ["REQUEST", *["SKEW"] * 20, *["REQUEST"] * (MAX_REQUESTED - 1)]
    rig.box.write("REQUEST", 0.0, {})


def test_a_fault_s_box_has_what_came_after_it_also_where_the_daemon_ends(rig: Rig) -> None:
    asked_s = time.monotonic()
    rig.box.write("SKEW", 0.2, {})
    while not (said := rig.heard()):
        rig.box.look()
    assert (said[0].reason, time.monotonic() - asked_s >= 0.2) == ("SKEW", True)
    rig.box.write("STALL", 3_600.0, {})
    rig.box.close()
    *asked, end = rig.heard()
    assert ([each.reason for each in asked], end) == (["SKEW", "STALL"], End())


def test_an_end_with_more_boxes_due_than_the_socket_holds_loses_none(rig: Rig) -> None:
    for number in range(20):
        rig.box.write(f"F{number}", 3_600.0, {"firmware": "x" * 20_000})
    with ThreadPoolExecutor() as beside:
        ended = beside.submit(rig.box.close)
        said: list[Write | End] = []
        while not ended.done():
            said += rig.heard()
    said += rig.heard()
    assert [each.reason for each in said[:-1]] == [f"F{number}" for number in range(20)]
    assert said[-1] == End()


@pytest.mark.parametrize("is_noticed", [True, False])
def test_a_process_that_ends_is_named_and_harms_no_end(rig: Rig, is_noticed: bool) -> None:
    rig.its.close()
    if is_noticed:
        rig.box.look()
        assert "ended" in rig.box.report().refusal
    rig.box.close()


def test_a_keeper_that_ended_is_replaced_and_no_tick_is_lost(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tormagd.daemon.child_process.start_child", rig.start)
    waits: list[float] = []
    for _ in range(4):
        rig.its.close()
        ended_s = time.monotonic()
        rig.box.look()
        waits.append(round(rig.box._due_s - ended_s))
        rig.tick(PART_TICKS)
        monkeypatch.setattr(rig.box, "_due_s", ended_s)
        rig.box.look()
    assert (waits, rig.box.report().refusal, rig.box.report().dropped) == ([1] * 4, "", 0)
    told = [name for part in rig.parts() for name in names(part)]
    assert (told.count("tick"), told.count("missing")) == (4 * PART_TICKS - PART_TICKS // 2, 0)
    paths = [rig.box.write("SKEW", 0.0, {})]
    rig.its.close()
    rig.box.look()
    paths.append(rig.box.write("REQUEST", 0.0, {}))
    monkeypatch.setattr(rig.box, "_due_s", ended_s)
    assert rig.box.is_missing
    rig.box.look()
    assert ([each.path for each in answered(rig)], rig.box.is_missing) == ([*map(str, paths)], False)


def test_an_entry_that_cannot_be_written_ends_the_box_and_not_control(rig: Rig) -> None:
    rig.box.journal._entries.append((TEACH, object()))
    rig.tick(PART_TICKS)
    assert "cannot be written" in rig.box.report().refusal
    rig.tick(100)
    assert len(rig.parts()) == 10


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
    assert says in box.report().refusal
    box.close()


def test_a_journal_that_nobody_takes_is_bounded_and_says_so() -> None:
    journal = Journal()
    for _ in range(3 * MAX_ENTRIES + 5):
        journal.note(STEP)
    entries = journal.take()
    assert (entries[0], len(entries) < MAX_ENTRIES) == (("missing",), True)


def test_a_black_box_without_room_in_memory_keeps_no_daemon_from_starting(core: Core, tmp_path: Path) -> None:
    (tmp_path / "full").touch()
    full = os.open(tmp_path / "full", os.O_RDONLY)
    with patch("tempfile.mkstemp", return_value=(full, "")):
        rig = Rig(core)
    rig.tick(PART_TICKS)
    assert rig.box.report().dropped > 0
    rig.box.close()
    os.close(full)


def test_a_ring_without_a_name_looks_for_no_other(tmp_path: Path) -> None:
    with patch("tormagd.record.keeper.SHARED_MEMORY", str(tmp_path / "nowhere")):
        assert list(Ring(in_shared_memory("/boxes")).left()) == []
