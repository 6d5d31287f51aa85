"""`python -m firmware_protocol.conformance PORT|CHANNEL`: does this device do what firmware_protocol/README.md says?"""

import argparse
import contextlib
import json
import math
import shlex
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from typing import Any, Final, TextIO

from firmware_protocol.codec import Identity
from firmware_protocol.conformance.bench import left_open
from firmware_protocol.conformance.check import Check, Result, run
from firmware_protocol.conformance.examination import CHECKS, checks_on
from firmware_protocol.conformance.host import OPENING_MM_S, STROKE_MM, Host
from firmware_protocol.conformance.line import Line
from firmware_protocol.conformance.ports import open_line
from firmware_protocol.conformance.rules import RULES

PASSED, FAILED, USAGE = 0, 1, 2
RESET_S: Final = 30.0
PAGE: Final = "firmware_protocol/README.md"
WARNING: Final = """\
{line}: THE DEVICE'S MOTORS WILL MOVE, for about six minutes: homings, duties of up to 1, the whole way to the closed
switches, openings because this program falls silent on purpose. A firmware that is wrong may do anything: keep the
motors' supply switch in reach, take hands and patient's side off the brake, and end the daemon."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Examine the device on a line, once the user has agreed that its motors move, and print the results."""
    command = parser()
    options = command.parse_args(arguments)
    if options.list:
        for one in CHECKS:
            print(f"{one.name}: {one.sent}: {one.expected} ({one.page}; else {one.hazard.value})")
        print(*(f"{finds} cannot be checked: {rule}" for rule, finds in RULES.items() if finds[0] == "-"), sep="\n")
        return PASSED
    if options.line is None:
        command.error("the following arguments are required: PORT|CHANNEL")
    if not (options.yes or _is_agreed(options.line)):
        print(f"{command.prog}: nothing was sent; say yes, or --yes where nobody can be asked", file=sys.stderr)
        return USAGE
    try:
        line = open_line(options.line, options.baud, options.bitrate, options.node)
    except OSError as error:
        print(f"{command.prog}: {error}", file=sys.stderr)
        return USAGE
    try:
        results = _examined(line, options)
    except ValueError as error:
        command.error(str(error))
    finally:
        line.port.close()
    return PASSED if results and all(result.passed is not False for result in results) else FAILED


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
    """Return a result as text: one line if the check passed, else what was sent, seen and expected."""
    one = result.check
    if result.passed:
        return f"ok    {one.name}: {result.seen}"
    if result.passed is None:
        return f"-     {one.name}: not tested: {result.seen}"
    return (
        f"FAIL  {one.name}\n      sent      {one.sent}\n      seen      {result.seen}\n"
        f"      expected  {one.expected}\n      page      {PAGE}: {one.page}\n      hazard    {one.hazard.value}"
    )


def _examined(line: Line, options: argparse.Namespace) -> Sequence[Result]:
    checks = _chosen(checks_on(line), options.only)
    out = sys.stderr if options.json else sys.stdout
    host = Host(
        line,
        opening_mm_s=options.opening_mm_s,
        stroke_mm=options.stroke_mm,
        uptime_s=options.uptime,
        reset=_resetter(options),
        ask=lambda what: _say(f"please {what}", sys.stderr),
    )
    results: list[Result] = []

    def tell(result: Result) -> None:
        results.append(result)
        _say(told(result), out)

    with contextlib.ExitStack() as kept:
        for number in (signal.SIGINT, signal.SIGTERM):
            kept.callback(signal.signal, number, signal.getsignal(number))
        # a request to end ends the checks, but the gap is still opened
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        try:
            try:
                run(host, checks, tell)
            except KeyboardInterrupt:
                signal.signal(signal.SIGINT, signal.SIG_IGN)
                signal.signal(signal.SIGTERM, signal.SIG_IGN)
                print("ended; opening the gap", file=sys.stderr, flush=True)
                run(host, [left_open], tell)
                return []
        except OSError as error:
            print(f"the line is gone ({error}): by the page the device opens the gap by itself now", file=sys.stderr)
            return []
    passed, failed, untested = (sum(result.passed is each for result in results) for each in (True, False, None))
    besides = f", {untested} not tested" if untested else ""
    _say(f"{options.line}: {_name(host)}: {passed} of {passed + failed} checks passed{besides}", out)
    if options.json:
        _say(json.dumps(report(results), indent=2), sys.stdout)
    return results


def _resetter(options: argparse.Namespace) -> Callable[[str], None] | None:
    """Return what resets the device: the command of `--reset`, or a person at the terminal."""
    if options.reset:
        return lambda how: _call([*shlex.split(options.reset), how])
    if options.yes or not sys.stdin.isatty():
        return None
    return _ask_for_reset


def _call(command: Sequence[str]) -> None:
    try:
        done = subprocess.run(command, check=False, timeout=RESET_S, stdin=subprocess.DEVNULL)
    except subprocess.TimeoutExpired as error:
        raise OSError(f"{shlex.join(command)} took over {RESET_S:g} s") from error
    if done.returncode:
        raise OSError(f"{shlex.join(command)} ended with {done.returncode}")


def _ask_for_reset(how: str) -> None:
    ways = {"warm": "by its reset pin", "cold": "by its supply, off and on"}
    print(f"Reset the device {ways[how]}, then press Enter: ", end="", file=sys.stderr, flush=True)
    sys.stdin.readline()


def _say(text: str, out: TextIO) -> None:
    with contextlib.suppress(OSError):
        print(text, file=out, flush=True)


def _name(host: Host) -> str:
    """Return the device's serial number and firmware in words."""
    heard = host.newest.get(Identity)
    if heard is None or not isinstance(heard.message, Identity):
        return "nobody"
    identity = heard.message
    return f"device {identity.serial_number}, firmware {identity.firmware_major}.{identity.firmware_minor}"


def _chosen(checks: Sequence[Check], only: Sequence[str]) -> Sequence[Check]:
    """Return the checks that `only` names (empty: all), and always the one that leaves the gap open."""
    names = {one.name for one in checks}
    if unknown := [name for name in only if name not in names]:
        raise ValueError(f"--only {unknown[0]}: checks on this line are {', '.join(sorted(names))}")
    return [one for one in checks if not only or one.name in only or one is left_open]


def _is_agreed(line: str) -> bool:
    print(WARNING.format(line=line), file=sys.stderr, flush=True)
    if not sys.stdin.isatty():
        return False
    print("Type yes to go on: ", end="", file=sys.stderr, flush=True)
    return sys.stdin.readline().strip().lower() == "yes"


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text}: allowed are numbers over 0")
    return value


OPTIONS: Final[dict[str, dict[str, Any]]] = {
    "--yes": {"action": "store_true", "help": "let the motors move without asking"},
    "--json": {"action": "store_true", "help": "JSON on stdout, progress on stderr"},
    "--only": {
        "action": "append",
        "default": [],
        "metavar": "CHECK",
        "help": "run only this and left_open; may be repeated",
    },
    "--list": {"action": "store_true", "help": "list the checks of every line, and the rules that none can check"},
    "--baud": {"type": int, "default": 1_000_000, "metavar": "N", "help": "of a serial port; default 1000000"},
    "--bitrate": {"type": int, "default": 1_000_000, "metavar": "N", "help": "of a CAN bus; default 1000000"},
    "--node": {"type": int, "choices": range(16), "default": 1, "metavar": "N", "help": "on a CAN bus; default 1"},
    "--reset": {
        "metavar": "COMMAND",
        "help": "resets the device, given warm (memory kept) or cold (supply off and on); the line stays",
    },
    "--uptime": {"type": _positive, "metavar": "S", "help": "how long the device's clock has run"},
    "--opening-mm-s": {
        "type": _positive,
        "default": OPENING_MM_S,
        "metavar": "V",
        "help": f"default {OPENING_MM_S:g}",
    },
    "--stroke-mm": {
        "type": _positive,
        "default": STROKE_MM,
        "metavar": "MM",
        "help": f"between switches; default {STROKE_MM:g}",
    },
}


def parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(
        prog="python -m firmware_protocol.conformance",
        description="Checks a device against firmware_protocol/README.md. Its motors move; the gap is left open. "
        "Exit code 0: all checks passed, 1: not all, 2: not begun.",
    )
    made.add_argument(
        "line",
        nargs="?",
        metavar="PORT|CHANNEL",
        help="path of a serial port, or INTERFACE:CHANNEL of a CAN bus: socketcan:can0, slcan:/dev/ttyACM0, "
        "tormagsim:PATH",
    )
    for name, options in OPTIONS.items():
        made.add_argument(name, **options)
    return made


if __name__ == "__main__":
    sys.exit(main())
