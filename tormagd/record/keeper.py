"""The process that writes a daemon's black boxes: `python -m tormagd.record.keeper DESCRIPTOR RING`.

The daemon itself keeps the newest half minute, in shared memory that outlives it. This process writes that to a file
when the daemon says so, or is gone without having said that it ends. Where both were killed, the next keeper does.
"""

import contextlib
import fcntl
import hashlib
import math
import os
import re
import signal
import socket
import stat
import struct
import sys
import tempfile
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path

import msgspec

from tormagd.ground.terminal import write_line

REQUEST = "REQUEST"
"Reason of a black box that somebody asked for."
KEPT_S = 30.0
MAX_BYTES = 48_000_000
"The ring's bounds; half a minute at 1 kHz is 18 MB."
HALVES = 0, 1 << 30
"Where each half of a ring begins; what is between was never written and takes no memory."
OWN_NAME = re.compile(r"\d{8}T\d{6}\.\d{3}Z-([A-Z_-]+)\.mcap")
"What a keeper names a box; another name is somebody's own, and stays."
MAX_FILES = 20
"Of faults, and of requests; the oldest goes."
MAX_PACKET = 1_000_000
DIED = "DAEMON-DIED"
SHARED_MEMORY = "/dev/shm"
LENGTH = struct.Struct("<I")
"Of what follows it in a ring."
END = LENGTH.pack(0)
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


Header = dict[str, str]
"What a half of a ring begins with, and each scene in it: a black box's metadata, and the `folder` for it."


class Part(msgspec.Struct, frozen=True, array_like=True):
    """Some control periods, as entries of `stream.py`; the time is the last period's."""

    time_s: float
    entries: bytes


class Write(msgspec.Struct, frozen=True, array_like=True, tag="write"):
    """Request to write what the ring has to a file, which gets this header: more than its scene's."""

    path: str
    reason: str
    header: Header


class End(msgspec.Struct, frozen=True, array_like=True, tag="end"):
    """Last message of a daemon that ends as it should; one that ends without it leaves a black box."""


class Written(msgspec.Struct, frozen=True, array_like=True, tag="written"):
    """Answer of the keeper: the black box `name` is on the disk, or a `refusal`."""

    name: str
    refusal: str = ""


def box_path(folder: str, reason: str) -> Path:
    """Return the path of a black box of now: FOLDER/UTC-REASON.mcap, UTC to the ms."""
    now_ms = time.time_ns() // 1_000_000
    utc = time.strftime("%Y%m%dT%H%M%S", time.gmtime(now_ms // 1_000))
    return Path(folder, f"{utc}.{now_ms % 1_000:03d}Z-{reason}.mcap")


def in_shared_memory(folder: str) -> int | None:
    """Open a new file for a ring, locked until all who hold it have ended; None where there is no such place."""
    name = f"tormagd-{os.getuid()}-{hashlib.sha256(folder.encode()).hexdigest()[:16]}-"
    try:
        file, _ = tempfile.mkstemp(prefix=name, dir=SHARED_MEMORY)
    except OSError:
        return None
    fcntl.flock(file, fcntl.LOCK_EX)
    return file


class Ring:
    """The newest parts of a black box in a file, of which the older half is written over: one writes, others read."""

    def __init__(self, file: int | None = None, kept_s: float = KEPT_S, most_bytes: int = MAX_BYTES) -> None:
        self.file = os.memfd_create("tormagd", os.MFD_CLOEXEC) if file is None else file
        self._kept_s, self._most_bytes = kept_s, most_bytes // 2
        self._header: Header | None = None
        self._half = self._at = self._bytes = 0
        self._first_s = math.inf

    def put(self, header: Header, part: Part) -> None:
        """Add a part, which comes later than those before, and its scene's header."""
        self._first_s = min(self._first_s, part.time_s)
        if part.time_s - self._first_s > self._kept_s or self._bytes + len(part.entries) > self._most_bytes:
            self._half = 1 - self._half
            self._at = HALVES[self._half]
            os.pwrite(self.file, END, self._at)
            self._first_s, self._bytes, self._header = part.time_s, 0, None
        if header is not self._header:
            self._append(header)
            self._header = header
        self._append(part)
        self._bytes += len(part.entries)

    def kept(self) -> list[tuple[Header, Part]]:
        """List what is kept, the oldest first, each part with its header: none over `kept_s` older than the last."""
        found: list[tuple[Header, Part]] = []
        for at in HALVES:
            header: Header = {}
            with contextlib.suppress(msgspec.MsgspecError, struct.error):  # it was killed in the midst of a part
                while length := LENGTH.unpack(os.pread(self.file, LENGTH.size, at))[0]:
                    said = msgspec.msgpack.decode(os.pread(self.file, length, at + LENGTH.size), type=Header | Part)
                    at += LENGTH.size + length
                    if isinstance(said, Part):
                        found.append((header, said))
                    else:
                        header = said
        found.sort(key=lambda each: each[1].time_s)
        return [each for each in found if found[-1][1].time_s - each[1].time_s <= self._kept_s]

    @property
    def path(self) -> Path:
        return Path(f"/proc/self/fd/{self.file}").readlink()

    def left(self) -> "Iterator[Ring]":
        """Yield the ring of each daemon with this folder that was killed with its keeper, and remove it then."""
        if self.path.parent != Path(SHARED_MEMORY):
            return
        for path in self.path.parent.glob(f"{self.path.name.rpartition('-')[0]}-*"):
            with contextlib.suppress(OSError), contextlib.ExitStack() as opened:
                file = os.open(path, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
                opened.callback(os.close, file)
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                known = os.fstat(file)
                if known.st_uid == os.getuid() and stat.S_ISREG(known.st_mode):
                    yield Ring(file)
                    path.unlink()

    def _append(self, what: Header | Part) -> None:
        data = msgspec.msgpack.encode(what)
        # whoever reads meanwhile finds the end before it, or all of it
        os.pwrite(self.file, data + END, self._at + LENGTH.size)
        os.pwrite(self.file, LENGTH.pack(len(data)), self._at)
        self._at += LENGTH.size + len(data)


class Keeper:
    """Writes the black boxes of the daemon at the other end of the socket `its`, from its `ring`."""

    def __init__(self, its: socket.socket, ring: Ring) -> None:
        self._socket, self._ring = its, ring
        self._written: deque[str] = deque(maxlen=2 * MAX_FILES)

    def run(self) -> None:
        """Write black boxes until the daemon ends."""
        for left in self._ring.left():
            self._write_of_a_dead(left)
        while isinstance(said := self._heard(), Write):
            self._write(said, self._ring)
        if said is None:
            self._write_of_a_dead(self._ring)
        self._ring.path.unlink(missing_ok=True)

    def _heard(self) -> Write | End | None:
        """Wait for a word of the daemon; None where it has died."""
        try:
            data = self._socket.recv(MAX_PACKET)
        except OSError:
            data = b""
        return msgspec.msgpack.decode(data, type=Write | End) if data else None

    def _write_of_a_dead(self, ring: Ring) -> None:
        """Write what the ring of a daemon has that did not say that it ends."""
        if kept := ring.kept():
            header, _ = kept[-1]
            self._write(Write(str(box_path(header["folder"], DIED)), DIED, header), ring)

    def _write(self, write: Write, ring: Ring) -> None:
        """Write one black box, unless it is there, and answer the daemon."""
        path, refusal = Path(write.path), ""
        try:
            if not path.exists():  # a keeper may have ended before it could say so
                self._new_box(path, write, ring)
        except (OSError, ValueError, TypeError, KeyError, msgspec.MsgspecError) as error:
            refusal = f"{path}: {getattr(error, 'strerror', None) or error!r}"
            if isinstance(error, OSError):
                refusal += "; next: make room there, or name another [black_box] folder"
            write_line(f"tormagd: no black box: {refusal}", sys.stderr)
        with contextlib.suppress(OSError):  # there may be nobody any more
            self._socket.send(msgspec.msgpack.encode(Written(path.name, refusal)), socket.MSG_DONTWAIT)

    def _new_box(self, path: Path, write: Write, ring: Ring) -> None:
        """Write a black box, and delete the oldest of its kind beyond MAX_FILES."""
        from tormagd.record.writer import write_black_box

        parts = [part.entries for header, part in ring.kept() if header.items() <= write.header.items()]
        if not parts:
            raise OSError(0, "nothing is kept yet")
        path.parent.mkdir(mode=0o750, parents=True, exist_ok=True)
        write_black_box(path, {**write.header, "reason": write.reason}, parts)
        # a name is a clock's word: what this daemon has written is newer than the rest
        self._written.append(path.name)
        known = sorted(path.parent.iterdir(), key=lambda each: (each.name in self._written, each.name))
        named = [(each, OWN_NAME.fullmatch(each.name)) for each in known if each.is_file()]
        alike = [each for each, name in named if name and (name[1] == REQUEST) is (write.reason == REQUEST)]
        for old in alike[:-MAX_FILES]:
            with contextlib.suppress(OSError):  # the box is written, whoever holds an older one
                old.unlink()


def main() -> None:
    """Keep the black box until the daemon ends that holds the other end of the socket descriptor in `sys.argv[1]`."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)  # it ends after the daemon, not with it
    with contextlib.suppress(OSError):  # where it may not
        os.nice(5)
    with socket.socket(fileno=int(sys.argv[1])) as its:
        Keeper(its, Ring(int(sys.argv[2]))).run()


if __name__ == "__main__":
    main()
