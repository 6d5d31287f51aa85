"""Who made a tick late: the callbacks since the last one, and which of them filled most of the delay."""

from collections import Counter
from collections.abc import Callable
from time import monotonic_ns, thread_time_ns
from typing import NamedTuple

from tormagd.hardware.connection import Watcher

KERNEL = "kernel"
"To blame where nothing of ours ran: the thread was not given the processor, or was stopped."
NEWS_NS = 10_000_000_000
"At most one log line in this time."


class Delay(NamedTuple):
    """How long after it was due a tick was done, and what most of that time went into."""

    took_ns: int
    culprit: str
    share_ns: int


class News(NamedTuple):
    """Late ticks since the last line about them."""

    ticks: int
    worst: Delay

    def __str__(self) -> str:
        took_ns, culprit, share_ns = self.worst
        return (
            f"control ticks that were late: {self.ticks}, the worst done {took_ns * 1e-6:.1f} ms after it "
            f"was due; {share_ns * 1e-6:.1f} ms of that went to {culprit}"
        )


class Callbacks:
    """Watches descriptors as the event loop does, and keeps account of the callbacks, each by its qualified name.

    A callback in whose midst the kernel gave the processor to somebody else is charged with that too, unless that was
    most of the delay: `cpu_ns` counts what the thread really ran.
    """

    def __init__(
        self,
        loop: Watcher,
        clock_ns: Callable[[], int] = monotonic_ns,
        cpu_ns: Callable[[], int] = thread_time_ns,
    ) -> None:
        self._loop, self._clock_ns, self._cpu_ns = loop, clock_ns, cpu_ns
        self._cpu_before_ns = cpu_ns()
        self._ran: list[tuple[str, int, int]] = []
        self.blamed: Counter[str] = Counter()
        "How many late ticks each is to blame for."
        self._news = News(0, Delay(0, "", 0))
        self._news_due_ns = clock_ns()

    def add_reader(self, fd: int, callback: Callable[[], None]) -> None:
        """Calls back whenever the descriptor is readable, on the account of `callback`."""
        name, clock_ns = callback.__qualname__, self._clock_ns

        def timed() -> None:
            start_ns = clock_ns()
            callback()
            self._ran.append((name, start_ns, clock_ns()))

        self._loop.add_reader(fd, timed)

    def remove_reader(self, fd: int) -> None:
        """Stops that."""
        self._loop.remove_reader(fd)

    def ran(self, name: str, start_ns: int, end_ns: int) -> None:
        """Something else ran: a part of a tick."""
        self._ran.append((name, start_ns, end_ns))

    def forget(self) -> None:
        """A tick was on time: what ran before it does not matter any more."""
        self._ran.clear()
        self._cpu_before_ns = self._cpu_ns()

    def blame(self, due_ns: int, done_ns: int) -> Delay:
        """A tick that was due and done at these times was late: whatever filled most of the time between."""
        shares: Counter[str] = Counter()
        for name, start_ns, end_ns in self._ran:
            shares[name] += max(0, min(end_ns, done_ns) - max(start_ns, due_ns))
        shares[KERNEL] = done_ns - due_ns - shares.total()
        culprit, share_ns = shares.most_common(1)[0]
        waited_ns = done_ns - due_ns - (self._cpu_ns() - self._cpu_before_ns)
        if waited_ns > (done_ns - due_ns) / 2:
            culprit, share_ns = KERNEL, waited_ns
        delay = Delay(done_ns - due_ns, culprit, share_ns)
        self.forget()
        self.blamed[culprit] += 1
        self._news = News(self._news.ticks + 1, max(self._news.worst, delay))
        return delay

    def news(self) -> News | None:
        """What there is to log now; None where no tick was late or the last line is not long enough ago."""
        now_ns = self._clock_ns()
        if not self._news.ticks or now_ns < self._news_due_ns:
            return None
        news, self._news = self._news, News(0, Delay(0, "", 0))
        self._news_due_ns = now_ns + NEWS_NS
        return news
