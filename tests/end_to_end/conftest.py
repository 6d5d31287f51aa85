"""A daemon and a simulated device as real processes, joined by a pty, spoken to over real sockets."""

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tormagd_client import Client, ClientError, RefusedError, UnreachableError

PATIENCE_S = 60.0
"Only a failure waits so long."


class Rig:
    """The processes of one test, and a client."""

    def __init__(self, folder: Path) -> None:
        self._start(folder)

    def _start(self, folder: Path) -> None:
        self.folder = folder
        self.port = folder / "tty"
        self.truth_path = folder / "truth.csv"
        self.config = folder / "tormagd.toml"
        self.config.write_text(
            'scene = "coronary"\n[realtime]\nfifo_priority = 50\n'  # only a warning where it is refused
            f'[device]\nport = "{self.port}"\nprofiles = "{folder}/profiles"\nmeasurement_timeout_ms = 50.0\n'
            "[rates]\ncontrol_hz = 1000\n"  # a motor log needs that
            f'[black_box]\nfolder = "{folder}/boxes"\n[endpoints]\n'
            + "".join(f'{n} = "ipc://{folder}/{n}"\n' for n in ("setpoint", "telemetry", "control", "recording"))
        )
        self.simulator: subprocess.Popen[str] | None = None
        self.daemon: subprocess.Popen[str] | None = None
        self.client = Client.local(str(folder), PATIENCE_S, source="test")
        self._load_simulator()
        self._load_daemon()  # beside the simulator: both take a while to load
        self._plug_in()
        self._wait_for_link()

    def start_again(self, folder: Path) -> None:
        self.close()
        self._start(folder)

    def start_simulator(self) -> None:
        self._load_simulator()
        self._plug_in()

    def start_daemon(self) -> None:
        self._load_daemon()
        self._wait_for_link()

    def _load_simulator(self) -> None:
        command = [sys.executable, "-m", "tormagd.simulation", "--pty", "--seed", "1", "--truth", str(self.truth_path)]
        self.simulator = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        with contextlib.suppress(OSError):  # where it is allowed: a device does not wait for the host's processors
            os.sched_setscheduler(self.simulator.pid, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(40))

    def _plug_in(self) -> None:
        path = self.simulator.stdout.readline().strip()
        assert path.startswith("/")
        self.port.unlink(missing_ok=True)
        self.port.symlink_to(path)

    def _load_daemon(self) -> None:
        environment = os.environ | {"OMP_NUM_THREADS": "1"}
        self.daemon = subprocess.Popen(
            [sys.executable, "-m", "tormagd.daemon.main", "--config", str(self.config)], env=environment, text=True
        )

    def _wait_for_link(self) -> None:
        self.until(lambda: self.status()["link"]["state"] == "RUNNING", "the link runs")

    def refused(self, name: str) -> str:
        try:
            self.client.request(name)
        except RefusedError as error:
            return error.code
        return ""

    def status(self) -> dict[str, Any]:
        return self.client.request("status")

    def until(self, reached: Callable[[], bool], what: str) -> None:
        until_s = time.monotonic() + PATIENCE_S
        while True:
            with contextlib.suppress(UnreachableError):
                if reached():
                    return
            assert time.monotonic() < until_s, f"not within {PATIENCE_S:g} s: {what}"
            time.sleep(0.05)

    def arm(self) -> None:
        if not self.status()["is_homed"]:
            self.client.request("home")
        self.until(lambda: self.status()["is_homed"] and not self.status()["is_busy"], "homed")
        # a busy machine may find the newest measurement a little old once
        self.until(lambda: not self.refused("enable"), "enabled")

    def render(self, force_N: float) -> None:
        self.client.publish(force_N, 30_000.0)
        self.until(lambda: abs((self.status()["measured_cf"] or 0.0) - force_N) < 0.06, f"{force_N} N")

    def make_neutral(self) -> None:
        """Bring it to disabled, at rest and without a fault or setpoint; start it anew if that fails."""
        try:
            self.client.publish(0.0, 1.0)
            if self.status()["operating_state"] != "FAULT":
                self.client.request("disable")
            self.until(lambda: not self.status()["is_busy"], "at rest")
            if self.status()["faults"]:
                self.client.request("clear-fault")
        except (AssertionError, ClientError):
            self.start_again(Path(tempfile.mkdtemp(dir=self.folder.parent)))

    def end(self, child: "subprocess.Popen[str]", number: signal.Signals) -> int:
        child.send_signal(number)
        return child.wait(timeout=PATIENCE_S)

    def truth(self) -> "np.ndarray[Any, Any]":
        assert self.simulator is not None
        self.end(self.simulator, signal.SIGTERM)
        return np.genfromtxt(self.truth_path, delimiter=",", names=True)

    def close(self) -> None:
        for child in (self.daemon, self.simulator):
            if child is not None and child.poll() is None:
                child.kill()
                child.wait()
        self.client.close()


@pytest.fixture(scope="module")
def shared_rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    """A device and a daemon for a whole module, because they take a processor."""
    with contextlib.closing(Rig(tmp_path_factory.mktemp("rig"))) as made:
        yield made


@pytest.fixture
def rig(shared_rig: Rig) -> Rig:
    shared_rig.make_neutral()
    return shared_rig


@pytest.fixture
def new_rig(tmp_path: Path) -> Iterator[Rig]:
    with contextlib.closing(Rig(tmp_path)) as made:
        yield made
