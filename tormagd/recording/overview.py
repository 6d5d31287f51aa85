"""A recording at a glance: what pictures, pages and reports show of all of it, in bounded memory.

Time is cut into stretches of one width, which doubles when there are too many; of each stretch there is the least and
the greatest value of each quantity. The recorder writes it at the end of its file. Of a file without one it is made
anew, by the same steps, from the same messages.
"""

import math
import re
from array import array
from bisect import bisect_right
from collections.abc import Iterable, Mapping
from itertools import pairwise
from typing import Annotated, Any, TypedDict

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from tormagd.recording.following import Following, FollowingReport
from tormagd_client.messages import Mark

Floats = NDArray[np.float64]

QUANTITIES = (
    "setpoint_cf", "governed_cf", "measured_cf", "gap_mm", "gap_setpoint_mm", "left_duty", "right_duty", "field_mT",
)  # fmt: skip
KINDS = ("operating_state", "limits", "faults")
"Fields that hold codes."
BREAK_S = 0.1
"Messages further apart than this do not belong together: nothing is known between them."
BREAK_NS = round(BREAK_S * 1e9)
FIRST_WIDTH_NS = 1_000_000
MOST_STRETCHES = 1_500
MOST_SPANS = 1_000
"Of one code: where there are more, those nearest to each other are drawn as one."
MOST_CODES, MOST_MARKS = 200, 1_000
MOST_BYTES = 2_000_000
CODE = re.compile(r"[A-Za-z0-9_.:?-]{1,64}")
ODD = re.compile(r"[^A-Za-z0-9_.:?-]")
OTHER = "OTHER"
"Stands for codes beyond MOST_CODES."
LATE_US = (10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1_000.0, 2_000.0, 5_000.0)
"Where one bar of the lateness histogram ends and the next begins."


Word = Annotated[str, Meta(max_length=4_096)]
Words = Annotated[tuple[Word, ...], Meta(max_length=256)]


class Glance(TypedDict, total=False):
    """What an overview takes of a message, a control tick's or a snapshot's."""

    setpoint_cf: float | None
    governed_cf: float | None
    measured_cf: float | None
    field_mT: float | None
    gap_mm: float | None
    gap_setpoint_mm: float | None
    left_mm: float | None
    right_mm: float | None
    reference_gap_mm: float | None
    left_duty: float | None
    right_duty: float | None
    duty: tuple[float, float] | None
    operating_state: Word | None
    limits: Words | None
    faults: Words | None
    lateness_us: float | None
    mark: Mark | None


class Curves(msgspec.Struct, frozen=True):
    """Stretches with a message in them, as bytes: their numbers (int64), and of each quantity the least and greatest
    values (float32, NaN where none is known)."""

    stretches: bytes
    low: dict[str, bytes]
    high: dict[str, bytes]


class Series(msgspec.Struct, frozen=True):
    """One quantity over time since the recording's start, in the middle of each stretch; shapes (n,) all."""

    t_s: Floats
    low: Floats
    high: Floats


class Codes(msgspec.Struct, frozen=True):
    """When a code was there: from, to, ns since the start; and for how long in all, which spans may overstate."""

    spans_ns: list[tuple[int, int]]
    held_ns: int


class Overview(msgspec.Struct, frozen=True, kw_only=True):
    """All of a recording; times are ns since 1970, or since `start_ns`."""

    start_ns: int
    end_ns: int
    width_ns: int
    ticks: int
    snapshots: int
    of_ticks: Curves
    of_snapshots: Curves
    codes: dict[str, dict[str, Codes]]
    "By kind, then by code in the order of their first appearance."
    following: FollowingReport
    late_counts: list[int]
    marks: list[Mark]

    @property
    def duration_s(self) -> float:
        """From the first message to the last."""
        return (self.end_ns - self.start_ns) * 1e-9

    def series(self, name: str) -> Series | None:
        """The quantity `name`, from the ticks or else from the snapshots; None where neither has a known value."""
        for curves in (self.of_ticks, self.of_snapshots):
            if name in curves.low:
                low, high = _numbers(curves.low[name]), _numbers(curves.high[name])
                if np.isfinite(low).any():
                    numbers = np.frombuffer(curves.stretches, np.int64)
                    return Series(np.array((numbers + 0.5) * (self.width_ns * 1e-9), np.float64), low, high)
        return None

    def spans_s(self, kind: str) -> dict[str, list[tuple[float, float]]]:
        """By code of this kind the stretches of time in which it was there, s since the start."""
        known = self.codes.get(kind, {})
        return {code: [(a * 1e-9, b * 1e-9) for a, b in each.spans_ns] for code, each in known.items()}

    def packed(self) -> bytes:
        """As it stands in a file."""
        return msgspec.msgpack.encode(self)


def unpacked(data: bytes) -> Overview:
    """The overview that a file has. Raises ValueError for what is none."""
    if len(data) > MOST_BYTES:
        raise ValueError(f"an overview of {len(data)} bytes: allowed is {MOST_BYTES}")
    try:
        found = msgspec.msgpack.decode(data, type=Overview)
    except (msgspec.MsgspecError, RecursionError) as error:
        raise ValueError(f"its overview: {error}") from error
    for curves in (found.of_ticks, found.of_snapshots):
        count = len(curves.stretches) // 8
        sizes = {len(side) for sides in (curves.low, curves.high) for side in sides.values()}
        if len(curves.stretches) % 8 or not sizes <= {4 * count} or set(curves.low) != set(curves.high):
            raise ValueError("its overview: curves of unequal length")
    names = [code for kind in found.codes.values() for code in kind]
    longest = max((len(codes.spans_ns) for kind in found.codes.values() for codes in kind.values()), default=0)
    bounds = len(names) <= MOST_CODES, longest <= MOST_SPANS, len(found.marks) <= MOST_MARKS
    forms = set(found.codes) == set(KINDS), len(found.late_counts) == len(LATE_US) + 1, found.width_ns > 0
    if not (all(bounds) and all(forms) and all(map(CODE.fullmatch, names))):
        raise ValueError("its overview: there is more in it than any tormagd writes, or other things")
    return found


class OverviewBuilder:
    """An overview on its way."""

    def __init__(self) -> None:
        self._start_ns: int | None = None
        self._end_ns = 0
        self._stretches = {True: _Stretches(), False: _Stretches()}
        self._spans = {True: _Codes(), False: _Codes()}
        self._following = {True: Following(), False: Following()}
        self._counts = {True: 0, False: 0}
        self._late = [0] * (len(LATE_US) + 1)
        self._marks: list[Mark] = []

    def add(self, t_ns: int, is_tick: bool, message: Mapping[str, Any]) -> None:
        """One message, in the order in which they were written."""
        if self._start_ns is None:
            self._start_ns = self._end_ns = t_ns
        since_ns = t_ns - self._start_ns
        self._end_ns = max(self._end_ns, t_ns)
        self._counts[is_tick] += 1
        values = quantities(message)
        self._stretches[is_tick].add(since_ns, values)
        self._spans[is_tick].add(since_ns, message)
        self._following[is_tick].add(since_ns, values[0], values[2], message)
        late_us = _number(message.get("lateness_us"))
        if late_us is not None:
            self._late[bisect_right(LATE_US, late_us)] += 1
        mark = message.get("mark")
        # every snapshot tells the newest, also one from before
        if mark and mark.t_ns >= self._start_ns and len(self._marks) < MOST_MARKS and self._marks[-1:] != [mark]:
            self._marks.append(mark)

    def made(self) -> Overview:
        """What is known so far."""
        width_ns = max(each.width_ns for each in self._stretches.values())
        for each in self._stretches.values():
            each.widen(width_ns)
        ticks, snapshots = self._spans[True].made(), self._spans[False].made()
        return Overview(
            start_ns=self._start_ns or 0,
            end_ns=self._end_ns,
            width_ns=width_ns,
            ticks=self._counts[True],
            snapshots=self._counts[False],
            of_ticks=self._stretches[True].made(),
            of_snapshots=self._stretches[False].made(),
            codes={kind: ticks[kind] or snapshots[kind] for kind in KINDS},
            following=self._following[True].made() or self._following[False].made() or FollowingReport(),
            late_counts=self._late,
            marks=self._marks,
        )


def quantities(message: Mapping[str, Any]) -> tuple[float | None, ...]:
    """QUANTITIES of a message, as ticks or snapshots spell them."""
    get = message.get
    gap_mm, left_mm, right_mm = _number(get("gap_mm")), _number(get("left_mm")), _number(get("right_mm"))
    if gap_mm is None and left_mm is not None and right_mm is not None:
        gap_mm = left_mm + right_mm
    wanted_mm = _number(get("gap_setpoint_mm"))
    left, right = get("duty") or (get("left_duty"), get("right_duty"))
    return (
        _number(get("setpoint_cf")),
        _number(get("governed_cf")),
        _number(get("measured_cf")),
        gap_mm,
        _number(get("reference_gap_mm")) if wanted_mm is None else wanted_mm,
        _number(left),
        _number(right),
        _number(get("field_mT")),
    )


def _number(value: object) -> float | None:
    return value if value.__class__ is float or value.__class__ is int else None


def codes_of(message: Mapping[str, Any], kind: str) -> tuple[str, ...]:
    """A message's codes of this kind."""
    return _codes(message.get(kind))


def _codes(told: object) -> tuple[str, ...]:
    """The codes that a field tells, in characters that every picture can show."""
    words = (told,) if isinstance(told, str) else told if isinstance(told, tuple | list) else ()
    return tuple(word if CODE.fullmatch(word) else ODD.sub("?", word[:64]) or "?" for word in map(str, words))


def _numbers(data: bytes) -> Floats:
    return np.array(np.frombuffer(data, np.float32), np.float64)


class _Stretches:
    """The curves of one kind of message."""

    def __init__(self) -> None:
        self.width_ns = FIRST_WIDTH_NS
        self._numbers = array("q")
        self._low = [array("f") for _ in QUANTITIES]
        self._high = [array("f") for _ in QUANTITIES]

    def add(self, since_ns: int, values: Iterable[float | None]) -> None:
        number = since_ns // self.width_ns
        # a clock that was set back does not set the curve back
        if not self._numbers or number > self._numbers[-1]:
            if len(self._numbers) >= MOST_STRETCHES:
                self.widen(2 * self.width_ns)
                self.add(since_ns, values)
                return
            self._numbers.append(number)
            for low, high in zip(self._low, self._high, strict=True):
                low.append(math.inf)
                high.append(-math.inf)
        for value, low, high in zip(values, self._low, self._high, strict=True):
            if value is not None:
                if value < low[-1]:
                    low[-1] = value
                if value > high[-1]:
                    high[-1] = value

    def widen(self, width_ns: int) -> None:
        """To this width, which is some powers of two of the present one."""
        ratio, self.width_ns = width_ns // self.width_ns, width_ns
        if ratio == 1 or not self._numbers:
            return
        numbers = [number // ratio for number in self._numbers]
        firsts = [i for i, number in enumerate(numbers) if i == 0 or number != numbers[i - 1]]
        ends = [*firsts[1:], len(numbers)]
        self._numbers = array("q", [numbers[i] for i in firsts])
        for sides, of in ((self._low, min), (self._high, max)):
            for i, side in enumerate(sides):
                sides[i] = array("f", [of(side[a:b]) for a, b in zip(firsts, ends, strict=True)])

    def made(self) -> Curves:
        sides: tuple[dict[str, bytes], dict[str, bytes]] = ({}, {})
        for known, arrays in zip(sides, (self._low, self._high), strict=True):
            for name, side in zip(QUANTITIES, arrays, strict=True):
                values = np.array(side, np.float32)
                known[name] = np.where(np.isfinite(values), values, np.float32(np.nan)).tobytes()
        return Curves(self._numbers.tobytes(), *sides)


def _joined(spans: list[list[int]]) -> list[list[int]]:
    """Fewer spans: those that lie nearest to each other are one; the last stays."""
    gaps = [after[0] - before[1] for before, after in pairwise(spans[:-1])]
    near_ns, joined = sorted(gaps)[len(gaps) // 2], [spans[0]]
    for span, gap_ns in zip(spans[1:-1], gaps, strict=True):
        if gap_ns <= near_ns:
            joined[-1][1] = span[1]
        else:
            joined.append(span)
    return [*joined, spans[-1]]


class _Codes:
    """The codes of one kind of message, and when each was there."""

    def __init__(self) -> None:
        self._known: dict[str, dict[str, list[list[int]]]] = {kind: {} for kind in KINDS}
        self._held: dict[tuple[str, str], int] = {}
        self._last: dict[str, tuple[str, ...]] = dict.fromkeys(KINDS, ())
        self._last_ns: int | None = None
        self._step_ns = 0

    def add(self, since_ns: int, message: Mapping[str, Any]) -> None:
        passed_ns = 0 if self._last_ns is None else since_ns - self._last_ns
        if 0 < passed_ns <= BREAK_NS:
            self._step_ns = passed_ns
        else:
            passed_ns = min(max(passed_ns, 0), self._step_ns)
        before_ns = since_ns if self._last_ns is None else self._last_ns
        for kind in KINDS:
            self._extend(kind, before_ns + passed_ns, passed_ns)
            told = message.get(kind)
            if told or self._last[kind]:
                self._begin(kind, since_ns, _codes(told))
        self._last_ns = since_ns

    def _extend(self, kind: str, to_ns: int, by_ns: int) -> None:
        known = self._known[kind]
        for code in self._last[kind]:
            known[code][-1][1] = to_ns
            self._held[kind, code] += by_ns

    def _begin(self, kind: str, since_ns: int, codes: tuple[str, ...]) -> None:
        known = self._known[kind]
        if len(known) >= MOST_CODES // len(KINDS) - 1:
            codes = tuple(code if code in known else OTHER for code in codes)
        for code in codes:
            spans = known.setdefault(code, [])
            self._held.setdefault((kind, code), 0)
            # what goes on from the last message is one
            if not spans or code not in self._last[kind] or spans[-1][1] != since_ns:
                spans.append([since_ns, since_ns])
                if len(spans) > MOST_SPANS:
                    known[code] = _joined(spans)
        self._last[kind] = codes

    def made(self) -> dict[str, dict[str, Codes]]:
        for kind in KINDS:
            if self._last_ns is not None:
                self._extend(kind, self._last_ns + self._step_ns, self._step_ns)
            self._last[kind] = ()
        return {
            kind: {code: Codes([(a, b) for a, b in spans], self._held[kind, code]) for code, spans in known.items()}
            for kind, known in self._known.items()
        }
