"""The same thing for a long time: does memory grow, do descriptors leak, is every tick recorded?

A daemon renders force, is recorded, and a new client asks for its status every half second. Growth counts after two
minutes, or a quarter of a shorter time, when everything that is made once exists.
"""

import math
import time
from pathlib import Path
from typing import Any

import msgspec
from machines.processes import end
from mcap.reader import make_reader
from tqdm import tqdm

from endurance.stand import PATIENCE_S, Figures, Stand, used
from tormagd.record.writer import TICKS_TOPIC
from tormagd_client import Client

MEAN_N, SWING_N, SWING_HZ = 1.5, 0.3, 0.2
SAMPLE_S, SETTLED_S = 0.5, 120.0
ALLOWED_KB = {"daemon": 2_048, "recorder": 16_384}
"The recorder keeps the index, which is written last: two entries a second."


def run(stand: Stand, count: int, seed: int) -> Figures:
    path = stand.folder / "soak.mcap"
    ctl = ("-m", "tormagd.ctl.main", "--config", str(stand.folder / "tormagd.toml"))
    processes = {"daemon": stand.daemon, "recorder": stand.begin(*ctl, "record", str(path))}
    stand.until(lambda _status: path.exists(), "recorded")
    stand.arm()
    samples: dict[str, list[tuple[int, int]]] = {name: [] for name in processes}
    for _ in tqdm(range(count), desc="soak", unit="sample", disable=None):
        since_s = time.monotonic()
        stand.ask(MEAN_N + SWING_N * math.sin(math.tau * SWING_HZ * since_s))
        time.sleep(SAMPLE_S)
        with Client(stand.endpoints, PATIENCE_S) as client:
            client.request("status")
        if stand.see_faults(since_s):
            stand.arm()
        for name, process in processes.items():
            samples[name].append(used(process))
    end(processes["recorder"])
    grown_kB = {name: growth([kB for _, kB in values]) for name, values in samples.items()}
    stayed = {name: staying([descriptors for descriptors, _ in values]) for name, values in samples.items()}
    ticks = recorded(path)
    return {
        "minutes": round(count * SAMPLE_S / 60.0, 2),
        "growth_kB": grown_kB,
        "memory_kB": {name: values[-1][1] for name, values in samples.items()},
        "descriptor_growth": stayed,
        "ticks": len(ticks),
        "failures": failures(grown_kB, stayed, ticks),
    }


def failures(grown_kB: dict[str, int], stayed: dict[str, int], ticks: list[int]) -> list[str]:
    found = [
        f"{name}: memory grew by {grown} kB, allowed {ALLOWED_KB[name]}"
        for name, grown in grown_kB.items()
        if grown > ALLOWED_KB[name]
    ]
    found += [f"{name}: {more} more descriptors" for name, more in stayed.items() if more > 0]
    if not ticks or ticks[-1] - ticks[0] + 1 != len(ticks):
        found.append(f"recording: {len(ticks)} ticks, not all of {ticks[:1]} to {ticks[-1:]}")
    return found


def recorded(path: Path) -> list[int]:
    with path.open("rb") as file:
        messages: Any = make_reader(file).iter_messages(topics=[TICKS_TOPIC])
        return [int(msgspec.json.decode(message.data)["tick"]) for _, _, message in messages]


def staying(values: list[int]) -> int:
    """Return the increase from the second to the last quarter, whatever comes and goes."""
    quarter = len(values) // 4
    return min(values[-quarter:]) - min(values[quarter : 2 * quarter])


def growth(values: list[int]) -> int:
    """Return the growth of the largest once everything that is made once exists."""
    settled = min(len(values) // 4, round(SETTLED_S / SAMPLE_S))
    return max(values[settled:]) - values[settled]
