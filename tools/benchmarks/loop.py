"""`benchmark loop`: how late the control loop is, beside a bare timer that carries the same clients.

Daemon and stub run in alternating blocks, because a shared machine drifts: the ratio of neighbouring blocks counts.
Both have the same heartbeat, event loop and scheduling, publish every tick, and answer the same eight clients, which
ask for status without pause. Processor time is that of the daemon with its threads and children; wake-ups are voluntary
switches of its threads. Each block runs alone, then with the clients and a subscriber that reads every tick. A tick is
fresh if its measurement came since the last one. With `--against` the daemon of another checkout takes its turn. If
there is a C compiler, so does a host in C (`reference_host.c`) with nothing but wire, timer and two PIDs: it shows this
machine's limit.
"""

import argparse
import asyncio
import contextlib
import json
import multiprocessing
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import uvloop
import zmq
from machines.own import own_machine
from stand import received

from firmware_protocol.c.build import FIRMWARE, ROOM, STRICT, BuildError, compiler
from tormag_lab.arrays import Array
from tormagd.config import Config, RealTime, load_config
from tormagd.ctl.processes import begun, first_line, is_linked, processor_s
from tormagd.ctl.record import listening
from tormagd.ctl.scene import as_toml
from tormagd.daemon.endpoint import Endpoint
from tormagd.daemon.realtime import Heartbeat, prepare, priority_of_threads
from tormagd.headroom.bare_timer import beat
from tormagd.record.ticks import encode_ticks
from tormagd_client import Client, ClientError
from tormagd_client.endpoints import ENDPOINTS, Endpoints
from tormagd_client.messages import Request
from tormagd_client.printable import require

TOOLS = Path(__file__).parents[1]
LOG = "tormagd.log"
CLIENTS = 8
SETPOINT_HZ, CONTROL_HZ = 500, 1_000
PATIENCE_S = 60.0
STARTS_MS = 20_000
WARM_UP_S = 1.0
TELEMETRY_EVERY = 20
SHARES = ("core_share", "alone_share")
COLUMNS = ("t_ns", "lateness_us", "exec_us", "received_s")
QUANTILES = {"p50": 50.0, "p99": 99.0, "p999": 99.9, "max": 100.0}


class Block(NamedTuple):
    """The ticks of one block, and in `told` shares of a processor, wake-ups, plans and phases."""

    lateness_us: Array
    exec_us: Array
    ticks: int
    merged: int
    seconds: float
    fresh: int = 0
    told: dict[str, Any] = {}  # noqa: RUF012 nobody changes it


class Pair(NamedTuple):
    daemon: Block
    bare: Block
    against: Block | None = None
    host: dict[str, Any] | None = None


class Stand(NamedTuple):
    """What is measured: scheduling, setpoint rate, the checkout of daemon and device, and the rates of control and
    plans.
    """

    realtime: RealTime
    setpoint_hz: int = SETPOINT_HZ
    root: Path | None = None
    rates_hz: tuple[int, int] = (CONTROL_HZ, CONTROL_HZ)


T = TypeVar("T")
Running = tuple[Config, int]


def summary(pairs: list[Pair], realtime: RealTime) -> dict[str, Any]:
    bare = merge([pair.bare for pair in pairs])
    both_us = [(quantiles(pair.daemon.lateness_us), quantiles(pair.bare.lateness_us)) for pair in pairs]
    result = _told([pair.daemon for pair in pairs]) | {
        "bare": {
            "method": f"uvloop + timerfd, fifo {realtime.fifo_priority}, {CLIENTS} clients",
            "lateness_us": quantiles(bare.lateness_us),
            "merged_share": bare.merged / max(bare.ticks, 1),
            **{name: bare.told[name] for name in SHARES if name in bare.told},
        },
        "ratio": {
            name: statistics.median(ours_us[name] / bare_us[name] for ours_us, bare_us in both_us)
            for name in ("p50", "p99", "p999")
        },
        "pairs": len(pairs),
        "load": {
            "clients": CLIENTS,
            "recording": True,
            "setpoint_hz": SETPOINT_HZ,
            "alone": "neither of the first two",
        },
    }
    if hosts := [pair.host for pair in pairs if pair.host is not None]:
        result["reference_host"] = _middle(hosts)
    if against := [(pair.daemon, pair.against) for pair in pairs if pair.against is not None]:
        result["against"] = _told([theirs for _, theirs in against]) | {
            **{
                f"{name}_ratio": round(
                    statistics.median(ours.told[name] / theirs.told[name] for ours, theirs in against), 3
                )
                for name in SHARES
            },
        }
    return result | asked_for(realtime)


def _told(blocks: list[Block]) -> dict[str, Any]:
    whole = merge(blocks)
    return {
        "rate_hz": whole.ticks / whole.seconds,
        "ticks": whole.ticks,
        "merged_ticks": whole.merged,
        "merged_share": whole.merged / max(whole.ticks, 1),
        "fresh_share": round(whole.fresh / max(whole.ticks - len(blocks), 1), 5),
        "lateness_us": quantiles(whole.lateness_us),
        "control_exec_us": {"mean": float(whole.exec_us.mean())} | quantiles(whole.exec_us),
    } | whole.told


def _middle(found: list[dict[str, Any]]) -> dict[str, Any]:
    return {
        key: _middle([each[key] for each in found])
        if isinstance(first, dict)
        else (all if isinstance(first, bool) else statistics.median)(each[key] for each in found)
        for key, first in found[0].items()
    }


def block(started: Callable[[Path], contextlib.AbstractContextManager[Running]], seconds: float) -> Block:
    """Measure one block under the load of the clients; `started` begins what is measured."""
    with tempfile.TemporaryDirectory(prefix="tormag-") as folder, started(Path(folder)) as (config, pid):
        time.sleep(WARM_UP_S)
        _, *alone = spent(pid, lambda: time.sleep(seconds))
        # while somebody listens, ticks are encoded and sent
        with listening(config.endpoints) as recorder:
            stop = multiprocessing.Event()
            load = multiprocessing.Process(target=hammer, args=(config.endpoints.control, stop), daemon=True)
            load.start()
            try:
                recorder.poll(STARTS_MS)
                collect(recorder, WARM_UP_S, config)
                ticks, *busy = spent(pid, partial(collect, recorder, seconds, config))
                told = reported(config.endpoints.control)
            finally:
                stop.set()
                load.join(5.0)
    keys = "alone_share", "alone_wakeups_hz", "core_share", "wakeups_hz"
    return ticks._replace(told=dict(zip(keys, [*alone, *busy], strict=True)) | told)


def spent(pid: int, wait: Callable[[], T]) -> tuple[T, float, dict[str, float]]:
    """Return what `wait` returns, the process's share of a processor meanwhile, and the wake-ups of its first thread
    (control) and of all threads, Hz.
    """
    started_s, before_s, before = time.monotonic(), processor_s(pid), wakeups(pid)
    result = wait()
    took_s, after = time.monotonic() - started_s, wakeups(pid)
    woken = {thread: count - before.get(thread, count) for thread, count in after.items()}
    hz = {"control": round(woken[pid] / took_s, 1), "all": round(sum(woken.values()) / took_s, 1)}
    return result, round((processor_s(pid) - before_s) / took_s, 4), hz


def wakeups(pid: int) -> dict[int, int]:
    """Return how often each thread of a process has been woken (proc_pid_status(5))."""
    found = {}
    for thread in Path(f"/proc/{pid}/task").iterdir():
        with contextlib.suppress(OSError):  # it may have ended
            status = (thread / "status").read_text(encoding="ascii", errors="replace")
            found[int(thread.name)] = int(status.partition("\nvoluntary_ctxt_switches:")[2].split()[0])
    return found


def reference_host(stand: Stand, seconds: float) -> dict[str, Any] | None:
    """Return what the host in C prints, on a simulated device of its own; None without a C compiler."""
    with contextlib.suppress(BuildError), contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="tormag-")))
        host = built_host(folder)
        start = partial(begun, stack, folder / LOG, environment=environment(None, folder))
        words = [str(1_000_000 // stand.rates_hz[0]), str(seconds), str(stand.realtime.fifo_priority)]
        command = [str(host), first_line(start(*own_machine(0, "tormagd.simulation", "--pty"))), *words]
        return dict(json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout))
    return None


def built_host(folder: Path) -> Path:
    host, sources = folder / "reference_host", [TOOLS / "reference_host.c", *(ROOM / f"{name}.c" for name in FIRMWARE)]
    subprocess.run([compiler(), *STRICT, "-O2", f"-I{ROOM}", *map(str, sources), "-lm", "-o", str(host)], check=True)
    return host


def collect(socket: "zmq.Socket[bytes]", seconds: float, config: Config) -> Block:
    until_s = time.monotonic() + seconds
    rows: list[list[Any]] = []
    while time.monotonic() < until_s:
        if socket.poll(100):
            rows.extend([tick.get(name) for name in COLUMNS] for tick in received(socket))
    if len(rows) < 2:
        raise RuntimeError(f"no ticks within {seconds:g} s")
    return as_block(rows, config.rates.control_hz)


def as_block(rows: list[list[Any]], control_hz: int) -> Block:
    lateness_us, exec_us, received_s = np.array([row[1:] for row in rows], dtype=np.float64).T
    spanned_s = (rows[-1][0] - rows[0][0]) * 1e-9
    merged = max(0, round(spanned_s * control_hz) + 1 - len(rows))
    return Block(lateness_us, exec_us, len(rows), merged, spanned_s, int(np.count_nonzero(np.diff(received_s) > 0.0)))


def reported(address: str) -> dict[str, Any]:
    with contextlib.closing(Client(Endpoints(control=address), 5.0)) as client:
        status = client.request("status")
    state = status.get("operating_state", "ENABLED")
    require(state == "ENABLED", "operating_state at a block's end", state, "ENABLED: try again on a quieter machine")
    found = status.get("phases_us", {}) | {"plan_us": status.get("rates", {}).get("inference", {}).get("exec_us")}
    told = {name: {key: float(each[key]) for key in ("p50", "p99")} for name, each in found.items() if each}
    plan_us = told.pop("plan_us", None)
    return {} if plan_us is None else {"plan_us": plan_us, "phases_us": told}


def merge(blocks: list[Block]) -> Block:
    told = [block.told for block in blocks if block.told]
    return Block(
        np.concatenate([block.lateness_us for block in blocks]),
        np.concatenate([block.exec_us for block in blocks]),
        sum(block.ticks for block in blocks),
        sum(block.merged for block in blocks),
        sum(block.seconds for block in blocks),
        sum(block.fresh for block in blocks),
        _middle(told) if told else {},
    )


def quantiles(values: Array) -> dict[str, float]:
    return {name: round(float(np.percentile(values, share)), 1) for name, share in QUANTILES.items()}


def hammer(address: str, stop: Event) -> None:

    def ask() -> None:
        with contextlib.closing(Client(Endpoints(control=address), 2.0)) as client:
            while not stop.is_set():
                with contextlib.suppress(ClientError):
                    client.request("status")

    with ThreadPoolExecutor(CLIENTS) as clients:
        for _ in range(CLIENTS):
            clients.submit(ask)


def write_config(folder: Path, port: str, stand: Stand) -> Path:
    path, realtime, (control_hz, inference_hz) = folder / "tormagd.toml", stand.realtime, stand.rates_hz
    tables = {
        "device": {"port": port},
        "endpoints": {name: f"ipc://{folder}/{name}" for name in ENDPOINTS},
        "rates": {"control_hz": control_hz, "inference_hz": inference_hz},
        "realtime": {
            "fifo_priority": realtime.fifo_priority,
            "keep_awake": realtime.keep_awake,
            "lock_memory": realtime.lock_memory,
        },
    }
    path.write_text(as_toml(tables), encoding="utf-8")
    return path


@contextlib.contextmanager
def daemon(stand: Stand, folder: Path) -> Iterator[Running]:
    """Run the daemon on a simulated device, homed and enabled, with setpoints arriving unless `setpoint_hz` is 0."""
    with contextlib.ExitStack() as stack:
        theirs = environment(stand.root, folder)
        start = partial(begun, stack, folder / LOG, environment=theirs)
        path = write_config(folder, first_line(start(*own_machine(0, "tormagd.simulation", "--pty"))), stand)
        config = load_config(path)
        process = start("-P", "-m", "tormagd.daemon.main", "--config", str(path), is_read=False)
        with contextlib.closing(Client(config.endpoints, 1.0)) as client:
            if not is_linked(client, process, PATIENCE_S):
                raise RuntimeError("the daemon did not reach its device")
        ctl = ("-P", "-m", "tormagd.ctl.main", "--config", str(path), "--wait", "20")
        for word in ("home", "enable"):
            subprocess.run([sys.executable, *ctl, word], check=True, capture_output=True, env=theirs)
        if stand.setpoint_hz:
            start(*ctl, "send", "pulse", "--rate", str(stand.setpoint_hz), "--duration", "3600", is_read=False)
        yield config, process.pid


def checkout(text: str) -> Path:
    root = Path(text).resolve()
    if not (root / "tormagd").is_dir() or not (root / "tools" / "benchmark.py").is_file():
        raise argparse.ArgumentTypeError(f"{text}: allowed is the root of a checkout, with tormagd/ and tools/ in it")
    return root


def environment(root: Path | None, folder: Path) -> dict[str, str]:
    """Return the environment of a process that runs that checkout; None for what runs here."""
    if root is None:
        folders = [str(TOOLS), *filter(None, [os.environ.get("PYTHONPATH")])]
    else:
        setup = [sys.executable, "-c", "from setuptools import setup; setup()", "--quiet"]
        subprocess.run([*setup, "egg_info", "--egg-base", str(folder)], cwd=root, check=True, capture_output=True)
        folders = [str(root), str(root / "client" / "src"), str(root / "tools"), str(folder)]
    return os.environ | {"PYTHONPATH": os.pathsep.join(folders), "OMP_NUM_THREADS": "1"}


@contextlib.contextmanager
def stub_process(stand: Stand, folder: Path) -> Iterator[Running]:
    config = load_config(write_config(folder, "/dev/null", stand))
    stub = multiprocessing.Process(target=bare_loop, args=(config,), daemon=True)
    stub.start()
    assert stub.pid is not None
    try:
        yield config, stub.pid
    finally:
        stub.terminate()
        stub.join(5.0)


def bare_loop(config: Config) -> None:
    uvloop.run(_bare(config))


async def _bare(config: Config) -> None:
    prepare(config.realtime)
    endpoint = Endpoint(config.endpoints, priority_of_threads())
    rows: list[tuple[int, float, float]] = []
    answer = {"state": "bare"} | {f"key_{index}": float(index) for index in range(60)}

    def reply(_request: Request) -> dict[str, Any]:
        return answer

    left = 0

    def publish(heartbeat: Heartbeat, _beats: int, now_ns: int) -> None:
        nonlocal left
        endpoint.arrivals.look()
        endpoint.take_requests(reply)
        endpoint.admission.update()
        if left:
            left -= endpoint.serve(reply, left)
        rows.append((time.time_ns(), (now_ns - heartbeat.due_ns) * 1e-3, 0.0))
        if len(rows) >= TELEMETRY_EVERY:
            endpoint.publish_ticks(encode_ticks(rows, ("t_ns", "lateness_us", "exec_us")))
            rows.clear()
            left = endpoint.requests.count

    await beat(1_000_000_000 // config.rates.control_hz, publish, asyncio.Event())


REALTIME: dict[str, dict[str, Any]] = {
    "--fifo": {"type": int, "default": 50, "help": "SCHED_FIFO priority of what is measured; 0 for none"},
    "--keep-awake": {"action": "store_true", "help": "idle processors do not sleep"},
}


def realtime_settings(options: argparse.Namespace) -> RealTime:
    return RealTime(options.fifo, lock_memory=True, keep_awake=options.keep_awake)


def asked_for(realtime: RealTime) -> dict[str, Any]:
    return {"fifo_priority": realtime.fifo_priority, "keep_awake": realtime.keep_awake}


OPTIONS = REALTIME | {
    "--seconds": {"type": float, "default": 10.0, "help": "length of a block (%(default)s)"},
    "--pairs": {"type": int, "default": 3, "help": "blocks of each kind (%(default)s)"},
    "--against": {
        "type": checkout,
        "metavar": "FOLDER",
        "help": "root of another checkout, measured in turns with this one",
    },
    "--rates": {
        "type": int,
        "nargs": 2,
        "default": (CONTROL_HZ, CONTROL_HZ),
        "metavar": ("CONTROL", "PLANS"),
        "help": "Hz (1000 and 1000)",
    },
}


def measure(options: argparse.Namespace) -> dict[str, Any]:
    ours = Stand(realtime_settings(options), rates_hz=tuple(options.rates))
    theirs = ours._replace(root=options.against)
    pairs = [
        Pair(
            block(partial(daemon, ours), options.seconds),
            block(partial(stub_process, ours), options.seconds),
            None if options.against is None else block(partial(daemon, theirs), options.seconds),
            reference_host(ours, options.seconds),
        )
        for _ in range(options.pairs)
    ]
    return summary(pairs, ours.realtime)
