"""A folder of recordings: segments named by when they begin, kept within a budget of size and age.

Names, file times and sizes alone decide what is pruned, so it is alike in every process, also after a kill. The oldest
segment goes first. A segment is spared that is marked, is being written, or has another form of name. The present time
decides nothing: how old a segment is, the newest one says, as far back as the segments follow each other.
"""

import contextlib
import errno
import fcntl
import re
import shutil
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from tormagd.config import Recordings
from tormagd_client.printable import require

MB, DAY_S = 1e6, 86_400.0
END_BYTES = 500_000
"What a segment may grow by once it is due: last chunk, overview and index."
MARKED = ".marked"
"Follows the time in a marked segment's name. Black boxes have another form: their keeper deletes them."
BEFORE_MARK_S = 60.0
"A segment younger than this is marked together with the one before."
LONGEST_PAUSE_S = 3 * DAY_S
"""Where a segment seems to last longer, or to follow the one before later, a clock may have been set."""
_NAME = re.compile(rf"(\d{{4}}-\d\d-\d\dT\d\d-\d\d-\d\d)(\.\d{{3}}Z)?({re.escape(MARKED)})?\.mcap")
_FORM = "%Y-%m-%dT%H-%M-%S"


class NoRoomError(OSError):
    """What is to be written does not fit; what was written can be read."""


class Segment(NamedTuple):
    """One recording in a folder: when it began, as its name says, and was last written, both s since 1970."""

    path: Path
    began_s: float | None
    bytes: int
    is_marked: bool
    ended_s: float

    @property
    def may_go(self) -> bool:
        return not (self.is_marked or self.began_s is None or self.path.is_symlink())


def segment_of(path: Path) -> Segment | None:
    """Describe the recording in `path` by its name and size; None where its size cannot be asked, as of no file."""
    named = _NAME.fullmatch(path.name)
    began_s = None
    with contextlib.suppress(ValueError):  # such as the 13th month
        if named is not None:
            began_s = datetime.strptime(f"{named[1]}{named[2] or '.000Z'}", f"{_FORM}.%f%z").timestamp()
    with contextlib.suppress(OSError):
        known = path.lstat()
        return Segment(path, began_s, known.st_size, named is not None and named[3] is not None, known.st_mtime)
    return None


def mark(path: Path) -> Path:
    """Rename a segment so that pruning keeps it, and return its new path; one that is marked already stays as it is."""
    named = _NAME.fullmatch(path.name)
    require(named is not None, "the name", path.name, "that of a segment, as tormagctl record DIR gives it")
    if named is None or named[3]:
        path.stat()
        return path
    target = path.with_name(f"{named[1]}{named[2] or ''}{MARKED}.mcap")
    try:
        return path.rename(target)
    except FileNotFoundError:
        if not target.exists():  # or somebody else has just marked it
            raise
    return target


class RecordingFolder:
    """Recordings in the folder `path` within `budget`; `clock` is in seconds since 1970."""

    def __init__(self, path: Path, budget: Recordings, clock: Callable[[], float] = time.time) -> None:
        self.path, self.budget, self._clock = path, budget, clock

    def segments(self) -> list[Segment]:
        """List the folder's recordings, the last written last; those whose name says no time come before all."""
        found = [each for path in self.path.glob("*.mcap") if (each := segment_of(path)) is not None]
        return sorted(found, key=lambda each: (each.ended_s if each.began_s else 0.0, each.path.name))

    def new(self) -> Path:
        """Prune until a whole segment has room, and return the path for a new one, named by the present time."""
        self._make_room(self.budget.segment_MB * MB + END_BYTES)
        now = datetime.fromtimestamp(self._clock(), UTC)
        return self.path / f"{now:{_FORM}}.{now.microsecond // 1_000:03d}Z.mcap"

    def is_due(self, size: int, lasted_s: float) -> bool:
        """Return whether a segment of this size (bytes) and length is to end."""
        return size >= self.budget.segment_MB * MB or lasted_s >= self.budget.segment_minutes * 60.0

    def require_room(self, needed_bytes: int) -> None:
        """Prune where the disk is short of `needed_bytes`. Raises NoRoomError."""
        if shutil.disk_usage(self.path).free < self.budget.free_MB * MB + needed_bytes:
            self._make_room(needed_bytes)

    def _make_room(self, coming_bytes: float) -> None:
        self.prune(coming_bytes)
        if over := self.over(self.segments(), coming_bytes):
            said = f"No space left on device: {over}, and nothing unmarked is left that would help"
            raise NoRoomError(errno.ENOSPC, said)

    def prune(self, coming_bytes: float = 0.0) -> list[Segment]:
        """Delete segments too old, and, where that helps, the oldest until `coming_bytes` more fit budget and
        disk; return those deleted."""
        left, gone = self.segments(), []
        old, may_go = set(self._too_old(left)), [each for each in left if each.may_go]
        stay = [each for each in left if not each.may_go]
        helps = not self.over(stay, coming_bytes, sum(each.bytes for each in may_go))
        for segment in may_go:
            if (segment in old or (helps and self.over(left, coming_bytes))) and self._delete(segment):
                left.remove(segment)
                gone.append(segment)
        return gone

    def _too_old(self, segments: list[Segment]) -> Iterator[Segment]:
        """Yield the segments that were last written longer than the budget's age before the newest, the
        newest first."""
        for segment, later in zip(segments[-2::-1], segments[:0:-1], strict=True):
            began_s = later.began_s or 0.0
            if max(abs(began_s - segment.ended_s), abs(later.ended_s - began_s)) > LONGEST_PAUSE_S:
                return
            if segments[-1].ended_s - segment.ended_s > self.budget.most_days * DAY_S:
                yield segment

    def mark_around(self, segment: Path) -> Path:
        """Mark a segment, and the one before where this one began under BEFORE_MARK_S ago; return its new path."""
        marked = mark(segment)
        known = self.segments()
        place = [each.path for each in known].index(marked)
        began_s = known[place].began_s
        if place and began_s is not None and self._clock() - began_s < BEFORE_MARK_S:
            with contextlib.suppress(OSError, ValueError):  # it has another name, or has been taken away
                mark(known[place - 1].path)
        return marked

    def over(self, left: list[Segment], coming_bytes: float = 0.0, freed_bytes: float = 0.0) -> str:
        """Say why `coming_bytes` beside the segments `left` break the budget or the disk's reserve; empty where they do
        not."""
        coming_MB, free_MB = coming_bytes / MB, (shutil.disk_usage(self.path).free + freed_bytes) / MB
        size_MB = sum(each.bytes for each in left) / MB
        if size_MB + coming_MB > self.budget.most_MB:
            over = f"{size_MB:.1f} MB are in {self.path}, up to {coming_MB:.1f} come"
            return f"{over}, its budget is {self.budget.most_MB:.1f}"
        if free_MB < self.budget.free_MB + coming_MB:
            return f"{free_MB:.1f} MB are free, and {self.budget.free_MB:.1f} stay so for black boxes"
        return ""

    def _delete(self, segment: Segment) -> bool:
        """Delete a segment; return True also where it is gone."""
        with contextlib.suppress(FileNotFoundError), segment.path.open("rb") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                return False  # it is being written
            except OSError:
                pass  # this file system knows no locks
            segment.path.unlink()
        return True
