"""What the kernel is asked for: real-time policy, locked memory, processors, no sleep, and the timer of the beat.

All but the timer may be refused. The timer is the kernel's, because asyncio's own round to a millisecond.
"""

import ctypes
import gc
import logging
import os
import resource
import struct
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from tormagd.config import RealTime
from tormagd.ground.scheduling import ask_for_slices

OPEN_FILES = 1_024
"About 50 of the daemon's own, its endpoints' connections (`admission`), and a reserve."
_MCL_CURRENT, _MCL_FUTURE = 1, 2
_LATENCY = Path("/dev/cpu_dma_latency")
"""While it is open, no processor sleeps so deeply that waking takes longer than the us written to it (the kernel's
Documentation/power/pm_qos_interface)."""

_TFD_TIMER_ABSTIME = 1
_ITIMERSPEC = struct.Struct("@4l")
"Interval and first beat, each in seconds and nanoseconds."
_NS = 1_000_000_000

# os.timerfd_create needs Python 3.13
_libc = ctypes.CDLL(None, use_errno=True)

log = logging.getLogger(__name__)


def prepare(settings: RealTime) -> list[str]:
    """Ask the kernel for these settings; return what it refused, a line each."""
    refused = []
    if settings.cpus:
        try:
            os.sched_setaffinity(0, settings.cpus)
        except OSError as error:
            refused.append(f"realtime.cpus = {list(settings.cpus)}: {error.strerror}")
    if settings.fifo_priority:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(settings.fifo_priority))
        except OSError as error:
            why = f"{error.strerror} under a limit of {resource.getrlimit(resource.RLIMIT_RTPRIO)[0]}; see LimitRTPRIO"
            refused.append(f"realtime.fifo_priority = {settings.fifo_priority}: {why}")
    ask_for_slices()
    if settings.lock_memory and ctypes.CDLL(None, use_errno=True).mlockall(_MCL_CURRENT | _MCL_FUTURE) != 0:
        refused.append(f"realtime.lock_memory: {os.strerror(ctypes.get_errno())}; see LimitMEMLOCK")
    if settings.keep_awake:
        try:
            # never closed: it holds until the process ends
            os.write(os.open(_LATENCY, os.O_WRONLY | os.O_CLOEXEC), bytes(4))
        except OSError as error:
            refused.append(f"realtime.keep_awake: {_LATENCY}: {error.strerror}; see 60-tormag.rules")
    for line in refused:
        log.warning("the kernel does not grant %s; next: tormagctl doctor", line)
    return refused


def priority_of_threads() -> int:
    """Return the FIFO priority for threads begun by this one: one below its own, 1 at least, 0 without FIFO."""
    if os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK != os.SCHED_FIFO:
        return 0
    priority = max(os.sched_getparam(0).sched_priority - 1, os.sched_get_priority_min(os.SCHED_FIFO))
    # tried in a thread, because libzmq ends the process if it is refused
    with ThreadPoolExecutor(1) as pool:
        try:
            pool.submit(os.sched_setscheduler, 0, os.SCHED_FIFO, os.sched_param(priority)).result()
        except OSError as error:
            log.warning(
                "the kernel does not grant ZeroMQ's threads FIFO priority %d: %s; next: tormagctl doctor",
                *(priority, error.strerror),
            )
            return 0
    return priority


def freeze_garbage() -> None:
    """Exempt all living objects from garbage collection: a full one takes tens of milliseconds."""
    gc.collect()
    gc.freeze()


class Heartbeat:
    """A periodic timer on CLOCK_MONOTONIC (timerfd)."""

    def __init__(self, period_ns: int) -> None:
        self._fd: int = _libc.timerfd_create(time.CLOCK_MONOTONIC, os.O_NONBLOCK | os.O_CLOEXEC)
        if self._fd < 0:
            raise OSError(
                ctypes.get_errno(), "the kernel makes no timer for the beat (timerfd_create); tormagctl doctor"
            )
        self.period_ns = period_ns
        self.due_ns = time.monotonic_ns()
        setting = _ITIMERSPEC.pack(*divmod(period_ns, _NS), *divmod(self.due_ns + period_ns, _NS))
        if _libc.timerfd_settime(self._fd, _TFD_TIMER_ABSTIME, setting, None) < 0:
            raise OSError(
                ctypes.get_errno(), "the kernel sets no timer for the beat (timerfd_settime); tormagctl doctor"
            )

    def fileno(self) -> int:
        return self._fd

    def beats(self) -> int:
        """Return the number of beats due since the last call."""
        try:
            expirations: int = struct.unpack("=Q", os.read(self._fd, 8))[0]
        except BlockingIOError:
            return 0
        self.due_ns += expirations * self.period_ns
        return expirations

    def close(self) -> None:
        os.close(self._fd)
