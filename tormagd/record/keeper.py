"""The process that keeps a daemon's black box: `python -m tormagd.record.keeper DESCRIPTOR`.

It holds the newest half minute in memory and writes it to a file when the daemon says so. It also writes it when the
daemon is gone without having said that it ends.
"""

import contextlib
import os
import select
import signal
import socket
import sys
import threading
import time
from collections import deque
from pathlib import Path

import msgspec

from tormagd.ground.terminal import write_line
from tormagd.record.keeper_messages import REQUEST, Begin, End, Part, Said, Write, Written

KEPT_S = 30.0
MAX_BYTES = 48_000_000
"""The ring holds no more than either bound. Half a minute at 1 kHz with 500 setpoints a second is 18 MB."""
MAX_FILES = 20
"The oldest file of a fault is deleted when there are more, and likewise of a request."
MAX_PACKET = 4_000_000
MAX_DUE = 28
"How many files may wait to be written; more are refused."
LOOK_S = 0.05
"Period of looking whether a file is due."
DIED = "DAEMON-DIED"
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Ring:
    """The newest parts of a black box: none over `kept_s` older than the last, at most `most_bytes`, and always the
    last."""

    def __init__(self, kept_s: float = KEPT_S, most_bytes: int = MAX_BYTES) -> None:
        self._kept_s, self._most_bytes = kept_s, most_bytes
        self._parts: deque[Part] = deque()
        self.bytes = 0

    def put(self, part: Part) -> None:
        """Add a part, which comes later than those before, and drop the oldest while they are too old or too large."""
        self._parts.append(part)
        self.bytes += len(part.entries)
        parts = self._parts
        while len(parts) > 1 and (self.bytes > self._most_bytes or part.time_s - parts[0].time_s > self._kept_s):
            self.bytes -= len(parts.popleft().entries)

    def parts(self) -> list[Part]:
        """List what is kept, the oldest first."""
        return list(self._parts)


class Keeper:
    """Keeps the black box of the daemon at the other end of the socket `its`, and writes it to files."""

    def __init__(self, its: socket.socket) -> None:
        self._socket = its
        self._ring = Ring()
        self._begun = Begin("", {})
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
                stamp = time.strftime("%Y%m%dT%H%M%S.000Z", time.gmtime())
                self._due.append((0.0, Write(f"{stamp}-{DIED}.mcap", DIED, 0.0, {})))
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
                self._begun, self._ring = said, Ring()
            case Write() if len(self._due) < MAX_DUE:
                self._due.append((time.monotonic() + said.after_s, said))
                self._due.sort(key=lambda each: each[1].reason == REQUEST)  # a fault's go first
            case Write():
                self._answer(Written(said.name, f"{said.name}: {MAX_DUE} others are still to be written"))

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
            write_black_box(folder / write.name, details, parts)
            # a name is a clock's word: what this daemon has written is newer than the rest
            self._written.append(write.name)
            known = sorted(folder.glob("*Z-*.mcap"), key=lambda each: (each.name in self._written, each.name))
            alike = [each for each in known if each.match(f"*-{REQUEST}.mcap") is (write.reason == REQUEST)]
            for old in alike[:-MAX_FILES]:
                old.unlink()
        except (OSError, ValueError, TypeError, KeyError, msgspec.MsgspecError) as error:
            refusal = f"{folder / write.name}: {getattr(error, 'strerror', None) or error!r}"
            write_line(f"tormagd: no black box: {refusal}", sys.stderr)
        self._answer(Written(write.name, refusal))

    def _answer(self, answer: Written) -> None:
        with contextlib.suppress(OSError):  # there may be nobody any more
            self._socket.send(msgspec.msgpack.encode(answer), socket.MSG_DONTWAIT)


def main() -> None:
    """Keep the black box until the daemon ends that holds the other end of the socket descriptor in `sys.argv[1]`."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)  # it ends after the daemon, not with it
    with socket.socket(fileno=int(sys.argv[1])) as its:
        Keeper(its).run()


if __name__ == "__main__":
    main()
