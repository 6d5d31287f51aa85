"""`tormagctl top`: what the daemon does, live in a terminal."""

import contextlib
import os
import select
import signal
import sys
import termios
import time
import tty
from collections import deque

from rich.console import Console
from rich.live import Live

from tormagd.ctl.outcome import Outcome, is_terminal, usage_error
from tormagd.ctl.top_screen import Seen, screen
from tormagd.ground.terminal import interrupted_by
from tormagd_client.blocking import Client
from tormagd_client.errors import not_understood
from tormagd_client.messages import Explained, MessageError, Status, Telemetry
from tormagd_client.wire import Pending, understood

REDRAW_S = 0.2
ASK_S = 1.0
"The status is asked for sooner if a code appears that is not explained yet."
KEPT = 1_000
"Snapshots of 20 s: shorter limits would come and go too fast to be read."


def top(client: Client) -> Outcome:
    """Draw the daemon's state until `q`, Ctrl-C or SIGTERM."""
    console = Console(highlight=False)
    if not (is_terminal(sys.stdin) and console.is_terminal) or console.is_dumb_terminal:
        raise usage_error("top needs a terminal that can be drawn on", "tormagctl status, with --json for a script")
    watcher = Watcher(client)
    start_s = time.monotonic()
    with (
        interrupted_by(signal.SIGINT, signal.SIGTERM) as is_interrupted,
        contextlib.ExitStack() as terminal,
        Live(console=console, screen=True, auto_refresh=False) as live,
    ):
        terminal.callback(termios.tcsetattr, sys.stdin, termios.TCSADRAIN, termios.tcgetattr(sys.stdin))
        tty.setcbreak(sys.stdin)  # keys are read when pressed, without echo
        while not is_interrupted():
            live.update(screen(watcher.look(), *console.size), refresh=True)
            if select.select([sys.stdin], [], [], REDRAW_S)[0]:
                # all that came: what Python read ahead would wait for the next key
                keys = os.read(sys.stdin.fileno(), 1_024)
                if b"q" in keys or not keys:
                    break
    seconds = time.monotonic() - start_s
    return Outcome({"seconds": round(seconds, 1)}, f"watched for {seconds:.0f} s; the daemon goes on")


class Watcher:
    """Gathers telemetry and status for the screen; waits only for the first status."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._telemetry: deque[Telemetry] = deque(maxlen=KEPT)
        self._status = client.status()
        self._explained: dict[str, Explained] = {}
        self._asked: Pending | None = None
        self._ask_s = self._heard_s = time.monotonic()

    def look(self) -> Seen:
        """Return what has arrived by now, and ask for the status from time to time."""
        now_s = time.monotonic()
        try:
            arrived = self._client.telemetry()
        except MessageError as error:
            raise not_understood("telemetry", error) from error
        if arrived:
            self._heard_s = now_s
            self._telemetry += arrived
            self._ask(now_s, {*arrived[-1].faults, *arrived[-1].limits})
        self._explained |= {each.code: each for each in (*self._status.limit_details, *self._status.fault_details)}
        return Seen(self._telemetry, self._status, self._explained, now_s - self._heard_s)

    def _ask(self, now_s: float, codes: set[str]) -> None:
        result = None if self._asked is None else self._client.answer(self._asked)
        if result is not None:
            self._status = understood(result, Status)
            self._asked = None
        if now_s >= self._ask_s or (self._asked is None and not codes <= self._explained.keys()):
            self._asked = self._client.ask("status")
            self._ask_s = now_s + ASK_S
