"""The same thing for a long time: does memory grow, do descriptors leak, does anything drift?

First the closed loop in virtual time, then a daemon on a simulated device in real time, under 500 setpoints a second,
whose status a new client asks for every half second. Growth counts from a quarter of the time on, when what is made
once has been made. Exit status 0 if neither grew, nothing latched a fault, and the last minute tracked as the first.
"""

import argparse
import json
import math
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmark_loop import daemon_process
from tqdm import tqdm

from tormagd.closed_loop import ClosedLoop
from tormagd.config import RealTime, load_config
from tormagd.control.core import build_core
from tormagd.control.governor import TimedSetpoint
from tormagd.ctl.client import Client
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.hand import SteadyHand
from tormagd.simulation.parameters import load_plant

MEAN_N, SWING_N, SWING_HZ = 1.5, 0.3, 1.2
SETTLING_TICKS = 5_000
SAMPLE_S = 0.5
GROWTH_ALLOWED_KB = 2_048
DRIFT_ALLOWED_N = 0.02
FIFO_PRIORITY = 50
PATIENCE_S = 5.0
PROC = Path("/proc")


def virtual(minutes: float) -> dict[str, Any]:
    """The closed loop in virtual time: memory, faults, mean force error of the first and the last minute."""
    config = load_config(None)
    core = build_core(config)
    loop = ClosedLoop(config, core.stepper, core.planner, VirtualDevice(load_plant("sample_1"), SteadyHand(), seed=1))
    loop.arm()
    ticks = round(60.0 * minutes * config.rates.control_hz)
    minute = min(round(60.0 * config.rates.control_hz), ticks // 2)
    memory_kB: list[int] = []
    faults: set[str] = set()
    first_N = last_N = 0.0
    for tick in tqdm(range(-SETTLING_TICKS, ticks), desc="virtual time", unit="tick", unit_scale=True, disable=None):
        force_N = MEAN_N + SWING_N * math.sin(math.tau * SWING_HZ * loop.now_s)
        sample = loop.tick(TimedSetpoint(force_N, loop.now_s, 0.1))
        faults.update(map(str, sample.state.safety.faults))
        error_N = abs(sample.truth.force_N - force_N)
        if 0 <= tick < minute:
            first_N += error_N / minute
        if tick >= ticks - minute:
            last_N += error_N / minute
        if tick % 1_000 == 0:
            memory_kB.append(resident_kB(os.getpid()))
    return {
        "minutes": minutes,
        "ticks": ticks,
        "memory_kB": memory_kB[-1],
        "growth_kB": growth(memory_kB),
        "faults": sorted(faults),
        "mean_error_first_N": round(first_N, 4),
        "mean_error_last_N": round(last_N, 4),
    }


def daemon(minutes: float) -> dict[str, Any]:
    """A daemon in real time: memory, descriptors, faults, and what its link counted."""
    memory_kB, descriptors = [], []
    faults: set[str] = set()
    realtime = RealTime(fifo_priority=FIFO_PRIORITY)
    with tempfile.TemporaryDirectory(prefix="tormag-") as folder, daemon_process(Path(folder), realtime) as config:
        process = child("tormagd.daemon.main")
        for _ in tqdm(range(round(60.0 * minutes / SAMPLE_S)), desc="real time", unit="sample", disable=None):
            time.sleep(SAMPLE_S)
            with Client(config.endpoints.control, PATIENCE_S) as client:
                status = client.request("status")
            faults.update(status["faults"])
            memory_kB.append(resident_kB(process))
            descriptors.append(len(list((PROC / str(process) / "fd").iterdir())))
    link = status["link"]
    return {
        "minutes": minutes,
        "clients": len(memory_kB),
        "memory_kB": memory_kB[-1],
        "growth_kB": growth(memory_kB),
        "descriptors": descriptors[-1],
        "descriptor_growth": growth(descriptors),
        "faults": sorted(faults),
        "operating_state": status["operating_state"],
        "link": {name: link[name] for name in ("frames", "corrupt", "lost", "repeated", "resynchronisations")},
    }


def growth(values: list[int]) -> int:
    """The largest of the last quarter over the largest of the second, of at least four values."""
    quarter = len(values) // 4
    return max(values[-quarter:]) - max(values[quarter : 2 * quarter])


def resident_kB(process: int) -> int:
    """Memory of a process. Raises OSError where there is no /proc or no such process."""
    pages = int((PROC / str(process) / "statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") // 1024


def child(module: str) -> int:
    """The process that we started with `python -m module`. Raises LookupError without one."""
    for folder in PROC.glob("[0-9]*"):
        try:
            words = (folder / "cmdline").read_bytes().split(b"\0")
            parent = int((folder / "stat").read_text(encoding="utf-8").rpartition(")")[2].split()[1])
        except OSError:  # it ended while we looked
            continue
        if parent == os.getpid() and module.encode() in words:
            return int(folder.name)
    raise LookupError(f"no child process runs {module}")


def failures(result: dict[str, Any]) -> list[str]:
    """What did not hold, in words."""
    found = []
    for name in ("virtual", "daemon"):
        part = result[name]
        if part["growth_kB"] > GROWTH_ALLOWED_KB:
            found.append(f"{name}: memory grew by {part['growth_kB']} kB, allowed {GROWTH_ALLOWED_KB}")
        if part["faults"]:
            found.append(f"{name}: faults {', '.join(part['faults'])}")
    if result["daemon"]["descriptor_growth"] > 0:
        found.append(f"daemon: {result['daemon']['descriptor_growth']} more descriptors")
    drift_N = result["virtual"]["mean_error_last_N"] - result["virtual"]["mean_error_first_N"]
    if drift_N > DRIFT_ALLOWED_N:
        found.append(f"virtual: the force error grew by {drift_N:.3f} N, allowed {DRIFT_ALLOWED_N}")
    return found


def print_table(result: dict[str, Any]) -> None:
    """The result for people."""
    for name in ("virtual", "daemon"):
        part = result[name]
        print(f"{name}, {part['minutes']:g} min: memory grew by {part['growth_kB']} kB to {part['memory_kB']} kB")
    part = result["virtual"]
    print(f"mean force error: first minute {part['mean_error_first_N']} N, last {part['mean_error_last_N']} N")
    part = result["daemon"]
    print(f"{part['descriptors']} descriptors, {part['descriptor_growth']} more than before {part['clients']} clients")
    print(f"{part['operating_state']}, link {part['link']}")
    for failure in result["failures"]:
        print(f"FAILED: {failure}")


def main() -> int:
    """Runs both; returns 0 if all held."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--virtual-minutes", type=float, default=5.0)
    parser.add_argument("--daemon-minutes", type=float, default=3.0)
    options = parser.parse_args()
    if not (0.1 <= options.virtual_minutes <= 1e4 and 0.1 <= options.daemon_minutes <= 1e4):
        parser.error("--virtual-minutes and --daemon-minutes are 0.1 to 10000")
    result: dict[str, Any] = {"virtual": virtual(options.virtual_minutes), "daemon": daemon(options.daemon_minutes)}
    result["failures"] = failures(result)
    result["passed"] = not result["failures"]
    if options.json:
        print(json.dumps(result))
    else:
        print_table(result)
    return 0 if result["passed"] else 1


if __name__ == "__main__":
    sys.exit(main())
