"""What the kernel can be asked for: a real-time policy, locked memory, processors. A refusal is a warning."""

import ctypes
import gc
import logging
import os

from tormagd.config import RealTime

_MCL_CURRENT, _MCL_FUTURE = 1, 2

log = logging.getLogger(__name__)


def prepare(settings: RealTime) -> list[str]:
    """Applies the settings to this thread and process; returns what was refused, in plain words.

    FIFO is set on this thread only and reset on fork, so that ZeroMQ's I/O thread and child processes stay ordinary.
    """
    refused = []
    if settings.cpus:
        try:
            os.sched_setaffinity(0, settings.cpus)
        except OSError as error:
            refused.append(f"realtime.cpus = {list(settings.cpus)}: {error.strerror}")
    if settings.fifo_priority:
        try:
            policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
            os.sched_setscheduler(0, policy, os.sched_param(settings.fifo_priority))
        except OSError as error:
            refused.append(f"realtime.fifo_priority = {settings.fifo_priority}: {error.strerror}; see LimitRTPRIO")
    if settings.lock_memory and ctypes.CDLL(None, use_errno=True).mlockall(_MCL_CURRENT | _MCL_FUTURE) != 0:
        refused.append(f"realtime.lock_memory: {os.strerror(ctypes.get_errno())}; see LimitMEMLOCK")
    for line in refused:
        log.warning("not granted: %s", line)
    return refused


def freeze_garbage() -> None:
    """Takes what lives now out of the collector's reach: with torch loaded, a full collection takes 80 ms."""
    gc.collect()
    gc.freeze()
