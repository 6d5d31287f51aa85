"""Processes of ours: begun with a log, waited for, heard, and ended."""

import contextlib
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import zmq

from tormagd.record.ticks import decode_ticks
from tormagd_client import Client, ClientError

PATIENCE_S, LOOK_S = 20.0, 0.05


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


def received(socket: "zmq.Socket[bytes]") -> list[dict[str, Any]]:
    batch = decode_ticks(socket.recv())
    return [dict(zip(batch.columns, row, strict=True)) for row in batch.rows]


def end(child: "subprocess.Popen[Any]", number: signal.Signals = signal.SIGTERM) -> int:
    """Ask a process to end, and kill it if it does not; return its exit code."""
    child.send_signal(number)
    try:
        return child.wait(PATIENCE_S)
    except subprocess.TimeoutExpired:
        child.kill()
        return child.wait()
