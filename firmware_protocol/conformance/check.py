"""A check: what is sent, what the page expects then, and where it stands there; and the running of them all."""

from collections.abc import Callable, Iterable, Sequence
from typing import Final, NamedTuple

from firmware_protocol.conformance.host import STALLED_S, Host, Unmet

ATTEMPTS: Final = 3
"A check that failed while this process was late is tried so often."
Perform = Callable[[Host], str]


class Check(NamedTuple):
    """`perform` returns what was seen, or raises Unmet with it."""

    name: str
    page: str
    "Heading of firmware_protocol/README.md, and the number of the rule below it."
    sent: str
    expected: str
    perform: Perform
    moves: bool
    is_gate: bool
    "Where it fails, nothing is moved any more."


class Result(NamedTuple):
    """What came of a check."""

    check: Check
    passed: bool
    seen: str


def check(
    page: str, sent: str, expected: str, *, moves: bool = False, is_gate: bool = False
) -> Callable[[Perform], Check]:
    """Makes a check of a function, by its name."""
    return lambda perform: Check(perform.__name__, page, sent, expected, perform, moves, is_gate)


def run(host: Host, checks: Iterable[Check], tell: Callable[[Result], None] = lambda result: None) -> Sequence[Result]:
    """Performs checks one after the other. Raises OSError when the line is gone."""
    results: list[Result] = []
    closed_by = ""
    for one in checks:
        if one.moves and closed_by:
            result = Result(one, passed=False, seen=f"not tried, because {closed_by} failed")
        else:
            result = _performed(host, one)
        if one.is_gate and not result.passed:
            closed_by = closed_by or one.name
        results.append(result)
        tell(result)
    return results


def _performed(host: Host, one: Check) -> Result:
    for attempt in range(1, ATTEMPTS + 1):
        host.begin()
        try:
            return Result(one, passed=True, seen=one.perform(host))
        except Unmet as unmet:
            seen = str(unmet)
            if host.stalled_s > STALLED_S:
                seen += f" (this computer was {host.stalled_s * 1e3:.0f} ms late meanwhile)"
                if attempt < ATTEMPTS:
                    continue
            return Result(one, passed=False, seen=seen)
    raise AssertionError("unreachable")
