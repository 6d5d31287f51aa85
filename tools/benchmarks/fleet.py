"""Recordings of many consoles summed up by `tools/fleet.py`, one by one and on a local Dask cluster, in turns.

The recordings are synthetic: drawn devices with a pulse each day, in virtual time, written as `tormagctl record` does.
They and the cluster are there before the time begins.
"""

import argparse
import math
import statistics
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
from consoles.reading import Fleet, files, read_all
from machines.executors import processes
from rendering.device_draws import drawn_device
from tqdm import tqdm

from tormagd.closed_loop import ClosedLoop
from tormagd.config import Config
from tormagd.control.core import build_core
from tormagd.control.governor import TimedSetpoint
from tormagd.daemon.telemetry import snapshot, tick_record
from tormagd.recording.ticks import decode_ticks
from tormagd.recording.writer import RecordingWriter
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.hand import SteadyHand
from tormagd_client.messages import Telemetry, TickRecord, decode, encode, encode_ticks

DAILY = 10
"Recordings of one console."
DAY_NS = 86_400_000_000_000
FIRST_NS = 1_800_000_000_000_000_000
BATCH = 20
"Ticks in a message, and between two snapshots, as the daemon sends them."
MEAN_N, SWING_N, PULSE_HZ = 1.55, 0.15, 1.2
VALID_S = 0.1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """How many recordings, how long, by how many workers, and how often."""
    parser.add_argument("--recordings", type=int, default=200, metavar="N", help="(%(default)s)")
    parser.add_argument("--seconds", type=float, default=5.0, help="of each recording (%(default)s)")
    parser.add_argument("--workers", type=int, default=2, metavar="N", help="of the cluster (%(default)s)")
    parser.add_argument("--rounds", type=int, default=3, metavar="N", help="of both (%(default)s)")


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """`{recordings, seconds, bytes, workers, one_by_one_s, cluster_s, speedup, is_same}`: the times of each round, the
    median of their ratios, and whether every figure of every round was the same to the bit."""
    from distributed import Client, LocalCluster

    with tempfile.TemporaryDirectory(prefix="tormag-") as folder:
        with processes(options.workers) as pool:
            consoles = range(math.ceil(options.recordings / DAILY))
            made = pool.map(partial(record_console, Path(folder), options.seconds), consoles)
            list(tqdm(made, total=len(consoles), unit="console", desc="recording", disable=None))
        urls = dict(list(files(folder).items())[: options.recordings])
        alone: list[float] = []
        shared: list[float] = []
        seen: list[Fleet] = []
        with (
            processes(1) as one,
            LocalCluster(n_workers=options.workers, threads_per_worker=1, dashboard_address=None) as cluster,
            Client(cluster) as client,
            client.get_executor() as workers,
        ):
            for executor in one, workers:
                read_all(dict(list(urls.items())[: 2 * options.workers]), executor)  # they have imported what they need
            for _ in range(options.rounds):
                for executor, times_s in ((one, alone), (workers, shared)):
                    start_s = time.monotonic()
                    seen.append(read_all(urls, executor))
                    times_s.append(round(time.monotonic() - start_s, 2))
        size = sum(path.stat().st_size for path in Path(folder).rglob("*.mcap"))
    return {
        "recordings": len(urls),
        "seconds": options.seconds,
        "bytes": size,
        "workers": options.workers,
        "one_by_one_s": alone,
        "cluster_s": shared,
        "speedup": round(statistics.median(one_s / both_s for one_s, both_s in zip(alone, shared, strict=True)), 2),
        "is_same": all(each == seen[0] and not each.left_out for each in seen),
    }


def record_console(folder: Path, seconds: float, number: int) -> None:
    """A recording each day of the drawn device `number`, which plays on from one to the next."""
    config = Config()
    core = build_core(config)
    device = VirtualDevice(drawn_device(number), SteadyHand(), seed=number)
    loop = ClosedLoop(config, core.stepper, core.planner, device)
    loop.arm()
    about = {
        "kind": "synthetic: a drawn device in virtual time",
        "serial_number": str(number),
        "scene": msgspec.json.encode(core.scene).decode(),
    }
    place = folder / f"console_{number:03d}"
    place.mkdir()
    for day in range(DAILY):
        with RecordingWriter(place / f"day_{day:02d}.mcap", about) as writer:
            _record(writer, loop, FIRST_NS + day * DAY_NS, round(seconds * config.rates.control_hz))


def _record(writer: RecordingWriter, loop: ClosedLoop, begin_ns: int, ticks: int) -> None:
    rows: list[TickRecord] = []
    start_s = loop.now_s
    for number in range(ticks):
        force_N = MEAN_N + SWING_N * math.sin(2.0 * math.pi * PULSE_HZ * loop.now_s)
        sample = loop.tick(TimedSetpoint(force_N, loop.now_s, VALID_S))
        record = tick_record(
            sample.time_s, sample.state, sample.output, sample.plan, sample.trim, loop.measurement, 0.0, 0.0, number
        )
        t_ns = begin_ns + round((sample.time_s - start_s) * 1e9)
        rows.append(msgspec.structs.replace(record, t_ns=t_ns))
        if len(rows) == BATCH:
            writer.ticks(decode_ticks(encode_ticks(rows)))
            told = snapshot(rows[-1], number // BATCH, is_homed=True, is_busy=False, age_s=0.0)
            writer.telemetry(decode(encode(told), Telemetry))
            rows.clear()


def print_table(result: dict[str, Any]) -> None:
    """The same for a person."""
    print(
        f"{result['recordings']} synthetic recordings of {result['seconds']:g} s, {1e-6 * result['bytes']:.0f} MB: "
        f"{'the same figures' if result['is_same'] else 'OTHER FIGURES'}"
    )
    for name, shown in (("one_by_one_s", "one by one"), ("cluster_s", f"{result['workers']} Dask workers")):
        print(f"{shown:<16}{', '.join(f'{each:.1f}' for each in result[name])} s")
    print(f"{result['speedup']:.2f} times as fast")
