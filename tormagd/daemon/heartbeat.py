"""The heartbeat: a kernel timer, because asyncio's own timers round to a millisecond."""

import ctypes
import os
import struct
import time

_TFD_TIMER_ABSTIME = 1
_ITIMERSPEC = struct.Struct("@4l")
"Interval and first beat, each in seconds and nanoseconds."
_NS = 1_000_000_000

# os.timerfd_create needs Python 3.13
_libc = ctypes.CDLL(None, use_errno=True)


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
