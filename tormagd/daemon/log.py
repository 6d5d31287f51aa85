"""The daemon's log on stderr: for the journal, or for whoever watches."""

import logging
import sys

from tormagd.output import escaped
from tormagd_client.printable import printable


def log_to_stderr() -> None:
    """From here on whatever is logged is one line there, with its time on a terminal: the journal has its own."""
    handler = logging.StreamHandler(sys.stderr)
    time_first = "%(asctime)s " if sys.stderr is not None and sys.stderr.isatty() else ""
    handler.setFormatter(LogFormatter(f"{time_first}%(levelname)s %(name)s: %(message)s"))
    logging.basicConfig(level=logging.INFO, handlers=[handler])


class LogFormatter(logging.Formatter):
    """One line for each record, whatever stands in it; a traceback keeps its lines."""

    def formatMessage(self, record: logging.LogRecord) -> str:
        """The record's line."""
        return printable(super().formatMessage(record))

    def format(self, record: logging.LogRecord) -> str:
        """The line and the traceback."""
        return escaped(super().format(record))
