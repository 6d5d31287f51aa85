"""One beat: what the daemon does in every control period, phase by phase, and where the time went.

The kernel's timer is all that wakes the event loop while the daemon runs. What arrives between two beats, from the
device or from a socket, waits for the next.
"""

import logging
from collections import Counter
from collections.abc import Callable
from time import monotonic_ns, thread_time_ns
from typing import NamedTuple

from tormagd.daemon.rate_group import Histogram

KERNEL = "kernel"
"To blame where nothing of ours ran: the thread was not given the processor, or was stopped."
NEWS_NS = 10_000_000_000
"At most one log line about late beats in this time."
COUNTED = 7
"The times of every seventh beat are kept: no period of anything else."

log = logging.getLogger(__name__)


class Beat(NamedTuple):
    """When a beat was due and when it began, ns of the monotonic clock. It stands for `merged` missed ones too."""

    due_ns: int
    start_ns: int
    merged: int


Part = tuple[str, Callable[[Beat], object]]
"A part of a beat, with its name. It returns False where there was nothing to do."


class Delay(NamedTuple):
    """How long after it was due a beat had driven the device, and what most of that time went into."""

    took_ns: int
    culprit: str
    share_ns: int


class Phases:
    """Runs all phases in their order, then one slice: the slices take turns. An error ends its phase alone."""

    def __init__(
        self,
        stall_ns: float,
        clock_ns: Callable[[], int] = monotonic_ns,
        cpu_ns: Callable[[], int] = thread_time_ns,
    ) -> None:
        """A beat that drives later than `stall_ns` after it was due is an error in the log."""
        self._stall_ns, self._clock_ns, self._cpu_ns = stall_ns, clock_ns, cpu_ns
        self._phases: list[Part] = []
        self._slices: list[Part] = []
        self._turn = self._beats = 0
        self._is_busy = False
        self._cpu_before_ns = cpu_ns()
        self._ran: list[tuple[str, int, int]] = []
        self._last_ran: list[tuple[str, int, int]] = []
        self.spent: dict[str, Histogram] = {}
        "What each took."
        self._errors: dict[str, str] = {}
        self.blamed: Counter[str] = Counter()
        "How many late beats each is to blame for."
        self._late, self._worst = 0, Delay(0, "", 0)
        self._tell_ns = clock_ns()

    def begin(self, phases: list[Part], slices: list[Part]) -> None:
        """From now on a beat is this."""
        self._phases, self._slices = phases, slices
        self.spent = {name: Histogram() for name, _ in (*phases, *slices)}

    def run(self, due_ns: int, merged: int) -> None:
        """One beat that was due at `due_ns`, and stands for `merged` missed ones too."""
        beat = Beat(due_ns, self._clock_ns(), merged)
        self._last_ran, self._ran = self._ran, []
        for name, phase in self._phases:
            self._run(name, phase, beat)
        # a quiet beat asks one slice, one that follows a busy beat all of them until one has something to do
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
        """The device was driven in time: what ran before does not matter any more."""
        self._cpu_before_ns = self._cpu_ns()

    def blame(self, due_ns: int) -> Delay:
        """The device was driven just now, too late for `due_ns`. What most of the time since then went into.

        A phase in whose midst the kernel gave the processor to somebody else is charged with that too, unless that was
        most of the delay: `cpu_ns` counts what the thread really ran.
        """
        done_ns = self._clock_ns()
        took_ns = done_ns - due_ns
        shares: Counter[str] = Counter()
        running_since_ns = self._ran[-1][2] if self._ran else due_ns
        running = self._phases[len(self._ran)][0]
        for name, start_ns, end_ns in (*self._last_ran, *self._ran, (running, running_since_ns, done_ns)):
            shares[name] += max(0, min(end_ns, done_ns) - max(start_ns, due_ns))
        shares[KERNEL] = took_ns - shares.total()
        culprit, share_ns = shares.most_common(1)[0]
        waited_ns = took_ns - (self._cpu_ns() - self._cpu_before_ns)
        if waited_ns > took_ns / 2:
            culprit, share_ns = KERNEL, waited_ns
        self.on_time()
        delay = Delay(took_ns, culprit, share_ns)
        self.blamed[culprit] += 1
        self._late += 1
        self._worst = max(self._worst, delay)
        return delay

    def tell(self) -> None:
        """Says in the log how many beats were late, and of the worst why: some times a second."""
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
        """Runs one part; whether it had something to do."""
        start_ns = self._clock_ns()
        try:
            is_done = part(beat) is not False
        except Exception as error:
            is_done = True
            if str(error) != self._errors.get(name):  # the first is news, the same one again is not
                self._errors[name] = str(error)
                log.error("the beat's %r failed", name, exc_info=error)
        if is_done:
            self._ran.append((name, start_ns, self._clock_ns()))
        return is_done
