"""The same thing for a long time: does memory grow, do descriptors leak, does anything drift?

First the closed loop in virtual time, then a daemon on a simulated device in real time, under 500 setpoints a second,
recorded, whose status a new client asks for every half second. Growth counts after two minutes (a quarter of a shorter
time), when what is made once has been made. Where a processor stands still for longer than the device waits, a fault
has to latch: it is cleared, and the host has to answer for it if a bare timer stood still then. At the end recorder and
daemon are killed. Exit status 0 if nothing grew, nothing else latched a fault, the last minute tracked as the first, no
tick came too late for the device, every number is in the recording, and what was killed lost a second of it at most.
"""

import argparse
import contextlib
import json
import math
import os
import struct
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
from benchmarks.loop import Stand, end, wait_for, write_config
from machines.host import HOST_SHARE, HostWatch
from machines.own import own_machine
from machines.wire import carried
from mcap.exceptions import EndOfFile
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader
from tqdm import tqdm

from tormagd.closed_loop import ClosedLoop
from tormagd.config import Config, RealTime, load_config
from tormagd.control.core import build_core
from tormagd.control.governor import TimedSetpoint
from tormagd.recording.writer import TELEMETRY_TOPIC, TICKS_TOPIC
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.hand import SteadyHand
from tormagd.simulation.parameters import load_plant
from tormagd_client import Client

MEAN_N, SWING_N, SWING_HZ = 1.5, 0.3, 1.2
SETTLING_TICKS = 5_000
SAMPLE_S = 0.5
SETTLED_S = 120.0
WITNESS_S = 3.0
MISSING_ALLOWED_MS = 1_000.0
GROWTH_ALLOWED_KB = 2_048
RECORDER_GROWTH_ALLOWED_KB = 16_384
"The recorder keeps the index, which is written last: two entries a second."
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
    """A daemon in real time, recorded: memory and descriptors of both, faults and missed deadlines with how long the
    host stood still then, what its link counted, what is in the file, and what `kill -9` of recorder and daemon costs.
    """
    memory_kB: dict[str, list[int]] = {"daemon": [], "recorder": []}
    descriptors: dict[str, list[int]] = {"daemon": [], "recorder": []}
    latched: list[tuple[tuple[float, float], str]] = []
    began_s = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="tormag-") as name, contextlib.ExitStack() as stack:
        folder = Path(name)
        log = stack.enter_context((folder / "bare_timer.log").open("w", encoding="utf-8"))
        watched = stack.enter_context(HostWatch(FIFO_PRIORITY + 1, log))
        is_carried = stack.enter_context(carried(FIFO_PRIORITY - 1))
        config, process = _running(folder, stack)
        processes = {"daemon": process, "recorder": _recorder(folder, "soak", stack)}
        for _ in tqdm(range(round(60.0 * minutes / SAMPLE_S)), desc="real time", unit="sample", disable=None):
            before_s = time.monotonic()
            time.sleep(SAMPLE_S)
            with Client(config.endpoints, PATIENCE_S) as client:
                status = client.request("status")
            if status["faults"]:
                latched.append(((before_s, time.monotonic()), ", ".join(status["faults"])))
                _armed_again(folder, stack)
            for each, running in processes.items():
                memory_kB[each].append(resident_kB(running.pid))
                descriptors[each].append(len(list((PROC / str(running.pid) / "fd").iterdir())))
        missing_ms = {"recorder": _killed(processes["recorder"], folder / "soak.mcap")}
        witness = _recorder(folder, "killed", stack)
        time.sleep(WITNESS_S)
        missing_ms["daemon"] = _killed(processes["daemon"], folder / "killed.mcap", witness)
        watched.end()
        recorded = recording(folder / "soak.mcap", 1e3 / config.rates.control_hz, config.device.command_timeout_ms)
        held_up = [
            {"what": what, "host_stood_still_ms": round(watched.between(*span).bare_worst_ms, 1)}
            for span, what in (*latched, *((span, "missed deadline") for span in recorded["missed_deadlines_s"]))
        ]
        host_worst_ms = watched.between(began_s, time.monotonic()).bare_worst_ms
    link, control = status["link"], status["rates"]["control"]
    return {
        "minutes": minutes,
        "clients": len(memory_kB["daemon"]),
        "memory_kB": memory_kB["daemon"][-1],
        "growth_kB": growth(memory_kB["daemon"]),
        "descriptors": descriptors["daemon"][-1],
        "descriptor_growth": staying(descriptors["daemon"]),
        "recorder": {
            "memory_kB": memory_kB["recorder"][-1],
            "growth_kB": growth(memory_kB["recorder"]),
            "descriptor_growth": staying(descriptors["recorder"]),
        },
        "held_up": held_up,
        "host_worst_ms": round(host_worst_ms, 1),
        "pty_workers_fifo": is_carried,
        "operating_state": status["operating_state"],
        "control": {name: control[name] for name in ("runs", "merged", "overruns", "stalls")},
        "worst_lateness_ms": round(control["lateness_us"]["worst"] * 1e-3, 3),
        "late_ticks_by": status["late_ticks_by"],
        "newest_stall": status["newest_stall"],
        "link": {name: link[name] for name in ("frames", "corrupt", "lost", "repeated", "resynchronisations")},
        "recording": recorded,
        "killed_missing_ms": missing_ms,
    }


def recording(path: Path, period_ms: float, deadline_ms: float) -> dict[str, Any]:
    """What is in a recording: ticks and snapshots, numbers that are missing, and the longest time between two ticks.

    Two that are `deadline_ms` apart are a deadline that was missed: so long the device waits for a command.
    """
    counts, missing, last = Counter[str](), Counter[str](), dict[str, int]()
    longest_ms, before_s = 0.0, 0.0
    late: list[tuple[float, float]] = []
    for topic, monotonic_s, number in _numbered(path):
        if topic in last:
            missing[topic] += number != last[topic] + 1
        if topic == TICKS_TOPIC and counts[topic]:
            between_ms = 1e3 * (monotonic_s - before_s)
            longest_ms = max(longest_ms, between_ms)
            if between_ms >= deadline_ms:
                late.append((before_s, monotonic_s))
        if topic == TICKS_TOPIC:
            before_s = monotonic_s
        counts[topic] += 1
        last[topic] = number
    return {
        "bytes": path.stat().st_size,
        "ticks": counts[TICKS_TOPIC],
        "ticks_out_of_sequence": missing[TICKS_TOPIC],
        "telemetry": counts[TELEMETRY_TOPIC],
        "telemetry_out_of_sequence": missing[TELEMETRY_TOPIC],
        "period_ms": period_ms,
        "longest_between_ticks_ms": round(longest_ms, 3),
        "deadline_ms": deadline_ms,
        "missed_deadlines_s": late,
    }


def _numbered(path: Path) -> Iterator[tuple[str, float, int]]:
    """Topic, time and number of each message of a recording, up to where it was cut: a tick's time is the monotonic
    clock's, because the wall clock may be set meanwhile."""
    topics: dict[int, str] = {}
    with path.open("rb") as file, contextlib.suppress(EndOfFile, struct.error):
        for record in StreamReader(file).records:
            if isinstance(record, Channel):
                topics[record.id] = record.topic
            elif isinstance(record, Message):
                message = _DECODER.decode(record.data)
                topic = topics[record.channel_id]
                yield topic, message.monotonic_s, message.tick if topic == TICKS_TOPIC else message.seq


class _Numbered(msgspec.Struct):
    """What is looked at of a message: a snapshot's `tick` is something else than a tick's."""

    monotonic_s: float = 0.0
    tick: Any = None
    seq: int = 0


_DECODER = msgspec.json.Decoder(_Numbered)


def _running(folder: Path, stack: contextlib.ExitStack) -> tuple[Config, "subprocess.Popen[Any]"]:
    """A daemon on a simulated device, enabled, with setpoints arriving; all of it ends with `stack`."""
    device = own_machine(FIFO_PRIORITY - 1, "tormagd.simulation", "--pty")
    simulator = _begun(device, stack, stdout=subprocess.PIPE)
    assert simulator.stdout is not None
    stand = Stand(RealTime(fifo_priority=FIFO_PRIORITY, lock_memory=True))
    path = write_config(folder, simulator.stdout.readline().decode().strip(), stand)
    process = _begun(["-m", "tormagd.daemon.main", "--config", str(path)], stack, stderr=subprocess.DEVNULL)
    config = load_config(path)
    wait_for(config.endpoints)
    subprocess.run([*_ctl(folder), "home"], check=True, stdout=subprocess.DEVNULL)
    _driven(folder, stack)
    return config, process


def _armed_again(folder: Path, stack: contextlib.ExitStack) -> None:
    """Clears a fault, once the gap is open, and drives on. Raises RuntimeError if it stays."""
    until_s = time.monotonic() + PATIENCE_S
    while subprocess.run([*_ctl(folder), "clear-fault"], stdout=subprocess.DEVNULL).returncode:
        if time.monotonic() > until_s:
            raise RuntimeError(f"the fault could not be cleared within {PATIENCE_S:g} s")
        time.sleep(SAMPLE_S)
    _driven(folder, stack)


def _driven(folder: Path, stack: contextlib.ExitStack) -> None:
    """Enables the device, with setpoints arriving, until a fault."""
    subprocess.run([*_ctl(folder), "enable"], check=True, stdout=subprocess.DEVNULL)
    _begun([*_ctl(folder)[1:], "send", "pulse", "--duration", "1e6"], stack, stdout=subprocess.DEVNULL)


def _recorder(folder: Path, name: str, stack: contextlib.ExitStack) -> "subprocess.Popen[Any]":
    path = folder / f"{name}.mcap"
    recorder = _begun([*_ctl(folder)[1:], "record", str(path)], stack, stdout=subprocess.DEVNULL)
    until_s = time.monotonic() + PATIENCE_S
    while not path.exists():
        if time.monotonic() > until_s:
            raise RuntimeError(f"{path.name} was not begun within {PATIENCE_S:g} s")
        time.sleep(0.05)
    return recorder


def _ctl(folder: Path) -> list[str]:
    return [sys.executable, "-m", "tormagd.ctl.main", "--config", str(folder / "tormagd.toml"), "--wait", "20"]


def _begun(arguments: list[str], stack: contextlib.ExitStack, **streams: int) -> "subprocess.Popen[Any]":
    child = subprocess.Popen([sys.executable, *arguments], **streams)  # type: ignore[call-overload]
    stack.callback(end, child)
    begun: subprocess.Popen[Any] = child
    return begun


def _killed(victim: "subprocess.Popen[Any]", path: Path, recorder: "subprocess.Popen[Any] | None" = None) -> float:
    """Kills `victim` and ends the `recorder`, if it is another: how much of the time before is not in the file, ms."""
    killed_s = time.monotonic()
    victim.kill()
    victim.wait(PATIENCE_S)
    if recorder is not None:
        end(recorder)
    newest_s = max((monotonic_s for topic, monotonic_s, _ in _numbered(path) if topic == TICKS_TOPIC), default=0.0)
    return round(1e3 * (killed_s - newest_s), 1)


def staying(values: list[int]) -> int:
    """By how many more there are in the last quarter than in the second, whatever comes and goes."""
    quarter = len(values) // 4
    return min(values[-quarter:]) - min(values[quarter : 2 * quarter])


def growth(values: list[int]) -> int:
    """By how much the largest is above the first, once what is made once has been made: after two minutes, or after a
    quarter of a shorter time."""
    settled = min(len(values) // 4, round(SETTLED_S / SAMPLE_S))
    return max(values[settled:]) - values[settled]


def resident_kB(process: int) -> int:
    """Memory of a process. Raises OSError where there is no /proc or no such process."""
    pages = int((PROC / str(process) / "statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") // 1024


def failures(result: dict[str, Any]) -> list[str]:
    """What did not hold, in words."""
    found = []
    for name in ("virtual", "daemon"):
        part = result[name]
        if part["growth_kB"] > GROWTH_ALLOWED_KB:
            found.append(f"{name}: memory grew by {part['growth_kB']} kB, allowed {GROWTH_ALLOWED_KB}")
    if result["virtual"]["faults"]:
        found.append(f"virtual: faults {', '.join(result['virtual']['faults'])}")
    daemon, recorder, recorded = result["daemon"], result["daemon"]["recorder"], result["daemon"]["recording"]
    if recorder["growth_kB"] > RECORDER_GROWTH_ALLOWED_KB:
        found.append(f"recorder: memory grew by {recorder['growth_kB']} kB, allowed {RECORDER_GROWTH_ALLOWED_KB}")
    for name, part in (("daemon", daemon), ("recorder", recorder)):
        if part["descriptor_growth"] > 0:
            found.append(f"{name}: {part['descriptor_growth']} more descriptors")
    found += [
        f"daemon: {held_up['what']}, while the host stood still for {held_up['host_stood_still_ms']:g} ms"
        for held_up in daemon["held_up"]
        if held_up["host_stood_still_ms"] < HOST_SHARE * recorded["deadline_ms"]
    ]
    found += [
        f"recording: {recorded[f'{name}_out_of_sequence']} of {recorded[name]} {name} out of sequence"
        for name in ("ticks", "telemetry")
        if recorded[f"{name}_out_of_sequence"] or not recorded[name]
    ]
    for name, missing_ms in daemon["killed_missing_ms"].items():
        if missing_ms > MISSING_ALLOWED_MS:
            found.append(f"{name}: {missing_ms:g} ms missing after kill -9, allowed {MISSING_ALLOWED_MS:g}")
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
    print(f"{part['operating_state']}, link {part['link']}; the host stood still for up to {part['host_worst_ms']} ms")
    for held_up in part["held_up"]:
        print(f"{held_up['what']}: the host stood still for {held_up['host_stood_still_ms']} ms then")
    recorder, recorded, killed = part["recorder"], part["recording"], part["killed_missing_ms"]
    print(f"recorder: memory grew by {recorder['growth_kB']} kB to {recorder['memory_kB']} kB")
    print(
        f"recorded: {recorded['ticks']} ticks, {recorded['ticks_out_of_sequence']} out of sequence, at most "
        f"{recorded['longest_between_ticks_ms']} ms apart; {recorded['telemetry']} snapshots, "
        f"{recorded['telemetry_out_of_sequence']} out of sequence"
    )
    print(f"kill -9: {killed['recorder']} ms missing of the recorder's, {killed['daemon']} ms of the daemon's")
    for failure in result["failures"]:
        print(f"FAILED: {failure}")


def main() -> int:
    """Runs both; returns 0 if all held."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--virtual-minutes", type=float, default=5.0, help="in virtual time (5)")
    parser.add_argument("--minutes", type=float, default=3.0, help="in real time (3)")
    options = parser.parse_args()
    if not (0.1 <= options.virtual_minutes <= 1e4 and 0.1 <= options.minutes <= 1e4):
        parser.error("--virtual-minutes and --minutes are 0.1 to 10000")
    result: dict[str, Any] = {"virtual": virtual(options.virtual_minutes), "daemon": daemon(options.minutes)}
    result["failures"] = failures(result)
    result["passed"] = not result["failures"]
    if options.json:
        print(json.dumps(result))
    else:
        print_table(result)
    return 0 if result["passed"] else 1


if __name__ == "__main__":
    sys.exit(main())
