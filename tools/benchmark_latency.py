"""`benchmark latency`: from a setpoint that is sent to the first drive frame that reflects it.

Each setpoint has a force of its own, so that the recording shows the first control tick whose plan used it; the frame
of that tick has just been written when its row is stamped. A bare ZeroMQ hop of the same message is measured in the
same run.
"""

import argparse
import multiprocessing
import random
import tempfile
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import zmq
from benchmark_loop import daemon_process, quantiles

from tormagd.config import Config
from tormagd.messages import VERSION, Setpoint, encode
from tormagd.recording.ticks import decode_ticks

Array = npt.NDArray[np.float64]

LEAST_N, GRAIN_N = 1.0, 1e-4
SPACING_S = (0.004, 0.009)
"Random, so that setpoints meet every phase of the control period."
PERIOD_S = 1e-3
SETTLE_S = 0.5


def run(count: int, fifo_priority: int) -> dict[str, Any]:
    """The contract's object, over `count` setpoints."""
    with tempfile.TemporaryDirectory(prefix="tormag-") as name, daemon_process(Path(name), fifo_priority, 0) as config:
        sent, rows = exchange(config, count)
    hop_us = bare_hop(count)
    first = first_ticks(sent, rows)
    latency_us = np.array([(tick["t_ns"] - stamp) * 1e-3 for stamp, tick in first])
    plan_us = np.array([(tick["plan_time_ns"] - stamp) * 1e-3 for stamp, tick in first])
    return {
        "setpoint_to_wire_us": quantiles(latency_us),
        "bare_zmq_us": quantiles(hop_us),
        "ratio": round(float(np.median(latency_us) / np.median(hop_us)), 2),
        "stages_us": {
            "sent to planned": quantiles(plan_us),
            "planned to written": quantiles(latency_us - plan_us),
        },
        "setpoints": count,
        "seen": len(first),
        "fifo_priority": fifo_priority,
    }


def exchange(config: Config, count: int) -> tuple[dict[float, int], list[dict[str, Any]]]:
    """Publishes and records: when each force was sent, ns, and the ticks of that time."""
    with zmq.Context() as context, context.socket(zmq.XPUB) as publisher, context.socket(zmq.SUB) as recording:
        for socket in (publisher, recording):
            socket.setsockopt(zmq.LINGER, 0)
        recording.subscribe(b"")
        recording.connect(config.endpoints.recording)
        publisher.connect(config.endpoints.setpoint)
        if not publisher.poll(5_000):
            raise RuntimeError("the daemon does not take setpoints")
        publisher.recv()
        sent: dict[float, int] = {}
        rows: list[dict[str, Any]] = []
        spacing = random.Random(1)
        for number in range(count):
            force = round(LEAST_N + GRAIN_N * (number % 5_000), 6)
            stamp = time.time_ns()
            setpoint = Setpoint(
                v=VERSION, source="latency", seq=number, stamp_ns=stamp, servo_cf=force, valid_for_ms=500.0
            )
            publisher.send(encode(setpoint))
            sent[force] = stamp
            read_rows(recording, rows, spacing.uniform(*SPACING_S))
            # reading waits in whole milliseconds from a message that the daemon sends right after a tick
            time.sleep(spacing.uniform(0.0, PERIOD_S))
        read_rows(recording, rows, SETTLE_S)
    return sent, rows


def read_rows(recording: "zmq.Socket[bytes]", rows: list[dict[str, Any]], for_s: float) -> None:
    """Takes what the daemon records for a while."""
    until_s = time.monotonic() + for_s
    while (left_s := until_s - time.monotonic()) > 0.0:
        if recording.poll(max(1, round(left_s * 1e3))):
            batch = decode_ticks(recording.recv())
            rows.extend(dict(zip(batch.columns, row, strict=True)) for row in batch.rows)


def first_ticks(sent: dict[float, int], rows: list[dict[str, Any]]) -> list[tuple[int, dict[str, Any]]]:
    """For each setpoint the first tick whose plan used it."""
    first: dict[float, dict[str, Any]] = {}
    for row in rows:
        force = row["setpoint_cf"]
        if force in sent and force not in first:
            # the plan's time is on the monotonic clock; the row has both
            row["plan_time_ns"] = row["t_ns"] - (row["monotonic_s"] - row["plan_time_s"]) * 1e9
            first[force] = row
    return [(sent[force], row) for force, row in first.items()]


def bare_hop(count: int) -> Array:
    """The same message from PUB to SUB between two processes, us."""
    with tempfile.TemporaryDirectory(prefix="tormag-") as folder, zmq.Context() as context:
        address = f"ipc://{folder}/hop"
        ours, theirs = multiprocessing.Pipe()
        process = multiprocessing.Process(target=receive, args=(address, count, theirs), daemon=True)
        process.start()
        with context.socket(zmq.XPUB) as publisher:
            publisher.setsockopt(zmq.LINGER, 0)
            publisher.connect(address)
            publisher.poll(10_000)
            publisher.recv()
            spacing = random.Random(2)
            for number in range(count):
                time.sleep(spacing.uniform(*SPACING_S))
                stamp = time.time_ns()
                publisher.send(
                    encode(
                        Setpoint(v=VERSION, source="hop", seq=number, stamp_ns=stamp, servo_cf=1.0, valid_for_ms=500.0)
                    )
                )
            if not ours.poll(10):
                raise RuntimeError("the bare hop lost messages")
            found: Array = ours.recv()
        process.join(5.0)
    return found


def receive(address: str, count: int, result: Connection) -> None:
    """The far end of the bare hop."""
    with zmq.Context() as context, context.socket(zmq.SUB) as socket:
        socket.subscribe(b"")
        socket.bind(address)
        hops = np.zeros(count)
        for index in range(count):
            data = socket.recv()
            hops[index] = (time.time_ns() - _stamp(data)) * 1e-3
        result.send(hops)


def _stamp(data: bytes) -> int:
    import msgpack

    return int(msgpack.unpackb(data)["stamp_ns"])


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `benchmark latency`."""
    parser.add_argument("--count", type=int, default=1_000, help="setpoints")
    parser.add_argument("--fifo", type=int, default=50, help="SCHED_FIFO priority of the daemon; 0 for none")


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """The object for these options."""
    return run(options.count, options.fifo)


def print_table(result: dict[str, Any]) -> None:
    """The object for a person."""
    print(f"{'':22s}{'p50':>9s}{'p99':>9s}{'p99.9':>9s}   us (fifo {result['fifo_priority']})")
    rows = {"setpoint to wire": result["setpoint_to_wire_us"], "bare ZeroMQ hop": result["bare_zmq_us"]}
    for name, found in (rows | result["stages_us"]).items():
        print(f"{name:22s}" + "".join(f"{found[key]:9.0f}" for key in ("p50", "p99", "p999")))
    print(f"{result['seen']} of {result['setpoints']} setpoints seen on the wire")
