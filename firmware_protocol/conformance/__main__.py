"""`python -m firmware_protocol.conformance PORT|CHANNEL`: does this device do what firmware_protocol/README.md says?"""

import argparse
import contextlib
import json
import shlex
import signal
import subprocess
import sys
from collections.abc import Sequence
from functools import partial
from typing import Any, Final, TextIO

from firmware_protocol.codec import Identity
from firmware_protocol.conformance.check import Check, Result, run
from firmware_protocol.conformance.examination import CHECKS, left_open
from firmware_protocol.conformance.host import OPENING_MM_S, STROKE_MM, Host, Unmet
from firmware_protocol.conformance.line import Line
from firmware_protocol.conformance.ports import open_line
from firmware_protocol.conformance.rules import RULES

PASSED, FAILED, USAGE = 0, 1, 2
BOUNDS: Final = {
    "baud": (300, 100_000_000),
    "bitrate": (10_000, 8_000_000),
    "opening_mm_s": (1.0, 1000.0),
    "stroke_mm": (5.0, 1000.0),
}
PAGE: Final = "firmware_protocol/README.md"
LISTED: Final = "\n".join(
    (
        *(f"{one.name}: {one.sent}: {one.expected} ({one.page}; else {one.hazard.value})" for one in CHECKS),
        *(f"{finds} cannot be checked: {rule}" for rule, finds in RULES.items() if finds.startswith("-")),
    )
)
WARNING: Final = """\
{line}: THE DEVICE'S MOTORS WILL MOVE, for about seven minutes: homings, duties of up to 1, the whole way to the closed
switches, openings because this program falls silent on purpose. A firmware that is wrong may do anything: keep the
motors' supply switch in reach, take hands and patient's side off the brake, and end the daemon."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Examine the device on a line, once the user has agreed that its motors move, and print the results."""
    command = parser()
    options = command.parse_args(arguments)
    for name, (least, most) in BOUNDS.items():
        if not least <= getattr(options, name) <= most:
            command.error(f"{name} = {getattr(options, name):g}: allowed is {least:g}..{most:g}")
    if not (options.yes or _is_agreed(options.line)):
        command.exit(USAGE, f"{command.prog}: nothing was sent; say yes, or --yes where nobody can be asked\n")
    try:
        line = open_line(options.line, options.baud, options.bitrate, options.node)
    except OSError as error:
        command.exit(USAGE, f"{command.prog}: {error}\n")
    with contextlib.closing(line.port):
        checks = [one for one in CHECKS if not options.only or one.name in options.only or one is left_open]
        return PASSED if _examined(line, checks, options) else FAILED


def report(results: Sequence[Result]) -> dict[str, Any]:
    """Return the results as the JSON document of `--json`; what was not tested is a list of its own."""
    return {
        "checks": [{**_row(result), "passed": result.passed} for result in results if result.passed is not None],
        "untested": [_row(result) for result in results if result.passed is None],
    }


def _row(result: Result) -> dict[str, Any]:
    one = result.check
    return {
        "name": one.name,
        "seen": result.seen,
        "expected": one.expected,
        "sent": one.sent,
        "page": f"{PAGE}: {one.page}",
        "hazard": one.hazard.value,
    }


def told(result: Result) -> str:
    """Return a result as text: one line, or what was sent, seen and expected."""
    one = result.check
    if result.passed is False:
        return (
            f"FAIL  {one.name}\n      sent      {one.sent}\n      seen      {result.seen}\n"
            f"      expected  {one.expected}\n      page      {PAGE}: {one.page}\n      hazard    {one.hazard.value}"
        )
    return f"ok    {one.name}: {result.seen}" if result.passed else f"-     {one.name}: not tested: {result.seen}"


def _examined(line: Line, checks: Sequence[Check], options: argparse.Namespace) -> bool:
    """Run the checks, print the results, and return whether none failed."""
    out = sys.stderr if options.json else sys.stdout
    host = Host(
        line,
        opening_mm_s=options.opening_mm_s,
        stroke_mm=options.stroke_mm,
        reset=partial(_reset, options.reset) if options.reset else None,
        ask=lambda what: _say(f"please {what}", sys.stderr),
    )
    results, ended = _performed(host, checks, out)
    lost = _say(f"{options.line}: {_summary(host, results)}", out)
    if options.json:
        lost = _say(json.dumps(report(results), indent=2), sys.stdout)
    elif isinstance(lost, BrokenPipeError):  # its reader meant to
        lost = None
    if lost:
        _say(f"the results could not be written: {lost}", sys.stderr)
    return not (ended or lost or any(result.passed is False for result in results))


def _performed(host: Host, checks: Sequence[Check], out: TextIO | None) -> tuple[list[Result], str]:
    """Tell and return the results, and why that ended early."""
    results, ended = list[Result](), ""
    try:
        for result in run(host, checks):
            results.append(result)
            _say(told(result), out)
    except KeyboardInterrupt:  # a request to end ends the checks, but the gap is still opened
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
        _say("ended; opening the gap", sys.stderr)
        opened, ended = _performed(host, [left_open], out)
        results, ended = results + opened, ended or "it was ended before"
    except OSError as error:
        ended = f"the line is gone ({error})"
        _say(f"{ended}: by the page the device opens the gap by itself now", sys.stderr)
    untried = set(checks).difference(result.check for result in results)
    return results + [Result(one, passed=None, seen=ended) for one in checks if one in untried], ended


def _summary(host: Host, results: Sequence[Result]) -> str:
    passed, failed, untested = (sum(result.passed is each for result in results) for each in (True, False, None))
    names = [
        f"device {it.serial_number}, firmware {it.firmware_major}.{it.firmware_minor}"
        for _, it in host.all_of(Identity)
    ]
    return f"{(names or ['nobody'])[-1]}: {passed} of {passed + failed} checks passed, {untested} not tested"


def _reset(command: str, how: str) -> None:
    """Reset the device by the command of `--reset`."""
    try:
        subprocess.run([*shlex.split(command), how], check=True, timeout=30.0, stdin=subprocess.DEVNULL)
    except (OSError, subprocess.SubprocessError, ValueError) as error:
        raise Unmet(f"--reset: {error}") from error


def _say(text: str, out: TextIO | None) -> OSError | None:
    if out is None:
        return OSError("the stream is closed")
    try:
        print(text, file=out, flush=True)
    except OSError as error:
        return error
    return None


def _is_agreed(line: str) -> bool:
    print(WARNING.format(line=line), "Type yes to go on: ", sep="\n", end="", file=sys.stderr, flush=True)
    return sys.stdin is not None and sys.stdin.isatty() and sys.stdin.readline().strip().lower() == "yes"


OPTIONS: Final[dict[str, dict[str, Any]]] = {
    "--yes": {"action": "store_true", "help": "let the motors move without asking"},
    "--json": {"action": "store_true", "help": "JSON on stdout, progress on stderr"},
    "--only": {
        "action": "append",
        "default": [],
        "choices": [one.name for one in CHECKS],
        "metavar": "CHECK",
        "help": "run only this and left_open; may be repeated",
    },
    "--list": {
        "action": "version",
        "version": LISTED,
        "help": "list the checks of every line, and the rules that none can check",
    },
    "--baud": {"type": int, "default": 1_000_000, "metavar": "N", "help": "of a serial port; default 1000000"},
    "--bitrate": {"type": int, "default": 1_000_000, "metavar": "N", "help": "of a CAN bus; default 1000000"},
    "--node": {"type": int, "choices": range(16), "default": 1, "metavar": "N", "help": "on a CAN bus; default 1"},
    "--reset": {
        "metavar": "COMMAND",
        "help": "resets the device, given warm (memory kept) or cold (supply off and on); the line stays",
    },
    "--opening-mm-s": {
        "type": float,
        "default": OPENING_MM_S,
        "metavar": "V",
        "help": f"default {OPENING_MM_S:g}",
    },
    "--stroke-mm": {
        "type": float,
        "default": STROKE_MM,
        "metavar": "MM",
        "help": f"between switches; default {STROKE_MM:g}",
    },
}


def parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(
        prog="python -m firmware_protocol.conformance",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Checks a device against firmware_protocol/README.md. Its motors move; the gap is left open. "
        "Exit code 0: all checks passed, 1: not all, 2: not begun.",
    )
    made.add_argument(
        "line",
        metavar="PORT|CHANNEL",
        help="path of a serial port, or INTERFACE:CHANNEL of a CAN bus: socketcan:can0, slcan:/dev/ttyACM0, "
        "tormagsim:PATH",
    )
    for name, options in OPTIONS.items():
        made.add_argument(name, **options)
    return made


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    sys.exit(main())
