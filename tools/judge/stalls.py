"""Daemon and device stopped for some milliseconds while force is held: does it go on, or is it safe?

Each pause is a SIGSTOP and a SIGCONT. Its true length is measured and decides, because a busy machine makes it longer.
Below the device's own timeout of 50 ms nothing may latch, and the plant's force must stay within 0.1 N. From 60 ms on
the gap must be open in the end, and one fault must say what happened.
"""

import random
import signal
import time
from typing import NamedTuple

import numpy as np
from tqdm import tqdm

from judge.stand import Figures, Stand, is_at_rest

FORCE_N, ALLOWED_N = 1.5, 0.1
PAUSES_MS = (5.0, 15.0, 25.0, 35.0, 45.0, 60.0, 83.0, 400.0)
SURVIVED_MS, OPENS_MS = 48.0, 52.0
"The device's timeout, with a period on either side."
OPEN_MM = 94.0
SETTLED_S, WATCHED_S = 0.7, 0.6
TOLD = {"daemon": "HOST_STALL", "device": "MEASUREMENT_STALE"}
"Name of the one fault after a long stop."


class Stop(NamedTuple):
    process: str
    took_ms: float
    faults: tuple[str, ...]
    began_ns: int
    rest_ns: int

    def failure(self, worst_N: float, gap_mm: float) -> str:
        if self.took_ms <= SURVIVED_MS and self.faults:
            return f"fault {', '.join(self.faults)}"
        if self.took_ms <= SURVIVED_MS and worst_N > ALLOWED_N:
            return f"force off by {worst_N:.3f} N, allowed {ALLOWED_N:g}"
        if self.took_ms >= OPENS_MS and self.faults != (TOLD[self.process],):
            return f"told as {', '.join(self.faults) or 'nothing'}"
        if self.faults and gap_mm < OPEN_MM:
            return f"gap {gap_mm:.1f} mm, not open"
        return ""


def run(stand: Stand, count: int, seed: int) -> Figures:
    draw = random.Random(seed)
    stops: list[Stop] = []
    for number in tqdm(range(count), desc="stalls", unit="stop", disable=None):
        _hold(stand)
        time.sleep(draw.uniform(0.0, 0.02))
        stops.append(_stop(stand, ("daemon", "device")[number % 2], draw.choice(PAUSES_MS)))
    truth = stand.truth()
    failures: list[str] = []
    worst_N = 0.0
    for stop in stops:
        seen = truth[(truth[:, 0] >= stop.began_ns) & (truth[:, 0] <= stop.rest_ns)]
        error_N = float(np.abs(seen[:, 1] - FORCE_N).max())
        if failure := stop.failure(error_N, float(seen[-1, 2])):
            failures.append(f"{stop.process} stopped for {stop.took_ms:.1f} ms: {failure}")
        worst_N = max(worst_N, 0.0 if stop.faults else error_N)
    faulted = sum(bool(stop.faults) for stop in stops)
    return {"stops": count, "faulted": faulted, "worst_N": round(worst_N, 4), "failures": failures}


def _hold(stand: Stand) -> None:
    while True:
        stand.arm()
        since_s = time.monotonic()
        stand.ask(FORCE_N)
        stand.until(
            lambda status: bool(status["faults"]) or abs((status["measured_cf"] or 0.0) - FORCE_N) < ALLOWED_N,
            f"{FORCE_N} N",
        )
        time.sleep(SETTLED_S)
        if not stand.see_faults(since_s):
            return


def _stop(stand: Stand, process: str, pause_ms: float) -> Stop:
    child = stand.daemon if process == "daemon" else stand.device
    began_ns = time.time_ns()
    child.send_signal(signal.SIGSTOP)
    # a sleep may end late, which a stop must not: the last stretch is waited for awake
    time.sleep(max(0.0, pause_ms * 1e-3 - 1e-3))
    while time.time_ns() - began_ns < pause_ms * 1e6:
        pass
    child.send_signal(signal.SIGCONT)
    took_ms = (time.time_ns() - began_ns) * 1e-6
    time.sleep(WATCHED_S)
    status = stand.until(lambda status: not status["faults"] or is_at_rest(status), "at rest")
    return Stop(process, took_ms, tuple(status["faults"]), began_ns, time.time_ns())
