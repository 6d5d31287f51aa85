"""The unit of a publisher's stamps. Stamps far from our clock are judged by how fast they run.

A clock that was never set runs as fast as ours. Stamps in us, ms or s run a thousand times as slow, or more. No I/O and
no clock: times are arguments.
"""

FACTORS = {"us": 10**3, "ms": 10**6, "s": 10**9}
"ns in what publishers send instead."
FAR_NS = 86_400 * 10**9
"Stamps of such another unit are years away; nearer ones are of a clock."
LOOKED_AT, MIN_S = 8, 0.005
"Messages, and time, that it takes to see how fast stamps run."
SLOW = 0.03
"Share of our clock's rate: no clock runs so slow."


class StampUnit:
    """Finds out whether the stamps of one publisher count ns. Give it each message."""

    def __init__(self) -> None:
        self.is_known = False
        self.wrong = ""
        "The unit of the stamps, a key of FACTORS; empty where it is ns or not known."
        self._from: tuple[float, int] | None = None
        self._messages = 0

    @property
    def remedy(self) -> str:
        return f"send ns since 1970 (CLOCK_REALTIME): {FACTORS[self.wrong]} times as much" if self.wrong else ""

    def hear(self, now_s: float, stamp_ns: int, realtime_ns: int) -> None:
        """Take a message that came at `now_s`; `realtime_ns` is our CLOCK_REALTIME then."""
        if abs(realtime_ns - stamp_ns) < FAR_NS:
            self.is_known, self.wrong, self._from = True, "", None
            return
        if self._from is None:
            self._from, self._messages = (now_s, stamp_ns), 0
        self._messages += 1
        past_s = now_s - self._from[0]
        if self._messages < LOOKED_AT or past_s < MIN_S:
            return
        is_slow = (stamp_ns - self._from[1]) * 1e-9 < SLOW * past_s
        self.wrong = min(FACTORS, key=lambda unit: abs(stamp_ns * FACTORS[unit] - realtime_ns)) if is_slow else ""
        self.is_known, self._from = True, None
