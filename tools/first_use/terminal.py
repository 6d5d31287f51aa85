"""A shell that is typed into, line by line, as by somebody who waits for each answer."""

import os
import queue
import re
import signal
import subprocess
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Self

PATIENCE_S = 60.0
"For one line; only a failure waits for it."
ENDED = re.compile(r"^\[ended (\d+)\]$", re.MULTILINE)

Environment = Mapping[str, str]


class Terminal:
    """A shell in the new user's folder."""

    def __init__(self, folder: Path, environment: Environment) -> None:
        self._shell = subprocess.Popen(
            ["bash"],
            cwd=folder,
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,  # Ctrl-C goes to the shell and to what runs in it, and to nobody else
        )
        self._is_busy = False
        self._printed: queue.Queue[str] = queue.Queue()
        threading.Thread(target=self._listen, daemon=True).start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        try:
            if self._is_busy:
                self.end()
        except (TimeoutError, OSError):
            os.killpg(self._shell.pid, signal.SIGKILL)
        assert self._shell.stdin is not None
        self._shell.stdin.close()
        self._shell.wait()

    def run(self, line: str) -> tuple[int, str]:
        """Types a line: its exit code and what it printed. Raises TimeoutError."""
        printed, _, code = self._until(f'{line}\necho "[ended $?]"', ENDED).rpartition("[ended ")
        return int(code.rstrip("]\n")), printed

    def start(self, line: str, said: re.Pattern[str]) -> str:
        """Types a line that goes on: the first that it printed of `said`. Raises TimeoutError."""
        self._is_busy = True
        found = said.search(self._until(line, said))
        assert found is not None
        return found[0]

    def end(self) -> tuple[int, str]:
        """Ctrl-C: the exit code of what was started, and what it still printed. Raises TimeoutError."""
        os.killpg(self._shell.pid, signal.SIGINT)
        self._is_busy = False
        return self.run("")

    def _until(self, line: str, said: re.Pattern[str]) -> str:
        assert self._shell.stdin is not None
        self._shell.stdin.write(f"{line}\n")
        self._shell.stdin.flush()
        text, until_s = "", time.monotonic() + PATIENCE_S
        while not said.search(text):
            try:
                text += self._printed.get(timeout=max(0.0, until_s - time.monotonic()))
            except queue.Empty:
                raise TimeoutError(f"not within {PATIENCE_S:g} s; it said {text.strip()[-300:]!r}") from None
        return text

    def _listen(self) -> None:
        assert self._shell.stdout is not None
        for line in self._shell.stdout:
            self._printed.put(line)
