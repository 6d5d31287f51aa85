"""The inbox: chooses the setpoint to plan for among those of several publishers.

Five judgements are made of each message, a module each. Is it newer than the last of its source (`sequence`)? Do its
stamps count ns (`stamp_unit`)? How old is it, by a clock that may be wrong (`source_clock`)? How does its source send
(`source_manner`)? May its source hold the brake (`hold`)?
What was taken may then wait (`playout`).
"""

import logging
import math
import shlex
import time
from collections import deque

from tormagd.config import Sources
from tormagd.control.records import TimedSetpoint, Wall
from tormagd.daemon.hold import Hold, is_passed
from tormagd.daemon.playout import Playout, Taken
from tormagd.daemon.rate_group import Histogram
from tormagd.daemon.sequence import Order, Sequence
from tormagd.daemon.source_clock import AHEAD_S, SourceClock
from tormagd.daemon.source_manner import Arrival, Needs, SourceManner, needs_of
from tormagd.daemon.stamp_unit import LOOKED_AT, StampUnit
from tormagd.hardware.connection import clock_report
from tormagd.hardware.link_statistics import WINDOW_S
from tormagd.safety.codes import Explanation, Limit
from tormagd.safety.operating_state import RefusedError
from tormagd.scenes.scene import Scene
from tormagd_client.messages import ClockReport, MessageError, Setpoint, SetpointReport, SourceReport, decode

SOURCES = 16
"Publishers that are kept apart; one more is refused until an old one has been silent."
SILENT_S = 1.0
"A source that was silent this long makes room for another; one that was refused is named for so long."
LONGEST_REFUSAL = 200
"Characters kept of the last refusal."
REPORTED = 6
"Sources that are reported in full, the newest ones: an answer has to stay under its limit."
MAX_DRIFT_PPM = 100.0
"A clock that drifts faster than quartz does is named."
NEVER_SET_NS = 946_684_800 * 10**9
"The year 2000, in which nobody publishes: a clock that begins in 1970 has not been set."
SURE_WINDOWS = 20
"Half seconds that a clock's line needs before its scatter says how sure its slope is."
NEWS, NEWS_S = 4, 1.0
"Lines for the log that wait, and how long each waits after the one before."
STEP_NAMED_S = 60.0
"A clock that was set is named for so long."

EQUAL_SOURCES = Sources()
"None goes before another, and nothing is held back."

log = logging.getLogger(__name__)


class _Source:
    """One publisher: its newest setpoint, sequence, clock, unit of stamps, manner of sending, and counts."""

    def __init__(self, setpoint: Setpoint, now_s: float) -> None:
        self.setpoint, self.heard_s = setpoint, now_s
        self.stamp_s = -math.inf  # no setpoint of this source has been taken yet
        self.sequence = Sequence(setpoint.session, setpoint.seq)
        self.unit, self.clock, self.manner = StampUnit(), SourceClock(), SourceManner()
        self.delays = Histogram()
        self.accepted = self.refused = 0
        self.is_named = False
        self.refresh(now_s)

    def refresh(self, now_s: float) -> bool:
        """Update the reported figures: delays, the clock's line `fit`, and `cause` and `remedy` of wrong clock or
        stamps."""
        self.delays.refresh()
        self.fit = self.clock.line.fit()
        self.cause, self.remedy = _of_clock(self.clock, self.fit, now_s, self.setpoint.stamp_ns)
        if self.unit.wrong:
            self.cause, self.remedy = f"its stamps count {self.unit.wrong}, and are refused", self.unit.remedy
        was_named, self.is_named = self.is_named, self.clock.is_settled and bool(self.cause)
        return self.is_named and not was_named

    def is_stale(self, now_s: float) -> bool:
        return now_s - self.stamp_s > self.setpoint.valid_for_ms * 1e-3

    def keep(self, setpoint: Setpoint, now_s: float, delay_s: float, playout_s: float, needs: Needs) -> None:
        """Make `setpoint` the source's newest, heard at `now_s` and stamped `delay_s`, its age on arrival, before."""
        clock = self.clock
        if clock.is_settled:
            self.delays.add(now_s, delay_s * 1e6)
            preview_s = len(setpoint.preview_N or ()) * (setpoint.preview_dt_ms or 0.0) * 1e-3
            self.manner.hear(now_s, Arrival(delay_s, clock.hidden_s, playout_s, self.sequence.lost, preview_s), needs)
        # a stamp in the future counts as now
        self.setpoint, self.heard_s, self.stamp_s = setpoint, now_s, now_s - max(delay_s, 0.0)


class SetpointInbox:
    """Chooses the setpoint to plan for, `newest`: the newest valid one of the source that holds the brake, once it is
    due."""

    def __init__(self, sources: Sources = EQUAL_SOURCES) -> None:
        self.has_way = True
        "Whether the scene's element is a brake, whose handle goes either way, and no pad."
        self.accepted = 0
        self.refused = 0
        self.dropped = 0
        self.last_refusal: str | None = None
        self.playout = Playout()
        self._needs = Needs()
        self.hold = Hold()
        self.sources = sources
        """Who goes before whom, and how long setpoints wait."""
        self._sources: dict[str, _Source] = {}
        self._other, self._other_s = "", -SILENT_S
        "The source that was refused last, because another holds the brake, and when."
        self._news: deque[str] = deque(maxlen=NEWS)
        self._told_s = -NEWS_S
        self._turn = 0

    def take(self, data: bytes, now_s: float, realtime_ns: int) -> bool:
        """Decode and judge one message, and count it; return True if another setpoint is in force after it."""
        try:
            setpoint = decode(data, Setpoint)
            if not self.has_way:
                _refuse_way(setpoint)
            return self._judge(setpoint, now_s, realtime_ns)
        except MessageError as error:
            self._refuse(str(error))
            return False

    def give(self, name: str, now_s: float) -> None:
        """Make the source `name` the holder of the brake, as an operator's choice."""
        source = self._sources.get(name)
        if source is None:
            known = ", ".join(sorted(self._sources)) or "none"
            raise RefusedError("unknown_source", f"no source {name!r} has sent setpoints", f"known: {known}"[:200])
        if source.is_stale(now_s):
            raise RefusedError(
                "source_stale", f"source {name!r} has sent nothing that is still valid", "let it send, then take again"
            )
        if name == self.hold.source:
            self.hold = self.hold._replace(is_given=True)
            return
        self._hand_over(name, "an operator's choice", is_given=True)
        self._play(source, now_s)

    @property
    def newest(self) -> TimedSetpoint | None:
        """Return the setpoint to plan for, the newest that is due; None before the first."""
        in_force = self.playout.in_force
        return None if in_force is None else in_force.setpoint

    def passed_over(self) -> tuple[str, int] | None:
        """Return source and newest `seq` of the source last refused because another one holds the brake."""
        other = self._sources.get(self._other)
        return None if other is None or self._other_s <= -SILENT_S else (self._other, other.setpoint.seq)

    def begin_scene(self, scene: Scene) -> None:
        """Judge by the needs of `scene` from now on, and forget the newest setpoint and those that wait."""
        self.playout.forget()
        self.has_way, self._needs = scene.element == "torque", needs_of(scene)

    def withdraw(self, reason: str) -> None:
        """Forget the setpoint to plan for and those that wait; count one refused message, with `reason` as
        `last_refusal`."""
        if self.playout.in_force is not None:
            self.playout.forget()
            self._refuse(reason)

    def _refuse(self, reason: str) -> None:
        self.refused += 1
        self.last_refusal = reason[:LONGEST_REFUSAL]

    def tell(self, now_s: float) -> None:
        """Log one waiting line, of a new holder or of a wrong clock; at most one in NEWS_S."""
        if self._news and now_s - self._told_s >= NEWS_S:
            self._told_s = now_s
            log.warning("%s", self._news.popleft())

    def told(self, now_s: float) -> dict[Limit, Explanation]:
        """Return explanations of the limits about sources, as things are now, whether the limits are in force or not."""
        holder = self._sources.get(self.hold.source)
        if holder is None:
            return {}
        why = {Limit.STALE: self._why_stale(holder, now_s), Limit.OTHER_SOURCE: self._why_other(holder, now_s)}
        return why | holder.manner.found

    def refresh(self, now_s: float) -> None:
        """Update the reported figures of the playout, and those of one source, the next in turn."""
        if self._sources:
            self._turn += 1
            if self.sources.playout_ms > 0.0:
                self.playout.held.refresh()
            source = tuple(self._sources.values())[self._turn % len(self._sources)]
            if source.refresh(now_s):
                self._news.append(f"source {source.setpoint.source!r}: {source.cause}: {source.remedy}")

    def report(self, now_s: float, oversize: int = 0) -> SetpointReport:
        """Return counts, the last refusal, and each source's `seq`, with full reports on the holder and the newest
        others."""
        newest = sorted(self._sources, key=lambda name: (name != self.hold.source, -self._sources[name].heard_s))
        return SetpointReport(
            accepted=self.accepted,
            refused=self.refused,
            dropped=self.dropped,
            oversize=oversize,
            last_refusal=self.last_refusal,
            newest_source=self.hold.source,
            sources={name: source.sequence.seq for name, source in self._sources.items()},
            by_source={name: self._source_report(name, now_s) for name in newest[:REPORTED]},
            playout=self.playout.report(self.sources.playout_ms),
        )

    def _judge(self, setpoint: Setpoint, now_s: float, realtime_ns: int) -> bool:
        """Judge a decoded setpoint and count it; return True if another one is in force after it."""
        source, order = self._sources.get(setpoint.source), Order.NEWER
        if source is None:
            self._make_room(setpoint.source, now_s)
            source = self._sources[setpoint.source] = _Source(setpoint, now_s)
        else:
            is_over = source.is_stale(now_s)
            order = source.sequence.order(now_s, setpoint.session, setpoint.seq, is_over=is_over)
            if order is Order.STRAY:
                self.dropped += 1
                return False
        _require_ns(source, setpoint, now_s, realtime_ns)
        lateness_s = (realtime_ns - setpoint.stamp_ns) * 1e-9
        delay_s = source.clock.hear(now_s, lateness_s, is_continued=order is not Order.REPLACED)
        if delay_s < -AHEAD_S:
            raise MessageError(
                f"stamp_ns is {-delay_s * 1e3:.0f} ms ahead of this clock: allowed is {AHEAD_S * 1e3:.0f} ms, "
                "until the clock of its source has shown itself"
            )
        source.keep(setpoint, now_s, delay_s, self.sources.playout_ms * 1e-3, self._needs)
        hold = self.hold
        if source.setpoint.source != hold.source:
            taken = self.playout.newest
            is_free = taken is None or now_s - taken.setpoint.stamp_s > taken.setpoint.valid_for_s
            if hold.source and (
                source.is_stale(now_s) or not is_passed(hold, setpoint.source, self.sources.priority, is_stale=is_free)
            ):
                self._other, self._other_s = setpoint.source, now_s
                source.refused += 1
                self.refused += 1
                return False
            self._hand_over(setpoint.source, "that is stale" if is_free else "it goes before that")
        elif order is not Order.NEWER:
            self.hold = hold._replace(number=hold.number + 1)  # another process sends as this source now
        source.accepted += 1
        self.accepted += 1
        return self._play(source, now_s)

    def _play(self, source: _Source, now_s: float) -> bool:
        setpoint = source.setpoint
        return self.playout.update(now_s, Taken(self._timed(source, now_s), setpoint.source, setpoint.seq))

    def _hand_over(self, name: str, why: str, *, is_given: bool = False) -> None:
        """Make the source `name` the holder; queue a log line that says `why`, and begin a ramp."""
        if self.hold.source:
            self._news.append(f"source {name!r} holds the brake instead of {self.hold.source!r}: {why}")
        # of the first ever, there is nobody to take over from
        self.hold = Hold(name, self.hold.number + bool(self.hold.source), is_given)
        if self._other == name:
            self._other_s = -SILENT_S

    def _timed(self, source: _Source, now_s: float) -> TimedSetpoint:
        """Return the source's newest setpoint, stamped on the control clock, for the planner."""
        setpoint = source.setpoint
        wall = setpoint.contact
        is_contested = now_s - self._other_s < SILENT_S or source.sequence.is_doubled(now_s)
        others = (Limit.OTHER_SOURCE,) if is_contested else ()
        return TimedSetpoint(
            setpoint.servo_cf,
            source.stamp_s,
            setpoint.valid_for_ms * 1e-3,
            setpoint.displacement_mm,
            setpoint.rate_mm_s,
            setpoint.preview_N or (),
            (setpoint.preview_dt_ms or 0.0) * 1e-3,
            self.hold.number,
            (*others, *source.manner.found),
            setpoint.withdraw_cf,
            self.sources.playout_ms * 1e-3,
            None if wall is None else Wall(wall.handle_mm, wall.stiffness_N_mm, wall.friction_N),
        )

    def _make_room(self, name: str, now_s: float) -> None:
        """Forget one source where SOURCES are kept, so that `name` can be added."""
        if len(self._sources) < SOURCES:
            return
        others = [source for other, source in self._sources.items() if other != self.hold.source]
        silent = [source for source in others if now_s - source.heard_s > SILENT_S]
        listed = self.sources.priority
        unlisted = [source for source in others if source.setpoint.source not in listed]
        may_go = silent or (unlisted if name in listed else [])
        if not may_go:
            raise MessageError(f"source = {name!r}: allowed are {SOURCES} publishers at a time")
        oldest = min(may_go, key=lambda source: source.heard_s)
        del self._sources[oldest.setpoint.source]

    def _why_stale(self, holder: _Source, now_s: float) -> Explanation:
        """Return why a setpoint of the `holder` is stale: it has fallen silent, its messages come late, or they wait
        too long."""
        name, silent_ms = self.hold.source, (now_s - holder.heard_s) * 1e3
        valid_ms = holder.setpoint.valid_for_ms
        if silent_ms > valid_ms:
            return Explanation(
                f"{name!r} has sent nothing for {silent_ms:.0f} ms, and its setpoints are valid for {valid_ms:g} ms; "
                "the force decays to F_min",
                "check the publisher and the network",
            )
        late_ms = (holder.heard_s - holder.stamp_s) * 1e3
        if late_ms <= valid_ms and self.sources.playout_ms > 0.0:
            return Explanation(
                f"setpoints of {name!r} are followed from {self.sources.playout_ms:g} ms after their stamp on, and are "
                f"valid for {valid_ms:g} ms; the force decays to F_min before the next one",
                "send a valid_for_ms of sources.playout_ms and two periods more, or lower sources.playout_ms",
            )
        return Explanation(
            f"setpoints of {name!r} come {late_ms:.0f} ms late, and are valid for {valid_ms:g} ms; the force decays to "
            "F_min",
            "look for a queue in the network; if its clock was set while it paused, start the publisher again",
        )

    def _why_other(self, holder: _Source, now_s: float) -> Explanation:
        """Return why setpoints compete: two publishers of the holder's name, or else the source that was passed over
        last."""
        if holder.sequence.is_doubled(now_s):
            return Explanation(
                f"two publishers call themselves {self.hold.source!r}, or one repeats itself: one of them is followed",
                "end one of them, or let it use another `source`",
            )
        return Explanation(
            f"{self._other!r} sends setpoints too, and {self.hold.source!r} holds the brake",
            f"end the other one, or give it the brake: tormagctl take {shlex.quote(self._other)}",
        )

    def _source_report(self, name: str, now_s: float) -> SourceReport:
        """Return the report on one known source, with the figures of its last `refresh`."""
        source = self._sources[name]
        clock, sequence = source.clock, source.sequence
        state = "holds" if name == self.hold.source else "refused"
        return SourceReport(
            state="stale" if source.is_stale(now_s) else state,
            silent_ms=round((now_s - source.heard_s) * 1e3, 1),
            session=sequence.session,
            seq=sequence.seq,
            accepted=source.accepted,
            refused=source.refused,
            lost=sequence.lost,
            restarts=sequence.restarts,
            delay_us=source.delays.report,
            jitter_us=round(clock.jitter_s * 1e6, 1),
            clock_behind_ms=round(clock.offset_s * 1e3, 3) if clock.is_settled and source.stamp_s > -math.inf else None,
            clock_steps=clock.steps,
            clock=clock_report(source.fit),
            cause=source.cause,
            remedy=source.remedy,
        )


def _refuse_way(setpoint: Setpoint) -> None:
    """Raise MessageError for a setpoint with `withdraw_cf` or `contact`: the element is a pad."""
    for name in ("withdraw_cf", "contact"):
        if getattr(setpoint, name) is not None:
            raise MessageError(f"{name}: allowed is servo_cf alone, as the scene's element is a pad")


def _require_ns(source: _Source, setpoint: Setpoint, now_s: float, realtime_ns: int) -> None:
    """Raise MessageError where the source's stamps do not count ns, or where this is not known yet."""
    unit = source.unit
    unit.hear(now_s, setpoint.stamp_ns, realtime_ns)
    source.heard_s = now_s
    if unit.wrong:
        raise MessageError(f"stamp_ns = {setpoint.stamp_ns} of {setpoint.source!r} counts {unit.wrong}: {unit.remedy}")
    if not unit.is_known:
        raise MessageError(
            f"stamp_ns = {setpoint.stamp_ns} of {setpoint.source!r} is days from this clock: allowed is less until "
            f"{LOOKED_AT} messages show whether it counts ns"
        )


def _of_clock(clock: SourceClock, fit: ClockReport | None, now_s: float, stamp_ns: int) -> tuple[str, str]:
    """Return what is wrong with a publisher's clock, and the remedy; two empty texts where nothing is."""
    if not clock.is_settled:
        return "its stamps are far from this machine's clock: it is watched which of the two it is", "wait a moment"
    causes = []
    if clock.is_wrong and stamp_ns < NEVER_SET_NS:
        causes.append(f"it was never set (it says {time.gmtime(stamp_ns * 1e-9).tm_year}), and is corrected")
    elif clock.is_wrong:
        side = "behind" if clock.offset_s > 0.0 else "ahead of"
        or_way = " (or its way takes that long)" if clock.offset_s > 0.0 and not clock.steps else ""
        causes.append(f"it is {abs(clock.offset_s):.3f} s {side} this machine's{or_way}, and is corrected")
    if now_s - clock.stepped_at_s < STEP_NAMED_S:
        way, often = "forward" if clock.stepped_s > 0.0 else "back", f", the last of {clock.steps} times"
        causes.append(f"it was set {way} by {abs(clock.stepped_s):.3f} s{often if clock.steps > 1 else ''}")
    if fit is not None and fit.windows >= SURE_WINDOWS:
        # standard deviation of the slope, ppm, of a line through evenly spaced points
        sd_ppm = fit.residual_us * math.sqrt(12.0 / fit.windows) / (fit.windows * WINDOW_S)
        if abs(fit.drift_ppm) - 3.0 * sd_ppm > MAX_DRIFT_PPM:
            causes.append(f"it runs {abs(fit.drift_ppm):.0f} ppm {'fast' if fit.drift_ppm > 0.0 else 'slow'}")
    if not causes:
        return "", ""
    return f"its clock: {'; '.join(causes)}", "keep the clocks of both machines by chrony or ptp4l"
