"""Lines on a standard stream that may be closed or full, or whose reader has gone; the log; what a signal ends.

A terminal obeys what is printed to it. So words of a file, a device or another process are made `printable` where they
come in, and whatever else is not printable is escaped on output, except line ends and our own colours.
"""

import codecs
import io
import json
import logging
import os
import re
import select
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from types import FrameType
from typing import TextIO

from tormagd_client.printable import printable

_OURS = re.compile("(\n|\t|\x1b\\[(?:0|1|31|32|33)m)")
"What a line may hold besides printable characters: its end, tabulators, and the colours of `ctl.outcome.Colour`."
_ALIKE = {"±": "+-", "·": "-", "…": "~"} | dict(zip("▁▂▃▄▅▆▇█", ".,:;+=*#", strict=True))
"Substitutes on a terminal that has only ASCII."


def _alike(error: UnicodeError) -> tuple[str, int]:
    """Replace characters that an encoding lacks: an error handler of codecs."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    lacking = error.object[error.start : error.end]
    return "".join(_ALIKE.get(each) or json.dumps(each)[1:-1] for each in lacking), error.end


codecs.register_error("alike", _alike)


def write_in_any_encoding() -> None:
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="alike")


def write_line(text: str, stream: TextIO | None) -> OSError | None:
    """Write `text`, escaped, with a line end; return the error that prevented it."""
    if stream is None:
        return OSError(0, "the stream is closed")
    try:
        print(escaped(text), file=stream, flush=True)
    except OSError as error:
        # otherwise the interpreter tries again at its end, complains, and changes the exit code
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)
        return error
    return None


def write_answer(text: str, program: str) -> bool:
    """Write the answer of `program` to stdout; on failure tell stderr and return False."""
    lost = write_line(text, sys.stdout)
    # a reader that stopped reading meant to; a disk that is full did not
    if lost is None or isinstance(lost, BrokenPipeError):
        return True
    write_line(f"{program}: the answer could not be written: {lost.strerror}", sys.stderr)
    return False


def escaped(text: str) -> str:
    """Escape all but printable characters, line ends, tabulators and our own colours."""
    parts = _OURS.split(text)
    parts[::2] = [printable(part) for part in parts[::2]]
    return "".join(parts)


@contextmanager
def interrupted_by(*signals: signal.Signals) -> Iterator[Callable[[], bool]]:
    """Give a function that says whether one of `signals` has come since."""
    arrived: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        arrived.append(number)

    with ExitStack() as handlers:
        for number in signals:
            handlers.callback(signal.signal, number, signal.signal(number, note))
        yield lambda: bool(arrived)


def log_to_stderr() -> None:
    """Send the log of this process, from INFO on, to stderr, a line a record: level, logger's name and message."""
    handler = PromptHandler(sys.stderr)
    time_first = "%(asctime)s " if sys.stderr is not None and sys.stderr.isatty() else ""
    handler.setFormatter(LogFormatter(f"{time_first}%(levelname)s %(name)s: %(message)s"))
    logging.basicConfig(level=logging.INFO, handlers=[handler])


class PromptHandler(logging.StreamHandler[TextIO]):
    """Writes only what its stream takes at once, because control must not wait for a reader; says what it left out."""

    left_out = 0

    def emit(self, record: logging.LogRecord) -> None:
        """Write the record, or count it where a pipe is full or a terminal stopped."""
        with suppress(OSError, ValueError, TypeError):  # it has no descriptor, so nobody waits
            if not select.select([], [self.stream], [], 0.0)[1]:
                self.left_out += 1
                return
        if self.left_out:
            record.msg, self.left_out = f"{record.msg} ({self.left_out} lines before were not read, and are lost)", 0
        super().emit(record)


class LogFormatter(logging.Formatter):
    """Formats each record as one line, with unprintable characters escaped; a traceback keeps its lines."""

    def formatMessage(self, record: logging.LogRecord) -> str:
        """Return the record's line, unprintable characters escaped."""
        return printable(super().formatMessage(record))

    def format(self, record: logging.LogRecord) -> str:
        """Return the record's line and its traceback, if any, unprintable characters escaped."""
        return escaped(super().format(record))
