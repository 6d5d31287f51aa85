"""The process that keeps the black box: bounded, and it outlives the daemon."""

import json
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest
from hypothesis import given, settings, strategies as st

from tormagd.daemon.black_box import KEEPER
from tormagd.record import keeper
from tormagd.record.black_box import read_black_box
from tormagd.record.keeper import (
    DIED,
    KEPT_S,
    MAX_BYTES,
    MAX_DUE,
    MAX_FILES,
    Begin,
    End,
    Part,
    Ring,
    Said,
    Write,
    Written,
    ring_paths,
)
from tormagd.record.writer import is_tick

PATIENCE_S = 60.0
HEADER = {"format": "0", "columns": json.dumps(["t_ns", "x"])}


def part(time_s: float, size: int = 100) -> Part:
    return Part(time_s, bytes(size))


def kept(ring: Ring) -> int:
    return sum(len(each.entries) for each in ring.parts())


def test_the_ring_keeps_half_a_minute_of_a_day() -> None:
    ring = Ring()
    for number in range(10_000):
        ring.put(part(0.02 * number))
    parts = ring.parts()
    assert parts[-1].time_s - parts[0].time_s == pytest.approx(KEPT_S, abs=0.021)


def test_the_ring_holds_no_more_bytes_than_it_may() -> None:
    ring = Ring()
    for number in range(300):
        ring.put(part(0.001 * number, 1_000_000))
        if number % 40 == 39:
            assert MAX_BYTES // 2 - 1_000_000 <= kept(ring) <= MAX_BYTES or number < 60
    ring.put(part(1.0, MAX_BYTES + 1))
    assert ring.parts()[-1].time_s == 1.0  # the newest is always there


@settings(max_examples=30)
@given(st.lists(st.tuples(st.floats(0.0, 2.0), st.integers(0, 60)), max_size=60))
def test_neither_bound_is_passed(steps: list[tuple[float, int]]) -> None:
    ring, now_s = Ring(None, 5.0, 200), 0.0
    for step_s, size in steps:
        now_s += step_s
        ring.put(part(now_s, size))
        parts = ring.parts()
        assert kept(ring) <= 200
        assert parts[-1].time_s - parts[0].time_s <= 5.0
        assert parts[-1].time_s == now_s


def test_a_list_that_begins_with_a_number_is_a_tick() -> None:
    assert [is_tick(each) for each in ([1, 2.0], [], ["step", 1], [True], [1.0], (1, 2), "a", 1)] == [
        True,
        *[False] * 7,
    ]


class Process:
    def __init__(self) -> None:
        self.ours, its = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.ours.settimeout(PATIENCE_S)
        with its:
            number = its.fileno()
            self.child = subprocess.Popen(
                [sys.executable, "-P", "-m", KEEPER, str(number)],
                pass_fds=(number,),
                stderr=subprocess.PIPE,
                text=True,
            )

    def say(self, *words: Said) -> None:
        for word in words:
            self.ours.send(msgspec.msgpack.encode(word))

    def heard(self) -> Written:
        return msgspec.msgpack.decode(self.ours.recv(65_536), type=Written)


@pytest.fixture
def process() -> Iterator[Process]:
    made = Process()
    yield made
    made.ours.close()
    if made.child.poll() is None:
        made.child.kill()
    made.child.communicate()


def ticks(first: int, count: int) -> Part:
    entries = [item for number in range(first, first + count) for item in ("step", [number, 0.5])]
    return Part(first * 1e-3, msgspec.msgpack.encode(entries))


def test_it_writes_what_it_is_told_and_what_a_dead_daemon_left(process: Process, tmp_path: Path) -> None:
    folder = tmp_path / "boxes"
    folder.mkdir()
    for number in range(MAX_FILES + 3):
        (folder / f"20400101T0000{number:02d}.000Z-OLD.mcap").touch()  # by a clock that was ahead
        (folder / f"20200101T0000{number:02d}.000Z-REQUEST.mcap").touch()
    process.say(Begin(str(folder), HEADER), ticks(1, 20), ticks(21, 20))
    process.say(Write("20300101T000000.000Z-SKEW.mcap", "SKEW", 0.0, {"firmware": "1.2"}))
    assert process.heard() == Written("20300101T000000.000Z-SKEW.mcap")
    box = read_black_box(folder / "20300101T000000.000Z-SKEW.mcap")
    assert (box.header["reason"], box.header["firmware"], box.is_complete) == ("SKEW", "1.2", True)
    assert [entry[0] for entry in box.entries if entry != "step"] == list(range(1, 41))
    assert len(list(folder.iterdir())) == 2 * MAX_FILES + 3
    process.say(Write("20300101T000000.000Z-REQUEST.mcap", "REQUEST", 0.0, {}))
    assert (process.heard().refusal, len(list(folder.iterdir()))) == ("", 2 * MAX_FILES)
    # a name that is taken, or a folder that is none, says so
    process.say(Write("20300101T000000.000Z-SKEW.mcap", "SKEW", 0.0, {}))
    assert "exists" in process.heard().refusal
    process.say(Write("20300102T000000.000Z-DUE.mcap", "DUE", 3_600.0, {}))
    process.say(Begin(str(folder / "20300101T000000.000Z-SKEW.mcap"), HEADER))
    assert process.heard() == Written("20300102T000000.000Z-DUE.mcap")
    process.say(Write("x.mcap", "SKEW", 0.0, {}))
    assert "x.mcap" in process.heard().refusal
    # so does a part that is none
    process.say(Begin(str(folder), HEADER), Part(0.0, b"\xc1"), Write("y.mcap", "SKEW", 0.0, {}))
    assert process.heard().refusal.startswith(f"{folder}/y.mcap: DecodeError")
    # no word, no daemon: it was killed. Each beginning is of another scene, and keeps nothing of the one before
    process.say(Begin(str(folder), HEADER), ticks(41, 20), Write("2031Z-LATER.mcap", "LATER", 3_600.0, {}))
    process.ours.close()
    assert process.child.wait(PATIENCE_S) == 0
    (left,) = folder.glob(f"*{DIED}.mcap")
    assert [entry[0] for entry in read_black_box(left).entries if entry != "step"] == list(range(41, 61))
    assert (folder / "2031Z-LATER.mcap").is_file()  # what was still due was written too


def test_one_that_asks_for_too_many_is_refused_and_gets_the_others(process: Process, tmp_path: Path) -> None:
    process.say(Begin(str(tmp_path), HEADER), ticks(1, 20))
    asked = [Write(f"{number}Z-X.mcap", "X" if number % 2 else "REQUEST", 3_600.0, {}) for number in range(MAX_DUE + 1)]
    process.say(*asked)
    assert "others are still to be written" in process.heard().refusal
    process.say(End())
    assert process.child.wait(PATIENCE_S) == 0
    assert [process.heard().name for _ in range(3)] == ["1Z-X.mcap", "3Z-X.mcap", "5Z-X.mcap"]
    assert len(list(tmp_path.iterdir())) == MAX_DUE


@pytest.mark.parametrize("is_again", [False, True], ids=["both were killed", "the keeper was killed"])
def test_what_a_killed_keeper_had_is_there_after_it(process: Process, tmp_path: Path, is_again: bool) -> None:
    process.say(Begin(str(tmp_path), HEADER), ticks(1, 20), Write("1Z-X.mcap", "X", 0.0, {}))
    process.heard()  # so it has taken all that
    process.child.kill()
    process.child.wait()
    after = Process()
    after.say(Begin(str(tmp_path), HEADER, is_again), ticks(21, 20), Write("2Z-Y.mcap", "Y", 0.0, {}))
    while after.heard().name != "2Z-Y.mcap":
        pass
    after.say(End())
    assert after.child.wait(PATIENCE_S) == 0
    after.ours.close()
    after.child.communicate()
    boxes = {path.name.partition("Z-")[2]: read_black_box(path).entries for path in tmp_path.iterdir()}
    firsts = {name: (entries[1][0], entries[-1][0]) for name, entries in boxes.items()}
    assert firsts.pop("X.mcap") == (1, 20)
    assert firsts == ({"Y.mcap": (1, 40)} if is_again else {"Y.mcap": (21, 40), f"{DIED}.mcap": (1, 20)})
    assert not any(path.exists() for path in ring_paths(str(tmp_path)))


def test_another_s_files_are_not_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(keeper, "SHARED_MEMORY", str(tmp_path))
    ours, first = os.getuid(), keeper.in_shared_memory("/boxes")
    assert (len(first), keeper.in_shared_memory("/boxes")) == (2, [])  # another keeper has them
    for file in first:
        os.close(file)
    monkeypatch.setattr("os.getuid", lambda: 12_345)
    for path in tmp_path.iterdir():
        path.rename(tmp_path / path.name.replace(f"tormagd-{ours}", "tormagd-12345"))
    assert keeper.in_shared_memory("/boxes") == []


@pytest.mark.parametrize("words", [(), (ticks(1, 20), End())], ids=["gone before it kept anything", "ended in order"])
def test_it_ends_with_the_daemon_and_leaves_nothing(process: Process, tmp_path: Path, words: tuple[Said, ...]) -> None:
    process.say(Begin(str(tmp_path / "boxes"), HEADER), *words)
    process.ours.close()
    assert process.child.communicate(timeout=PATIENCE_S) == (None, "")
    assert not (tmp_path / "boxes").exists()
