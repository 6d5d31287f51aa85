"""Processes of ours: begun with a log, waited for, and ended; and what they take."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from tormagd_client import Client, ClientError

PATIENCE_S = 90.0
"A recorder on a busy machine writes for up to 60 s what waits."
LOOK_S = 0.05


def begun(
    stack: contextlib.ExitStack,
    log: Path,
    *arguments: str,
    is_read: bool = True,
    environment: dict[str, str] | None = None,
) -> "subprocess.Popen[str]":
    with log.open("a") as said:
        stdout = subprocess.PIPE if is_read else said
        child = subprocess.Popen([sys.executable, *arguments], stdout=stdout, stderr=said, text=True, env=environment)
    stack.callback(end, child)
    return child


def first_line(child: "subprocess.Popen[str]") -> str:
    """Return the first printed line, such as a simulated device's port; empty if it ended before."""
    assert child.stdout is not None
    return child.stdout.readline().strip()


def is_linked(client: Client, daemon: "subprocess.Popen[str]", patience_s: float) -> bool:
    """Wait until the daemon has its device; return whether it has."""
    until_s = time.monotonic() + patience_s
    while time.monotonic() < until_s and daemon.poll() is None:
        with contextlib.suppress(ClientError):
            if client.request("status").get("link", {}).get("state") == "RUNNING":
                return True
        time.sleep(LOOK_S)
    return False


def end(child: "subprocess.Popen[Any]", number: signal.Signals = signal.SIGTERM) -> int:
    """Ask a process to end, and kill it if it does not; return its exit code."""
    child.send_signal(number)
    try:
        return child.wait(PATIENCE_S)
    except subprocess.TimeoutExpired:
        child.kill()
        return child.wait()


def processor_s(pid: int) -> float:
    """Return the processor time of a process and all its children, s; ended ones count if they were waited for."""
    ticks = 0
    waiting = [pid]
    while waiting:
        member = waiting.pop()
        try:
            stat = Path(f"/proc/{member}/stat").read_text(encoding="ascii", errors="replace")
        except OSError:
            if member == pid:
                raise
            continue  # it ended while we looked
        with contextlib.suppress(OSError):  # so may a thread
            for thread in Path(f"/proc/{member}/task").iterdir():
                waiting.extend(int(child) for child in (thread / "children").read_text(encoding="ascii").split())
        # a name may hold spaces and parentheses, so the fields are counted from the last one (proc_pid_stat(5))
        ticks += sum(int(field) for field in stat.rpartition(")")[2].split()[11:15])
    return ticks / os.sysconf("SC_CLK_TCK")
