"""A daemon made of sockets only: it answers what a test tells it to and publishes steadily."""

import contextlib
import importlib
import io
import json
import math
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import chain, repeat
from pathlib import Path
from typing import Any, NamedTuple

import msgpack
import msgspec
import pytest
import zmq

from tormagd.ctl.main import main
from tormagd.record.stream import TOLD
from tormagd.scenes.scene import load_scene
from tormagd_client.messages import (
    MOTION_TOPIC,
    VERDICT_TOPIC,
    VERSION,
    Motion,
    Setpoint,
    Telemetry,
    Tick,
    Verdict,
    decode,
    encode,
)

PATIENCE_S = 20.0
COLUMNS = ("t_ns", "setpoint_cf", "governed_cf", "measured_cf", "left_mm", "right_mm", "left_duty", "right_duty")


def telemetry(seq: int, t_ns: int, **changes: Any) -> Telemetry:
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


MOTION = Motion(v=VERSION, t_ns=7, device_s=0.5, handle_mm=3.0, handle_mm_s=-20.0)
VERDICT = Verdict(v=VERSION, t_ns=8, source="me", seq=3, outcome="cannot", arrives_ms=None, why=("F_MAX",))

LINK: dict[str, Any] = {
    "state": "RUNNING",
    "cause": "",
    "remedy": "",
    "backend": "serial",
    "port": "/dev/tormag",
    "losses": 1,
    "last_loss": "no message for 80 ms",
    "firmware": "1.0",
    "serial_number": 7,
    "firmware_schema": "4b3a5911",
    "daemon_schema": "4b3a5911",
    "protocol_version": 1,
    "frames": 55_096,
    "bytes": 812_345,
    "corrupt": 0,
    "lost": 2,
    "repeated": 0,
    "resynchronisations": 0,
    "round_trip_us": {"least": 351.0, "p50": 402.5, "p99": 480.0},
    "clock": {"offset_s": 12.345678, "drift_ppm": 30.12, "residual_us": 3.2, "windows": 120, "outliers": 1},
}


SOURCE: dict[str, Any] = {
    "state": "holds",
    "silent_ms": 1.0,
    "session": None,
    "seq": 4,
    "accepted": 5,
    "refused": 0,
    "lost": 3,
    "restarts": 1,
    "delay_us": {"p50": 1_200.0, "p99": 3_400.0, "p999": 4_000.0, "max": 4_100.0},
    "jitter_us": 450.0,
    "clock_behind_ms": 1001.0,
    "clock_steps": 0,
    "clock": {"offset_s": 1.002, "drift_ppm": -201.3, "residual_us": 8.0, "windows": 60, "outliers": 0},
    "cause": "its clock: it is 1.001 s behind this machine's, and is corrected",
    "remedy": "keep the clocks",
}


TIMES_US = {"p50": 41.0, "p99": 304.0, "p999": 500.0, "max": 900.0}
RATE: dict[str, Any] = {
    **{"grade": "warning", "hz": 999.6, "runs": 9, "merged": 1, "overruns": 2, "stalls": 3},
    **{"lateness_us": TIMES_US | {"worst": 2000.0}, "exec_us": TIMES_US},
}


def merged(known: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    inner = {name: it for name, it in changes.items() if isinstance(it, dict) and isinstance(known.get(name), dict)}
    return known | changes | {name: merged(known[name], it) for name, it in inner.items()}


def status(**changes: Any) -> dict[str, Any]:
    return merged(
        msgspec.to_builtins(telemetry(1, 1))
        | {
            "version": "0",
            "build": "compiled",
            "scene": "pulse",
            "uptime_s": 5.0,
            "least_N": 0.6,
            "most_N": 4.0,
            "trim": 1.0,
            "device": {
                "scale": 1.0,
                "scale_sd": 0.1,
                "offset_N": 0.0,
                "offset_sd_N": 0.1,
                "sensor_zero_N": 0.0,
                "sensor_zero_sd_N": 0.02,
            },
            "profile": {"is_used": False, "age_s": None, "refusal": ""},
            "least_gap_mm": 30.0,
            "link": LINK,
            "setpoints": {
                "accepted": 3,
                "refused": 1,
                "dropped": 0,
                "last_refusal": "too much",
                "newest_source": "a",
                "sources": {"a": 4},
            },
            "rates": {"control": RATE, "inference": RATE},
            "late_ticks_by": {},
            "fault_details": [],
            "limit_details": [],
            "newest_stall": None,
            "not_granted": [],
        },
        changes,
    )


DESCRIPTION: dict[str, Any] = {
    "version": "0",
    "build": "compiled",
    "configuration": {"rates": {"control_hz": 1_000}},
    "scene": msgspec.to_builtins(load_scene("pulse")),
    "model": 16 * "0123",
    "profile": {"is_used": False, "age_s": None, "refusal": ""},
    "firmware": "1.0",
    "serial_number": 7,
}


class FakeDaemon(threading.Thread):
    def __init__(self, directory: Path) -> None:
        super().__init__(daemon=True)
        self.directory = directory
        self.control = f"ipc://{directory}/control"
        self.at = ("--endpoint", self.control, "--wait", "20")  # patient: the machine may be busy
        self.answers: dict[str, Callable[[], dict[str, Any]]] = {
            "status": lambda: {"ok": True, "result": status(setpoints=self.taken())},
            "describe": lambda: {"ok": True, "result": DESCRIPTION},
        }
        self.taken_share, self.is_silent = 1.0, False
        self.commands: list[str] = []
        self.requests: list[dict[str, Any]] = []
        self.setpoints: list[Setpoint] = []
        self.rubbish: list[bytes] = []
        self.is_bound = threading.Event()
        self.is_over = threading.Event()

    def says(self, **changes: Any) -> None:
        self.says_in_turn(changes)

    def says_in_turn(self, *looks: dict[str, Any]) -> None:
        each = chain(looks, repeat(looks[-1]))
        self.answers["status"] = lambda: {"ok": True, "result": status(**{"setpoints": self.taken()} | next(each))}

    def taken(self) -> dict[str, Any]:
        counts = Counter(setpoint.source for setpoint in self.setpoints)
        by_source = {name: SOURCE | {"accepted": int(self.taken_share * count)} for name, count in counts.items()}
        return {"by_source": by_source if self.taken_share else {}}

    def arrived(self, count: int) -> list[Setpoint]:
        until_s = time.monotonic() + PATIENCE_S
        while len(self.setpoints) < count:
            assert time.monotonic() < until_s, f"{len(self.setpoints)} of {count} setpoints arrived"
            time.sleep(0.01)
        return self.setpoints

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
                self.requests.append(request)
                while setpoints.poll(0):
                    self.setpoints.append(decode(setpoints.recv(), Setpoint))
                answer = self.answers.get(request["command"], lambda: {"ok": True, "result": {}})()
                router.send_multipart([*envelope, msgpack.packb({"v": VERSION, "id": request["id"], **answer})])
            while setpoints.poll(0):
                self.setpoints.append(decode(setpoints.recv(), Setpoint))
            if self.is_silent:
                continue
            t_ns = start_ns + seq * 20_000_000
            telemetry_out.send(encode(telemetry(seq, t_ns)))
            telemetry_out.send_multipart([MOTION_TOPIC, encode(MOTION)])
            telemetry_out.send_multipart([VERDICT_TOPIC, encode(VERDICT)])
            felt_N = [1.5 + 0.1 * math.sin(seq + k) for k in range(20)]
            rows = [(t_ns + k * 1_000_000, 1.5, 1.5, felt_N[k], 35.0, 36.0, 0.1, -0.1) for k in range(20)]
            core = msgpack.packb([*rows, (TOLD, msgspec.to_builtins(telemetry(seq, t_ns)))])
            recording.send(msgpack.packb({"v": VERSION, "columns": COLUMNS, "rows": rows, "core": core}))
            for data in self.rubbish:
                recording.send(data)
            seq += 1
        context.destroy(linger=0)


class Ran(NamedTuple):
    code: int
    out: str
    err: str

    def ended(self, code: int) -> "Ran":
        assert self.code == code, self
        return self

    @property
    def said(self) -> dict[str, Any]:
        found: dict[str, Any] = json.loads(self.out)
        assert (list(found), found["ok"]) == (["command", "ok", "result", "error"], self.code == 0)
        return found

    @property
    def result(self) -> Any:
        return self.said["result"]

    @property
    def error(self) -> Any:
        return self.said["error"]


@pytest.fixture
def ctl(capsys: pytest.CaptureFixture[str]) -> Callable[..., Ran]:
    def run(*arguments: str) -> Ran:
        capsys.readouterr()
        return Ran(main(list(arguments)), *capsys.readouterr())

    return run


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


class Files:
    def __init__(self, root: Path) -> None:
        self.root = root

    def write(self, texts: Mapping[str, str]) -> None:
        for path, text in texts.items():
            (self.root / path).parent.mkdir(parents=True, exist_ok=True)
            (self.root / path).write_text(text)

    def process(self, number: int, name: str, *opened: str) -> None:
        self.write({f"proc/{number}/comm": f"{name}\n"})
        (self.root / f"proc/{number}/fd").mkdir()
        for descriptor, path in enumerate(opened):
            (self.root / f"proc/{number}/fd/{descriptor}").symlink_to(path)

    def inode(self, path: str) -> str:
        status = (self.root / path).stat()
        return f"{os.major(status.st_dev):02x}:{os.minor(status.st_dev):02x}:{status.st_ino}"


@pytest.fixture
def machine(tmp_path: Path) -> Files:
    return Files(tmp_path)


@pytest.fixture
def terminal() -> type[Terminal]:
    return Terminal


@pytest.fixture
def checked_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """The daemon's own check of a scene, in this process: another takes longer to load than to check."""

    def answer_of(module: str, arguments: Iterable[str], longest_s: float) -> str:
        said, told = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(told):
            code = importlib.import_module(module).main([*arguments])
        if code:
            raise ChildProcessError(told.getvalue().strip().splitlines()[-1])
        return said.getvalue()

    monkeypatch.setattr("tormagd.ctl.scene.answer_of", answer_of)


@pytest.fixture
def status_with() -> Callable[..., dict[str, Any]]:
    return status


@pytest.fixture
def telemetry_with() -> Callable[..., Telemetry]:
    return telemetry


@pytest.fixture
def source_with() -> Callable[..., dict[str, Any]]:
    return lambda **changes: SOURCE | changes


@pytest.fixture
def run_dir() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="tormag") as directory:
        yield Path(directory)


@pytest.fixture
def started(fake_daemon: FakeDaemon) -> Callable[..., contextlib.AbstractContextManager["subprocess.Popen[str]"]]:
    """`tormagctl` as a process of its own, which does not outlive its block."""

    @contextlib.contextmanager
    def start(*arguments: str) -> Iterator["subprocess.Popen[str]"]:
        command = [sys.executable, "-m", "tormagd.ctl.main", *fake_daemon.at, *arguments]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
            try:
                yield process
            finally:
                process.kill()

    return start


@pytest.fixture
def fake_daemon(run_dir: Path) -> Iterator[FakeDaemon]:
    daemon = FakeDaemon(run_dir)
    daemon.start()
    assert daemon.is_bound.wait(5.0)
    yield daemon
    daemon.is_over.set()
    daemon.join(5.0)
