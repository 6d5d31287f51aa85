"""`benchmark latency`: from a setpoint that is sent to the first drive frame that reflects it.

Each setpoint has a force of its own, so that the recording shows the first control tick whose plan used it; its frame
has just been written when the row is stamped. A bare ZeroMQ hop of the same message is measured in the same run. If the
daemon has a real-time priority, publisher and hop have a lower one, so that no sender's wait for a processor is
measured. At worst a setpoint just misses a beat: it waits for the next, which plans for it and writes.
"""

import argparse
import os
import random
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import zmq
from stand import received

from benchmarks.loop import REALTIME, Stand, asked_for, daemon, quantiles, realtime_settings
from tormag_lab.arrays import Array
from tormagd.config import Config, RealTime
from tormagd.ctl.record import listening
from tormagd.daemon.endpoint import context
from tormagd.daemon.realtime import prepare, priority_of_threads
from tormagd_client.messages import VERSION, Setpoint, encode

MIN_N, GRAIN_N = 1.0, 1e-4
SPACING_S = (0.0015, 0.0025)
"500 a second, as in `make run`; random, so that they meet every phase of the control period."
COLUMNS = ("t_ns", "exec_us")
SETTLE_NS = 500_000_000
LOST_S = 10.0
BELOW = 10
"The measurement's own processes are this far below the daemon's real-time priority."


Stages = dict[str, Array]
"""Durations by name, us: of the whole way, of the bare hop, and of the parts of the way."""
WHOLE, HOP = "setpoint to wire", "bare ZeroMQ hop"


def stages(ticks: list[tuple[Any, ...]]) -> Stages:
    stamp_ns, written_ns, beat_us = (np.array(column) for column in zip(*ticks, strict=True))
    whole_us = (written_ns - stamp_ns) * 1e-3
    return {
        WHOLE: whole_us,
        "sent, until its beat begins": whole_us - beat_us,
        "the beat, until it has written": beat_us,
    }


def summary(found_us: Stages, count: int, realtime: RealTime) -> dict[str, Any]:
    told = {name: quantiles(durations_us) for name, durations_us in found_us.items()}
    whole_us, hop_us = told.pop(WHOLE), told.pop(HOP)
    return {
        "setpoint_to_wire_us": whole_us,
        "bare_zmq_us": hop_us,
        "ratio": round(float(np.median(found_us[WHOLE]) / np.median(found_us[HOP])), 2),
        "stages_us": told,
        "setpoints": count,
        "seen": found_us[WHOLE].size,
    } | asked_for(realtime)


def exchange(config: Config, count: int) -> tuple[dict[float, int], list[dict[str, Any]]]:
    """Publish and record; return when each force was sent, ns, and the ticks of that time."""
    with listening(config.endpoints, context(priority_of_threads())) as recording:
        sent = publish(config.endpoints.setpoint, count)
        # only now: reading would set the pace
        return sent, rows_until(recording, time.time_ns() + SETTLE_NS)


def publish(address: str, count: int) -> dict[float, int]:
    with context(priority_of_threads()) as ours, ours.socket(zmq.XPUB) as publisher:
        publisher.setsockopt(zmq.LINGER, 1_000)
        publisher.connect(address)
        if not publisher.poll(10_000):
            raise RuntimeError(f"nobody takes setpoints at {address}")
        publisher.recv()
        sent: dict[float, int] = {}
        spacing = random.Random(1)
        for number in range(count):
            time.sleep(spacing.uniform(*SPACING_S))
            force, stamp_ns = round(MIN_N + GRAIN_N * (number % 5_000), 6), time.time_ns()
            setpoint = Setpoint(
                v=VERSION, source="latency", seq=number, stamp_ns=stamp_ns, servo_cf=force, valid_for_ms=500.0
            )
            publisher.send(encode(setpoint))
            sent[force] = stamp_ns
    return sent


def rows_until(recording: "zmq.Socket[bytes]", until_ns: int) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    while not rows or rows[-1]["t_ns"] < until_ns:
        if not recording.poll(5_000):
            raise RuntimeError("the daemon records nothing")
        rows += received(recording)
    return rows


def first_ticks(sent: dict[float, int], rows: list[dict[str, Any]]) -> list[tuple[Any, ...]]:
    """Return for each setpoint when it was sent, and COLUMNS of the first tick whose plan used it."""
    first: dict[float, dict[str, Any]] = {}
    for row in rows:
        first.setdefault(row["setpoint_cf"], row)
    return [(sent[force], *(row[name] for name in COLUMNS)) for force, row in first.items() if force in sent]


def bare_hop(count: int) -> Array:
    scheduling = os.sched_getscheduler(0), os.sched_getparam(0).sched_priority
    with tempfile.TemporaryDirectory(prefix="tormag-") as folder, ProcessPoolExecutor(1) as pool:
        address = f"ipc://{folder}/hop"
        received = pool.submit(receive, address, count, scheduling)
        publish(address, count)
        return received.result()


def receive(address: str, count: int, scheduling: tuple[int, int]) -> Array:
    os.sched_setscheduler(0, scheduling[0], os.sched_param(scheduling[1]))
    with context(priority_of_threads()) as ours, ours.socket(zmq.SUB) as socket:
        socket.setsockopt(zmq.RCVTIMEO, round(LOST_S * 1e3))
        socket.subscribe(b"")
        socket.bind(address)
        hops = np.zeros(count)
        for index in range(count):
            data = socket.recv()
            hops[index] = (time.time_ns() - msgpack.unpackb(data)["stamp_ns"]) * 1e-3
    return hops


OPTIONS = REALTIME | {"--count": {"type": int, "default": 1_000, "help": "setpoints"}}


def measure(options: argparse.Namespace) -> dict[str, Any]:
    realtime, count = realtime_settings(options), options.count
    stand = Stand(realtime, setpoint_hz=0)
    with tempfile.TemporaryDirectory(prefix="tormag-") as name, daemon(stand, Path(name)) as (config, _):
        prepare(RealTime(fifo_priority=max(realtime.fifo_priority - BELOW, 0), keep_awake=realtime.keep_awake))
        ticks = first_ticks(*exchange(config, count))
    return summary(stages(ticks) | {HOP: bare_hop(count)}, count, realtime)
