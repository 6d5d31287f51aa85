"""A recording's overview: what pictures, pages and reports show of its whole length, in bounded memory.

Time is cut into stretches of equal width. If there are too many, their width doubles. Each stretch holds the least and
the greatest value of each quantity. The recorder writes the overview at the end of its file. For a file without one, a
reader makes it from the messages in the same way.
"""

import re
from bisect import bisect_right
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, TypedDict

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from tormagd.record.force_following import PERIOD_S, Following
from tormagd_client.messages import FollowingReport, Mark
from tormagd_client.printable import require

Floats = NDArray[np.float64]

QUANTITIES = (
    "setpoint_cf", "governed_cf", "measured_cf", "gap_mm", "gap_setpoint_mm", "left_duty", "right_duty", "field_mT",
)  # fmt: skip
GIVES = (
    "setpoint_cf", "governed_cf", "measured_cf", "left_mm", "right_mm", "reference_gap_mm", "left_duty", "right_duty",
    "field_mT",
)  # fmt: skip
"Columns of a tick that give them."
KINDS = ("operating_state", "limits", "faults")
BREAK_S = 0.1
"Between messages further apart, nothing is known."
BREAK_NS = round(BREAK_S * 1e9)
FIRST_WIDTH_NS = 1_000_000
MAX_STRETCHES = 1_500
MAX_SPANS = 1_000
"Beyond these, each two neighbours of one code are joined."
STEP_NS = 100_000_000
"A wall clock that is set further is said."
MAX_CODES, MAX_MARKS = 66, 1_000
MAX_BYTES = 2_000_000
CODE = re.compile(r"[A-Za-z0-9_.:?-]{1,64}")
ODD = re.compile(r"[^A-Za-z0-9_.:?-]")
OTHER = "OTHER"
"Stands for codes beyond MAX_CODES."
_LOOK_NS = round(PERIOD_S * 1e9)
LATE_US = (10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1_000.0, 2_000.0, 5_000.0)
"Bounds of the bars of the lateness histogram."


Word = Annotated[str, Meta(max_length=4_096)]
Words = Annotated[tuple[Word, ...], Meta(max_length=256)]
Code = Annotated[str, Meta(pattern=rf"\A{CODE.pattern}\Z")]


def glance(*numbers: str, **others: Any) -> Any:
    """Return the type as which a message is decoded: what an overview shows of it, and further fields."""
    fields = {
        **dict.fromkeys((*GIVES, "t_ns", "lateness_us", "handle_mm", "handle_rate_mm_s", *numbers), float | None),
        **dict.fromkeys(("limits", "faults"), Words | None),
        **{"operating_state": Word | None, "mark": Mark | None},
    }
    return TypedDict("Glance", fields | others, total=False)  # type: ignore[operator]


Glance = glance()


class Series(msgspec.Struct, frozen=True):
    """One quantity over time: middle of each stretch in seconds since the start, least and greatest value; all shape
    (n,)."""

    t_s: Floats
    low: Floats
    high: Floats


Span = Annotated[list[int], Meta(min_length=2, max_length=2)]


class Codes(msgspec.Struct):
    """When a code was present, ns since the start; spans may be joined, `held_ns` is the exact total."""

    spans_ns: Annotated[list[Span], Meta(max_length=MAX_SPANS)] = []
    held_ns: int = 0

    def hold(self, from_ns: int, to_ns: int) -> None:
        spans = self.spans_ns
        if spans and from_ns <= spans[-1][1] <= to_ns:
            self.held_ns += to_ns - spans[-1][1]
            spans[-1][1] = to_ns
            return
        self.held_ns += to_ns - from_ns
        if len(spans) == MAX_SPANS:
            self.spans_ns = spans = [[a, b] for (a, _), (_, b) in zip(spans[::2], spans[1::2], strict=True)]
        spans.append([from_ns, to_ns])


class Overview(msgspec.Struct, frozen=True, kw_only=True):
    """A whole recording in bounded size. Its start, end and marks are timed since 1970, the rest since `start_ns`."""

    start_ns: int
    end_ns: int
    width_ns: Annotated[int, Meta(gt=0)]
    ticks: int
    snapshots: int
    stretches: bytes
    "Number of each stretch that has a message: int64, shape (n,)."
    sides: bytes
    "Least and greatest values of QUANTITIES: float32, shape (2, n, 8)."
    codes: dict[str, Annotated[dict[Code, Codes], Meta(max_length=MAX_CODES)]]
    "By kind, then by code in the order of their first appearance."
    following: FollowingReport | None
    followed_s: float
    "`following` is None if this is too short."
    late_counts: Annotated[list[int], Meta(min_length=len(LATE_US) + 1, max_length=len(LATE_US) + 1)]
    marks: Annotated[list[Mark], Meta(max_length=MAX_MARKS)]

    def __post_init__(self) -> None:
        is_even = not len(self.stretches) % 8 and len(self.sides) == len(QUANTITIES) * len(self.stretches)
        require(is_even, "stretches and sides", len(self.sides), "curves of equal length")
        require(set(self.codes) == set(KINDS), "codes", list(self.codes)[:4], ", ".join(KINDS))

    @property
    def duration_s(self) -> float:
        return (self.end_ns - self.start_ns) * 1e-9

    def require_messages(self) -> None:
        if not self.ticks:
            raise ValueError("the recording has no control ticks: was the daemon running?")

    def series(self, name: str) -> Series | None:
        """Return one of QUANTITIES; None where it was never known."""
        sides = np.frombuffer(self.sides, np.float32).reshape(2, -1, len(QUANTITIES))
        low, high = np.array(sides[:, :, QUANTITIES.index(name)], np.float64)
        if not np.isfinite(low).any():
            return None
        middles = np.frombuffer(self.stretches, np.int64) + np.float64(0.5)
        return Series(np.array(middles * (self.width_ns * 1e-9), np.float64), low, high)

    def spans_s(self, kind: str) -> dict[str, list[tuple[float, float]]]:
        """Return the spans of each code of this kind, seconds since the start."""
        known = self.codes.get(kind, {})
        return {code: [(a * 1e-9, b * 1e-9) for a, b in each.spans_ns] for code, each in known.items()}


def unpacked(data: bytes) -> Overview:
    require(len(data) <= MAX_BYTES, "its overview", len(data), f"{MAX_BYTES} bytes")
    try:
        return msgspec.msgpack.decode(data, type=Overview)
    except (msgspec.MsgspecError, RecursionError) as error:
        raise ValueError(f"its overview: {error}") from error


class OverviewBuilder:
    def __init__(self) -> None:
        self._start_ns: int | None = None
        self._end_ns = 0
        self._ticks = self._snapshots = 0
        self._stretches, self._codes, self._following = _Stretches(), _Codes(), _Followed()
        self._late = [0] * (len(LATE_US) + 1)
        self._marks: list[Mark] = []
        self._mark: Mark | None = None
        self._ahead_ns = 0

    def add(self, t_ns: int, is_tick: bool, message: Mapping[str, Any]) -> bool:
        """Add a control tick or a snapshot, in the order of writing, and return whether it has a new mark; `t_ns` is
        since 1970, as `Derived` places it."""
        if self._start_ns is None:
            self._start_ns = t_ns
        self._end_ns = max(self._end_ns, t_ns)
        if is_tick:
            self._ticks += 1
            self._add_tick(t_ns - self._start_ns, t_ns, message)
            return False
        self._snapshots += 1
        mark = message.get("mark")
        if not mark or mark == self._mark:  # every snapshot has the newest
            return False
        self._mark = mark
        return self._add_mark(Mark(t_ns=mark.t_ns - self._ahead_ns, text=mark.text))

    def _add_tick(self, since_ns: int, t_ns: int, tick: Mapping[str, Any]) -> None:
        values = quantities(tick)
        self._stretches.add(since_ns, values)
        self._codes.add(since_ns, tick)
        self._following.add(since_ns, values[0], values[2], tick)
        late_us, wall_ns = _number(tick.get("lateness_us")), _number(tick.get("t_ns"))
        if late_us is not None:
            self._late[bisect_right(LATE_US, late_us)] += 1
        step_ns = 0 if wall_ns is None else round(wall_ns) - t_ns - self._ahead_ns
        if abs(step_ns) > STEP_NS:
            self._ahead_ns += step_ns
            self._add_mark(Mark(t_ns=t_ns, text=f"the clock stepped by {step_ns * 1e-9:+.6g} s"))

    def _add_mark(self, mark: Mark) -> bool:
        """Add a mark, and return whether it is of this recording: the newest one may be from before."""
        is_within = mark.t_ns >= (self._start_ns or 0) and len(self._marks) < MAX_MARKS
        if is_within:
            self._marks.append(mark)
        return is_within

    def made(self) -> Overview:
        stretches, sides = self._stretches.made()
        return Overview(
            start_ns=self._start_ns or 0,
            end_ns=self._end_ns,
            width_ns=self._stretches.width_ns,
            ticks=self._ticks,
            snapshots=self._snapshots,
            stretches=stretches,
            sides=sides,
            codes=self._codes.made(),
            following=self._following.report(),
            followed_s=self._following.counted_s,
            late_counts=self._late,
            marks=self._marks,
        )


def quantities(tick: Mapping[str, Any]) -> tuple[float | None, ...]:
    """Return the QUANTITIES of a tick; None for what is missing or no number."""
    asked_N, governed_N, measured_N, left_mm, right_mm, *others = [_number(tick.get(name)) for name in GIVES]
    gap_mm = None if left_mm is None or right_mm is None else left_mm + right_mm
    return asked_N, governed_N, measured_N, gap_mm, *others


def _number(value: object) -> float | None:
    return value if value.__class__ is float or value.__class__ is int else None


def codes_in(told: object) -> tuple[str, ...]:
    """Return the codes in a field's value, a text or several."""
    words = (told,) if isinstance(told, str) else told if isinstance(told, tuple | list) else ()
    return tuple(word if CODE.fullmatch(word) else ODD.sub("?", word[:64]) or "?" for word in map(str, words))


class _Followed(Following):
    _number = 0

    def add(self, since_ns: int, asked_N: float | None, measured_N: float | None, message: Mapping[str, Any]) -> None:
        number = since_ns // _LOOK_NS
        if number == self._number:
            return
        if not 0 < number - self._number <= BREAK_NS // _LOOK_NS:
            self.begin()
        self._number, get = number, message.get
        limits = get("limits") or ()
        self.look(get("operating_state"), limits, asked_N, measured_N, get("handle_mm"), get("handle_rate_mm_s"))


class _Stretches:
    """The least and greatest values of the ticks, in stretches of `width_ns`; NaN where there is none."""

    def __init__(self) -> None:
        self.width_ns = FIRST_WIDTH_NS
        self._numbers: list[int] = []
        self._sides = np.full((2, MAX_STRETCHES, len(QUANTITIES)), np.nan)

    def add(self, since_ns: int, values: Iterable[float | None]) -> None:
        while len(self._numbers) == MAX_STRETCHES:
            self._widen()
        number = since_ns // self.width_ns
        # a clock that was set back must not set the curve back
        if not self._numbers or number > self._numbers[-1]:
            self._numbers.append(number)
        known = np.array(values, np.float64)
        for side, of in zip(self._sides[:, len(self._numbers) - 1], (np.fmin, np.fmax), strict=True):
            of(side, known, out=side)

    def _widen(self) -> None:
        self.width_ns *= 2
        numbers, firsts = np.unique(np.array(self._numbers) // 2, return_index=True)
        known, self._numbers = self._sides[:, : len(self._numbers)].copy(), numbers.tolist()
        self._sides[:] = np.nan
        for side, kept, of in zip(self._sides, known, (np.fmin, np.fmax), strict=True):
            side[: len(firsts)] = of.reduceat(kept, firsts, axis=0)

    def made(self) -> tuple[bytes, bytes]:
        """Return the stretches' numbers, and their values."""
        with np.errstate(over="ignore"):  # a file may say any number
            sides = self._sides[:, : len(self._numbers)].astype(np.float32)
        return np.array(self._numbers, np.int64).tobytes(), sides.tobytes()


class _Codes:
    def __init__(self) -> None:
        self._known: dict[str, dict[str, Codes]] = {kind: {} for kind in KINDS}
        self._now: list[tuple[str, str]] = []
        self._now_ns = self._step_ns = 0

    def add(self, since_ns: int, message: Mapping[str, Any]) -> None:
        """Hold the last message's codes up to this one, or over a break for one usual step; then take this one's."""
        passed_ns = since_ns - self._now_ns
        if 0 < passed_ns <= BREAK_NS:
            self._step_ns = passed_ns
        self._hold(min(max(passed_ns, 0), self._step_ns))
        self._now = [(kind, code) for kind in KINDS if (told := message.get(kind)) for code in codes_in(told)]
        self._now_ns = since_ns

    def _hold(self, for_ns: int) -> None:
        for kind, code in self._now:
            known = self._known[kind]
            is_kept = code in known or len(known) < MAX_CODES - 1
            known.setdefault(code if is_kept else OTHER, Codes()).hold(self._now_ns, self._now_ns + for_ns)

    def made(self) -> dict[str, dict[str, Codes]]:
        """Hold the last codes for one usual step, and return all spans by kind and code."""
        self._hold(self._step_ns)
        self._now = []
        return self._known
