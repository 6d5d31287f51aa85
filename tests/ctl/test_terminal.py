"""What others say reaches the terminal as plain text; a closed or full stream breaks nothing; what `top` draws."""

import io
import json
import logging
import math
import os
import pty
import re
import signal
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import msgspec
import pytest
from hypothesis import given, strategies as st
from rich.console import Console

from tormagd.ctl.outcome import Colour
from tormagd.ctl.top import CURVES, EIGHTHS, Seen, Watcher, columns, screen, span, sparkline
from tormagd.ground.terminal import LogFormatter, write_line
from tormagd.scenes.scene import scene_path
from tormagd_client.errors import UnreachableError
from tormagd_client.messages import Explained, Status
from tormagd_client.printable import printable

# -- text --------------------------------------------------------------------------------------------------------------


EVIL = "\x1b[2J\x1b]0;owned\x07\r\n\x9b31m\u202eevil\x7f"
HARMLESS = r"\u001b[2J\u001b]0;owned\u0007\r\n\u009b31m\u202eevil\u007f"


def spoil(value):
    if isinstance(value, str):
        return value + EVIL
    if isinstance(value, dict):
        return {name: spoil(inner) for name, inner in value.items()}
    return [spoil(inner) for inner in value] if isinstance(value, list | tuple) else value


def is_harmless(text: str) -> bool:
    return text.replace("\n", "").isprintable()


def test_a_text_is_made_one_printable_line() -> None:
    assert (printable(EVIL), printable("a ± b, 5 µs")) == (HARMLESS, "a ± b, 5 µs")
    assert printable("\ud800") == r"\ud800"


@given(st.text())
def test_whatever_is_written_is_printable_and_json_stays_json(text: str) -> None:
    plain, as_json = io.StringIO(), io.StringIO()
    assert write_line(text, plain) is None
    assert is_harmless(plain.getvalue().replace("\t", ""))
    write_line(json.dumps({"said": text}, ensure_ascii=False), as_json)
    assert json.loads(as_json.getvalue()) == {"said": text}


@pytest.mark.parametrize(
    "arguments", [["status"], ["--json", "status"], ["take", "\u00b5"], ["send", "\u2581"], ["-h"]]
)
def test_a_terminal_that_has_ascii_only_gets_all_of_it(fake_daemon, status_with, arguments):
    scale = {"value": 0.75, "sd": 0.01, "unit": "\u00b5", "acts": True}
    fake_daemon.says(belief={"lag": scale}, limits=["\u0394"])
    fake_daemon.answers["take"] = lambda: {"ok": True, "result": {"source": "\u00b5", "instead_of": None}}
    told = subprocess.run(
        [sys.executable, "-m", *CTL, *fake_daemon.at, "--wait", "5", *arguments],
        capture_output=True,
        env=os.environ | {"PYTHONIOENCODING": "ascii", "LC_ALL": "C"},
        check=False,
    )
    said = (told.stdout + told.stderr).decode("ascii")
    assert (told.returncode in (0, 2), "Traceback" in said) == (True, False)
    if arguments == ["status"]:
        assert "lag 0.75 +- 0.01 \\u00b5" in said
    if "--json" in arguments:
        assert json.loads(said)["result"]["limits"] == ["\u0394"]


def test_a_narrow_terminal_gets_lines_that_go_on_under_their_own_words(fake_daemon, ctl, monkeypatch, checked_here):
    monkeypatch.setattr("tormagd.ctl.outcome.is_terminal", lambda stream: True)
    monkeypatch.setenv("COLUMNS", "40")
    monkeypatch.setenv("NO_COLOR", "1")
    for arguments in (["status"], ["firmware"], ["doctor"], ["scene", "list"], ["scene", "check", "coronary"]):
        lines = ctl(*fake_daemon.at, *arguments).out.splitlines()
        assert max(map(len, lines)) <= 40, arguments
    assert "\naorta_1         Aorta cannulation, use\n             case 1 of table" in f"\n{ctl('scene', 'list').out}"


def test_our_own_colours_and_lines_stay_on_a_terminal_that_wants_them(
    monkeypatch: pytest.MonkeyPatch, terminal
) -> None:
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.delenv("NO_COLOR", raising=False)
    stream = terminal()
    colour = Colour(stream)
    text = "\n".join(paint("x") for paint in (colour.red, colour.green, colour.yellow, colour.bold))
    write_line(text, stream)
    assert stream.getvalue() == text + "\n"
    assert text.startswith("\x1b[31mx\x1b[0m\n")
    for name, value in (("NO_COLOR", "1"), ("TERM", "dumb")):
        with monkeypatch.context() as other:
            other.setenv(name, value)
            assert Colour(stream).red("x") == "x"


@pytest.mark.parametrize("command", ["status", "firmware"])
def test_a_daemon_cannot_write_to_the_terminal(fake_daemon, ctl, status_with, source_with, command):
    told = spoil(
        status_with(
            limits=["RATE"],
            faults=["SKEW"],
            fault_details=[{"code": "SKEW", "cause": "a", "remedy": "b"}],
            setpoints={"by_source": {"me": source_with()}, "last_refusal": "x"},
            late_ticks_by={"somebody": 3},
            peers={
                "refused": 1,
                "refusals": [{"endpoint": "e", "address": "a", "key": "k", "reason": "r", "count": 1}],
            },
        )
    )
    told["late_ticks_by"] = {EVIL: 3}  # names, too
    told["setpoints"]["by_source"] = {EVIL: told["setpoints"]["by_source"]["me"]}
    fake_daemon.answers["status"] = lambda: {"ok": True, "result": told}
    captured = ctl(*fake_daemon.at, command).ended(0)
    assert is_harmless(captured.out + captured.err)
    # one line each
    assert not any(line.startswith("evil") for line in captured.out.splitlines())
    assert HARMLESS in captured.out
    printed = ctl(*fake_daemon.at, "--json", command).ended(0).out
    assert is_harmless(printed)
    known = json.loads(printed)["result"]
    assert (known["link"] if command == "status" else known)["port"].endswith(EVIL)


def test_a_refusal_is_one_printable_line_and_a_hint(fake_daemon, ctl):
    error = {"code": EVIL, "message": "no" + EVIL, "hint": "next" + EVIL}
    fake_daemon.answers["pause"] = lambda: {"ok": False, "error": error}
    said = ctl(*fake_daemon.at, "pause").ended(1).err
    assert is_harmless(said)
    assert len(said.splitlines()) == 2


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.toml", '"\\u001b[2J" = 1'),
        ("a.toml", 'scene = "\\u001b[2J\\n"'),
        ("\x1b[2J.toml", "x = 1"),
        ("a.toml", 'scene = "b.toml"'),
    ],
)
def test_a_file_cannot_either(tmp_path: Path, ctl, monkeypatch, name: str, text: str) -> None:
    monkeypatch.chdir(tmp_path)
    Path("b.toml").write_text(scene_path("pulse").read_text().replace('description = "', 'description = "\\u001b[2J'))
    Path(name).write_text(text)
    captured = ctl("--config", name, "scene", "show").ended(2)
    assert is_harmless(captured.out + captured.err)
    assert r"\u001b[2J" in captured.err or r"\x1b[2J" in captured.err


def test_the_log_has_a_line_for_each_record_and_a_traceback_its_own() -> None:
    formatter = LogFormatter("%(levelname)s %(name)s: %(message)s")
    record = logging.LogRecord("a.b", logging.INFO, "", 1, "device %s", (EVIL,), None)
    assert formatter.format(record) == f"INFO a.b: device {HARMLESS}"
    try:
        raise ValueError(EVIL)
    except ValueError as error:
        record.exc_info = (type(error), error, error.__traceback__)
    text = formatter.format(record)
    assert is_harmless(text)
    assert "Traceback" in text.splitlines()[1]


# -- streams -----------------------------------------------------------------------------------------------------------


CTL, DAEMON = ("tormagd.ctl.main",), "tormagd.daemon.main"
LIST = (*CTL, "scene", "list")
LOST = "tormagctl scene: the answer could not be written: No space left on device"
CLOSED = "the answer could not be written: the stream is closed"


def run(redirected: str, *arguments: str, stdout: int = subprocess.PIPE) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        ["sh", "-c", f'"$@" {redirected}', "sh", sys.executable, "-m", *arguments],
        stdout=stdout,
        stderr=subprocess.PIPE,
        text=True,
        check=False,
        timeout=60,
    )


@pytest.mark.parametrize(
    ("redirected", "command", "code", "said"),
    [
        *(
            (redirected, (*LIST, *form), code, said)
            for form in ((), ("--json",))
            for redirected, code, said in (("> /dev/full", 1, LOST), (">&-", 1, CLOSED), (">&- 2>&-", 1, ""))
        ),
        *(
            (redirected, command, 1, said)
            for command in ((*CTL, "--help"), (DAEMON, "--version"), (DAEMON, "--check"))
            for redirected, said in (("> /dev/full", "No space left on device"), (">&-", CLOSED))
        ),
    ],
)
def test_what_cannot_be_written_is_told_in_a_line(redirected, command, code, said):
    ran = run(redirected, *command)
    assert (ran.returncode, len(ran.stderr.splitlines())) == (code, bool(said))
    assert said in ran.stderr


def test_a_refusal_without_stderr_leaves_the_object_alone_on_stdout(tmp_path: Path):
    ran = run("2>&-", *CTL, "--endpoint", f"ipc://{tmp_path}/control", "--wait", "0.05", "--json", "home")
    assert (ran.returncode, json.loads(ran.stdout)["error"]["code"]) == (3, "unreachable")


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (LIST, 0, ""),
        ((DAEMON, "--check"), 0, ""),
        (("tormagd.simulation", "--pty"), 1, "could not be written to stdout"),
    ],
)
def test_a_reader_that_has_gone_makes_no_traceback(arguments, code, said):
    reading, writing = os.pipe()
    os.close(reading)
    ran = run("", *arguments, stdout=writing)
    os.close(writing)
    assert (ran.returncode, len(ran.stderr.splitlines())) == (code, bool(said))
    assert said in ran.stderr


# -- top ---------------------------------------------------------------------------------------------------------------


SIZES = ((80, 24), (160, 50))
RATE = Explained("RATE", "the force was asked to change faster than the carriages travel", "ask for slower changes")
SKEW = Explained("SKEW", "the carriages are 1.31 mm apart, 1 mm is allowed", "look for dirt or wear, then clear-fault")


@pytest.fixture
def seen(status_with, telemetry_with) -> Seen:
    known = msgspec.convert(status_with(uptime_s=7200.0), Status)
    snapshots = [
        telemetry_with(
            k,
            k * 20_000_000,
            setpoint_cf=1.5 + 0.2 * math.sin(k / 20),
            measured_cf=1.5 + 0.19 * math.sin(k / 20),
            limits=("RATE",) if k >= 900 else (),
        )
        for k in range(1_000)
    ]
    return Seen(snapshots, known, {"RATE": RATE})


def in_fault(seen: Seen) -> Seen:
    faulty = msgspec.structs.replace(
        seen.status, operating_state="FAULT", faults=("SKEW",), fault_details=(SKEW,), gap_mm=None
    )
    return seen._replace(status=faulty, silent_s=7.2)


def drawn(seen: Seen, width: int, height: int) -> list[str]:
    console = Console(width=width, height=height, color_system=None)
    with console.capture() as captured:
        console.print(screen(seen, width, height))
    return captured.get().splitlines()


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_the_screen_fits_and_says_what_the_device_does(seen: Seen, width: int, height: int) -> None:
    lines = drawn(seen, width, height)
    text = "\n".join(lines)
    said = (
        "state     ENABLED, homed",
        "RATE 10% of the time",
        RATE.cause,
        "next: ask for slower changes",
        "force     asked",
    )
    assert [words for words in said if words not in text] == []
    assert all(any(line.startswith(f"{curve.label} ") for line in lines) for curve in CURVES)
    # a sine fills its rows from bottom to top
    assert {"▁", "█"} <= set(text)


@pytest.mark.parametrize(("width", "height"), [*SIZES, (40, 18)])
def test_silence_and_a_fault_with_its_remedy_come_before_the_limits(seen: Seen, width: int, height: int) -> None:
    lines = drawn(in_fault(seen), width, height)
    assert "nothing heard for 7 s" in lines[0]
    text = " ".join(" ".join(lines).split())
    assert f"state FAULT, homed fault SKEW {SKEW.cause} next: {SKEW.remedy} held by RATE 10% of the time" in text


@pytest.mark.parametrize(("width", "height"), [*SIZES, (40, 24), (79, 23), (400, 120)])
@pytest.mark.parametrize("count", [0, 1_000])
def test_any_size_can_be_drawn_on_and_a_narrow_one_keeps_a_sparkline(
    seen: Seen, count: int, width: int, height: int
) -> None:
    lines = drawn(seen._replace(telemetry=seen.telemetry[:count]), width, height)
    assert len(lines) <= height
    assert all(len(line) <= width for line in lines)
    assert width != 40 or not count or re.search(r"\nasked +\d\.\d{3} N +[▁▂▃▄▅▆▇█]{8}", "\n".join(lines))


def test_the_status_is_asked_for_at_news_and_a_daemon_that_is_gone_is_waited_for(seen: Seen) -> None:
    known = msgspec.structs.replace(seen.status, limit_details=(RATE,))
    old, new, paused = seen.telemetry[0], seen.telemetry[-1], msgspec.structs.replace(seen.telemetry[0], seq=9)
    paused = msgspec.structs.replace(paused, operating_state="PAUSED")
    client = Mock(**{"status.side_effect": [seen.status, seen.status, known, UnreachableError("gone", "", "")]})
    client.telemetry.side_effect = [[old], [old], [new], [new], [paused]]
    watcher = Watcher(client)
    looks = [(watcher.look(), client.status.call_count) for _ in range(5)]
    assert [count for _, count in looks] == [2, 2, 3, 3, 4]
    last, _ = looks[-1]
    assert (len(last.telemetry), last.explained, last.status) == (5, {"RATE": RATE}, known)


def test_nothing_that_telemetry_says_is_obeyed_by_the_terminal(seen: Seen) -> None:
    last = msgspec.structs.replace(seen.telemetry[-1], limits=(f"C{EVIL}",))
    text = "".join(drawn(seen._replace(telemetry=[last]), 160, 50))
    assert text.isprintable()
    assert f"C{HARMLESS} 100% of the time" in text
    rare = [seen.telemetry[0]] * 199 + [last]
    assert f"C{HARMLESS} under 1% of the time" in "".join(drawn(seen._replace(telemetry=rare), 160, 50))


@given(
    values=st.lists(st.none() | st.floats(-1e3, 1e3), min_size=1, max_size=40),
    rows=st.integers(1, 6),
    least=st.floats(0.1, 10),
)
def test_a_bar_is_as_high_as_its_value(values: list[float | None], rows: int, least: float) -> None:
    low, high = span(values, least)
    lines = sparkline(values, low, high, rows)
    assert [len(line) for line in lines] == [len(values)] * rows
    heights = [sum(EIGHTHS.index(line[column]) for line in lines) for column in range(len(values))]
    assert [height == 0 for height in heights] == [value is None for value in values]
    known = sorted((value, height) for value, height in zip(values, heights, strict=True) if value is not None)
    assert [height for _, height in known] == sorted(height for _, height in known)
    if known and known[-1][0] - known[0][0] >= least:
        assert (known[0][1], known[-1][1]) == (1, 8 * rows)


def test_a_column_stays_what_it_is_while_time_goes_on() -> None:
    times_ns, values = [0, 4, 10, 14, 31], [1.0, 3.0, None, math.nan, 7.0]
    assert columns(times_ns, values, 4, 10, max) == [3.0, None, None, 7.0]
    assert columns([*times_ns, 40], [*values, 9.0], 4, 10, max) == [None, None, 7.0, 9.0]
    assert columns([], [], 2, 10, max) == [None, None]


def in_terminal(control: str, end: bytes | signal.Signals, **settings: str) -> tuple[int, str]:
    """Ends it by a key or a signal; returns exit code and screen."""
    far, near = pty.openpty()
    environment = os.environ | {"TERM": "xterm-256color", "COLUMNS": "80", "LINES": "24"} | settings
    command = [sys.executable, "-m", "tormagd.ctl.main", "--endpoint", control, "--wait", "5", "top"]
    process = subprocess.Popen(command, stdin=near, stdout=near, stderr=near, env=environment)
    os.close(near)
    text = b""
    try:
        while b"late" not in text:
            text += os.read(far, 65_536)
        os.write(far, end) if isinstance(end, bytes) else process.send_signal(end)
        while b"the daemon goes on" not in text:
            text += os.read(far, 65_536)
        return process.wait(20.0), text.decode()
    finally:
        process.kill()
        process.wait()
        os.close(far)


def test_a_narrow_terminal_without_colours_and_with_ascii_alone_is_drawn_on(fake_daemon) -> None:
    settings = {"COLUMNS": "40", "NO_COLOR": "1", "PYTHONIOENCODING": "ascii"}
    code, text = in_terminal(fake_daemon.control, b"q", **settings)
    assert (code, text.isascii(), "Traceback" in text) == (0, True, False)
    assert "tormagctl top; q ends" in text
    assert EIGHTHS.encode("ascii", "alike") == b" .,:;+=*#"
    assert not re.search(r"\x1b\[[\d;]*[34]\d", text)


@pytest.mark.parametrize("end", [b"\x1b[Aq", signal.SIGINT, signal.SIGTERM], ids=["arrow, q", "Ctrl-C", "SIGTERM"])
def test_it_is_ended_by_a_key_or_a_signal_and_only_looks(fake_daemon, end: bytes | signal.Signals) -> None:
    code, text = in_terminal(fake_daemon.control, end)
    assert "ENABLED" in text
    assert (code, set(fake_daemon.commands), fake_daemon.setpoints) == (0, {"status"}, [])
