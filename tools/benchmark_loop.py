"""`benchmark loop`: how late the control loop is, beside a bare timer that carries the same clients.

Daemon and stub run in alternating blocks, because a shared machine drifts: what counts is the ratio of a block to its
neighbour. Both have the same heartbeat, event loop and scheduling, publish a row for each tick, and answer the same
eight clients, each of which asks for status again as soon as it is answered; the stub has no controller and no device.
"""

import argparse
import asyncio
import contextlib
import multiprocessing
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt
import uvloop
import zmq
from benchmark_plot import plot_histograms

from tormagd.config import Config, RealTime, load_config
from tormagd.ctl.client import Client
from tormagd.ctl.outcome import CommandError
from tormagd.daemon.daemon import SERVED_BEFORE_NS
from tormagd.daemon.endpoint import Endpoint
from tormagd.daemon.heartbeat import Heartbeat
from tormagd.daemon.realtime import prepare, priority_of_threads
from tormagd.headroom.bare_timer import beat
from tormagd.messages import Request
from tormagd.recording.ticks import decode_ticks

Array = npt.NDArray[np.float64]

CLIENTS = 8
SETPOINT_HZ = 500
WARM_UP_S = 1.0
TELEMETRY_EVERY = 20
QUANTILES = {"p50": 50.0, "p99": 99.0, "p999": 99.9, "max": 100.0}


class Block(NamedTuple):
    """The ticks of one block."""

    lateness_us: Array
    exec_us: Array
    ticks: int
    merged: int
    seconds: float


class Pair(NamedTuple):
    """A block of the daemon and one of the stub, one right after the other."""

    daemon: Block
    bare: Block


def run(seconds: float, pairs: int, realtime: RealTime) -> list[Pair]:
    """`pairs` blocks of each kind, `seconds` long."""
    return [
        Pair(block(daemon_process, seconds, realtime), block(stub_process, seconds, realtime)) for _ in range(pairs)
    ]


def summary(pairs: list[Pair], realtime: RealTime) -> dict[str, Any]:
    """The contract's object."""
    daemon, bare = merge([pair.daemon for pair in pairs]), merge([pair.bare for pair in pairs])
    return {
        "rate_hz": daemon.ticks / daemon.seconds,
        "ticks": daemon.ticks,
        "merged_ticks": daemon.merged,
        "lateness_us": quantiles(daemon.lateness_us),
        "control_exec_us": {"mean": float(daemon.exec_us.mean())} | quantiles(daemon.exec_us),
        "bare": {
            "method": f"uvloop + timerfd, fifo {realtime.fifo_priority}, {CLIENTS} clients",
            "lateness_us": quantiles(bare.lateness_us),
            "merged_share": bare.merged / max(bare.ticks, 1),
        },
        "ratio": {
            name: statistics.median(
                quantiles(pair.daemon.lateness_us)[name] / quantiles(pair.bare.lateness_us)[name] for pair in pairs
            )
            for name in ("p50", "p99", "p999")
        },
        "merged_share": daemon.merged / max(daemon.ticks, 1),
        "pairs": len(pairs),
        "block_s": round(daemon.seconds / len(pairs), 1),
    } | asked_for(realtime)


Started = Callable[[Path, RealTime], contextlib.AbstractContextManager[Config]]


def block(start: Started, seconds: float, realtime: RealTime) -> Block:
    """One block of one kind, under the load of the clients."""
    with tempfile.TemporaryDirectory(prefix="tormag-") as folder, contextlib.ExitStack() as stack:
        config = stack.enter_context(start(Path(folder), realtime))
        stop = multiprocessing.Event()
        load = multiprocessing.Process(target=hammer, args=(config.endpoints.control, stop), daemon=True)
        load.start()
        try:
            return collect(config.endpoints.recording, seconds)
        finally:
            stop.set()
            load.join(5.0)


def collect(address: str, seconds: float) -> Block:
    """Reads tick rows for a while, after a warm-up."""
    with zmq.Context() as context, context.socket(zmq.SUB) as socket:
        socket.setsockopt(zmq.LINGER, 0)
        socket.subscribe(b"")
        socket.connect(address)
        started_s = time.monotonic()
        lateness: list[float] = []
        execution: list[float] = []
        stamps: list[int] = []
        while time.monotonic() < started_s + WARM_UP_S + seconds:
            if not socket.poll(500):
                continue
            batch = decode_ticks(socket.recv())
            if time.monotonic() < started_s + WARM_UP_S:
                continue
            columns = {name: index for index, name in enumerate(batch.columns)}
            for row in batch.rows:
                stamps.append(int(row[columns["t_ns"]]))  # type: ignore[arg-type]
                lateness.append(float(row[columns["lateness_us"]]))  # type: ignore[arg-type]
                execution.append(float(row[columns["exec_us"]]))  # type: ignore[arg-type]
    if len(stamps) < 2:
        raise RuntimeError(f"no ticks at {address} within {seconds:g} s")
    spanned_s = (stamps[-1] - stamps[0]) * 1e-9
    return Block(
        np.array(lateness),
        np.array(execution),
        len(stamps),
        max(0, round(spanned_s * 1e3) + 1 - len(stamps)),
        spanned_s,
    )


def merge(blocks: list[Block]) -> Block:
    """All blocks as one."""
    return Block(
        np.concatenate([block.lateness_us for block in blocks]),
        np.concatenate([block.exec_us for block in blocks]),
        sum(block.ticks for block in blocks),
        sum(block.merged for block in blocks),
        sum(block.seconds for block in blocks),
    )


def quantiles(values: Array) -> dict[str, float]:
    """p50, p99, p99.9 and the largest."""
    return {name: round(float(np.percentile(values, share)), 1) for name, share in QUANTILES.items()}


def hammer(address: str, stop: Event) -> None:
    """Eight clients that each ask for status as fast as they are answered."""

    def ask() -> None:
        client = Client(address, 2.0)
        while not stop.is_set():
            with contextlib.suppress(CommandError):
                client.request("status")
        client.close()

    clients = [threading.Thread(target=ask) for _ in range(CLIENTS)]
    for client in clients:
        client.start()
    for client in clients:
        client.join()


def write_config(folder: Path, port: str, realtime: RealTime) -> Path:
    """A configuration with its sockets in `folder`; planning in every period, as in examples/service.toml."""
    path = folder / "tormagd.toml"
    sockets = "".join(
        f'{name} = "ipc://{folder}/{name}"\n' for name in ("setpoint", "telemetry", "control", "recording")
    )
    path.write_text(
        f'scene = "coronary"\n[device]\nport = "{port}"\n[endpoints]\n{sockets}'
        f"[rates]\ninference_hz = 1000\n"
        f"[realtime]\nfifo_priority = {realtime.fifo_priority}\nkeep_awake = {str(realtime.keep_awake).lower()}\n"
        f"cpus = {list(realtime.cpus)}\n"
    )
    return path


@contextlib.contextmanager
def daemon_process(folder: Path, realtime: RealTime, setpoint_hz: int = SETPOINT_HZ) -> Iterator[Config]:
    """The daemon on a simulated device, enabled, with setpoints arriving (none where `setpoint_hz` is 0)."""
    simulator = subprocess.Popen(
        [sys.executable, "-m", "tormagd.simulation", "--pty"], stdout=subprocess.PIPE, text=True
    )
    assert simulator.stdout is not None
    path = write_config(folder, simulator.stdout.readline().strip(), realtime)
    config = load_config(path)
    daemon = subprocess.Popen(
        [sys.executable, "-m", "tormagd.daemon.main", "--config", str(path)], stderr=subprocess.DEVNULL
    )
    publisher = None
    try:
        ctl = [sys.executable, "-m", "tormagd.ctl.main", "--config", str(path), "--wait", "20"]
        wait_for(config.endpoints.control)
        for command in ("home", "enable"):
            subprocess.run([*ctl, command], check=True, capture_output=True)
        if setpoint_hz:
            publisher = subprocess.Popen(
                [*ctl, "send", "pulse", "--rate", str(setpoint_hz), "--duration", "3600"], stdout=subprocess.DEVNULL
            )
        yield config
    finally:
        for child in (publisher, daemon, simulator):
            if child is not None:
                child.terminate()
                child.wait(20)


@contextlib.contextmanager
def stub_process(folder: Path, realtime: RealTime) -> Iterator[Config]:
    """The bare timer."""
    config = load_config(write_config(folder, "/dev/null", realtime))
    stub = multiprocessing.Process(target=bare_loop, args=(config,), daemon=True)
    stub.start()
    try:
        yield config
    finally:
        stub.terminate()
        stub.join(5.0)


def bare_loop(config: Config) -> None:
    """A heartbeat that publishes its own lateness, and answers."""
    uvloop.run(_bare(config))


async def _bare(config: Config) -> None:
    prepare(config.realtime)
    endpoint = Endpoint(config.endpoints, priority_of_threads())
    rows: list[tuple[int, float, float]] = []
    answer = {"state": "bare"} | {f"key_{index}": float(index) for index in range(60)}

    def reply(_request: Request) -> dict[str, Any]:
        return answer

    def publish(heartbeat: Heartbeat, _beats: int, now_ns: int) -> None:
        rows.append((time.time_ns(), (now_ns - heartbeat.due_ns) * 1e-3, 0.0))
        if len(rows) >= TELEMETRY_EVERY:
            endpoint.publish_ticks(("t_ns", "lateness_us", "exec_us"), rows)
            rows.clear()
            endpoint.serve(now_ns * 1e-9, reply, heartbeat.due_ns + heartbeat.period_ns - SERVED_BEFORE_NS)

    await beat(1_000_000_000 // config.rates.control_hz, publish, asyncio.Event())


def wait_for(address: str) -> None:
    """Until the daemon answers and its device does."""
    until_s = time.monotonic() + 60.0
    client = Client(address, 1.0)
    while time.monotonic() < until_s:
        with contextlib.suppress(CommandError):
            if client.request("status").get("link", {}).get("state") == "RUNNING":
                client.close()
                return
    raise RuntimeError("the daemon did not reach its device")


def add_realtime_arguments(parser: argparse.ArgumentParser) -> None:
    """What the kernel is asked for."""
    parser.add_argument("--fifo", type=int, default=50, help="SCHED_FIFO priority of what is measured; 0 for none")
    parser.add_argument("--keep-awake", action="store_true", help="idle processors do not sleep")
    parser.add_argument(
        "--cpus",
        type=int,
        nargs="+",
        default=[],
        metavar="N",
        help="processors for what is measured; what measures it keeps to the others",
    )


def realtime_settings(options: argparse.Namespace) -> RealTime:
    """The settings for these options. What measures and makes the load leaves the named processors from now on.

    Raises SystemExit where that leaves it none.
    """
    if options.cpus:
        usable = os.sched_getaffinity(0)
        others = usable - set(options.cpus)
        if not set(options.cpus) <= usable or not others:
            raise SystemExit(f"--cpus {options.cpus}: allowed are some, not all, of {sorted(usable)}")
        os.sched_setaffinity(0, others)
    return RealTime(fifo_priority=options.fifo, keep_awake=options.keep_awake, cpus=tuple(options.cpus))


def asked_for(realtime: RealTime) -> dict[str, Any]:
    """The settings as they stand in a result."""
    return {
        "fifo_priority": realtime.fifo_priority,
        "keep_awake": realtime.keep_awake,
        "cpus": list(realtime.cpus),
    }


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `benchmark loop`."""
    add_realtime_arguments(parser)
    parser.add_argument("--seconds", type=float, default=10.0, help="length of a block")
    parser.add_argument("--pairs", type=int, default=3, help="blocks of each kind")
    parser.add_argument("--without-fifo", action="store_true", help="as many pairs without FIFO after those with it")
    parser.add_argument("--plot", type=Path, metavar="FILE.png", help="histograms of the lateness")


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """The object for these options; what was measured without FIFO under `without_fifo`."""
    realtime = realtime_settings(options)
    pairs = run(options.seconds, options.pairs, realtime)
    result = summary(pairs, realtime)
    shown = {
        "daemon": merge([pair.daemon for pair in pairs]).lateness_us,
        "bare stub": merge([pair.bare for pair in pairs]).lateness_us,
    }
    if options.without_fifo:
        without = msgspec.structs.replace(realtime, fifo_priority=0)
        ordinary = run(options.seconds, options.pairs, without)
        result["without_fifo"] = summary(ordinary, without)
        shown["daemon without FIFO"] = merge([pair.daemon for pair in ordinary]).lateness_us
        shown["bare stub without FIFO"] = merge([pair.bare for pair in ordinary]).lateness_us
    if options.plot:
        plot_histograms(options.plot, f"Lateness of {result['ticks']} control ticks, {CLIENTS} clients", shown)
    return result


def print_table(result: dict[str, Any]) -> None:
    """The object for a person."""
    _print_pairs(result)
    if "without_fifo" in result:
        print()
        _print_pairs(result["without_fifo"])


def _print_pairs(result: dict[str, Any]) -> None:
    bare = result["bare"]
    print(f"{'':8s}{'p50':>9s}{'p99':>9s}{'p99.9':>9s}{'max':>9s}   lateness, us (fifo {result['fifo_priority']})")
    for name, found in (("daemon", result["lateness_us"]), ("bare", bare["lateness_us"])):
        print(f"{name:8s}" + "".join(f"{found[key]:9.1f}" for key in QUANTILES))
    print(f"{'ratio':8s}" + "".join(f"{result['ratio'][key]:9.2f}" for key in ("p50", "p99", "p999")))
    spent = result["control_exec_us"]
    print(
        f"{result['rate_hz']:.1f} Hz, merged {result['merged_share']:.3%} (bare {bare['merged_share']:.3%}), "
        f"control {spent['mean']:.0f} us mean, {spent['p99']:.0f} us p99, on {os.cpu_count()} processors"
    )
