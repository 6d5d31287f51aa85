"""How long `tormagctl status` takes until it has answered, beside `python -c 'import zmq'`, which every client needs.

Both are started in turns, with a daemon that has no device. Wall-clock time is what a person waits; processor time is
what the command itself needs, whatever else the machine does.
"""

import argparse
import contextlib
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from tormagd.config import ENDPOINTS
from tormagd_client import Client, ClientError

ALLOWED_MS = 150.0
PATIENCE_S = 60.0
COMMANDS = {
    "import_zmq": ["-c", "import zmq"],
    "status": ["-P", "-c", "import sys; from tormagd.entry import ctl; sys.exit(ctl())"],
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """How often each is started."""
    parser.add_argument("--runs", type=int, default=20, metavar="N", help="starts of each (20)")


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """`{import_zmq: {wall_ms, cpu_ms}, status: {wall_ms, cpu_ms}, ratio, cpu_ratio, allowed_ms}`, each a median."""
    taken: dict[str, list[tuple[float, float]]] = {name: [] for name in COMMANDS}
    with tempfile.TemporaryDirectory(prefix="tormag-") as folder:
        config = Path(folder, "tormagd.toml")
        addresses = [f'{name} = "ipc://{folder}/{name}"' for name in ENDPOINTS]
        config.write_text("\n".join([f'[device]\nport = "{folder}/none"', "[endpoints]", *addresses]))
        daemon = subprocess.Popen(
            [sys.executable, "-m", "tormagd.daemon.main", "--config", str(config)], stderr=subprocess.DEVNULL
        )
        try:
            wait_for(folder)
            asking = {"import_zmq": [], "status": ["--endpoint", f"ipc://{folder}/control", "--wait", "5", "status"]}
            for _ in range(options.runs):
                for name, command in COMMANDS.items():
                    taken[name].append(timed([sys.executable, *command, *asking[name]]))
        finally:
            daemon.terminate()
            daemon.wait()
    medians = {name: [statistics.median(values) for values in zip(*runs, strict=True)] for name, runs in taken.items()}
    result: dict[str, Any] = {
        name: {"wall_ms": round(wall, 1), "cpu_ms": round(cpu, 1)} for name, (wall, cpu) in medians.items()
    }
    (zmq_wall, zmq_cpu), (wall, cpu) = medians["import_zmq"], medians["status"]
    return result | {
        "ratio": round(wall / zmq_wall, 2),
        "cpu_ratio": round(cpu / zmq_cpu, 2),
        "allowed_ms": ALLOWED_MS,
    }


def wait_for(folder: str) -> None:
    """Until the daemon answers. Raises TimeoutError."""
    until_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < until_s:
        with contextlib.suppress(ClientError), Client.local(folder) as client:
            client.status()
            return
        time.sleep(0.1)
    raise TimeoutError(f"the daemon did not answer within {PATIENCE_S:g} s")


def timed(command: list[str]) -> tuple[float, float]:
    """What a process takes, and what of the processor it needs, ms. Raises CalledProcessError where it fails."""
    start_s = time.monotonic()
    # as installed: what was compiled before is kept
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=environment)
    _, status, usage = os.wait4(process.pid, 0)
    wall_ms = (time.monotonic() - start_s) * 1e3
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, command)
    return wall_ms, (usage.ru_utime + usage.ru_stime) * 1e3


def print_table(result: dict[str, Any]) -> None:
    """The same for a person."""
    for name, shown in (("import_zmq", "python -c 'import zmq'"), ("status", "tormagctl status")):
        print(f"{shown:<24}{result[name]['wall_ms']:7.0f} ms, {result[name]['cpu_ms']:.0f} ms of the processor")
    print(
        f"ratio {result['ratio']:.2f}, of processor time {result['cpu_ratio']:.2f}; allowed are "
        f"{result['allowed_ms']:.0f} ms on a quiet machine"
    )
