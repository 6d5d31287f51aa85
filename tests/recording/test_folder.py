"""A folder of recordings never outgrows its budget, and nothing marked is lost, wherever its recorder is killed."""

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
from mcap.writer import MCAP0_MAGIC
from sent import START_NS, batch, telemetry, tell

from tormagd.config import Recordings
from tormagd.record.folder import RecordingFolder, mark, segment_of
from tormagd.record.reader import RecordingFile, damage_in
from tormagd.record.writer import RecordingWriter
from tormagd_client.messages import Mark

DAY_S = 86_400.0
BUDGET = Recordings(segment_MB=0.04, segment_minutes=60.0, most_MB=1.08, most_days=30.0, free_MB=1.0)
SETTINGS = Recordings(segment_MB=0.1, segment_minutes=60.0, most_MB=2.0, most_days=30.0, free_MB=1.0)


class Clock:
    def __init__(self) -> None:
        self.now_s = START_NS * 1e-9

    def __call__(self) -> float:
        return self.now_s


def write(folder: RecordingFolder, clock: Clock) -> Path:
    with RecordingWriter(folder) as writer:
        ms = (clock.now_s - START_NS * 1e-9) * 1e3
        rng = random.Random(ms)
        writer.ticks(batch(*((ms + i, rng.random(), rng.random(), 35.0, 36.0, 0.25) for i in range(200))))
    return dated(writer.path, clock.now_s)


def dated(path: Path, now_s: float) -> Path:
    """The file, last written at this time."""
    path.touch()
    os.utime(path, (now_s, now_s))
    return path


def of_days(folder: Path, now_s: float, *days: float) -> list[Path]:
    """Recordings without content, so many days from `now_s`, by a clock that says so."""
    return [
        dated(folder / time.strftime("%Y-%m-%dT%H-%M-%S.mcap", time.gmtime(at_s)), at_s)
        for at_s in (now_s + day * DAY_S for day in days)
    ]


@pytest.mark.parametrize("wrong_days", [40, -40, -20_774])
def test_no_clock_takes_a_recording_away(tmp_path: Path, wrong_days: int) -> None:
    now_s, wrong_s = START_NS * 1e-9, START_NS * 1e-9 + wrong_days * DAY_S
    folder = RecordingFolder(tmp_path, BUDGET, lambda: wrong_s)
    made = [*of_days(tmp_path, now_s, *range(-29, 0)), *of_days(tmp_path, wrong_s, 0.1, 0.2, 0.3)]
    dated(folder.new(), now_s)  # begun by that clock, and written until it was set
    assert folder.prune() == []
    made[3].write_bytes(bytes(1_080_000))
    assert made[0] in [each.path for each in folder.prune(1)]


def test_what_ended_a_month_before_the_newest_goes_and_nothing_before_a_pause(tmp_path: Path) -> None:
    made = of_days(tmp_path, START_NS * 1e-9, -44, -40, *range(-36, 1))
    assert {each.path for each in RecordingFolder(tmp_path, BUDGET).prune()} == set(made[2:8])


def test_the_oldest_unmarked_go_first_and_nothing_else_goes(tmp_path: Path) -> None:
    clock = Clock()
    folder = RecordingFolder(tmp_path, BUDGET, clock)
    for name in ("mine.mcap", "2020-01-01T00-00-00-mine.mcap"):
        (tmp_path / name).write_bytes(b"x" * 20_000)
    marked = mark(write(folder, clock))
    made = []
    for _ in range(40):
        clock.now_s += 3_600.0
        made.append(write(folder, clock))
        assert sum(each.bytes for each in folder.segments()) <= 1_080_000
    left = {each.path for each in folder.segments()}
    kept = [path for path in made if path in left]
    assert kept == made[-len(kept) :]
    assert 3 < len(kept) < 40
    assert {marked, tmp_path / "mine.mcap", tmp_path / "2020-01-01T00-00-00-mine.mcap"} < left
    # one that is written is not taken away, whatever its age; nor is a marked one
    clock.now_s += 3_600.0
    held = folder.new()
    kept = [path for path in kept if path.exists()]
    with RecordingWriter(held) as writer:
        writer.ticks(batch((0, 1.0, 1.0, 35.0, 36.0, 0.25)))
        dated(held, clock.now_s)
        of_days(tmp_path, clock.now_s, *range(1, 32))
        assert {each.path for each in folder.prune()} == set(kept)
        assert held.exists()
    dated(held, clock.now_s)
    assert [each.path for each in folder.prune()] == [held]
    assert marked.exists()


def test_a_folder_full_of_marked_recordings_is_full_and_says_so(tmp_path: Path, monkeypatch) -> None:
    folder = RecordingFolder(tmp_path, BUDGET)
    for day in range(1, 7):
        (tmp_path / f"2026-11-0{day}T00-00-00.marked.mcap").write_bytes(bytes(100_000))
    with pytest.raises(OSError, match=r"up to 0\.5 come, its budget is 1\.1, and nothing unmarked is left"):
        folder.new()
    assert len(folder.segments()) == 6
    # what stays free is for black boxes
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=900_000))
    with pytest.raises(OSError, match=r"0\.9 MB are free, and 1\.0 stay so for black boxes"):
        folder.require_room(0)
    # what others fill is not made good by recordings
    unmarked = of_days(tmp_path, START_NS * 1e-9, -1, 0)
    with pytest.raises(OSError, match="nothing unmarked is left that would help"):
        folder.require_room(0)
    assert all(path.exists() for path in unmarked)


@pytest.mark.parametrize("name", ["a.mcap", "2026-13-45T05-09-27Z.mcap", "2026-11-26T05-09-27.mcap.part"])
def test_other_names_are_not_marked(tmp_path: Path, name: str) -> None:
    (tmp_path / name).touch()
    with pytest.raises(ValueError, match="allowed is that of a segment"):
        mark(tmp_path / name)
    assert segment_of(tmp_path / name).began_s is None


@pytest.mark.parametrize(("fraction", "began_s"), [("", 1_795_669_767.0), (".250Z", 1_795_669_767.25)])
def test_a_name_says_when_it_began_also_in_the_former_form(tmp_path: Path, fraction: str, began_s: float) -> None:
    path = tmp_path / f"2026-11-26T05-09-27{fraction}.mcap"
    path.touch()
    assert (segment_of(path).began_s, segment_of(path).is_marked) == (began_s, False)
    assert mark(mark(path)) == tmp_path / f"2026-11-26T05-09-27{fraction}.marked.mcap"


def test_a_segment_that_somebody_renamed_is_recorded_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with RecordingWriter(RecordingFolder(tmp_path, SETTINGS, Clock())) as recorder:
        recorder.path.rename(tmp_path / "mine.mcap")
        tell(recorder, telemetry(0, 0, mark=Mark(t_ns=START_NS + 10, text="here")))
    assert [each.text for each in RecordingFile(tmp_path / "mine.mcap").overview.marks] == ["here"]
    assert "the mark keeps no segment" in capsys.readouterr().err


def test_a_recorder_whose_budget_is_full_ends_its_segment_in_order(tmp_path: Path) -> None:
    recorder = RecordingWriter(RecordingFolder(tmp_path, SETTINGS, Clock()))
    mark(recorder.path)  # by somebody else: the recorder goes on
    (tmp_path / "another.mcap").write_bytes(b"x" * 1_900_000)
    newest = Mark(t_ns=START_NS + 10, text="here")
    with pytest.raises(OSError, match="nothing unmarked is left"), recorder as writer:  # noqa: PT012
        tell(recorder, telemetry(0, 0, mark=newest))
        recorder.ticks(batch((0, 1.0, 1.0, 35.0, 36.0, 0.25), (3.7e6, 1.0, 1.0, 35.0, 36.0, 0.25)))
    known = RecordingFile(writer.path)
    assert (known.is_complete, [each.text for each in known.overview.marks]) == (False, ["here"])
    assert known.damage == ""


def test_a_recording_that_was_taken_away_is_none(tmp_path: Path) -> None:
    recorder = RecordingWriter(tmp_path / "a.mcap")
    recorder.path.unlink()
    with pytest.raises(FileNotFoundError):
        recorder.close()


def test_a_segment_is_ended_in_order_whatever_keeps_the_next_from_beginning(tmp_path: Path, monkeypatch) -> None:
    recorder = RecordingWriter(RecordingFolder(tmp_path, SETTINGS, Clock()))
    monkeypatch.setattr(RecordingFolder, "new", Mock(side_effect=PermissionError(13, "Permission denied")))
    with pytest.raises(OSError, match="Permission denied"), recorder:
        recorder.ticks(batch((0, 1.0, 1.0, 35.0, 36.0, 0.25), (3.7e6, 1.0, 1.0, 35.0, 36.0, 0.25)))
    known = RecordingFile(recorder.path)
    assert (known.overview.ticks, known.notes) == (2, ["cut short: Permission denied"])


def record(path: Path, clock: Clock, hours: int, rng: random.Random) -> list[str]:
    told, newest = [], None
    with RecordingWriter(RecordingFolder(path, SETTINGS, clock)) as recorder:
        for number in range(hours * 20):
            clock.now_s += 180.0
            ms = (clock.now_s - START_NS * 1e-9) * 1e3
            recorder.ticks(batch((ms, 36.0, rng.randbytes(8_000).hex()), columns=("t_ns", "right_mm", "words")))
            if rng.random() < 0.0015:
                newest = Mark(t_ns=round(clock.now_s * 1e9), text=f"event {number}")
                told.append(newest.text)
            tell(recorder, telemetry(ms + 20, number, mark=newest))
    return told


def marks_in(path: Path) -> set[str]:
    kept = [RecordingFile(each) for each in path.glob("*.marked.mcap")]
    return {known.text for each in kept for known in each.overview.marks}


def test_a_year_of_recording_never_outgrows_its_budget_and_keeps_its_marks(tmp_path: Path) -> None:
    clock, rng = Clock(), random.Random(1)
    marks, written_bytes = [], 0
    for _ in range(12):
        before = {each.path for each in RecordingFolder(tmp_path, SETTINGS, clock).segments()}
        marks += record(tmp_path, clock, 12, rng)
        clock.now_s += 30 * DAY_S
        segments = RecordingFolder(tmp_path, SETTINGS, clock).segments()
        assert sum(each.bytes for each in segments) <= 2_000_000
        written_bytes += sum(each.bytes for each in segments if each.path not in before)
    assert written_bytes > 3_000_000
    assert marks_in(tmp_path) == set(marks) != set()
    assert {(each.is_complete, each.damage) for each in map(RecordingFile, tmp_path.iterdir())} == {(True, "")}


KILLED = """
import os, random, signal, sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from test_folder import Clock, record
what, after = sys.argv[3].split(":")
count = [int(after)]
def deadly(function, is_before):
    def call(*arguments, **named):
        count[0] -= 1
        if count[0] < 0 and is_before:
            os.kill(os.getpid(), signal.SIGKILL)
        result = function(*arguments, **named)
        if count[0] < 0:
            os.kill(os.getpid(), signal.SIGKILL)
        return result
    return call
from tormagd.record import writer
room, name = {
    "rotate": (writer.RecordingFolder, "new"), "begin": (writer.RecordingWriter, "_begin"),
    "prune": (Path, "unlink"), "mark": (Path, "rename"), "flush": (writer.Writer, "flush"),
    "finish": (writer.Writer, "finish"),
}[what]
setattr(room, name, deadly(getattr(room, name), random.Random(after).random() < 0.5))
record(Path(sys.argv[2]), Clock(), 24, random.Random(6))
"""


@pytest.mark.parametrize("where", ["rotate:2", "begin:4", "prune:1", "mark:0", "mark:1", "flush:90", "finish:3"])
def test_a_recorder_that_is_killed_anywhere_loses_nothing_marked(tmp_path: Path, where: str) -> None:
    command = [sys.executable, "-P", "-c", KILLED, str(Path(__file__).parent), str(tmp_path), where]
    assert subprocess.run(command, check=False).returncode == -signal.SIGKILL
    clock = Clock()
    whole = []
    for each in tmp_path.iterdir():
        with each.open("rb") as file:
            assert damage_in(file) == ""
        whole.append(each.read_bytes().endswith(MCAP0_MAGIC))
    assert whole.count(False) <= 1
    before = marks_in(tmp_path)
    # whoever records next goes on from there
    clock.now_s += 40 * DAY_S
    record(tmp_path, clock, 12, random.Random(5))
    assert before <= marks_in(tmp_path)
    assert sum(each.stat().st_size for each in tmp_path.iterdir()) <= 2_000_000
