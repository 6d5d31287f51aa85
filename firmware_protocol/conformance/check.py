"""A check, which says what is sent and what the protocol page expects; and the running of checks in a row."""

from collections.abc import Callable, Iterable, Sequence
from typing import Final, NamedTuple

from firmware_protocol.conformance.host import STALLED_S, Host, Unmet

ATTEMPTS: Final = 3
"A check that fails while this process is late is tried this often."
Perform = Callable[[Host], str]


class Check(NamedTuple):
    """One rule of the page as a test. `perform` returns what was seen, or raises Unmet with what was seen."""

    name: str
    page: str
    "Heading in firmware_protocol/README.md, and the number of the rule below it."
    sent: str
    expected: str
    perform: Perform
    moves: bool
    is_gate: bool
    "If this check fails, checks that move the device are not tried any more."


class Result(NamedTuple):
    """The result of one check: whether it passed, and what was seen."""

    check: Check
    passed: bool
    seen: str


def check(
    page: str, sent: str, expected: str, *, moves: bool = False, is_gate: bool = False
) -> Callable[[Perform], Check]:
    """Return a decorator that makes a Check of a function, with the function's name."""
    return lambda perform: Check(perform.__name__, page, sent, expected, perform, moves, is_gate)


def run(host: Host, checks: Iterable[Check], tell: Callable[[Result], None] = lambda result: None) -> Sequence[Result]:
    """Perform checks one after the other, hand each result to `tell`, and return all results.

    After a gate has failed, checks that move the device fail untried. Raises OSError when the line is gone.
    """
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
    """Perform one check; repeat a failure, ATTEMPTS times in all, while this process was late during it."""
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
