"""What the host takes from a real-time program while it runs, as the kernel and bare timers see it.

Nothing here asks the program itself: a program that holds itself up must not be able to blame the host. Bare timers
(`bare_timer.py`) stand on every processor, above the daemon's priority if that is allowed, so each misses exactly what
its processor did not give. `steal` is what the hypervisor gave to others, and a process has *waited* while it was ready
to run. The workers that carry a pty's bytes (`wire.py`) are processes, too.
"""

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from itertools import pairwise
from pathlib import Path
from typing import IO, NamedTuple

from machines.wire import workers

PERIOD_NS = 1_000_000
MAX_TIMERS = 8
"A timer costs 2% of a processor."
LOOK_S = 0.2
STALL_MS = 10.0
"A fifth of the time after which a device opens by itself."
HOST_SHARE = 0.5
"Share of a device's patience: a processor that stood still for less did not make something late."
MIN_KEPT = 0.99
"Share of its beats below which a bare timer says that the host does not leave enough."
MAX_WAITED = 0.1
"""Share of the time above which a waiting process was not left enough."""
MAX_WAIT_MS = 25.0
"""Over what MAX_WAITED allows between two looks."""
MAX_BLOCKED = 0.02
"""Share of the time above which waiting for disk or memory is a hold-up."""


class Stall(NamedTuple):
    """A time without a beat, from the first missed beat to the next, CLOCK_MONOTONIC."""

    start_s: float
    end_s: float


class Counters(NamedTuple):
    """The kernel's counters at one time: ticks stolen and in all, and each watched process's wait."""

    time_s: float
    stolen: int
    ticks: int
    waited_s: dict[str, float]
    blocked_s: float
    "How long some process was held up by disk or memory (Documentation/accounting/psi)."


class Host(NamedTuple):
    """What was taken in a span of time. `bare_kept` is the share of its beats that the worst bare timer kept."""

    steal: float
    bare_kept: float
    bare_worst_ms: float
    waited: dict[str, float]
    blocked: float = 0.0
    waited_worst_ms: float = 0.0
    "The longest wait of a process between two looks, less MAX_WAITED of that time."

    @property
    def took_much(self) -> bool:
        return (
            self.bare_worst_ms >= STALL_MS
            or self.bare_kept < MIN_KEPT
            or max(self.waited.values(), default=0.0) > MAX_WAITED
            or self.waited_worst_ms > MAX_WAIT_MS
            or self.blocked > MAX_BLOCKED
        )

    def __str__(self) -> str:
        name, share = max(self.waited.items(), key=lambda item: item[1], default=("", 0.0))
        waited = ""
        if share > MAX_WAITED:
            waited = f", and the {name} waited for a processor for {share:.0%} of the time"
        elif self.waited_worst_ms > MAX_WAIT_MS:
            waited = f", and a process waited for a processor for some {self.waited_worst_ms:.0f} ms together"
        return (
            f"a bare timer stood still for up to {self.bare_worst_ms:.0f} ms and kept {self.bare_kept:.1%} of its "
            f"beats{waited}; disk or memory held something up for {self.blocked:.0%} of the time"
        )


class HostWatch:
    def __init__(self, fifo_priority: int, log: IO[str]) -> None:
        command = [sys.executable, "-m", "machines.bare_timer", "--fifo", str(fifo_priority)]
        there = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])}
        self._timers = [
            subprocess.Popen([*command, "--cpu", str(cpu)], stdout=subprocess.PIPE, stderr=log, env=there, text=True)
            for cpu in sorted(os.sched_getaffinity(0))[:MAX_TIMERS]
        ]
        self._stalls: list[list[Stall]] = []
        self._pids: dict[str, int] = {}
        self._looks = [counters({})]
        self._ended = threading.Event()
        self._looking = threading.Thread(target=self._look, daemon=True)

    def __enter__(self) -> "HostWatch":
        for timer in self._timers:
            assert timer.stdout is not None
            timer.stdout.readline()  # before the timer stands it would see nothing, and the host would pass for quiet
        self._looking.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def wait_for(self, name: str, pid: int) -> None:
        """Also watch how long this process's main thread waits for a processor."""
        self._pids = self._pids | {name: pid}

    def end(self) -> None:
        if self._ended.is_set():
            return
        self._ended.set()
        self._looking.join()
        self._looks.append(counters(self._pids))
        for timer in self._timers:
            timer.send_signal(signal.SIGTERM)
        for timer in self._timers:
            printed, _ = timer.communicate(timeout=30)
            with contextlib.suppress(ValueError):  # one that ended before it could listen has seen nothing
                self._stalls.append([Stall(*pair) for pair in json.loads(printed)])

    def between(self, start_s: float, end_s: float) -> Host:
        # the kernel counts a wait when it is over: what led to the end is seen by a look after it
        looks = [look for look in self._looks if start_s - LOOK_S <= look.time_s <= end_s + LOOK_S]
        if len(looks) < 2:
            looks = self._looks
        first, last = looks[0], looks[-1]
        newest = {name: look for look in looks for name in look.waited_s if name in self._pids}
        within = [each for stalls in self._stalls for each in stalls if each.start_s < end_s and each.end_s > start_s]
        return Host(
            steal=(last.stolen - first.stolen) / max(last.ticks - first.ticks, 1),
            bare_kept=min((kept(stalls, start_s, end_s) for stalls in self._stalls), default=1.0),
            bare_worst_ms=1e3 * max((stall.end_s - stall.start_s for stall in within), default=0.0),
            waited={
                name: (look.waited_s[name] - first.waited_s.get(name, 0.0)) / max(look.time_s - first.time_s, 1e-9)
                for name, look in newest.items()
            },
            blocked=(last.blocked_s - first.blocked_s) / max(last.time_s - first.time_s, 1e-9),
            waited_worst_ms=1e3 * max((waited_over_s(*pair) for pair in pairwise(looks)), default=0.0),
        )

    def _look(self) -> None:
        while not self._ended.wait(LOOK_S):
            self._looks.append(counters(self._pids | workers()))


def waited_over_s(before: Counters, after: Counters) -> float:
    """Return the longest wait of a process between two looks, less MAX_WAITED of that time."""
    waits_s = [after.waited_s[name] - waited_s for name, waited_s in before.waited_s.items() if name in after.waited_s]
    return max(max(waits_s, default=0.0) - MAX_WAITED * (after.time_s - before.time_s), 0.0)


def kept(stalls: list[Stall], start_s: float, end_s: float) -> float:
    """Return the share of its beats that a bare timer kept: each stall is one beat."""
    period_s = PERIOD_NS * 1e-9
    missed = sum(
        int((min(stall.end_s, end_s) - max(stall.start_s, start_s)) / period_s)
        for stall in stalls
        if stall.start_s < end_s and stall.end_s > start_s
    )
    return 1.0 - min(missed * period_s / max(end_s - start_s, period_s), 1.0)


def counters(pids: dict[str, int]) -> Counters:
    fields = [int(field) for field in Path("/proc/stat").read_text(encoding="ascii").split("\n", 1)[0].split()[1:9]]
    waited_s = {}
    for name, pid in pids.items():
        # a kernel without schedstats has no such file, and then no wait is known
        with contextlib.suppress(OSError, IndexError):
            waited_s[name] = (
                int(Path(f"/proc/{pid}/task/{pid}/schedstat").read_text(encoding="ascii").split()[1]) * 1e-9
            )
    blocked_s = 0.0
    for resource in ("io", "memory"):
        with contextlib.suppress(OSError):  # nor is pressure known to every kernel
            some = Path(f"/proc/pressure/{resource}").read_text(encoding="ascii").split("\n", 1)[0]
            blocked_s += int(some.rpartition("total=")[2]) * 1e-6
    return Counters(time.monotonic(), fields[7], sum(fields), waited_s, blocked_s)
