"""One beat: what the daemon does in every control period, phase by phase, and where the time went.

While the daemon runs, only the kernel's timer wakes the event loop. What arrives between two beats, from the device or
from a socket, waits for the next beat.
"""

import logging
from collections import Counter
from collections.abc import Callable
from time import monotonic_ns, thread_time_ns
from typing import NamedTuple

from tormagd.daemon.rate_group import Histogram

KERNEL = "kernel"
"Blamed if nothing of ours ran: the thread did not get the processor, or was stopped."
NEWS_NS = 10_000_000_000
COUNTED = 7
"Only every seventh beat's times are kept: nothing else has that period."

log = logging.getLogger(__name__)


class Beat(NamedTuple):
    """When a beat was due and when it began, on the monotonic clock. It includes `merged` missed ones."""

    due_ns: int
    start_ns: int
    merged: int


Part = tuple[str, Callable[[Beat], object]]
"The function returns False if it had nothing to do."


class Delay(NamedTuple):
    """Delay of a late beat, from when it was due until it drove the device. `culprit` took most of it: `share_ns`."""

    took_ns: int
    culprit: str
    share_ns: int


class Phases:
    """Runs the parts of every beat: all phases in order, then one of the slices, which take turns. An exception ends
    only its own part."""

    def __init__(
        self,
        stall_ns: float,
        clock_ns: Callable[[], int] = monotonic_ns,
        cpu_ns: Callable[[], int] = thread_time_ns,
    ) -> None:
        self._stall_ns, self._clock_ns, self._cpu_ns = stall_ns, clock_ns, cpu_ns
        self._phases: list[Part] = []
        self._slices: list[Part] = []
        self._turn = self._beats = 0
        self._is_busy = False
        self._cpu_before_ns = cpu_ns()
        self._ran: list[tuple[str, int, int]] = []
        self._last_ran: list[tuple[str, int, int]] = []
        self.spent: dict[str, Histogram] = {}
        self._errors: dict[str, str] = {}
        self.blamed: Counter[str] = Counter()
        self._late, self._worst = 0, Delay(0, "", 0)
        self._tell_ns = clock_ns()

    def begin(self, phases: list[Part], slices: list[Part]) -> None:
        self._phases, self._slices = phases, slices
        self.spent = {name: Histogram() for name, _ in (*phases, *slices)}

    def run(self, due_ns: int, merged: int) -> None:
        beat = Beat(due_ns, self._clock_ns(), merged)
        self._last_ran, self._ran = self._ran, []
        for name, phase in self._phases:
            self._run(name, phase, beat)
        # after a quiet slice one slice is asked; after a busy one all are, until one has something to do
        for _ in range(len(self._slices) if self._is_busy else 1):
            self._turn = (self._turn + 1) % len(self._slices)
            self._is_busy = self._run(*self._slices[self._turn], beat)
            if self._is_busy:
                break
        self._beats += 1
        if self._beats % COUNTED == 0:
            for name, start_ns, end_ns in self._ran:
                self.spent[name].add(end_ns * 1e-9, (end_ns - start_ns) * 1e-3)

    def on_time(self) -> None:
        self._cpu_before_ns = self._cpu_ns()

    def ran_ns(self) -> int:
        """Return this thread's processor time since it last drove the device."""
        return self._cpu_ns() - self._cpu_before_ns

    def blame(self, due_ns: int) -> Delay:
        """Return the delay of the device since `due_ns`, and the part that took most of it."""
        done_ns = self._clock_ns()
        took_ns = done_ns - due_ns
        shares: Counter[str] = Counter()
        running_since_ns = self._ran[-1][2] if self._ran else due_ns
        running = self._phases[len(self._ran)][0]
        for name, start_ns, end_ns in (*self._last_ran, *self._ran, (running, running_since_ns, done_ns)):
            shares[name] += max(0, min(end_ns, done_ns) - max(start_ns, due_ns))
        shares[KERNEL] = took_ns - shares.total()
        culprit, share_ns = shares.most_common(1)[0]
        waited_ns = took_ns - self.ran_ns()
        if waited_ns > took_ns / 2:
            culprit, share_ns = KERNEL, waited_ns
        self.on_time()
        delay = Delay(took_ns, culprit, share_ns)
        self.blamed[culprit] += 1
        self._late += 1
        self._worst = max(self._worst, delay)
        return delay

    def tell(self) -> None:
        now_ns = self._clock_ns()
        if self._late and now_ns >= self._tell_ns:
            took_ns, culprit, share_ns = self._worst
            log.log(
                logging.ERROR if took_ns > self._stall_ns else logging.WARNING,
                "control ticks that were late: %d, the worst done %.1f ms after it was due; %.1f ms of that went to %s",
                *(self._late, took_ns * 1e-6, share_ns * 1e-6, culprit),
            )
            self._late, self._worst = 0, Delay(0, "", 0)
            self._tell_ns = now_ns + NEWS_NS

    def _run(self, name: str, part: Callable[[Beat], object], beat: Beat) -> bool:
        start_ns = self._clock_ns()
        try:
            is_done = part(beat) is not False
        except Exception as error:
            is_done = True
            if str(error) != self._errors.get(name):  # only the first of equal errors is news
                self._errors[name] = str(error)
                log.error("the beat goes on without %r, which failed: report the trace", name, exc_info=error)
        if is_done:
            self._ran.append((name, start_ns, self._clock_ns()))
        return is_done
