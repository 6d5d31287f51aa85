"""`benchmark loop`: how late the control loop is, beside a bare timer that carries the same clients.

Daemon and stub run in alternating blocks, because a shared machine drifts: what counts is the ratio of a block to its
neighbour. Both have the same heartbeat, event loop and scheduling, publish a row for each tick, and answer the same
eight clients, each of which asks for status again as soon as it is answered; the stub has no controller and no device.

Processor time is that of the daemon with its threads and children; recording is on: a subscriber reads every tick. With
`--against` the daemon of another checkout takes its turn, on its own simulated device: the protocol changes, too.
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
from functools import partial
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt
import uvloop
import zmq
from machines.host import processor_s
from machines.own import own_machine
from machines.wire import carried

from benchmarks.against import add_against_argument, as_installed, environment
from benchmarks.histograms import plot_histograms
from benchmarks.keys import curve_table, free_port
from tormagd.config import ENDPOINTS, Config, Endpoints, RealTime, load_config
from tormagd.daemon.endpoint import Endpoint
from tormagd.daemon.heartbeat import Heartbeat
from tormagd.daemon.realtime import prepare, priority_of_threads
from tormagd.daemon.telemetry_loop import SERVED_BEFORE_NS
from tormagd.headroom.bare_timer import beat
from tormagd.recording.ticks import decode_ticks
from tormagd.simulation.device import DEFAULT_BAUD
from tormagd_client import Client, ClientError
from tormagd_client.messages import Request
from tormagd_client.wire import keys_of, opened

Array = npt.NDArray[np.float64]
NOTHING: Array = np.array([])

LOG = "tormagd.log"
"What the daemon says, in its folder."
CLIENTS = 8
SETPOINT_HZ = 500
STARTS_MS = 20_000
"Until the first tick, at most."
WARM_UP_S = 1.0
ALONE_S = 4.0
"For how long a block goes on without its clients."
TELEMETRY_EVERY = 20
PLAN_QUANTILES = ("p50", "p99")
COLUMNS = ("t_ns", "monotonic_s", "lateness_us", "exec_us", "received_s")
"What is read of a recorded tick; a stub has not all of them."
QUANTILES = {"p50": 50.0, "p99": 99.0, "p999": 99.9, "max": 100.0}


class Block(NamedTuple):
    """The ticks of one block; what only a daemon has is empty for the stub."""

    lateness_us: Array
    exec_us: Array
    ticks: int
    merged: int
    seconds: float
    without_write_us: Array = NOTHING
    "Of the same ticks, less what writing to the device took; empty where the writes were not seen."
    plan_us: dict[str, float] | None = None
    "p50 and p99 of its plans over the last 5 to 10 s as the daemon's status has them, in bins of 3%."
    core_share: float = 0.0
    "Processor time of all its processes over wall time, while the clients ask."
    core_share_without_clients: float = 0.0


class Pair(NamedTuple):
    """A block of the daemon and one of the stub, one right after the other, and maybe one of another checkout."""

    daemon: Block
    bare: Block
    against: Block | None = None


class Stand(NamedTuple):
    """What is measured: scheduling, rates, the serial line, how often setpoints come, and of which checkout daemon
    and device are. `device_fifo` is the device's own priority; it stands for a machine of its own.
    `within` runs the daemon on another machine (`ip netns exec NAME`), which is reached at `host`."""

    realtime: RealTime
    control_hz: int = 1_000
    inference_hz: int = 1_000
    baud: int = DEFAULT_BAUD
    setpoint_hz: int = SETPOINT_HZ
    root: Path | None = None
    device_fifo: int = 0
    scene: str = "coronary"
    device: tuple[str, ...] = ()
    "More arguments of the simulated device."
    guarded: tuple[str, ...] = ()
    "Endpoints at tcp:// addresses of `host` that demand keys; the others are at ipc://."
    host: str = "127.0.0.1"
    within: tuple[str, ...] = ()


class Running(NamedTuple):
    """A process that keeps time: where its sockets are, its id, and the file that has its writes once it has ended."""

    config: Config
    pid: int
    writes: Path | None = None


class Ticks(NamedTuple):
    """Rows of a recording, an array each. `start_ns` is CLOCK_MONOTONIC's; empty where it was not recorded."""

    stamp_ns: npt.NDArray[np.int64]
    start_ns: npt.NDArray[np.int64]
    lateness_us: Array
    exec_us: Array
    received_s: Array
    "When the newest state had come that the tick knew; NaN before the first."


def run(seconds: float, pairs: int, realtime: RealTime, against: Path | None = None) -> list[Pair]:
    """`pairs` blocks of each kind, `seconds` long."""
    ours = Stand(realtime)
    return [
        Pair(
            block(partial(daemon, ours), seconds),
            block(partial(stub_process, realtime), seconds),
            None if against is None else block(partial(daemon, ours._replace(root=against)), seconds),
        )
        for _ in range(pairs)
    ]


def summary(pairs: list[Pair], realtime: RealTime) -> dict[str, Any]:
    """The contract's object."""
    bare = merge([pair.bare for pair in pairs])
    result = _daemon([pair.daemon for pair in pairs]) | {
        "bare": {
            "method": f"uvloop + timerfd, fifo {realtime.fifo_priority}, {CLIENTS} clients",
            "lateness_us": quantiles(bare.lateness_us),
            "merged_share": bare.merged / max(bare.ticks, 1),
            "core_share": round(bare.core_share, 4),
        },
        "ratio": {
            name: statistics.median(
                quantiles(pair.daemon.lateness_us)[name] / quantiles(pair.bare.lateness_us)[name] for pair in pairs
            )
            for name in ("p50", "p99", "p999")
        },
        "pairs": len(pairs),
    }
    against = [pair.against for pair in pairs if pair.against is not None]
    if against:
        ratios = [_ratios(pair.daemon, pair.against) for pair in pairs if pair.against is not None]
        result["against"] = _daemon(against) | {
            "ratio": {
                name: round(statistics.median(ratio[name] for ratio in ratios), 3)
                for name in ratios[0]
                if all(name in ratio for ratio in ratios)
            }
        }
    return result | asked_for(realtime)


def _daemon(blocks: list[Block]) -> dict[str, Any]:
    whole = merge(blocks)
    without_us, plan_us = whole.without_write_us, whole.plan_us
    return {
        "rate_hz": whole.ticks / whole.seconds,
        "ticks": whole.ticks,
        "merged_ticks": whole.merged,
        "lateness_us": quantiles(whole.lateness_us),
        "control_exec_us": {"mean": float(whole.exec_us.mean())} | quantiles(whole.exec_us),
        "tick_without_write_us": {"mean": round(float(without_us.mean()), 1)} | quantiles(without_us)
        if without_us.size
        else None,
        "plan_us": plan_us,
        "core_share": round(whole.core_share, 4),
        "core_share_without_clients": round(whole.core_share_without_clients, 4),
        "merged_share": whole.merged / max(whole.ticks, 1),
        "block_s": round(whole.seconds / len(blocks), 1),
    }


def _ratios(ours: Block, theirs: Block) -> dict[str, float]:
    """What ours takes over what theirs does, as far as both are known."""
    taken = {
        "tick_mean": (float(ours.exec_us.mean()), float(theirs.exec_us.mean())),
        "core_share": (ours.core_share, theirs.core_share),
        "core_share_without_clients": (ours.core_share_without_clients, theirs.core_share_without_clients),
    }
    if ours.without_write_us.size and theirs.without_write_us.size:
        taken["tick_without_write_mean"] = float(ours.without_write_us.mean()), float(theirs.without_write_us.mean())
    if ours.plan_us and theirs.plan_us:
        taken |= {f"plan_{name}": (ours.plan_us[name], theirs.plan_us[name]) for name in PLAN_QUANTILES}
    return {name: own / other for name, (own, other) in taken.items() if other > 0.0}


Started = Callable[[Path], contextlib.AbstractContextManager[Running]]
"""Begins what is measured, with its files in the folder."""


def block(started: Started, seconds: float) -> Block:
    """One block of one kind, under the load of the clients; for some seconds more without them."""
    with tempfile.TemporaryDirectory(prefix="tormag-") as folder:
        with started(Path(folder)) as running, recording(running.config.endpoints) as recorder:
            stop = multiprocessing.Event()
            load = multiprocessing.Process(target=hammer, args=(running.config.endpoints.control, stop), daemon=True)
            load.start()
            try:
                recorder.poll(STARTS_MS)
                collect(recorder, WARM_UP_S)
                ticks, share = collect_and_weigh(recorder, running.pid, seconds)
                plan_us = planned(running.config.endpoints.control)
            finally:
                stop.set()
                load.join(5.0)
            collect(recorder, WARM_UP_S)  # what came while nobody read
            _, share_alone = collect_and_weigh(recorder, running.pid, min(seconds, ALONE_S))
        written = None if running.writes is None else writes(running.writes)  # they are there when it has ended
    return as_block(ticks, running.config.rates.control_hz)._replace(
        without_write_us=NOTHING if written is None else without_writes(ticks, *written),
        plan_us=plan_us,
        core_share=share,
        core_share_without_clients=share_alone,
    )


@contextlib.contextmanager
def recording(endpoints: Endpoints) -> Iterator["zmq.Socket[bytes]"]:
    """A subscriber of the tick rows; while there is one, they are encoded and sent."""
    with zmq.Context() as context, context.socket(zmq.SUB) as socket:
        yield opened(socket, endpoints.recording, keys_of(endpoints.curve))


def collect_and_weigh(socket: "zmq.Socket[bytes]", pid: int, seconds: float) -> tuple[Ticks, float]:
    """The ticks of that time, and the share of a processor that the process and what it has begun had meanwhile."""
    started_s, before_s = time.monotonic(), processor_s(pid)
    ticks = collect(socket, seconds)
    return ticks, (processor_s(pid) - before_s) / (time.monotonic() - started_s)


def collect(socket: "zmq.Socket[bytes]", seconds: float) -> Ticks:
    """Reads tick rows for a while. Raises RuntimeError where there are none."""
    until_s = time.monotonic() + seconds
    rows: list[list[Any]] = []
    while time.monotonic() < until_s:
        if socket.poll(100):
            batch = decode_ticks(socket.recv())
            columns = [batch.columns.index(name) if name in batch.columns else None for name in COLUMNS]
            rows.extend([None if column is None else row[column] for column in columns] for row in batch.rows)
    if len(rows) < 2:
        raise RuntimeError(f"no ticks within {seconds:g} s")
    stamp, start, lateness, execution, received = zip(*rows, strict=True)
    starts = [] if start[0] is None else [round(second * 1e9) for second in start]
    return Ticks(
        np.array(stamp, dtype=np.int64),
        np.array(starts, dtype=np.int64),
        np.array(lateness, dtype=np.float64),
        np.array(execution, dtype=np.float64),
        np.array(received, dtype=np.float64),
    )


def as_block(ticks: Ticks, rate_hz: int) -> Block:
    """The ticks, and how many periods had none."""
    count = ticks.stamp_ns.size
    spanned_s = float(ticks.stamp_ns[-1] - ticks.stamp_ns[0]) * 1e-9
    merged = max(0, round(spanned_s * rate_hz) + 1 - count)
    return Block(ticks.lateness_us, ticks.exec_us, count, merged, spanned_s)


def writes(file: Path) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]] | None:
    """When each write began and how long it took, ns; None where the daemon wrote some other way."""
    pairs = np.fromfile(file, dtype=np.int64) if file.exists() else np.array([], dtype=np.int64)
    return (pairs[0::2], pairs[1::2]) if pairs.size else None


def without_writes(ticks: Ticks, begun_ns: npt.NDArray[np.int64], took_ns: npt.NDArray[np.int64]) -> Array:
    """Each tick's time less that of the writes within it, us; empty where no tick wrote."""
    spent_us = np.concatenate([[0.0], np.cumsum(took_ns * 1e-3)])
    end_ns = ticks.start_ns + np.round(ticks.exec_us[: ticks.start_ns.size] * 1e3).astype(np.int64)
    first, last = np.searchsorted(begun_ns, ticks.start_ns), np.searchsorted(begun_ns, end_ns)
    if not np.any(last > first):
        return NOTHING
    return np.asarray(ticks.exec_us - (spent_us[last] - spent_us[first]), dtype=np.float64)


def planned(address: str) -> dict[str, float] | None:
    """What status says of the plans; None where it says nothing, as the stub's."""
    with contextlib.closing(Client(Endpoints(control=address), 5.0)) as client:
        spent = client.request("status").get("rates", {}).get("inference", {}).get("exec_us")
    return None if spent is None else {name: float(spent[name]) for name in PLAN_QUANTILES}


def merge(blocks: list[Block]) -> Block:
    """All blocks as one; shares and plans in the median."""
    plans = [block.plan_us for block in blocks if block.plan_us is not None]
    return Block(
        np.concatenate([block.lateness_us for block in blocks]),
        np.concatenate([block.exec_us for block in blocks]),
        sum(block.ticks for block in blocks),
        sum(block.merged for block in blocks),
        sum(block.seconds for block in blocks),
        np.concatenate([block.without_write_us for block in blocks]),
        {name: statistics.median(plan[name] for plan in plans) for name in PLAN_QUANTILES} if plans else None,
        statistics.median(block.core_share for block in blocks),
        statistics.median(block.core_share_without_clients for block in blocks),
    )


def quantiles(values: Array) -> dict[str, float]:
    """p50, p99, p99.9 and the largest."""
    return {name: round(float(np.percentile(values, share)), 1) for name, share in QUANTILES.items()}


def hammer(address: str, stop: Event) -> None:
    """Eight clients that each ask for status as fast as they are answered."""

    def ask() -> None:
        client = Client(Endpoints(control=address), 2.0)
        while not stop.is_set():
            with contextlib.suppress(ClientError):
                client.request("status")
        client.close()

    clients = [threading.Thread(target=ask) for _ in range(CLIENTS)]
    for client in clients:
        client.start()
    for client in clients:
        client.join()


def write_config(folder: Path, port: str, stand: Stand) -> Path:
    """A configuration with its sockets in `folder`; planning in every period, as in examples/service.toml."""
    path = folder / "tormagd.toml"
    sockets = "".join(
        f'{name} = "tcp://{stand.host}:{free_port()}"\n'
        if name in stand.guarded
        else f'{name} = "ipc://{folder}/{name}"\n'
        for name in ENDPOINTS
    )
    if stand.guarded:
        sockets += curve_table(folder / "keys", also_local=len(stand.guarded) == len(ENDPOINTS))
    realtime = stand.realtime
    # an older checkout knows no options, and only the other line's rate needs one
    options = "" if stand.baud == DEFAULT_BAUD else f"[device.options]\nbaud = {stand.baud}\n"
    path.write_text(
        f'scene = "{stand.scene}"\n[device]\nport = "{port}"\n{options}[endpoints]\n{sockets}'
        f"[rates]\ncontrol_hz = {stand.control_hz}\ninference_hz = {stand.inference_hz}\n"
        f"[realtime]\nfifo_priority = {realtime.fifo_priority}\nkeep_awake = {str(realtime.keep_awake).lower()}\n"
        f"lock_memory = {str(realtime.lock_memory).lower()}\n"
        f"cpus = {list(realtime.cpus)}\n"
    )
    return path


@contextlib.contextmanager
def daemon_process(folder: Path, realtime: RealTime, setpoint_hz: int = SETPOINT_HZ) -> Iterator[Config]:
    """The daemon on a simulated device, enabled, with setpoints arriving (none where `setpoint_hz` is 0)."""
    with daemon(Stand(realtime, setpoint_hz=setpoint_hz), folder) as running:
        yield running.config


@contextlib.contextmanager
def daemon(stand: Stand, folder: Path) -> Iterator[Running]:
    """The same for any stand."""
    with contextlib.ExitStack() as stack:
        theirs = environment(None) if stand.root is None else as_installed(stand.root, folder)
        if stand.device_fifo:
            stack.enter_context(carried(stand.device_fifo))
        device = own_machine(stand.device_fifo, "tormagd.simulation", "--pty", "--baud", str(stand.baud), *stand.device)
        simulator = subprocess.Popen([sys.executable, *device], stdout=subprocess.PIPE, env=theirs, text=True)
        stack.callback(end, simulator)
        assert simulator.stdout is not None
        path = write_config(folder, simulator.stdout.readline().strip(), stand)
        config = load_config(path)
        times = folder / "writes"
        written = [sys.executable, "-P", str(Path(__file__).with_name("written.py")), str(times), "--config", str(path)]
        with (folder / LOG).open("w") as log:
            process = subprocess.Popen([*stand.within, *written], env=theirs, stderr=log)
        stack.callback(end, process)
        ctl = [sys.executable, "-P", "-m", "tormagd.ctl.main", "--config", str(path), "--wait", "20"]
        wait_for(config.endpoints)
        for command in ("home", "enable"):
            subprocess.run([*ctl, command], check=True, capture_output=True, env=theirs)
        if stand.setpoint_hz:
            publisher = subprocess.Popen(
                [*ctl, "send", "pulse", "--rate", str(stand.setpoint_hz), "--duration", "3600"],
                stdout=subprocess.DEVNULL,
                env=theirs,
            )
            stack.callback(end, publisher)
        yield Running(config, process.pid, times)


def end(child: "subprocess.Popen[Any]") -> None:
    """Ends what we began."""
    child.terminate()
    child.wait(20)


@contextlib.contextmanager
def stub_process(realtime: RealTime, folder: Path) -> Iterator[Running]:
    """The bare timer."""
    config = load_config(write_config(folder, "/dev/null", Stand(realtime)))
    stub = multiprocessing.Process(target=bare_loop, args=(config,), daemon=True)
    stub.start()
    assert stub.pid is not None
    try:
        yield Running(config, stub.pid)
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
            endpoint.publish_ticks(rows, ("t_ns", "lateness_us", "exec_us"))
            rows.clear()
            endpoint.serve(now_ns * 1e-9, reply, heartbeat.due_ns + heartbeat.period_ns - SERVED_BEFORE_NS)

    await beat(1_000_000_000 // config.rates.control_hz, publish, asyncio.Event())


def wait_for(endpoints: Endpoints) -> None:
    """Until the daemon answers and its device does."""
    until_s = time.monotonic() + 60.0
    client = Client(endpoints, 1.0)
    while time.monotonic() < until_s:
        with contextlib.suppress(ClientError):
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
    return RealTime(options.fifo, lock_memory=True, cpus=tuple(options.cpus), keep_awake=options.keep_awake)


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
    add_against_argument(parser)


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """The object for these options; what was measured without FIFO under `without_fifo`."""
    realtime = realtime_settings(options)
    pairs = run(options.seconds, options.pairs, realtime, options.against)
    result = summary(pairs, realtime)
    shown = {
        "daemon": merge([pair.daemon for pair in pairs]).lateness_us,
        "bare stub": merge([pair.bare for pair in pairs]).lateness_us,
    }
    if options.without_fifo:
        without = msgspec.structs.replace(realtime, fifo_priority=0)
        ordinary = run(options.seconds, options.pairs, without, options.against)
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
    print(f"merged {result['merged_share']:.3%} (bare {bare['merged_share']:.3%}), on {os.cpu_count()} processors")
    print(_spent("this checkout", result))
    if "against" in result:
        print(_spent("against", result["against"]))
        print("ratio: " + ", ".join(f"{name} {ratio:.2f}" for name, ratio in result["against"]["ratio"].items()))


def _spent(name: str, result: dict[str, Any]) -> str:
    tick, bare_tick, plan = result["control_exec_us"], result["tick_without_write_us"], result["plan_us"]
    return (
        f"{name}: {result['rate_hz']:.1f} Hz, a tick {tick['mean']:.0f} us mean, {tick['p99']:.0f} p99"
        + (f" ({bare_tick['mean']:.0f} and {bare_tick['p99']:.0f} without the write)" if bare_tick else "")
        + (f", a plan {plan['p50']:.0f} us p50, {plan['p99']:.0f} p99" if plan else "")
        + f", {result['core_share']:.1%} of a core ({result['core_share_without_clients']:.1%} without the clients)"
    )
