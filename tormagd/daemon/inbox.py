"""The inbox: chooses the setpoint to plan for among those of several publishers, and hands it on when it is due.

Each message is judged once, by its `Source`. A source holds the brake until it is stale, one of higher priority sends,
or an operator gives the brake away. With `sources.playout_ms` every setpoint waits until that long after its stamp,
which removes the jitter of its way. Times are arguments.
"""

import logging
import shlex
from collections import deque
from typing import NamedTuple

import msgspec

from tormagd.config import Sources
from tormagd.control.records import TimedSetpoint, Wall
from tormagd.control.safety.codes import Explanation, Limit
from tormagd.control.safety.operating_state import RefusedError
from tormagd.daemon.rate_group import Histogram
from tormagd.daemon.source import JITTER_SHARE, NEWER, STRAY, Needs, Source, needs_of
from tormagd.scenes.scene import Scene
from tormagd_client.messages import MessageError, PlayoutReport, Setpoint, SetpointReport, decode

SOURCES = 16
"One more publisher is refused until another has fallen silent."
SILENT_S = 1.0
"After this silence a source makes room for another."
LONGEST_REFUSAL = 200
REPORTED = 6
"An answer has limited length: the newest sources are reported in full."
NEWS, NEWS_S = 4, 1.0
MAX_WAITING = 1_024
"What one publisher may send in the longest playout."

EQUAL_SOURCES = Sources()

log = logging.getLogger(__name__)


class Taken(NamedTuple):
    """An accepted setpoint, and when its publisher meant it, `stamp_s`."""

    setpoint: TimedSetpoint
    source: str
    seq: int
    stamp_s: float
    is_raised: bool = False
    "A force around zero was taken as 0."


class SetpointInbox:
    """Chooses the newest valid setpoint of the `holder` of the brake, once it is due."""

    def __init__(self, sources: Sources = EQUAL_SOURCES) -> None:
        self.has_way = True
        "A brake's handle goes either way, a pad's does not."
        self.accepted = self.refused = self.dropped = 0
        self.last_refusal: str | None = None
        self.holder = ""
        self.in_force: Taken | None = None
        "The newest setpoint that is due."
        self.sources = sources
        self._needs = Needs()
        self._number, self._is_given = 0, False
        """`_number` grows with every change of the publisher, also of the process behind one source: a ramp leads from
        one to the other."""
        self._sources: dict[str, Source] = {}
        self._waiting: deque[Taken] = deque(maxlen=MAX_WAITING)
        self._held = Histogram()
        self._played = self._late = 0
        self._held_s = self._jitter_s = 0.0
        self._other, self._other_s = "", -SILENT_S
        "The source last refused because another one holds the brake, and when."
        self._news: deque[str] = deque(maxlen=NEWS)
        self._told_s, self._turn = -NEWS_S, 0

    def take(self, data: bytes, now_s: float, realtime_ns: int, key: str = "") -> bool:
        """Take one message; return True if another setpoint is in force after it."""
        try:
            setpoint = decode(data, Setpoint)
            if key not in (allowed := self.sources.keys.get(setpoint.source, (key,))):
                raise MessageError(
                    f"source {setpoint.source!r} from the key {key}: allowed by sources.keys is {', '.join(allowed)}"
                )
            if not self.has_way:
                _refuse_way(setpoint)
            name = setpoint.source
            source = self._sources.get(name) or self._add(setpoint, now_s)
            order = source.judge(setpoint, now_s, realtime_ns, self.sources.playout_ms * 1e-3, self._needs)
        except MessageError as error:
            self._refuse(str(error))
            return False
        if order is STRAY:
            self.dropped += 1
            return False
        if name != self.holder:
            taken = self._waiting[-1] if self._waiting else self.in_force
            is_free = taken is None or now_s - taken.setpoint.stamp_s > taken.setpoint.valid_for_s
            goes_before = not self._is_given and self._rank(name) < self._rank(self.holder)
            if self.holder and (source.is_stale(now_s) or not (is_free or goes_before)):
                self._other, self._other_s = name, now_s
                source.refused += 1
                self.refused += 1
                return False
            self._hand_over(name, "that is stale" if is_free else "it goes before that")
        elif order is not NEWER:
            self._number += 1  # another process sends as this source now
        source.accepted += 1
        self.accepted += 1
        return self._follow(source, now_s)

    def give(self, name: str, now_s: float) -> None:
        """Give the brake to the source `name`, as an operator's choice."""
        source = self._sources.get(name)
        if source is None:
            known = ", ".join(sorted(self._sources)) or "none"
            raise RefusedError("unknown_source", f"no source {name!r} has sent setpoints", f"known: {known}"[:200])
        if source.is_stale(now_s):
            raise RefusedError(
                "source_stale", f"source {name!r} has sent nothing that is still valid", "let it send, then take again"
            )
        if name != self.holder:
            self._hand_over(name, "an operator's choice")
            self._follow(source, now_s)
        self._is_given = True

    @property
    def newest(self) -> TimedSetpoint | None:
        return None if self.in_force is None else self.in_force.setpoint

    def hand_on(self, now_s: float) -> bool:
        """Put the newest setpoint that is due in force."""
        before = self.in_force
        while self._waiting and self._waiting[0].setpoint.stamp_s <= now_s:
            self.in_force = self._waiting.popleft()
        return self.in_force is not before

    def passed_over(self) -> tuple[str, int] | None:
        """Return the source last refused because another one holds the brake, and its newest `seq`."""
        other = self._sources.get(self._other)
        return None if other is None or self._other_s <= -SILENT_S else (self._other, other.setpoint.seq)

    def begin_scene(self, scene: Scene) -> None:
        self._forget()
        self.has_way, self._needs = scene.element == "torque", needs_of(scene)

    def withdraw(self, reason: str) -> None:
        """Forget all setpoints, and count one as refused for `reason`."""
        if self.in_force is not None:
            self._forget()
            self._refuse(reason)

    def tell(self, now_s: float) -> None:
        if self._news and now_s - self._told_s >= NEWS_S:
            self._told_s = now_s
            log.warning("%s", self._news.popleft())

    def told(self, now_s: float) -> dict[Limit, Explanation]:
        """Return explanations of the limits about sources, also of those that are not in force."""
        holder = self._sources.get(self.holder)
        if holder is None:
            return {}
        why = {Limit.STALE: self._why_stale(holder, now_s), Limit.OTHER_SOURCE: self._why_other(holder, now_s)}
        return why | holder.found

    def refresh(self, now_s: float) -> None:
        if self._sources:
            self._turn += 1
            source = tuple(self._sources.values())[self._turn % len(self._sources)]
            if source.refresh(now_s):
                self._news.append(f"source {source.setpoint.source!r}: {source.cause}: {source.remedy}")

    def report(self, now_s: float) -> SetpointReport:
        newest = sorted(self._sources, key=lambda name: (name != self.holder, -self._sources[name].heard_s))
        reported = {name: "holds" if name == self.holder else "refused" for name in newest[:REPORTED]}
        playout_ms = self.sources.playout_ms
        return SetpointReport(
            accepted=self.accepted,
            refused=self.refused,
            dropped=self.dropped,
            last_refusal=self.last_refusal,
            newest_source=self.holder,
            sources={name: source.sequence.seq for name, source in self._sources.items()},
            by_source={name: self._sources[name].report(now_s, state) for name, state in reported.items()},
            playout=None
            if playout_ms == 0.0
            else PlayoutReport(
                playout_ms=playout_ms,
                held_us=self._held.report(),
                jitter_us=round(self._jitter_s * 1e6, 1),
                setpoints=self._played,
                late=self._late,
            ),
        )

    def _follow(self, source: Source, now_s: float) -> bool:
        """Let the source's newest setpoint wait until it is due."""
        setpoint, playout_s, wall = source.setpoint, self.sources.playout_ms * 1e-3, source.setpoint.contact
        is_contested = now_s - self._other_s < SILENT_S or source.sequence.is_doubled(now_s)
        others = (Limit.OTHER_SOURCE,) if is_contested else ()
        due_s = source.stamp_s + playout_s
        servo_cf, withdraw_cf, preview_N, is_raised = _from_zero(setpoint)
        source.raised += is_raised
        timed = TimedSetpoint(
            servo_cf,
            due_s,
            setpoint.valid_for_ms * 1e-3 - playout_s,
            setpoint.displacement_mm,
            setpoint.rate_mm_s,
            preview_N,
            (setpoint.preview_dt_ms or 0.0) * 1e-3,
            self._number,
            (*others, *source.found),
            withdraw_cf,
            None if wall is None else Wall(*msgspec.structs.astuple(wall)),
        )
        if playout_s > 0.0:
            held_s = max(due_s - now_s, 0.0)
            self._held.add(now_s, held_s * 1e6)
            if self._played:
                self._jitter_s += JITTER_SHARE * (abs(held_s - self._held_s) - self._jitter_s)
            self._held_s = held_s
            self._played += 1
            self._late += due_s < now_s
        while self._waiting and self._waiting[-1].setpoint.stamp_s >= due_s:
            self._waiting.pop()
        self._waiting.append(Taken(timed, setpoint.source, setpoint.seq, source.stamp_s, is_raised))
        return self.hand_on(now_s)

    def _hand_over(self, name: str, why: str) -> None:
        if self.holder:
            self._news.append(f"source {name!r} holds the brake instead of {self.holder!r}: {why}")
            self._number += 1
        self.holder, self._is_given = name, False
        if self._other == name:
            self._other_s = -SILENT_S

    def _rank(self, name: str) -> int:
        listed = self.sources.priority
        return listed.index(name) if name in listed else len(listed)

    def _refuse(self, reason: str) -> None:
        self.refused += 1
        self.last_refusal = reason[:LONGEST_REFUSAL]

    def _forget(self) -> None:
        self.in_force = None
        self._waiting.clear()

    def _add(self, setpoint: Setpoint, now_s: float) -> Source:
        """Add the source of `setpoint`, in the place of a silent or unlisted one."""
        name = setpoint.source
        if len(self._sources) >= SOURCES:
            others = [source for other, source in self._sources.items() if other != self.holder]
            silent = [source for source in others if now_s - source.heard_s > SILENT_S]
            listed = self.sources.priority
            unlisted = [source for source in others if source.setpoint.source not in listed]
            may_go = silent or (unlisted if name in listed else [])
            if not may_go:
                raise MessageError(f"source = {name!r}: allowed are {SOURCES} publishers at a time")
            oldest = min(may_go, key=lambda source: source.heard_s)
            del self._sources[oldest.setpoint.source]
        source = self._sources[name] = Source(setpoint)
        return source

    def _why_stale(self, holder: Source, now_s: float) -> Explanation:
        name, silent_ms = self.holder, (now_s - holder.heard_s) * 1e3
        valid_ms = holder.setpoint.valid_for_ms
        if silent_ms > valid_ms:
            silent = f"{silent_ms:.0f} ms" if silent_ms < 1e4 else f"{silent_ms * 1e-3:.0f} s"
            return Explanation(
                f"{name!r} has sent nothing for {silent}, and its setpoints are valid for {valid_ms:g} ms; "
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

    def _why_other(self, holder: Source, now_s: float) -> Explanation:
        if holder.sequence.is_doubled(now_s):
            return Explanation(
                f"two publishers call themselves {self.holder!r}, or one repeats itself: one of them is followed",
                "end one of them, or let it use another `source`",
            )
        return Explanation(
            f"{self._other!r} sends setpoints too, and {self.holder!r} holds the brake",
            f"end the other one, or give it the brake: tormagctl take {shlex.quote(self._other)}",
        )


def _refuse_way(setpoint: Setpoint) -> None:
    """Raise MessageError for a setpoint that only a brake can follow: the element is a pad."""
    for name in ("withdraw_cf", "contact"):
        if getattr(setpoint, name) is not None:
            raise MessageError(f"{name}: allowed is servo_cf alone, as the scene's element is a pad")


def _from_zero(setpoint: Setpoint) -> tuple[float, float | None, tuple[float, ...], bool]:
    """Return the forces of a setpoint, 0 for those around zero, and whether one was below it."""
    withdraw, preview_N = setpoint.withdraw_cf, setpoint.preview_N or ()
    is_raised = min((setpoint.servo_cf, withdraw or 0.0, *preview_N)) < 0.0
    # 0.0 stands first: of 0.0 and -0.0, max takes the first
    servo_cf, withdraw_cf = max(0.0, setpoint.servo_cf), None if withdraw is None else max(0.0, withdraw)
    return servo_cf, withdraw_cf, tuple([max(0.0, force_N) for force_N in preview_N]), is_raised
