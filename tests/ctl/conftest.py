"""A daemon made of sockets only: it answers what a test tells it to and publishes steadily."""

import math
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zmq

from tormagd.messages import VERSION, Setpoint, Telemetry, Tick, decode, encode

COLUMNS = ("t_ns", "setpoint_cf", "governed_cf", "measured_cf", "left_mm", "right_mm", "left_duty", "right_duty")


def telemetry(seq: int, t_ns: int, **changes: Any) -> Telemetry:
    """A snapshot of an enabled device in good order."""
    known: dict[str, Any] = {
        "v": VERSION,
        "t_ns": t_ns,
        "seq": seq,
        "operating_state": "ENABLED",
        "is_homed": True,
        "is_busy": False,
        "setpoint_cf": 1.5,
        "governed_cf": 1.5,
        "measured_cf": 1.49,
        "predicted_cf": 1.5,
        "field_mT": 120.0,
        "gap_mm": 70.0,
        "gap_setpoint_mm": 70.0,
        "measured_jp": (35.0, 35.0),
        "skew_mm": 0.0,
        "duty": (0.1, -0.1),
        "limits": (),
        "faults": (),
        "setpoint_age_ms": 1.0,
        "confidence": 0.9,
        "tick": Tick(lateness_us=20.0, exec_us=100.0),
    }
    return Telemetry(**(known | changes))


def status(**changes: Any) -> dict[str, Any]:
    """What the daemon answers to `status`."""
    snapshot = {name: getattr(telemetry(1, 1), name) for name in Telemetry.__struct_fields__ if name != "tick"}
    return (
        snapshot | {"version": "0", "scene": "pulse", "uptime_s": 5.0, "link": {"state": "UP", "frames": 7}} | changes
    )


class FakeDaemon(threading.Thread):
    """Binds the four endpoints in `directory`. `answers[command]` makes the reply's fields; setpoints are kept."""

    def __init__(self, directory: Path) -> None:
        super().__init__(daemon=True)
        self.directory = directory
        self.control = f"ipc://{directory}/control"
        self.answers: dict[str, Callable[[], dict[str, Any]]] = {"status": lambda: {"ok": True, "result": status()}}
        self.commands: list[str] = []
        self.setpoints: list[Setpoint] = []
        self.rubbish: list[bytes] = []
        self.is_bound = threading.Event()
        self.is_over = threading.Event()

    def refuse(self, command: str, code: str) -> None:
        error = {"code": code, "message": f"cannot {command}", "hint": "do this first"}
        self.answers[command] = lambda: {"ok": False, "error": error}

    def run(self) -> None:
        context = zmq.Context()
        router, setpoints = context.socket(zmq.ROUTER), context.socket(zmq.SUB)
        telemetry_out, recording = context.socket(zmq.PUB), context.socket(zmq.PUB)
        setpoints.subscribe(b"")
        for name, socket in (
            ("control", router),
            ("setpoint", setpoints),
            ("telemetry", telemetry_out),
            ("recording", recording),
        ):
            socket.bind(f"ipc://{self.directory}/{name}")
        self.is_bound.set()
        seq, start_ns = 0, time.time_ns()
        while not self.is_over.is_set():
            while router.poll(2):
                *envelope, data = router.recv_multipart()
                request = msgpack.unpackb(data)
                self.commands.append(request["command"])
                answer = self.answers.get(request["command"], lambda: {"ok": True, "result": {}})()
                router.send_multipart([*envelope, msgpack.packb({"v": VERSION, "id": request["id"], **answer})])
            while setpoints.poll(0):
                self.setpoints.append(decode(setpoints.recv(), Setpoint))
            t_ns = start_ns + seq * 20_000_000
            telemetry_out.send(encode(telemetry(seq, t_ns)))
            rows = [(t_ns + k * 1_000_000, 1.5, 1.5, 1.5 + 0.1 * math.sin(k), 35.0, 36.0, 0.1, -0.1) for k in range(20)]
            recording.send(msgpack.packb({"v": VERSION, "columns": COLUMNS, "rows": rows}))
            for data in self.rubbish:
                recording.send(data)
            seq += 1
        context.destroy(linger=0)


@pytest.fixture
def run_dir() -> Iterator[Path]:
    """A directory with a short path: an ipc address holds 107 characters."""
    with tempfile.TemporaryDirectory(prefix="tormag") as directory:
        yield Path(directory)


@pytest.fixture
def fake_daemon(run_dir: Path) -> Iterator[FakeDaemon]:
    daemon = FakeDaemon(run_dir)
    daemon.start()
    assert daemon.is_bound.wait(5.0)
    yield daemon
    daemon.is_over.set()
    daemon.join(5.0)
