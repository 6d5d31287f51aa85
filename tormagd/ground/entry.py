"""Entry of the installed commands: Ctrl-C while one is loading ends the process without a traceback."""

import signal
from collections.abc import Callable
from importlib import import_module

INTERRUPTED = 130
"""The shell's exit code for a process that SIGINT ended."""


def run(module: str) -> int:
    """Import `module`, run its `main` and return the exit code."""
    interrupt = signal.getsignal(signal.SIGINT)
    if interrupt is signal.default_int_handler:  # a shell's background job ignores it, and keeps doing so
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    main: Callable[[], int] = import_module(module).main
    try:
        signal.signal(signal.SIGINT, interrupt)
        return main()
    except KeyboardInterrupt:
        return INTERRUPTED
