"""The process that keeps a daemon's black box: `python -m tormagd.record.keeper DESCRIPTOR`.

It holds the newest half minute in shared memory and writes it to a file when the daemon says so. It also writes it when
the daemon is gone without having said that it ends; where both were killed, the next keeper does.
"""

import contextlib
import fcntl
import hashlib
import math
import os
import select
import signal
import socket
import struct
import sys
import threading
import time
from collections import deque
from pathlib import Path

import msgspec

from tormagd.ground.terminal import write_line

REQUEST = "REQUEST"
"Reason of a black box that somebody asked for."
KEPT_S = 30.0
MAX_BYTES = 48_000_000
"The ring's bounds; half a minute at 1 kHz is 18 MB."
MAX_FILES = 20
"Of faults, and of requests; the oldest goes."
MAX_PACKET = 4_000_000
MAX_DUE = 28
"Files that wait to be written."
LOOK_S = 0.05
DIED = "DAEMON-DIED"
SHARED_MEMORY = "/dev/shm"
LENGTH = struct.Struct("<I")
"Of what follows it in a file of the ring."
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Begin(msgspec.Struct, frozen=True, array_like=True, tag="begin"):
    """First message: the folder for black boxes, and the header of each; `is_again` where a keeper has ended before."""

    folder: str
    header: dict[str, str]
    is_again: bool = False


class Part(msgspec.Struct, frozen=True, array_like=True, tag="part"):
    """Some control periods, as entries of `journal.py`; the time is the last period's."""

    time_s: float
    entries: bytes


class Write(msgspec.Struct, frozen=True, array_like=True, tag="write"):
    """Request to write the kept entries, and those of the next `after_s`, to the file `name`."""

    name: str
    reason: str
    after_s: float
    details: dict[str, str]


class End(msgspec.Struct, frozen=True, array_like=True, tag="end"):
    """Last message of a daemon that ends as it should; one that ends without it leaves a black box."""


class Written(msgspec.Struct, frozen=True, array_like=True, tag="written"):
    """Answer of the keeper: the black box `name` is on the disk, or a `refusal`."""

    name: str
    refusal: str = ""


Said = Begin | Part | Write | End


def in_shared_memory(folder: str) -> list[int]:
    """Open the two files of the ring for `folder`; none where another keeps them, or they are not ours."""
    files: list[int] = []
    try:
        for path in ring_paths(folder):
            files.append(os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600))
            if os.fstat(files[-1]).st_uid != os.getuid():
                raise PermissionError(path)
            fcntl.flock(files[-1], fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        for file in files:
            os.close(file)
        return []
    return files


def ring_paths(folder: str) -> list[Path]:
    name = hashlib.sha256(folder.encode()).hexdigest()[:16]
    return [Path(SHARED_MEMORY, f"tormagd-{os.getuid()}-{name}-{number}") for number in range(2)]


class Ring:
    """The newest parts of a black box, after their Begin, in two files of which the older is written over.

    The files outlive their writer; `parts` gives none over `kept_s` older than the last, and always the last.
    """

    def __init__(self, files: list[int] | None = None, kept_s: float = KEPT_S, most_bytes: int = MAX_BYTES) -> None:
        self._files = files or [os.memfd_create("tormagd", os.MFD_CLOEXEC) for _ in range(2)]
        self._kept_s, self._most_bytes = kept_s, most_bytes // 2
        self._begun = Begin("", {})
        self._first_s, self._bytes = -math.inf, 0

    def begin(self, begun: Begin) -> None:
        """Forget what is kept."""
        self._begun = begun
        for file in self._files:
            os.ftruncate(file, 0)
        self._turn(-math.inf)

    def put(self, part: Part) -> None:
        """Add a part, which comes later than those before."""
        if part.time_s - self._first_s > self._kept_s or self._bytes + len(part.entries) > self._most_bytes:
            self._turn(part.time_s)
        self._append(part)
        self._bytes += len(part.entries)

    def said(self) -> list[Begin | Part]:
        """List what both files hold, as far as they were written."""
        found: list[Begin | Part] = []
        for file in self._files:
            data, at = os.pread(file, os.fstat(file).st_size, 0), LENGTH.size
            with contextlib.suppress(msgspec.MsgspecError, struct.error):
                while at <= len(data):
                    end = at + LENGTH.unpack_from(data, at - LENGTH.size)[0]
                    found.append(msgspec.msgpack.decode(data[at:end], type=Begin | Part))
                    at = end + LENGTH.size
        return found

    def parts(self) -> list[Part]:
        """List what is kept, the oldest first."""
        parts = sorted((each for each in self.said() if isinstance(each, Part)), key=lambda part: part.time_s)
        return [each for each in parts if parts[-1].time_s - each.time_s <= self._kept_s]

    def _turn(self, first_s: float) -> None:
        """Write over the older file."""
        self._files.reverse()
        os.ftruncate(self._files[0], 0)
        self._first_s, self._bytes = first_s, 0
        self._append(self._begun)

    def _append(self, what: Begin | Part) -> None:
        data = msgspec.msgpack.encode(what)
        os.pwrite(self._files[0], LENGTH.pack(len(data)) + data, os.fstat(self._files[0]).st_size)


class Keeper:
    """Keeps the black box of the daemon at the other end of the socket `its`, and writes it to files."""

    def __init__(self, its: socket.socket) -> None:
        self._socket = its
        self._ring, self._begun, self._is_named = Ring(), Begin("", {}), False
        self._due: list[tuple[float, Write]] = []
        self._writing: threading.Thread | None = None
        self._written: deque[str] = deque(maxlen=2 * MAX_FILES)

    def run(self) -> None:
        """Keep and write black boxes until the daemon ends, then write all that is still due, and return."""
        while self._hear():
            if self._writing is not None and self._writing.is_alive():
                continue  # one at a time
            due = next((each for each in self._due if each[0] <= time.monotonic()), None)
            if due is not None:
                self._due.remove(due)
                # in a thread of its own: what the daemon says meanwhile is kept
                self._writing = threading.Thread(target=self._write, args=(due[1], self._begun, self._ring.parts()))
                self._writing.start()
        self._write_due()
        if self._is_named:
            for path in ring_paths(self._begun.folder):
                path.unlink(missing_ok=True)

    def _write_due(self) -> None:
        """Write all black boxes that are still due, without waiting for what should have come into them."""
        if self._writing is not None:
            self._writing.join()
        for _, write in self._due:
            self._write(write, self._begun, self._ring.parts())
        self._due.clear()

    def _hear(self) -> bool:
        """Wait for one packet from the daemon and take it; return whether the daemon goes on."""
        ready, _, _ = select.select([self._socket], [], [], LOOK_S if self._due else None)
        if not ready:
            return True
        try:
            data = self._socket.recv(MAX_PACKET)
        except OSError:
            data = b""
        if not data:
            if self._ring.parts():
                self._due.append((0.0, died()))
            return False
        said: Said = msgspec.msgpack.decode(data, type=Said)
        self._take(said)
        return not isinstance(said, End)

    def _take(self, said: Said) -> None:
        """Take what the daemon said: keep a Part, begin anew for a Begin, or make the file of a Write due."""
        match said:
            case Part():
                self._ring.put(said)
            case Begin():
                self._write_due()  # they are of the scene that ends
                self._begin(said)
            case Write() if len(self._due) < MAX_DUE:
                self._due.append((time.monotonic() + said.after_s, said))
                self._due.sort(key=lambda each: each[1].reason == REQUEST)  # a fault's go first
            case Write():
                self._answer(Written(said.name, f"{MAX_DUE} others are still to be written"))

    def _begin(self, begun: Begin) -> None:
        """Begin the ring anew; write what a keeper that was killed has left, or go on with it for the same daemon."""
        parts: list[Part] = []
        if not self._begun.folder:
            files = in_shared_memory(begun.folder)
            self._ring, self._is_named = Ring(files), bool(files)
            parts = self._ring.parts()
            left = next((each for each in self._ring.said() if isinstance(each, Begin)), None)
            if left is not None and parts and not begun.is_again:
                self._write(died(), left, parts)
                parts = []
        self._begun = begun
        self._ring.begin(begun)
        for part in parts:
            self._ring.put(part)

    def _write(self, write: Write, begun: Begin, parts: list[Part]) -> None:
        """Write one black box of `parts`, delete the oldest of its kind beyond MAX_FILES, and answer the daemon."""
        from tormagd.record.black_box import write_black_box

        with contextlib.suppress(OSError):
            os.nice(5)  # of this thread alone
        folder, refusal = Path(begun.folder), ""
        try:
            if not parts:
                raise OSError(0, "nothing is kept yet")
            folder.mkdir(mode=0o750, parents=True, exist_ok=True)
            details = {**begun.header, **write.details, "reason": write.reason}
            write_black_box(folder / write.name, details, [part.entries for part in parts])
            # a name is a clock's word: what this daemon has written is newer than the rest
            self._written.append(write.name)
            known = sorted(folder.glob("*Z-*.mcap"), key=lambda each: (each.name in self._written, each.name))
            alike = [each for each in known if each.match(f"*-{REQUEST}.mcap") is (write.reason == REQUEST)]
            for old in alike[:-MAX_FILES]:
                old.unlink()
        except (OSError, ValueError, TypeError, KeyError, msgspec.MsgspecError) as error:
            refusal = f"{folder / write.name}: {getattr(error, 'strerror', None) or error!r}"
            if isinstance(error, OSError):
                refusal += "; next: make room there, or name another [black_box] folder"
            write_line(f"tormagd: no black box: {refusal}", sys.stderr)
        self._answer(Written(write.name, refusal))

    def _answer(self, answer: Written) -> None:
        with contextlib.suppress(OSError):  # there may be nobody any more
            self._socket.send(msgspec.msgpack.encode(answer), socket.MSG_DONTWAIT)


def died() -> Write:
    return Write(time.strftime(f"%Y%m%dT%H%M%S.000Z-{DIED}.mcap", time.gmtime()), DIED, 0.0, {})


def main() -> None:
    """Keep the black box until the daemon ends that holds the other end of the socket descriptor in `sys.argv[1]`."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)  # it ends after the daemon, not with it
    with socket.socket(fileno=int(sys.argv[1])) as its:
        Keeper(its).run()


if __name__ == "__main__":
    main()
