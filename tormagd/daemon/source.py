"""One publisher of setpoints: which of its messages count, how old they are, and how evenly they come.

A message that does not follow the newest may be the first of a new run; a few messages show whether it is. A message's
lateness, our time less its stamp, is the offset of its clock plus the time on the way. Messages of one publisher do not
overtake each other, and clocks drift slowly. So the least lateness is the offset plus the constant part of the way, and
what exceeds it is delay. From one side these two cannot be told apart: up to MAX_WAY_S counts as the way. Times are
arguments.
"""

import math
import time
from enum import Enum
from typing import Final, NamedTuple, final

from msgspec import UNSET

from tormagd.config import MAX_PLAYOUT_MS
from tormagd.control.ask.governor import AHEAD_S as SLOPE_S
from tormagd.control.safety.codes import Explanation, Limit
from tormagd.daemon.rate_group import Histogram
from tormagd.hardware.connection import clock_report
from tormagd.hardware.link_statistics import WINDOW_S as LINE_S, DeviceClock
from tormagd.scenes.scene import Scene
from tormagd_client.messages import MessageError, Setpoint, SourceReport

LONGEST_JUMP = 1_000
"A jump of `seq` by more steps is no loss: it is another run or a wrong number."
RUN = 3
STRAYS_S = 1.0
"RUN strays within this time are a second publisher of the same name."

FACTORS = {"us": 10**3, "ms": 10**6, "s": 10**9}
"ns in each unit that publishers send by mistake."
FAR_S = 86_400.0
"A stamp that is no further from our clock if it counts another unit does so. No setpoint is older than this."

MAX_WAY_S = 0.2
"A least lateness up to this is the way's: half of the delay allowed from sensor to force."
MAX_LATE_S = 1.0
"""Between MAX_WAY_S and this, the least lateness may be either: it corrects the clock, and the limits count it as the
way."""
AHEAD_S = 0.05
"A clock that is further ahead of ours is wrong."
SETTLED_S = 0.2
"A backlog drains in this time, before a new publisher's clock counts as wrong."
STEP_S = 0.005
"If stamps run back by more than this, the clock was set back."
DRIFT = 500e-6
FORGOTTEN_S = 5.0
"After a longer silence the clock may have been set by any amount."
JITTER_SHARE = 1.0 / 16.0
MAX_DRIFT_PPM = 100.0
"Quartz drifts less."
NEVER_SET_NS = 946_684_800 * 10**9
"The year 2000: a clock that starts in 1970 has not been set."
SURE_WINDOWS = 20
STEP_NAMED_S = 60.0

WINDOW_S, MIN_MESSAGES = 1.0, 4
MAX_LOST = 0.05
SPREAD_S = 0.02
"A delay that varies more shows in the force: the slope bridges 50 ms."
SLACK = 1.25
PLAYOUT_STEP_MS = 10


class Order(Enum):
    NEWER = "newer"
    NEW_RUN = "new run"
    "The first of a publisher that has restarted, or was replaced by another."
    STRAY = "stray"
    "Old, repeated, or from another run."


NEWER: Final = Order.NEWER
STRAY: Final = Order.STRAY


@final
class Sequence:
    """Follows a publisher's count `seq` through restarts. `session` is None if the publisher sends none."""

    def __init__(self, session: int | None, seq: int) -> None:
        self.session, self.seq = session, seq
        self.lost = self.missing = 0
        "Missing messages in all, and just before the newest; only counted if `seq` goes up by ones."
        self.restarts = self._step = 0
        self._latest_session = session
        self._stray_session, self._stray_seq, self._in_row = session, seq, 0
        self._strays, self._strays_since_s = 0, 0.0

    def order(self, now_s: float, session: int | None, seq: int, *, is_over: bool) -> Order:
        if session == self.session and seq > self.seq:
            step = seq - self.seq
            known = self._step
            if known == 0 or step <= LONGEST_JUMP * known or is_over:
                self.missing = min(step, LONGEST_JUMP) - 1 if known == 1 else 0
                self.lost += self.missing
                if known == 0 or step < known:
                    self._step = step
                self.seq, self._in_row = seq, 0
                return NEWER
        if session is not None and (self._latest_session is None or session > self._latest_session):
            self._latest_session = session
            return self._begin(session, seq)
        is_in_row = self._in_row > 0 and session == self._stray_session and seq > self._stray_seq
        self._in_row = self._in_row + 1 if is_in_row else 1
        self._stray_session, self._stray_seq = session, seq
        is_repeated = session == self.session and seq == self.seq
        if self._in_row >= RUN or (is_over and not is_repeated):
            return self._begin(session, seq)
        if now_s - self._strays_since_s > STRAYS_S:
            self._strays, self._strays_since_s = 0, now_s
        self._strays += 1
        return STRAY

    def is_doubled(self, now_s: float) -> bool:
        return self._strays >= RUN and now_s - self._strays_since_s <= STRAYS_S

    def _begin(self, session: int | None, seq: int) -> Order:
        self.session, self.seq, self._step = session, seq, 0
        self._in_row = self._strays = self.missing = 0
        self.restarts += 1
        return Order.NEW_RUN


@final
class SourceClock:
    """Estimates one publisher's clock offset and the delay of its messages, from stamps and arrivals."""

    def __init__(self) -> None:
        self.offset_s = 0.0
        "The clock's lag behind ours."
        self.jitter_s = 0.0
        "RFC 3550's interarrival jitter."
        self.stepped_s = 0.0
        "Forward positive."
        self.steps, self.stepped_at_s = 0, -math.inf
        self.way_s = self._lateness_s = self._leaked_s = 0.0
        self._heard_s: float | None = None
        self._settles_s: float | None = None
        self.line = DeviceClock()

    @property
    def is_settled(self) -> bool:
        return self._settles_s is None

    @property
    def is_wrong(self) -> bool:
        return self.is_settled and not -AHEAD_S <= self.offset_s <= AHEAD_S

    @property
    def hidden_s(self) -> float:
        return self.offset_s if 0.0 < self.offset_s < MAX_LATE_S and not self.steps else 0.0

    def hear(self, now_s: float, lateness_s: float, *, is_continued: bool = True) -> float:
        """Take a message, and return its delay, s."""
        if self._heard_s is None:
            self._begin(now_s, lateness_s)
        else:
            self._follow(now_s, lateness_s, now_s - self._heard_s, is_continued)
        self._heard_s, self._lateness_s = now_s, lateness_s
        self.line.add(now_s, now_s - lateness_s)
        if self._settles_s is not None:
            if now_s < self._settles_s:
                return lateness_s
            self._settle()
        return max(lateness_s - self.offset_s, 0.0)

    def wrong(self, now_s: float, stamp_ns: int) -> str:
        causes = []
        if self.is_wrong and stamp_ns < NEVER_SET_NS:
            causes.append(f"it was never set (it says {time.gmtime(stamp_ns * 1e-9).tm_year}), and is corrected")
        elif self.is_wrong:
            side = "behind" if self.offset_s > 0.0 else "ahead of"
            or_way = " (or its way takes that long)" if self.offset_s > 0.0 and not self.steps else ""
            causes.append(f"it is {abs(self.offset_s):.3f} s {side} this machine's{or_way}, and is corrected")
        if now_s - self.stepped_at_s < STEP_NAMED_S:
            way, often = "forward" if self.stepped_s > 0.0 else "back", f", the last of {self.steps} times"
            causes.append(f"it was set {way} by {abs(self.stepped_s):.3f} s{often if self.steps > 1 else ''}")
        fit = self.line.fit()
        if fit is not None and fit.windows >= SURE_WINDOWS:
            # standard deviation of the slope, ppm, of a line through evenly spaced points
            sd_ppm = fit.residual_us * math.sqrt(12.0 / fit.windows) / (fit.windows * LINE_S)
            if abs(fit.drift_ppm) - 3.0 * sd_ppm > MAX_DRIFT_PPM:
                causes.append(f"it runs {abs(fit.drift_ppm):.0f} ppm {'fast' if fit.drift_ppm > 0.0 else 'slow'}")
        return "; ".join(causes)

    def _begin(self, now_s: float, lateness_s: float) -> None:
        self.offset_s, self.way_s, self._leaked_s, self.jitter_s = lateness_s, 0.0, 0.0, 0.0
        self._settles_s = now_s + SETTLED_S
        self.line = DeviceClock()
        if -AHEAD_S <= lateness_s <= MAX_WAY_S:
            self._settle()

    def _settle(self) -> None:
        self._settles_s = None
        if 0.0 < self.offset_s <= MAX_WAY_S:
            self.offset_s, self.way_s = 0.0, self.offset_s

    def _follow(self, now_s: float, lateness_s: float, gap_s: float, is_continued: bool) -> None:
        rise_s = lateness_s - self._lateness_s
        if not is_continued or gap_s > FORGOTTEN_S:
            above_s = lateness_s - self.offset_s - self.way_s
            if not -STEP_S <= above_s <= MAX_WAY_S:
                self._begin(now_s, lateness_s)
                return
        elif rise_s > gap_s + STEP_S:
            # sent later but stamped earlier, which no delay explains: the way is taken to be as before
            self.offset_s += rise_s
            self._set(now_s, -rise_s)
        else:
            if lateness_s > self.offset_s + self.way_s - STEP_S:  # otherwise the clock was set
                self.jitter_s += JITTER_SHARE * (abs(rise_s) - self.jitter_s)
            leak_s = DRIFT * gap_s
            self.offset_s += leak_s
            self._leaked_s += leak_s
        fall_s = self.offset_s + self.way_s - lateness_s
        if fall_s >= 0.0:
            self._fall(now_s, fall_s)

    def _fall(self, now_s: float, fall_s: float) -> None:
        """Lower offset and way together by `fall_s`: the message was less late than both allow."""
        granted_s = min(fall_s, self._leaked_s)
        self.offset_s -= granted_s
        self._leaked_s -= granted_s
        shorter_s = min(fall_s - granted_s, self.way_s)
        self.way_s -= shorter_s
        ahead_s = fall_s - granted_s - shorter_s
        was_hidden = self.hidden_s > 0.0
        self.offset_s -= ahead_s
        if ahead_s > STEP_S and self.is_settled and not (was_hidden and self.hidden_s > 0.0):
            self._set(now_s, ahead_s)

    def _set(self, now_s: float, by_s: float) -> None:
        self.steps += 1
        self.stepped_s, self.stepped_at_s = by_s, now_s
        self.line = DeviceClock()


class Needs(NamedTuple):
    """The setpoints per second that a scene needs, and how old they may be on arrival."""

    setpoint_hz: float = 1.0 / SLOPE_S
    delay_s: float = MAX_LATE_S


def needs_of(scene: Scene) -> Needs:
    stated = UNSET if scene.signal is None else scene.signal.setpoint_hz
    delay_ms = scene.budget.delay_ms
    return Needs(
        Needs().setpoint_hz if stated is UNSET else stated,
        Needs().delay_s if delay_ms is UNSET else delay_ms * 1e-3,
    )


@final
class Source:
    """One publisher: its newest setpoint was meant at `stamp_s` on our clock."""

    def __init__(self, setpoint: Setpoint) -> None:
        self.setpoint = setpoint
        self.heard_s = self.stamp_s = -math.inf
        self.sequence, self.clock = Sequence(setpoint.session, setpoint.seq), SourceClock()
        self.delays = Histogram()
        self.accepted = self.refused = self.raised = 0
        self.found: dict[Limit, Explanation] = {}
        self.cause = self.remedy = ""
        self._is_named, self._begun = False, NEWER
        self._unit, self._sent_s = "", 0.0
        self._began_s: float | None = None
        self._window: list[tuple[int, float, float]] = []

    def judge(self, setpoint: Setpoint, now_s: float, realtime_ns: int, playout_s: float, needs: Needs) -> Order:
        """Judge a message, and keep it as the newest unless it is a stray."""
        order = NEWER
        if self.heard_s > -math.inf:
            is_over = self.is_stale(now_s)
            order = self.sequence.order(now_s, setpoint.session, setpoint.seq, is_over=is_over)
            if order is STRAY:
                return order
            if order is not NEWER:
                self._begun = order
        self.heard_s = now_s
        self._require_ns(setpoint, realtime_ns)
        lateness_s = (realtime_ns - setpoint.stamp_ns) * 1e-9
        delay_s = self.clock.hear(now_s, lateness_s, is_continued=order is NEWER)
        if not -AHEAD_S <= delay_s <= FAR_S:
            raise MessageError(
                f"stamp_ns is {abs(delay_s):.3f} s {'ahead of' if delay_s < 0.0 else 'behind'} this clock: allowed are "
                f"{AHEAD_S:g} s ahead and {FAR_S:.0f} s behind, until the clock of its source has shown itself"
            )
        self.setpoint, self.stamp_s = setpoint, now_s - max(delay_s, 0.0)
        order, self._begun = self._begun, NEWER
        if order is not NEWER:
            self._began_s, self.found = None, {}
        if self.clock.is_settled:
            self.delays.add(now_s, delay_s * 1e6)
            self._note_manner(now_s, delay_s, playout_s, needs)
        return order

    def is_stale(self, now_s: float) -> bool:
        return now_s - self.stamp_s > self.setpoint.valid_for_ms * 1e-3

    def refresh(self, now_s: float) -> bool:
        """Update the report; return True if something is newly wrong."""
        self.cause = self.remedy = ""
        if self._unit:
            self.cause, self.remedy = f"its stamps count {self._unit}, and are refused", _in_ns(self._unit)
        elif not self.clock.is_settled:
            self.cause = "its stamps are far from this machine's clock: it is watched which of the two it is"
            self.remedy = "wait a moment"
        elif wrong := self.clock.wrong(now_s, self.setpoint.stamp_ns):
            self.cause, self.remedy = f"its clock: {wrong}", "keep the clocks of both machines by chrony or ptp4l"
        was_named, self._is_named = self._is_named, self.clock.is_settled and bool(self.cause)
        return self._is_named and not was_named

    def report(self, now_s: float, state: str) -> SourceReport:
        clock, sequence, is_known = self.clock, self.sequence, self.clock.is_settled and self.stamp_s > -math.inf
        return SourceReport(
            state="stale" if self.is_stale(now_s) else state,
            silent_ms=round((now_s - self.heard_s) * 1e3, 1),
            session=sequence.session,
            seq=sequence.seq,
            accepted=self.accepted,
            refused=self.refused,
            lost=sequence.lost,
            restarts=sequence.restarts,
            delay_us=self.delays.report(),
            jitter_us=round(clock.jitter_s * 1e6, 1),
            clock_behind_ms=round(clock.offset_s * 1e3, 3) if is_known else None,
            clock_steps=clock.steps,
            clock=clock_report(clock.line.fit()),
            cause=self.cause,
            remedy=self.remedy,
            raised=self.raised,
        )

    def _require_ns(self, setpoint: Setpoint, realtime_ns: int) -> None:
        """Raise MessageError if the stamp counts another unit."""
        stamp_ns = setpoint.stamp_ns
        units = () if abs(realtime_ns - stamp_ns) < FAR_S * 1e9 else FACTORS.items()
        near = (unit for unit, factor in units if abs(realtime_ns - stamp_ns * factor) < FAR_S * 1e9)
        self._unit = next(near, "")
        if self._unit:
            raise MessageError(
                f"stamp_ns = {stamp_ns} of {setpoint.source!r} counts {self._unit}: {_in_ns(self._unit)}"
            )

    def _note_manner(self, now_s: float, delay_s: float, playout_s: float, needs: Needs) -> None:
        sent_s, missing = now_s - delay_s, self.sequence.missing
        spacing_s, self._sent_s = (sent_s - self._sent_s) / (1 + missing), sent_s
        if self._began_s is None:
            self._began_s, self._window = now_s, []
            return
        self._window.append((missing, spacing_s, max(delay_s, playout_s)))
        if now_s - self._began_s >= WINDOW_S and len(self._window) >= MIN_MESSAGES:
            self.found = self._judged(playout_s, needs)
            self._began_s, self._window = now_s, []

    def _judged(self, playout_s: float, needs: Needs) -> dict[Limit, Explanation]:
        lost, received, hidden_s = sum([each[0] for each in self._window]), len(self._window), self.clock.hidden_s
        late_s = [each[2] for each in self._window]
        found = {}
        if lost > MAX_LOST * (received + lost):
            found[Limit.SOURCE_LOSS] = Explanation(
                f"{lost / (received + lost):.0%} of its setpoints are lost on the way",
                "look for the lossy part of the network",
            )
        preview_s = len(self.setpoint.preview_N or ()) * (self.setpoint.preview_dt_ms or 0.0) * 1e-3
        most_s, spacings_s = max(SLACK / needs.setpoint_hz, preview_s), [each[1] for each in self._window]
        if 2 * len([each_s for each_s in spacings_s if each_s > most_s]) > received:
            spacing_s = sorted(spacings_s)[(received - 1) // 2]
            found[Limit.SOURCE_SELDOM] = Explanation(
                f"it sends {1.0 / spacing_s:.1f} setpoints a second, and the scene needs {needs.setpoint_hz:g}",
                "send more often, or a preview_N that reaches to the next one",
            )
        mean_s = sum(late_s, 0.0) / len(late_s) + hidden_s
        if mean_s > needs.delay_s:
            is_held = playout_s > 0.0 and playout_s + hidden_s > needs.delay_s
            found[Limit.SOURCE_LATE] = Explanation(
                f"its setpoints are {mean_s * 1e3:.0f} ms late, and the scene allows {needs.delay_s * 1e3:.0f}",
                f"{'lower sources.playout_ms, ' if is_held else ''}take a shorter way, set the clocks by chrony, or "
                "send a preview_N of that length",
            )
        least_s, most_s = min(late_s), max(late_s)
        if most_s - least_s > SPREAD_S:
            playout_ms = math.ceil(most_s * 1e3 / PLAYOUT_STEP_MS) * PLAYOUT_STEP_MS
            found[Limit.SOURCE_JITTER] = Explanation(
                f"its setpoints are {(least_s + hidden_s) * 1e3:.0f} to {(most_s + hidden_s) * 1e3:.0f} ms late",
                f"set sources.playout_ms = {playout_ms}, which delays every setpoint to that, or take a steadier way"
                if playout_ms <= MAX_PLAYOUT_MS
                else "send a preview_N that is longer than that differs, or take a steadier way",
            )
        return found


def _in_ns(unit: str) -> str:
    return f"send ns since 1970 (CLOCK_REALTIME): {FACTORS[unit]} times as much"
