"""A daemon on a simulated device, as processes, and its operator: what runs in real time stands on."""

import contextlib
import os
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import zmq
from machines.own import own_machine
from machines.wire import carried

from tormagd.config import load_config
from tormagd.ctl.processes import begun, first_line
from tormagd.ctl.record import listening
from tormagd.record.ticks import decode_ticks
from tormagd_client import Client, ClientError
from tormagd_client.endpoints import ENDPOINTS

FIFO_PRIORITY, DEVICE_PRIORITY = 50, 55
"Of the daemon, and of the device, which stands for a machine of its own; used if granted."
BACKENDS = {"serial": 'backend = "serial"', "can": 'backend = "can"\noptions.interface = "tormagsim"'}
DOORS = {"serial": "--pty", "can": "--can"}
NEUTRAL_N, LASTS_MS = 0.3, 60_000.0
PATIENCE_S = 60.0
LOOK_S = 0.02
UNHANDLED = ("Traceback", "CRITICAL", "Exception ignored")

Figures = dict[str, Any]


class Stand:
    """Daemon, device and an operator's client. All of it ends with `stack`."""

    def __init__(self, stack: ExitStack, transport: str = "serial", control_hz: int = 500) -> None:
        self._stack = stack
        self.folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="tormag-")))
        self.latched: list[tuple[str, float, float]] = []
        stack.enter_context(carried(DEVICE_PRIORITY))
        self.plug_in(transport)
        self.config = self.folder / "tormagd.toml"
        self.config.write_text(
            f'scene = "coronary"\n[realtime]\nfifo_priority = {FIFO_PRIORITY}\nlock_memory = true\n'
            f'[device]\nport = "{self.folder}/device"\n{BACKENDS[transport]}\nmeasurement_timeout_ms = 50.0\n'
            f'profiles = "{self.folder}/profiles"\n[black_box]\nfolder = "{self.folder}/boxes"\n'
            f"[rates]\ncontrol_hz = {control_hz}\n[endpoints]\n"
            + "".join(f'{name} = "ipc://{self.folder}/{name}"\n' for name in ENDPOINTS)
        )
        self.endpoints = load_config(self.config).endpoints
        # patient: the host may be busy
        self.client = stack.enter_context(Client(self.endpoints, 10.0))
        self.start_daemon()

    def start_daemon(self) -> None:
        self.daemon = self.begin("-m", "tormagd.daemon.main", "--config", str(self.config))
        self.until(lambda status: status["link"]["state"] == "RUNNING", "the link runs")

    def begin(self, *arguments: str) -> "subprocess.Popen[str]":
        return begun(self._stack, self.folder / "log", *arguments, environment=os.environ | {"OMP_NUM_THREADS": "1"})

    def plug_in(self, transport: str) -> None:
        """Start a device; a symbolic link to its line stands for udev's stable name."""
        (truth := self.folder / "truth.csv").unlink(missing_ok=True)
        simulated = (DOORS[transport], "--seed", "1", "--truth", str(truth))
        self.device = self.begin(*own_machine(DEVICE_PRIORITY, "tormagd.simulation", *simulated))
        line, port = first_line(self.device), self.folder / "device"
        port.unlink(missing_ok=True)
        port.symlink_to(line)

    def status(self) -> dict[str, Any]:
        return self.client.request("status")

    def until(self, reached: Callable[[dict[str, Any]], bool], what: str) -> dict[str, Any]:
        until_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < until_s and self.daemon.poll() is None:
            with contextlib.suppress(ClientError):
                if reached(status := self.status()):
                    return status
            time.sleep(LOOK_S)
        raise TimeoutError(f"not within {PATIENCE_S:g} s: {what}\n{(self.folder / 'log').read_text()[-2_000:]}")

    def ask(self, force_N: float) -> None:
        self.client.publish(force_N, LASTS_MS)

    def arm(self) -> None:

        def is_armed(status: dict[str, Any]) -> bool:
            if status["operating_state"] != "ENABLED":
                with contextlib.suppress(ClientError):
                    self.client.request("arm")
            return bool(status["operating_state"] == "ENABLED")

        self.ask(NEUTRAL_N)
        self.until(is_armed, "enabled")

    def see_faults(self, since_s: float) -> bool:
        faults = self.status()["faults"]
        self.latched += [(fault, since_s, time.monotonic()) for fault in faults]
        return bool(faults)

    @contextlib.contextmanager
    def ticks(self) -> Iterator[Callable[[], list[dict[str, Any]]]]:
        """Give a function that returns the control ticks since its last call."""
        with listening(self.endpoints) as recorder:

            def read() -> list[dict[str, Any]]:
                rows: list[dict[str, Any]] = []
                while recorder.poll(0):
                    rows += received(recorder)
                return rows

            yield read

    def unhandled(self) -> list[str]:
        lines = (self.folder / "log").read_text(encoding="utf-8", errors="replace").splitlines()
        return [line for line in lines if any(sign in line for sign in UNHANDLED)]


def received(socket: "zmq.Socket[bytes]") -> list[dict[str, Any]]:
    """Return ticks as a subscriber of recordings gets them."""
    batch = decode_ticks(socket.recv())
    return [dict(zip(batch.columns, row, strict=True)) for row in batch.rows]


def used(child: "subprocess.Popen[str]") -> tuple[int, int]:
    folder = Path(f"/proc/{child.pid}")
    pages = int((folder / "statm").read_text().split()[1])
    return len(list((folder / "fd").iterdir())), pages * os.sysconf("SC_PAGE_SIZE") // 1024
