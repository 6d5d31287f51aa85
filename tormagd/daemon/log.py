"""The daemon's log on stderr: for the journal, or for whoever watches."""

import logging
import sys

from tormagd.output import escaped
from tormagd_client.printable import printable


def log_to_stderr() -> None:
    """Send the log of this process, from INFO on, to stderr, a line a record: level, logger's name and message."""
    handler = logging.StreamHandler(sys.stderr)
    time_first = "%(asctime)s " if sys.stderr is not None and sys.stderr.isatty() else ""
    handler.setFormatter(LogFormatter(f"{time_first}%(levelname)s %(name)s: %(message)s"))
    logging.basicConfig(level=logging.INFO, handlers=[handler])


class LogFormatter(logging.Formatter):
    """Formats each record as one line, with unprintable characters escaped; a traceback keeps its lines."""

    def formatMessage(self, record: logging.LogRecord) -> str:
        """Return the record's line, unprintable characters escaped."""
        return printable(super().formatMessage(record))

    def format(self, record: logging.LogRecord) -> str:
        """Return the record's line and its traceback, if any, unprintable characters escaped."""
        return escaped(super().format(record))
