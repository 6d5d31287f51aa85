"""The process that keeps a daemon's black box: `python -m tormagd.recording.keeper DESCRIPTOR`.

It holds the newest half minute in memory and writes it when it is told to; or when the daemon is gone that did not say
it would end, whatever became of it.
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

from tormagd.keeping import Begin, End, Part, Said, Write, Written
from tormagd.output import write_line

KEPT_S = 30.0
MOST_BYTES = 48_000_000
"""The ring holds no more than either. Half a minute at 1 kHz with 500 setpoints a second is 24 MB; at rates or with
previews for which this is too little, it reaches less far back."""
MOST_FILES = 20
"The oldest goes when there are more."
MOST_PACKET = 4_000_000
DIED = "DAEMON-DIED"
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Ring:
    """The newest parts: of at most KEPT_S before the last, and MOST_BYTES."""

    def __init__(self, kept_s: float = KEPT_S, most_bytes: int = MOST_BYTES) -> None:
        self._kept_s, self._most_bytes = kept_s, most_bytes
        self._parts: deque[Part] = deque()
        self.bytes = 0

    def put(self, part: Part) -> None:
        """Takes one, and forgets those that are too old or too many."""
        self._parts.append(part)
        self.bytes += len(part.entries)
        parts = self._parts
        while len(parts) > 1 and (self.bytes > self._most_bytes or part.time_s - parts[0].time_s > self._kept_s):
            self.bytes -= len(parts.popleft().entries)

    def parts(self) -> list[Part]:
        """What is kept, the oldest first."""
        return list(self._parts)


class Keeper:
    """One daemon's."""

    def __init__(self, its: socket.socket) -> None:
        self._socket = its
        self._ring = Ring()
        self._begun = Begin("", {})
        self._due: list[tuple[float, Write]] = []
        self._writing: list[threading.Thread] = []

    def run(self) -> None:
        """Until the daemon ends."""
        while True:
            wait_s = max(0.0, min((due_s for due_s, _ in self._due), default=3600.0) - time.monotonic())
            ready, _, _ = select.select([self._socket], [], [], wait_s)
            if ready:
                try:
                    data = self._socket.recv(MOST_PACKET)
                except OSError:
                    data = b""
                said: Said = msgspec.msgpack.decode(data, type=Said) if data else End()
                if not data:
                    stamp = time.strftime("%Y%m%dT%H%M%S.000Z", time.gmtime())
                    self._due.append((0.0, Write(f"{stamp}-{DIED}.mcap", DIED, 0.0, {})))
                if isinstance(said, End):
                    self._write_due(None)
                    for thread in self._writing:
                        thread.join()
                    return
                self._take(said)
            self._write_due(time.monotonic())

    def _take(self, said: Said) -> None:
        match said:
            case Part():
                self._ring.put(said)
            case Begin():
                self._begun = said
            case Write():
                self._due.append((time.monotonic() + said.after_s, said))

    def _write_due(self, now_s: float | None) -> None:
        """What is due by then; everything without a time."""
        due = [write for due_s, write in self._due if now_s is None or due_s <= now_s]
        self._due = [(due_s, write) for due_s, write in self._due if write not in due]
        for write in due:
            # in a thread of its own: what the daemon says meanwhile is kept
            thread = threading.Thread(target=self._write, args=(write, self._begun, self._ring.parts()))
            thread.start()
            self._writing = [*(each for each in self._writing if each.is_alive()), thread]

    def _write(self, write: Write, begun: Begin, parts: list[Part]) -> None:
        from tormagd.recording.black_box import write_black_box

        with contextlib.suppress(OSError):
            os.nice(5)  # of this thread alone
        folder, refusal = Path(begun.folder), ""
        try:
            if not parts:
                raise OSError(0, "nothing is kept yet")
            folder.mkdir(mode=0o750, parents=True, exist_ok=True)
            details = {**begun.header, **write.details, "reason": write.reason}
            write_black_box(folder / write.name, details, parts)
            for old in sorted(folder.glob("*Z-*.mcap"))[:-MOST_FILES]:
                old.unlink()
        except OSError as error:
            refusal = f"{folder / write.name}: {error.strerror}"
            write_line(f"tormagd: no black box: {refusal}", sys.stderr)
        with contextlib.suppress(OSError):  # there may be nobody any more
            self._socket.send(msgspec.msgpack.encode(Written(write.name, refusal)))


def main() -> None:
    """Keeps until the daemon at the other end of the descriptor ends."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)  # it ends after the daemon, not with it
    with socket.socket(fileno=int(sys.argv[1])) as its:
        Keeper(its).run()


if __name__ == "__main__":
    main()
