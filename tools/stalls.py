"""Stop the daemon, or the simulated device, for some milliseconds while force is held: does it go on, or is it safe?

Real processes and real time: SIGSTOP and SIGCONT around a measured pause, over and over, the daemon with FIFO
scheduling where the kernel grants it. Shorter than the device's own timeout of 50 ms nothing may latch, and the plant's
force must stay within 0.1 N. From 60 ms on the gap must be open in the end, and one fault must say what happened. What
the pause really was is measured, and that decides: a busy machine makes it longer. Exit status 0 if all held.
"""

import argparse
import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import zmq
from machines.own import own_machine
from machines.wire import carried
from tqdm import tqdm

from tormagd_client import Client, ClientError
from tormagd_client.messages import VERSION, Setpoint, Telemetry, decode, encode

FORCE_N, NEUTRAL_N = 1.5, 0.3
ALLOWED_N = 0.1
SHORT_MS = (5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 35.0, 40.0, 45.0)
LONG_MS = (60.0, 83.0, 150.0, 400.0)
SURVIVED_MS = 48.0
"A pause that really was longer than this is the device's timeout with a period on either side."
OPENS_MS = 52.0
OPEN_MM = 94.0
LASTS_MS = 60_000.0
ENDPOINTS = ("setpoint", "telemetry", "control", "recording")
SETTLED_S = 0.7
WATCHED_S = 0.6
PATIENCE_S = 40.0
MOST_DISTURBED = 20
DEVICE_PRIORITY, SENDER_PRIORITY = 55, 60
TOLD = {"daemon": "HOST_STALL", "device": "MEASUREMENT_STALE"}
"What the one fault after a long stop has to be called."


class Stop(NamedTuple):
    """One process stopped once."""

    process: str
    asked_ms: float
    took_ms: float
    faults: tuple[str, ...]
    told: tuple[str, ...]
    "The sentences about them."
    limits: tuple[str, ...]
    began_ns: int
    ended_ns: int
    rest_ns: int
    "When nothing moved any more."

    def failure(self, worst_N: float, gap_mm: float) -> str:
        """What did not hold, given the plant's worst force error until it rested, and the gap there; else nothing."""
        if self.took_ms <= SURVIVED_MS and self.faults:
            return f"fault {', '.join(self.faults)}: {'; '.join(self.told)}"
        if self.took_ms <= SURVIVED_MS and worst_N > ALLOWED_N:
            return f"force off by {worst_N:.3f} N, allowed {ALLOWED_N:g}"
        if self.took_ms >= OPENS_MS and self.faults != (TOLD[self.process],):
            return f"told as {', '.join(self.faults) or 'nothing'}"
        if self.faults and gap_mm < OPEN_MM:
            return f"gap {gap_mm:.1f} mm, not open"
        return ""


class Rig:
    """A daemon and a simulated device as processes, and a client to each of the daemon's sockets."""

    def __init__(self, folder: Path, fifo_priority: int) -> None:
        self.truth = folder / "truth.csv"
        options = ("--pty", "--seed", "1", "--truth", str(self.truth))
        device = own_machine(DEVICE_PRIORITY, "tormagd.simulation", *options)
        self.device = subprocess.Popen([sys.executable, *device], stdout=subprocess.PIPE, text=True)
        assert self.device.stdout is not None
        port = self.device.stdout.readline().strip()
        config = folder / "tormagd.toml"
        config.write_text(
            f'scene = "coronary"\n[realtime]\nfifo_priority = {fifo_priority}\nlock_memory = true\n'
            f'[device]\nport = "{port}"\n[endpoints]\n'
            + "".join(f'{name} = "ipc://{folder}/{name}"\n' for name in ENDPOINTS),
            encoding="utf-8",
        )
        self.daemon = subprocess.Popen(
            [sys.executable, "-m", "tormagd.daemon.main", "--config", str(config)],
            env=os.environ | {"OMP_NUM_THREADS": "1"},
            stderr=subprocess.DEVNULL,
        )
        self._context = zmq.Context()
        self._setpoints = self._context.socket(zmq.XPUB)
        self._setpoints.connect(f"ipc://{folder}/setpoint")
        self._telemetry = self._context.socket(zmq.SUB)
        self._telemetry.connect(f"ipc://{folder}/telemetry")
        self._telemetry.subscribe(b"")
        self._client = Client.local(str(folder), PATIENCE_S)
        self._seq = 0
        self._until(lambda status: status["link"]["state"] == "RUNNING", "the link runs")
        if not self._setpoints.poll(round(PATIENCE_S * 1e3)):
            raise TimeoutError("the daemon does not listen to setpoints")

    def arm(self) -> None:
        """Whatever was before: clears, homes and enables."""
        self._ask(NEUTRAL_N)
        self._until(_is_at_rest, "at rest")
        self._until(lambda status: not status["faults"] or self._is_done("clear-fault"), "cleared")
        self._until(lambda _status: self._is_done("home"), "homing")
        self._until(lambda status: status["is_homed"] and not status["is_busy"], "homed")
        self._until(lambda _status: self._is_done("enable"), "enabled")

    def hold(self) -> list[str]:
        """Holds force, settled; the faults that came by themselves, which a stop here would not show."""
        self._ask(FORCE_N)
        self._until(
            lambda status: bool(status["faults"]) or abs((status["measured_cf"] or 0.0) - FORCE_N) < ALLOWED_N,
            f"{FORCE_N} N",
        )
        time.sleep(SETTLED_S + random.uniform(0.0, 0.02))
        return [detail["cause"] for detail in self._client.request("status")["fault_details"]]

    def stop(self, process: str, pause_ms: float) -> Stop:
        """Stops one of the two for that long while force is held, and sees what becomes of it."""
        self._limits()
        child = self.daemon if process == "daemon" else self.device
        began_ns = time.time_ns()
        child.send_signal(signal.SIGSTOP)
        try:
            # a sleep may end late, which a stop must not: the last stretch is waited for awake
            time.sleep(max(0.0, pause_ms * 1e-3 - 1e-3))
            while time.time_ns() - began_ns < pause_ms * 1e6:
                pass
        finally:
            child.send_signal(signal.SIGCONT)
        ended_ns = time.time_ns()
        time.sleep(WATCHED_S)
        status = self._until(lambda status: not status["faults"] or _is_at_rest(status), "at rest")
        return Stop(
            process,
            pause_ms,
            (ended_ns - began_ns) * 1e-6,
            tuple(status["faults"]),
            tuple(detail["cause"] for detail in status["fault_details"]),
            tuple(sorted(self._limits())),
            began_ns,
            ended_ns,
            time.time_ns(),
        )

    def close(self) -> None:
        """Ends both."""
        for child in (self.daemon, self.device):
            child.send_signal(signal.SIGCONT)
            child.terminate()
            child.wait(timeout=PATIENCE_S)
        self._client.close()
        self._context.destroy(linger=0)

    def _ask(self, force_N: float) -> None:
        self._seq += 1
        setpoint = Setpoint(
            v=VERSION, source="stalls", seq=self._seq, stamp_ns=time.time_ns(), servo_cf=force_N, valid_for_ms=LASTS_MS
        )
        self._setpoints.send(encode(setpoint))

    def _until(self, reached: Callable[[dict[str, Any]], bool], what: str) -> dict[str, Any]:
        """The status in which that is so. Raises TimeoutError saying what was waited for."""
        until_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < until_s:
            status = self._client.request("status")
            if status and reached(status):
                return status
            time.sleep(0.05)
        raise TimeoutError(f"not within {PATIENCE_S:g} s: {what}")

    def _is_done(self, name: str) -> bool:
        try:
            self._client.request(name)
        except ClientError:
            return False
        return True

    def _limits(self) -> set[str]:
        """The limits of all telemetry since this was last asked."""
        seen: set[str] = set()
        while self._telemetry.poll(0):
            seen.update(decode(self._telemetry.recv(), Telemetry).limits)
        return seen


def _is_at_rest(status: dict[str, Any]) -> bool:
    return status["link"]["state"] == "RUNNING" and not status["is_busy"]


def measure(each: int, fifo_priority: int) -> dict[str, Any]:
    """Stops daemon and device by turns: each short pause that often, and each long one a tenth as often."""
    plan = [
        (process, pause_ms)
        for process in TOLD
        for pauses_ms, times in ((SHORT_MS, each), (LONG_MS, -(-each // 10)))
        for pause_ms in pauses_ms
        for _ in range(times)
    ]
    random.seed(1)
    random.shuffle(plan)
    with tempfile.TemporaryDirectory(prefix="stalls-") as folder, carried(DEVICE_PRIORITY):
        rig = Rig(Path(folder), fifo_priority)
        with contextlib.suppress(PermissionError):  # where this is refused, pauses are longer on a busy machine
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(SENDER_PRIORITY))
        stops: list[Stop] = []
        disturbed: list[str] = []
        try:
            for process, pause_ms in tqdm(plan, desc="stalls", unit="stop", disable=not sys.stderr.isatty()):
                if not stops or stops[-1].faults:
                    rig.arm()
                while causes := rig.hold():
                    disturbed += causes
                    if len(disturbed) > MOST_DISTURBED:
                        raise TimeoutError(f"this machine leaves the two no time: {causes[0]}")
                    rig.arm()
                stops.append(rig.stop(process, pause_ms))
        finally:
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
            rig.close()
        truth = np.loadtxt(rig.truth, delimiter=",", skiprows=1, usecols=(0, 1, 2), ndmin=2)
    return report(stops, truth, disturbed)


def report(stops: list[Stop], truth: "np.ndarray[Any, Any]", disturbed: list[str]) -> dict[str, Any]:
    """The figures; `truth` has columns t_ns, force_N and gap_mm. `disturbed`: what the machine did besides."""
    rows: list[dict[str, Any]] = []
    failures: list[str] = []
    for process in TOLD:
        for asked_ms in (*SHORT_MS, *LONG_MS):
            these = [stop for stop in stops if (stop.process, stop.asked_ms) == (process, asked_ms)]
            worst_N = 0.0
            for stop in these:
                seen = truth[(truth[:, 0] >= stop.began_ns) & (truth[:, 0] <= stop.rest_ns)]
                error_N = float(np.abs(seen[:, 1] - FORCE_N).max())
                failure = stop.failure(error_N, float(seen[-1, 2]))
                if failure:
                    failures.append(f"{process} stopped for {stop.took_ms:.1f} ms: {failure}")
                if not stop.faults:
                    worst_N = max(worst_N, error_N)
            if these:
                rows.append(
                    {
                        "process": process,
                        "asked_ms": asked_ms,
                        "stops": len(these),
                        "took_ms": [round(pick(stop.took_ms for stop in these), 2) for pick in (min, max)],
                        "faults": sorted({fault for stop in these for fault in stop.faults}),
                        "told": sorted({sentence for stop in these for sentence in stop.told}),
                        "limits": sorted({limit for stop in these for limit in stop.limits}),
                        "faulted": sum(bool(stop.faults) for stop in these),
                        "worst_N": round(worst_N, 4),
                    }
                )
    return {"stops": len(stops), "rows": rows, "disturbed": disturbed, "failures": failures, "passed": not failures}


def print_table(result: dict[str, Any]) -> None:
    """The result for people."""
    print("stopped   for/ms  really/ms       times  faulted  worst/N  named")
    for row in result["rows"]:
        least, most = row["took_ms"]
        named = ", ".join([*row["faults"], *row["limits"]])
        print(
            f"{row['process']:9s} {row['asked_ms']:5.0f}  {least:6.1f}..{most:<6.1f}  {row['stops']:6d}  "
            f"{row['faulted']:7d}  {row['worst_N']:7.3f}  {named}"
        )
        for sentence in row["told"][:1]:
            print(f"{'':11s}{sentence}")
    for cause in result["disturbed"]:
        print(f"beside the stops: {cause}")
    for failure in result["failures"]:
        print(f"FAILED: {failure}")


def main() -> int:
    """Runs it; returns 0 if all held."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--each", type=int, default=20, help="how often each short pause is tried")
    parser.add_argument("--fifo-priority", type=int, default=50, help="of the daemon; 0 for none")
    options = parser.parse_args()
    if not (1 <= options.each <= 10_000 and 0 <= options.fifo_priority <= 90):
        parser.error("--each is 1 to 10000, --fifo-priority 0 to 90")
    result = measure(options.each, options.fifo_priority)
    if options.json:
        print(json.dumps(result))
    else:
        print_table(result)
    return 0 if result["passed"] else 1


if __name__ == "__main__":
    sys.exit(main())
