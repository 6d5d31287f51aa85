"""A course asks a device for something tick after tick, and says what it showed. It has no clock and does no I/O.

A course is a generator: it yields what to ask for, is sent what was heard since, and returns what it found. Time comes
with what it hears, so virtual time and a live device run the same courses.
"""

import math
from collections.abc import Callable, Generator, Iterable, Sequence
from typing import Any, NamedTuple, Protocol, TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt

from tormagd.commission.finding import Finding
from tormagd.config import Config
from tormagd.control.safety.codes import FAULTS, Fault

Columns: TypeAlias = dict[str, npt.NDArray[Any]]
Row: TypeAlias = Sequence[Any]
"One control tick: a value for each of COLUMNS."
Found = TypeVar("Found")

NUMBERS = (
    "monotonic_s",
    "predicted_cf",
    "trim",
    "link_unanswered",
    "link_damaged",
    "link_round_trip_s",
    "device_clock_drift",
    "device_time_s",
    "device_left_mm",
    "device_right_mm",
    "device_handle_mm",
    "device_force_N",
    "device_temperature_C",
    "left_current_A",
    "right_current_A",
    "supply_V",
    "reference_gap_mm",
    "measured_cf",
    "left_mm",
    "right_mm",
    "handle_mm",
    "handle_rate_mm_s",
    "left_duty",
    "right_duty",
)
WORDS = ("operating_state", "device_mode", "device_switches", "faults")
COLUMNS = (*NUMBERS, *WORDS)
PLACES = {name: place for place, name in enumerate(COLUMNS)}

PREVIEW_STEP_S, PREVIEW_STEPS = 0.02, 15
"Spacing and number of the forces that are told ahead."
MOVING_MM_S = 5.0
HANDLE_PATIENCE_S = 30.0
STILL = (
    "handle_still",
    f"the handle stood still for {HANDLE_PATIENCE_S:g} s",
    f"turn it to and fro, at {MOVING_MM_S:g} mm/s or more at the roller, while it runs",
)
CLEAR_N = 0.1
"At the open end the firmware holds back a duty that would push on, and a device's least force varies."


class Known(NamedTuple):
    config: Config
    period_s: float
    least_N: float
    most_N: float
    weight_N: float | None = None

    def force_N(self, share: float) -> float:
        """Return the force at a share of the range from CLEAR_N over the device's least force."""
        low_N = self.least_N + CLEAR_N
        return low_N + share * (self.most_N - low_N)


class Asked(NamedTuple):
    """What a course asks for: a force (None: no setpoint), and a command, given once ("": none)."""

    force_N: float | None = None
    command: str = ""
    preview_N: tuple[float, ...] = ()


class Heard(NamedTuple):
    now_s: float
    rows: Sequence[Row]


Course: TypeAlias = Generator[Asked, Heard, Found]


class StoppedError(Exception):
    """A course that cannot go on: a code, the cause in a sentence, what to do."""

    def __init__(self, code: str, cause: str, remedy: str, rows: Sequence[Row] = ()) -> None:
        super().__init__(cause)
        self.code, self.cause, self.remedy, self.rows = code, cause, remedy, rows
        self.found: Sequence[Finding] = ()


class Device(Protocol):
    def command(self, name: str) -> object:
        """Give one operator's command. Raises where it is refused."""

    def exchange(self, asked: Asked) -> Heard:
        """Publish the force that is `asked`, and return what was heard until the next is due."""


def drive(course: Course[Found], device: Device) -> Found:
    try:
        asked = next(course)
        while True:
            if asked.command:
                device.command(asked.command)
            asked = course.send(device.exchange(asked))
    except StopIteration as end:
        found: Found = end.value
        return found
    except BaseException:
        device.command("disable")
        raise


def columns_of(rows: Iterable[Row]) -> Columns:
    by_name = zip(*rows, strict=True)
    table = dict(zip(COLUMNS, by_name, strict=False)) or dict.fromkeys(COLUMNS, ())
    return {
        name: np.array([math.nan if value is None else value for value in values], dtype=np.float64)
        if name in NUMBERS
        else np.array([*values, None], dtype=object)[:-1]
        for name, values in table.items()
    }


def watch(
    lasts_s: float,
    force_N: Callable[[float], float] | None = None,
    states: Sequence[str] = ("ENABLED",),
    *,
    is_told_ahead: bool = False,
) -> Course[Columns]:
    """Ask for a force over time for `lasts_s`, and return all ticks."""
    rows: list[Row] = []
    ahead_s = [PREVIEW_STEP_S * number for number in range(1, 1 + PREVIEW_STEPS)] if is_told_ahead else []
    begun_s, t_s = math.nan, 0.0
    while t_s < lasts_s:
        asked = Asked() if force_N is None else Asked(force_N(t_s), "", tuple(force_N(t_s + it) for it in ahead_s))
        now_s, fresh = yield asked
        _require_state(fresh, states, rows)
        rows += fresh
        begun_s = now_s if math.isnan(begun_s) else begun_s
        t_s = now_s - begun_s
    return columns_of(rows)


def given(
    command: str,
    is_done: Callable[[Row], bool],
    most_s: float,
    force_N: float | None = None,
    late: tuple[str, str, str] | None = None,
) -> Course[Columns]:
    """Give `command` once, wait until the newest tick `is_done`, and return all ticks."""
    begun_s, fresh = yield Asked(force_N, command)
    rows = list(fresh)
    while not (rows and is_done(rows[-1])):
        now_s, fresh = yield Asked(force_N)
        _require_state(fresh, ("DISABLED", "ENABLED", "PAUSED"))
        rows += fresh
        if now_s - begun_s > most_s:
            what = command or "what was waited for"
            raise StoppedError(*(late or ("not_done", f"{what} was not done within {most_s:g} s", "tormagctl status")))
    return columns_of(rows)


def handle_moved(force_N: float) -> Course[None]:
    yield from given("", _moves, HANDLE_PATIENCE_S, force_N, STILL)


def _moves(row: Row) -> bool:
    return bool(abs(row[PLACES["handle_rate_mm_s"]] or 0.0) >= MOVING_MM_S)


def _require_state(fresh: Sequence[Row], states: Sequence[str], before: Sequence[Row] = ()) -> None:
    """Raise StoppedError, with `before` as its `rows`, for a tick in another operating state."""
    for row in fresh:
        state = row[PLACES["operating_state"]]
        if state not in states:
            codes = sorted(row[PLACES["faults"]] or (), key=lambda code: bool(code == "STOPPED"))
            if not codes:
                cause = f"the device went {state}: somebody gave a command"
                raise StoppedError("not_enabled", cause, "run it again", before)
            known = FAULTS[Fault(codes[0])]
            raise StoppedError(codes[0], f"{', '.join(codes)}: {known.cause}", known.remedy, before)
