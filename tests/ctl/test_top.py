"""`tormagctl top`: its screen at two sizes, and in a terminal of its own."""

import math
import os
import pty
import re
import signal
import subprocess
import sys
from unittest.mock import Mock

import msgspec
import pytest
from hypothesis import given, strategies as st
from rich.console import Console

from tormagd.ctl.top import CURVES, EIGHTHS, Seen, Watcher, columns, screen, span, sparkline
from tormagd_client.errors import UnreachableError
from tormagd_client.messages import Explained, Status

SIZES = ((80, 24), (160, 50))
RATE = Explained("RATE", "the force was asked to change faster than the carriages travel", "ask for slower changes")
SKEW = Explained("SKEW", "the carriages are 1.31 mm apart, 1 mm is allowed", "look for dirt or wear, then clear-fault")
EVIL = "\x1b[2J\x07\u202e"


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
    # at first, not twice a second, what is not explained, nothing new, another state
    assert [count for _, count in looks] == [2, 2, 3, 3, 4]
    last, _ = looks[-1]
    assert (len(last.telemetry), last.explained, last.status) == (5, {"RATE": RATE}, known)


def test_nothing_that_telemetry_says_is_obeyed_by_the_terminal(seen: Seen) -> None:
    last = msgspec.structs.replace(seen.telemetry[-1], limits=(f"C{EVIL}",))
    text = "".join(drawn(seen._replace(telemetry=[last]), 160, 50))
    assert text.isprintable()
    assert r"\u202e 100% of the time" in text
    rare = [seen.telemetry[0]] * 199 + [last]
    assert r"\u202e under 1% of the time" in "".join(drawn(seen._replace(telemetry=rare), 160, 50))


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
