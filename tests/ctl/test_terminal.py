"""What others say reaches the terminal as plain text; a closed or full stream breaks nothing."""

import io
import json
import logging
import os
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given, strategies as st

from tormagd.ctl.outcome import Colour
from tormagd.ground.terminal import LogFormatter, write_line
from tormagd.scenes.scene import scene_path
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
            setpoints=status_with()["setpoints"] | {"by_source": {"me": source_with()}, "last_refusal": "x"},
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


def run(redirected: str, *arguments: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        ["sh", "-c", f'"$@" {redirected}', "sh", sys.executable, "-m", *arguments],
        capture_output=True,
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
            for redirected, code, said in (("> /dev/full", 1, LOST), (">&-", 0, ""), (">&- 2>&-", 0, ""))
        ),
        *(
            ("> /dev/full", command, 1, "written: No space left on device")
            for command in ((*CTL, "--help"), (DAEMON, "--version"), (DAEMON, "--check"))
        ),
    ],
)
def test_what_cannot_be_written_is_told_in_a_line_and_what_nobody_wants_is_not(redirected, command, code, said):
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
    try:
        ran = subprocess.run(
            [sys.executable, "-m", *arguments],
            stdout=writing,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
            timeout=60,
        )
    finally:
        os.close(writing)
    assert ran.returncode == code
    assert said in ran.stderr
    assert len(ran.stderr.splitlines()) == bool(said)
