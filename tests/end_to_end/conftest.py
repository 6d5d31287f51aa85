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
import zmq

from tormagd_client.messages import VERSION, Reply, Request, Setpoint, Telemetry, decode, encode

PATIENCE_S = 60.0
"Longer than anything takes on a busy machine; only a failure waits for it."


class Rig:
    """The processes of one test, and a client to each of the daemon's sockets."""

    def __init__(self, folder: Path, door: str = "--pty", device: str = "") -> None:
        self.door, self._device = door, device
        self._start(folder)

    def _start(self, folder: Path) -> None:
        self.folder = folder
        self.port = folder / "tty"
        self.truth_path = folder / "truth.csv"
        self.config = folder / "tormagd.toml"
        self.config.write_text(
            'scene = "coronary"\n[realtime]\nfifo_priority = 50\n'  # only a warning where it is refused
            f'[device]\nport = "{self.port}"\nprofiles = "{folder}/profiles"\n'
            f'{self._device}measurement_timeout_ms = 50.0\n[black_box]\nfolder = "{folder}/boxes"\n[endpoints]\n'
            + "".join(f'{n} = "ipc://{folder}/{n}"\n' for n in ("setpoint", "telemetry", "control", "recording"))
        )
        self.simulator: subprocess.Popen[str] | None = None
        self.daemon: subprocess.Popen[str] | None = None
        self._context = zmq.Context()
        self._seq = 0
        self._setpoints = self._socket(zmq.XPUB, "setpoint")
        self._control = self._socket(zmq.DEALER, "control")
        self._telemetry = self._socket(zmq.SUB, "telemetry")
        self._telemetry.subscribe(b"")
        self._load_simulator()
        self._load_daemon()  # beside the simulator: both take a while to load
        self._plug_in()
        self._wait_for_link()
        self.wait_for_subscription()

    def start_again(self, folder: Path) -> None:
        """Ends everything and starts it anew in another folder: for a scenario that the host spoiled."""
        self.close()
        self._start(folder)

    def start_simulator(self) -> None:
        """A device behind the port."""
        self._load_simulator()
        self._plug_in()

    def start_daemon(self) -> None:
        """A daemon that has found its device."""
        self._load_daemon()
        self._wait_for_link()

    def _load_simulator(self) -> None:
        command = [sys.executable, "-m", "tormagd.simulation", self.door, "--seed", "1"]
        command += ["--truth", str(self.truth_path)]
        self.simulator = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        with contextlib.suppress(OSError):  # where it is allowed: a device does not wait for the host's processors
            policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
            os.sched_setscheduler(self.simulator.pid, policy, os.sched_param(40))

    def _plug_in(self) -> None:
        """A symbolic link to the simulator's line stands for the stable name that udev gives a real one."""
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

    def command(self, name: str, **args: Any) -> Reply:
        """The daemon's answer."""
        self._seq += 1
        self._control.send(encode(Request(v=VERSION, id=self._seq, command=name, args=args)))
        until_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < until_s:
            if self._control.poll(1_000):
                reply = decode(self._control.recv(), Reply)
                if reply.id == self._seq:
                    return reply
        pytest.fail(f"no answer to {name}")

    def burst(self, *names: str) -> list[Reply]:
        """The answers to commands that are given all at once."""
        first = self._seq + 1
        for name in names:
            self._seq += 1
            self._control.send(encode(Request(v=VERSION, id=self._seq, command=name)))
        replies: list[Reply] = []
        while len(replies) < len(names):
            assert self._control.poll(round(PATIENCE_S * 1e3)), f"no answer to {names[len(replies)]}"
            replies.append(decode(self._control.recv(), Reply))
        assert [reply.id for reply in replies] == list(range(first, self._seq + 1))
        return replies

    def done(self, name: str) -> None:
        """A command that must be carried out."""
        reply = self.command(name)
        assert reply.ok, reply.error

    def status(self) -> dict[str, Any]:
        """The daemon's status."""
        reply = self.command("status")
        assert reply.ok
        assert reply.result is not None
        return reply.result

    def telemetry(self) -> Telemetry:
        """The next telemetry message."""
        assert self._telemetry.poll(round(PATIENCE_S * 1e3)), "no telemetry"
        return decode(self._telemetry.recv(), Telemetry)

    def until(self, reached: Callable[[], bool], what: str) -> None:
        """Waits for a condition that each new look may find; fails saying what was waited for."""
        until_s = time.monotonic() + PATIENCE_S
        while not reached():
            assert time.monotonic() < until_s, f"not within {PATIENCE_S:g} s: {what}"
            self._telemetry.poll(50)

    def arm(self) -> None:
        """Homes, where that is still to do, and enables."""
        if not self.status()["is_homed"]:
            self.done("home")
        self.until(lambda: self.status()["is_homed"] and not self.status()["is_busy"], "homed")
        # a busy machine may find the newest measurement a little old once
        self.until(lambda: self.command("enable").ok, "enabled")

    def make_neutral(self) -> None:
        """Disabled, at rest, no fault, no setpoint in force; started anew where it does not get there."""
        try:
            self.ask(0.0, valid_for_ms=1.0)
            if self.status()["operating_state"] != "FAULT":
                self.done("disable")
            self.until(lambda: not self.status()["is_busy"], "at rest")
            if self.status()["faults"]:
                self.done("clear-fault")
            while self._telemetry.poll(0):  # what another test has not read
                self._telemetry.recv()
        except (AssertionError, pytest.fail.Exception):
            self.start_again(Path(tempfile.mkdtemp(dir=self.folder.parent)))

    def ask(self, force_N: float, valid_for_ms: float = 30_000.0, **fields: Any) -> None:
        """Publishes one setpoint."""
        self._seq += 1
        setpoint = Setpoint(
            v=VERSION,
            source="test",
            seq=self._seq,
            stamp_ns=time.time_ns(),
            servo_cf=force_N,
            valid_for_ms=valid_for_ms,
            **fields,
        )
        self.publish(encode(setpoint))

    def publish(self, data: bytes) -> None:
        """Sends any bytes to the setpoint socket."""
        self._setpoints.send(data)

    def wait_for_subscription(self) -> None:
        """Until the daemon listens; what is published earlier is lost, as everywhere in ZeroMQ."""
        assert self._setpoints.poll(round(PATIENCE_S * 1e3))
        self._setpoints.recv()

    def end(self, child: "subprocess.Popen[str]", number: signal.Signals) -> int:
        """Sends a signal; the exit code."""
        child.send_signal(number)
        return child.wait(timeout=PATIENCE_S)

    def truth(self) -> "np.ndarray[Any, Any]":
        """What the simulator wrote; ends it."""
        assert self.simulator is not None
        self.end(self.simulator, signal.SIGTERM)
        return np.genfromtxt(self.truth_path, delimiter=",", names=True)

    def close(self) -> None:
        """Ends what still runs."""
        for child in (self.daemon, self.simulator):
            if child is not None and child.poll() is None:
                child.kill()
                child.wait()
        self._context.destroy(linger=0)

    def _socket(self, kind: int, name: str) -> "zmq.Socket[bytes]":
        socket = self._context.socket(kind)
        socket.setsockopt(zmq.LINGER, 0)
        socket.connect(f"ipc://{self.folder}/{name}")
        return socket


@pytest.fixture(scope="package")
def shared_rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    """A device and a daemon that has found it, which outlive a test."""
    with contextlib.closing(Rig(tmp_path_factory.mktemp("rig"))) as made:
        yield made


@pytest.fixture
def rig(shared_rig: Rig) -> Rig:
    """The shared one, disabled and at rest; for tests that end no process."""
    shared_rig.make_neutral()
    return shared_rig


@pytest.fixture
def new_rig(tmp_path: Path) -> Iterator[Rig]:
    """One of its own: not homed yet, and its processes may be ended."""
    with contextlib.closing(Rig(tmp_path)) as made:
        yield made


@pytest.fixture
def can_rig(tmp_path: Path) -> Iterator[Rig]:
    """The same on a CAN bus."""
    device = 'backend = "can"\noptions.interface = "tormagsim"\n'
    with contextlib.closing(Rig(tmp_path, "--can", device)) as made:
        yield made
