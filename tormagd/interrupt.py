"""Ends a long run by a signal, between two of its steps."""

import signal
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import FrameType


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
