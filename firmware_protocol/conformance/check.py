"""A check: what is sent, what the protocol page expects, and which hazard it bears on; and the running of checks."""

from collections.abc import Callable, Iterable, Iterator
from enum import Enum
from typing import Final, NamedTuple

from firmware_protocol.conformance.host import STALLED_S, Host, Unmet, Untested

ATTEMPTS: Final = 3
"Tries of a check that fails while this process is late."
Perform = Callable[[Host], str]
WHO, ALL = "Who says what when, ", "everything, from the start on"


class Hazard(Enum):
    SHUT = "the gap stays shut: the brake holds the hand"
    CLOSES = "the gap closes unasked: the force rises"
    OPENS = "the gap opens unasked: the force is lost"
    MISLED = "the host acts on what is not so"
    WORN = "a motor, a screw or a stop takes harm"


class Check(NamedTuple):
    """One rule of the page as a test. `perform` returns what was seen."""

    name: str
    hazard: Hazard
    page: str
    "Heading in firmware_protocol/README.md, and the number of the rule below it."
    sent: str
    expected: str
    perform: Perform
    moves: bool
    is_gate: bool
    "If this check fails, checks that move the device are no longer tried."


class Result(NamedTuple):
    """The result of one check: whether it passed (None: not tested), and what was seen."""

    check: Check
    passed: bool | None
    seen: str


def check(
    hazard: Hazard, page: str, sent: str, expected: str, *, moves: bool = False, is_gate: bool = False
) -> Callable[[Perform], Check]:
    return lambda perform: Check(perform.__name__, hazard, page, sent, expected, perform, moves, is_gate)


def run(host: Host, checks: Iterable[Check]) -> Iterator[Result]:
    """Perform checks in order, and yield the result of each."""
    closed_by = ""
    for one in checks:
        seen = f"not tried, because {closed_by} failed"
        result = Result(one, passed=False, seen=seen) if one.moves and closed_by else _performed(host, one)
        closed_by = closed_by or (one.name if one.is_gate and result.passed is False else "")
        yield result


def _performed(host: Host, one: Check) -> Result:
    """Perform one check; repeat a failure while this process was late."""
    for _ in range(ATTEMPTS):
        host.begin()
        try:
            return Result(one, passed=True, seen=one.perform(host))
        except Untested as untested:
            return Result(one, passed=None, seen=str(untested))
        except Unmet as unmet:
            late_s = host.late_s if one.sent.startswith(ALL) else host.stalled_s
            if late_s <= STALLED_S:
                return Result(one, passed=False, seen=str(unmet))
            seen = f"{unmet} (this computer was {late_s * 1e3:.0f} ms late meanwhile)"
    return Result(one, passed=False, seen=seen)
