"""The inbox: which of the setpoints that several publishers sent is the one to plan for."""

from tormagd.control.governor import TimedSetpoint
from tormagd.messages import MessageError, Setpoint, SetpointReport, decode

SOURCES = 16
"Publishers that are kept apart; another one is refused until an old one has been silent."
SILENT_S = 1.0
"A source that was silent this long may start again at any sequence number."
AHEAD_S = 0.05
"A stamp may be this far ahead of our clock."
LONGEST_REFUSAL = 200
"Characters kept of the last refusal."


class _Source:
    __slots__ = ("heard_s", "newest", "seq")

    def __init__(self, newest: Setpoint, heard_s: float) -> None:
        self.newest, self.seq, self.heard_s = newest, newest.seq, heard_s


class SetpointInbox:
    """Chooses among what the publishers sent: the newest valid setpoint. No sockets, no clock."""

    def __init__(self) -> None:
        self.accepted = 0
        self.refused = 0
        self.dropped = 0
        self.oversize = 0
        self.last_refusal: str | None = None
        self.newest: TimedSetpoint | None = None
        self._newest_source = ""
        self._sources: dict[str, _Source] = {}

    def take(self, data: bytes, now_s: float, realtime_ns: int) -> bool:
        """Takes one message; True if it became the newest setpoint. `now_s` is the control clock."""
        try:
            setpoint = decode(data, Setpoint)
            self._admit(setpoint, now_s, realtime_ns)
        except MessageError as error:
            self.refused += 1
            self.last_refusal = str(error)[:LONGEST_REFUSAL]
            return False
        known = self._sources.get(setpoint.source)
        if known is not None and setpoint.seq <= known.seq and now_s - known.heard_s < SILENT_S:
            self.dropped += 1
            return False
        self._sources[setpoint.source] = _Source(setpoint, now_s)
        self.accepted += 1
        # Both on the control clock, which no setting of the time moves. Of one publisher `seq` alone says what is
        # newer: when its own clock was set back, its setpoints are older than they were, not out of order.
        stamp_s = now_s - (realtime_ns - setpoint.stamp_ns) * 1e-9
        if self.newest is not None and setpoint.source != self._newest_source and stamp_s < self.newest.stamp_s:
            return False
        self._newest_source = setpoint.source
        self.newest = TimedSetpoint(
            force_N=setpoint.servo_cf,
            stamp_s=stamp_s,
            valid_for_s=setpoint.valid_for_ms * 1e-3,
            displacement_mm=setpoint.displacement_mm,
            rate_mm_s=setpoint.rate_mm_s,
            preview_N=setpoint.preview_N or (),
            preview_dt_s=(setpoint.preview_dt_ms or 0.0) * 1e-3,
        )
        return True

    def withdraw(self, reason: str) -> None:
        """Forgets the newest setpoint: nothing can be planned for it. It counts as refused, too."""
        if self.newest is not None:
            self.newest = None
            self.refused += 1
            self.last_refusal = reason[:LONGEST_REFUSAL]

    def report(self) -> SetpointReport:
        """Counters, the last refusal, and each source with its newest sequence number."""
        return SetpointReport(
            accepted=self.accepted,
            refused=self.refused,
            dropped=self.dropped,
            oversize=self.oversize,
            last_refusal=self.last_refusal,
            newest_source=self._newest_source,
            sources={name: source.seq for name, source in self._sources.items()},
        )

    def _admit(self, setpoint: Setpoint, now_s: float, realtime_ns: int) -> None:
        ahead_s = (setpoint.stamp_ns - realtime_ns) * 1e-9
        if ahead_s > AHEAD_S:
            raise MessageError(
                f"stamp_ns is {ahead_s * 1e3:.0f} ms ahead of this clock: allowed is {AHEAD_S * 1e3:.0f} ms"
            )
        if setpoint.source not in self._sources and len(self._sources) >= SOURCES:
            silent = [name for name, source in self._sources.items() if now_s - source.heard_s > SILENT_S]
            if not silent:
                raise MessageError(f"source = {setpoint.source!r}: allowed are {SOURCES} publishers at a time")
            del self._sources[silent[0]]
