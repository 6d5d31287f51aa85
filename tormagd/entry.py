"""Where the installed commands begin: while one is loading, Ctrl-C ends the process, without a traceback."""

import signal
from collections.abc import Callable
from functools import partial
from importlib import import_module

INTERRUPTED = 130
"""Exit code that a shell shows of a process ended by SIGINT."""


def _run(module: str) -> int:
    """Import `module`, run its `main` and return the exit code; Ctrl-C while importing ends the process."""
    interrupt = signal.getsignal(signal.SIGINT)
    if interrupt is signal.default_int_handler:  # a shell's background job ignores it, and goes on doing so
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    main: Callable[[], int] = import_module(module).main
    try:
        signal.signal(signal.SIGINT, interrupt)
        return main()
    except KeyboardInterrupt:
        return INTERRUPTED


daemon = partial(_run, "tormagd.daemon.main")
"`tormagd`."
ctl = partial(_run, "tormagd.ctl.main")
"`tormagctl`."
lab = partial(_run, "tormagd.lab.main")
"`tormag-lab`."
