"""The process that keeps the black box: bounded, and it outlives the daemon."""

import json
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings, strategies as st

from tormagd.daemon.black_box import KEEPER
from tormagd.record import keeper
from tormagd.record.keeper import (
    DIED,
    KEPT_S,
    MAX_BYTES,
    MAX_FILES,
    End,
    Part,
    Ring,
    Write,
    Written,
    in_shared_memory,
)
from tormagd.record.reader import BlackBoxFile
from tormagd.record.writer import is_tick

PATIENCE_S = 60.0
HEADER = {"format": "0", "scene": "a", "columns": json.dumps(["t_ns", "x"])}


def headed(folder: Path | str, scene: str = "a") -> dict[str, str]:
    return HEADER | {"folder": str(folder), "scene": scene}


OF_BOXES = headed("/boxes")


def part(time_s: float, size: int = 100) -> Part:
    return Part(time_s, bytes(size))


def parts_in(ring: Ring) -> list[Part]:
    return [each for _, each in ring.kept()]


def kept(ring: Ring) -> int:
    return sum(len(each.entries) for each in parts_in(ring))


def test_the_ring_keeps_half_a_minute_of_a_day() -> None:
    ring = Ring()
    for number in range(10_000):
        ring.put(OF_BOXES, part(0.02 * number))
    kept = ring.kept()
    (of_first, first), (of_last, last) = kept[0], kept[-1]
    assert last.time_s - first.time_s == pytest.approx(KEPT_S, abs=0.021)
    assert of_first == of_last == OF_BOXES


def test_the_ring_holds_no_more_bytes_than_it_may() -> None:
    ring = Ring()
    for number in range(300):
        ring.put(OF_BOXES, part(0.001 * number, 1_000_000))
        if number % 40 == 39:
            assert MAX_BYTES // 2 - 1_000_000 <= kept(ring) <= MAX_BYTES or number < 60
    ring.put(OF_BOXES, part(1.0, MAX_BYTES + 1))
    assert parts_in(ring)[-1].time_s == 1.0  # the newest is always there
    assert os.fstat(ring.file).st_blocks * 512 < 2 * MAX_BYTES + 2_000_000


@settings(max_examples=30)
@given(st.lists(st.tuples(st.floats(0.0, 2.0), st.integers(0, 60)), max_size=60))
def test_neither_bound_is_passed(steps: list[tuple[float, int]]) -> None:
    ring, now_s = Ring(None, 5.0, 200), 0.0
    for step_s, size in steps:
        now_s += step_s
        ring.put(OF_BOXES, part(now_s, size))
        parts = parts_in(ring)
        assert kept(ring) <= 200
        assert parts[-1].time_s - parts[0].time_s <= 5.0
        assert parts[-1].time_s == now_s


def test_a_ring_that_broke_off_within_a_part_has_those_before() -> None:
    ring, scenes = Ring(), [{"folder": "/boxes", "scene": name} for name in "ab"]
    for number, header in enumerate(scenes):
        ring.put(header, part(float(number)))
        os.pwrite(ring.file, b"\xc1" * 50, ring._at + 4)
    assert [(header, each.time_s) for header, each in Ring(ring.file).kept()] == [(scenes[0], 0.0), (scenes[1], 1.0)]


def test_a_list_that_begins_with_a_number_is_a_tick() -> None:
    assert [is_tick(each) for each in ([1, 2.0], [], ["step", 1], [True], [1.0], (1, 2), "a", 1)] == [
        True,
        *[False] * 7,
    ]


class Process:
    """A keeper, and what a daemon does: parts go into the ring, words to the keeper."""

    def __init__(self, folder: Path, ring: Ring | None = None) -> None:
        self.ours, its = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.ours.settimeout(PATIENCE_S)
        self.ring = ring or Ring(in_shared_memory(str(folder)))
        self.ring_path = self.ring.path
        with its:
            files = its.fileno(), self.ring.file
            self.child = subprocess.Popen(
                [sys.executable, "-P", "-m", KEEPER, *map(str, files)],
                pass_fds=files,
                stderr=subprocess.PIPE,
                text=True,
            )

    def say(self, *words: dict[str, str] | Part | Write | End) -> None:
        for word in words:
            if isinstance(word, dict):
                self.header = word
            elif isinstance(word, Part):
                self.ring.put(self.header, word)
            else:
                self.ours.send(msgspec.msgpack.encode(word))

    def heard(self) -> Written:
        return msgspec.msgpack.decode(self.ours.recv(65_536), type=Written)

    def die(self) -> None:
        """End as a daemon that is killed does."""
        self.ours.close()
        os.close(self.ring.file)


@pytest.fixture
def process(tmp_path: Path) -> Iterator[Process]:
    made = Process(tmp_path)
    yield made
    made.ours.close()
    if made.child.poll() is None:
        made.child.kill()
    made.child.communicate()
    made.ring_path.unlink(missing_ok=True)


def written(folder: Path, name: str, **header: str) -> Write:
    reason = name.removesuffix(".mcap").rpartition("-")[2]
    return Write(str(folder / name), reason, headed(folder) | header)


def ticks(first: int, count: int) -> Part:
    entries = [item for number in range(first, first + count) for item in ("step", [number, 0.5])]
    return Part(first * 1e-3, msgspec.msgpack.encode(entries))


def test_it_writes_what_it_is_told_and_what_a_dead_daemon_left(process: Process, tmp_path: Path) -> None:
    folder = tmp_path / "boxes"
    folder.mkdir()
    for number in range(MAX_FILES + 3):
        (folder / f"20400101T0000{number:02d}.000Z-OLD.mcap").touch()  # by a clock that was ahead
        (folder / f"20200101T0000{number:02d}.000Z-REQUEST.mcap").touch()
    (folder / "20200101T000000.000Z-SKEW-to-keep.mcap").touch()
    (folder / "20200101T000000.000Z-SKEW.mcap").mkdir()
    process.say(headed(folder), ticks(1, 20), ticks(21, 20))
    process.say(written(folder, "20300101T000000.000Z-SKEW.mcap", firmware="1.2"))
    assert process.heard() == Written("20300101T000000.000Z-SKEW.mcap")
    box = BlackBoxFile(folder / "20300101T000000.000Z-SKEW.mcap")
    assert (box.metadata["reason"], box.metadata["firmware"], box.is_complete) == ("SKEW", "1.2", True)
    assert [entry[0] for entry in box.entries if entry != "step"] == list(range(1, 41))
    assert len(list(folder.iterdir())) == 2 * MAX_FILES + 5
    process.say(written(folder, "20300101T000000.000Z-REQUEST.mcap"))
    assert (process.heard().refusal, len(list(folder.iterdir()))) == ("", 2 * MAX_FILES + 2)
    # what is there already is not written again
    data = (folder / "20300101T000000.000Z-SKEW.mcap").read_bytes()
    process.say(ticks(41, 20), written(folder, "20300101T000000.000Z-SKEW.mcap"))
    assert process.heard().refusal == ""
    assert (folder / "20300101T000000.000Z-SKEW.mcap").read_bytes() == data
    # a folder that is none says so
    process.say(written(folder / "20300101T000000.000Z-SKEW.mcap", "x-SKEW.mcap"))
    assert "x-SKEW.mcap" in process.heard().refusal
    # what is asked for late is of the scene that its header names
    process.say(headed(folder, "b"), Part(0.05, b"\xc1"), written(folder, "20300102T000000.000Z-DUE.mcap"))
    assert process.heard().refusal == ""
    # so does a part that is none
    process.say(written(folder, "y-SKEW.mcap", scene="b"))
    assert process.heard().refusal.startswith(f"{folder}/y-SKEW.mcap: DecodeError")
    # no word, no daemon: it was killed. Each beginning is of another scene, and keeps nothing of the one before
    process.say(headed(folder, "c"), ticks(61, 20), written(folder, "2031Z-LATER.mcap", scene="c"))
    process.die()
    assert process.child.wait(PATIENCE_S) == 0
    (left,) = folder.glob(f"*{DIED}.mcap")
    for path, first in ((left, 61), (folder / "20300102T000000.000Z-DUE.mcap", 1), (folder / "2031Z-LATER.mcap", 61)):
        assert next(entry[0] for entry in BlackBoxFile(path).entries if entry != "step") == first, path
    assert not process.ring_path.exists()


@pytest.mark.parametrize("is_daemon_killed", [True, False], ids=["both were killed", "the keeper was killed"])
def test_what_a_killed_keeper_had_is_there_after_it(process: Process, tmp_path: Path, is_daemon_killed: bool) -> None:
    process.say(headed(tmp_path), ticks(1, 20))
    process.child.kill()
    process.child.wait()
    if is_daemon_killed:
        process.die()
        after = Process(tmp_path)
    else:
        after = Process(tmp_path, process.ring)
    after.say(headed(tmp_path), ticks(21, 20), written(tmp_path, "2Z-Y.mcap"))
    while after.heard().name != "2Z-Y.mcap":
        pass
    after.say(End())
    assert after.child.wait(PATIENCE_S) == 0
    after.die()
    after.child.communicate()
    boxes = {path.name.partition("Z-")[2]: BlackBoxFile(path).entries for path in tmp_path.iterdir()}
    firsts = {name: (entries[1][0], entries[-1][0]) for name, entries in boxes.items()}
    both = {"Y.mcap": (21, 40), f"{DIED}.mcap": (1, 20)}
    assert firsts == (both if is_daemon_killed else {"Y.mcap": (1, 40)})
    assert not any(each.ring_path.exists() for each in (process, after))


def test_another_s_files_are_not_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(keeper, "SHARED_MEMORY", str(tmp_path))
    files = [in_shared_memory(folder) for folder in ("/boxes", "/boxes", "/others")]
    ours, *_ = map(Ring, files)
    os.mkfifo(f"{ours.path}-fifo")
    assert list(ours.left()) == []  # their daemons run
    for file in files[1:]:
        os.close(file)
    with monkeypatch.context() as another:
        another.setattr("os.getuid", lambda: 12_345)
        assert list(ours.left()) == []
    assert len(list(ours.left())) == 1
    assert len(list(tmp_path.iterdir())) == 3


@pytest.mark.parametrize("words", [(), (ticks(1, 20), End())], ids=["gone before it kept anything", "ended in order"])
def test_it_ends_with_the_daemon_and_leaves_nothing(process: Process, tmp_path: Path, words: tuple[Any, ...]) -> None:
    process.say(headed(tmp_path / "boxes"), *words)
    process.die()
    assert process.child.communicate(timeout=PATIENCE_S) == (None, "")
    assert not (tmp_path / "boxes").exists()
