"""A folder of recordings: segments named by when they begin, within a budget of size and age.

Its name says all that decides whether a segment is taken away: so that is so wherever a process is killed. Nothing is
taken away that is marked, is being written, or has another name. The oldest goes first.
"""

import contextlib
import errno
import fcntl
import re
import shutil
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from tormagd_client.printable import require

END_BYTES = 500_000
"A segment ends with its last chunk, its overview and its index: so much more than its size when it is due."
MARKED = ".marked"
"Behind the time in a name; black boxes, which their keeper takes away, have another form."
BEFORE_MARK_S = 60.0
"The segment before is marked, too, where the one with the mark is younger."
_NAME = re.compile(rf"(\d{{4}}-\d\d-\d\dT\d\d-\d\d-\d\d)(\.\d{{3}}Z)?({re.escape(MARKED)})?\.mcap")
_FORM = "%Y-%m-%dT%H-%M-%S"


class Budget(NamedTuple):
    """How long a segment gets, and what a folder may hold: bytes, seconds, and bytes that stay free on its disk."""

    segment_bytes: int
    segment_s: float
    most_bytes: int
    most_s: float
    free_bytes: int


class Segment(NamedTuple):
    """One recording in a folder; `began_s` is since 1970, None where its name does not say so."""

    path: Path
    began_s: float | None
    bytes: int
    is_marked: bool


def segment_of(path: Path) -> Segment | None:
    """What a file's name says; None for one that is not there any more."""
    named = _NAME.fullmatch(path.name)
    began_s = None
    with contextlib.suppress(ValueError):
        if named is not None:
            began_s = datetime.strptime(named[1], _FORM).replace(tzinfo=UTC).timestamp() + float(
                (named[2] or "0")[:4] or 0
            )
    with contextlib.suppress(OSError):
        return Segment(path, began_s, path.lstat().st_size, named is not None and named[3] is not None)
    return None


def mark(path: Path) -> Path:
    """Keeps this segment from being taken away; returns its new name. Raises OSError, and ValueError for a file that is
    not named as a segment."""
    named = _NAME.fullmatch(path.name)
    require(named is not None, "the name", path.name, "that of a segment, as tormagctl record DIR gives it")
    if named is None or named[3]:
        return path
    target = path.with_name(f"{named[1]}{named[2] or ''}{MARKED}.mcap")
    try:
        return path.rename(target)
    except FileNotFoundError:
        if not target.exists():  # or somebody else has just marked it
            raise
    return target


class RecordingFolder:
    """Segments in `path`, by this clock (s since 1970). Methods raise OSError."""

    def __init__(self, path: Path, budget: Budget, clock: Callable[[], float] = time.time) -> None:
        self.path, self.budget, self._clock = path, budget, clock

    def segments(self) -> list[Segment]:
        """All recordings in it, the oldest first, and those before them whose name says no time."""
        found = [each for path in self.path.glob("*.mcap") if (each := segment_of(path)) is not None]
        return sorted(found, key=lambda each: (each.began_s or 0.0, each.path.name))

    def new(self) -> Path:
        """Makes room for a segment, and names it."""
        reason = self.make_room(self.budget.segment_bytes + END_BYTES)
        if reason:
            raise OSError(errno.ENOSPC, reason)
        now = datetime.fromtimestamp(self._clock(), UTC)
        return self.path / f"{now:{_FORM}}.{now.microsecond // 1_000:03d}Z.mcap"

    def is_due(self, size: int, lasted_s: float) -> bool:
        """Whether a segment of this size and length is to end."""
        return size >= self.budget.segment_bytes or lasted_s >= self.budget.segment_s

    def room(self, segment: Path, needed_bytes: int) -> str:
        """As a recorder asks while it writes: why there is no room; empty where there is."""
        if shutil.disk_usage(self.path).free >= self.budget.free_bytes + needed_bytes:
            return ""
        return self.make_room(needed_bytes)

    def make_room(self, coming_bytes: int) -> str:
        """Takes away what is too old, and the oldest until so many bytes more are within the budget. Returns why they
        are not; empty where they are."""
        self.prune(coming_bytes)
        over = self._over(self.segments(), coming_bytes)
        return f"No space left on device: {over}, and nothing unmarked is left to take away" if over else ""

    def prune(self, coming_bytes: int = 0) -> list[Segment]:
        """What was taken away."""
        left, gone = self.segments(), []
        for segment in list(left):
            is_old = segment.began_s is not None and self._clock() - segment.began_s > self.budget.most_s
            if (is_old or self._over(left, coming_bytes)) and self._is_taken(segment):
                left.remove(segment)
                gone.append(segment)
        return gone

    def mark_around(self, segment: Path) -> Path:
        """Marks a segment, and the one before it where that ended shortly before now; returns its new name."""
        marked = mark(segment)
        known = self.segments()
        place = [each.path for each in known].index(marked)
        began_s = known[place].began_s
        if place and began_s is not None and self._clock() - began_s < BEFORE_MARK_S:
            with contextlib.suppress(OSError, ValueError):  # it has another name, or has been taken away
                mark(known[place - 1].path)
        return marked

    def _over(self, left: list[Segment], coming_bytes: int) -> str:
        """Why so many bytes more are too many; empty where they are not."""
        size, free = sum(each.bytes for each in left), shutil.disk_usage(self.path).free
        if size + coming_bytes > self.budget.most_bytes:
            over = f"{size / 1e6:.1f} MB are in {self.path}, up to {coming_bytes / 1e6:.1f} come"
            return f"{over}, its budget is {self.budget.most_bytes / 1e6:.1f}"
        if free < self.budget.free_bytes + coming_bytes:
            return f"{free / 1e6:.1f} MB are free, and {self.budget.free_bytes / 1e6:.1f} stay so for black boxes"
        return ""

    def _is_taken(self, segment: Segment) -> bool:
        """Takes it away, unless something keeps it."""
        if segment.is_marked or segment.began_s is None or segment.path.is_symlink():
            return False
        with contextlib.suppress(FileNotFoundError), segment.path.open("rb") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                return False  # it is being written
            except OSError:
                pass  # this file system knows no locks
            segment.path.unlink()
        return True
