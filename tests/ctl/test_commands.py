import json
import subprocess
import sys
from itertools import chain, repeat
from pathlib import Path
from typing import Any

import msgspec
import pytest

from firmware_protocol.build import COST, REMEDY
from tormagd.ctl.main import main
from tormagd.ctl.operate import DONE
from tormagd.ctl.outcome import Colour
from tormagd.ctl.status import status_text
from tormagd.scenes.scene import TERMS, scene_path
from tormagd_client.messages import Status


def run_json(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, dict[str, Any]]:
    code = main([*arguments, "--json"])
    printed = json.loads(capsys.readouterr().out)
    assert list(printed) == ["command", "ok", "result", "error"]
    assert printed["ok"] == (code == 0)
    return code, printed


SUPPLY = {"code": "SUPPLY", "cause": "supply voltage low", "remedy": "check the power supply"}
IN_FAULT = {"operating_state": "FAULT", "faults": ["SUPPLY"], "fault_details": [SUPPLY]}
Row = tuple[dict[str, Any], dict[str, Any], int, list[str]]
UNDONE: list[Row] = [
    ({}, result, 1, ['"code":"not_done"']) for result in ({}, {"operating_state": None}, {"operating_state": "ASLEEP"})
]
ANSWERS: dict[str, list[Row]] = {
    # what is shown is the daemon's own
    "status": [
        ({"operating_state": "ENABLED"}, {}, 0, ["state     ENABLED, homed"]),
        (IN_FAULT, {}, 4, ["fault     SUPPLY", "supply voltage low", "next: check the power supply"]),
    ],
    # a newer daemon's too
    "--json status": [
        ({"core_share": 0.1}, {}, 0, ['"core_share":0.1', '"measured_jp":[35.0,35.0]', '"frames":55096'])
    ],
    "top": [({}, {}, 2, ["next: tormagctl status"])],  # there is no terminal
    "record /nowhere/a.mcap": [({}, {}, 2, ["/nowhere/a.mcap: No such file"])],
    # a command is done where the answer says so
    "stop": [
        ({}, {"operating_state": "FAULT", "is_connected": True}, 0, ["the gap opens"]),
        ({}, {"operating_state": "FAULT", "is_connected": False}, 1, ["nothing could be sent"]),
    ],
    "take b": [
        ({}, {"source": "b", "instead_of": "a"}, 0, ["'b' holds the brake instead of 'a'"]),
        ({}, {"source": "b", "instead_of": "b"}, 0, ["'b' holds the brake already"]),
    ],
    "--json take b": [({}, {"source": "c", "instead_of": "a"}, 1, ['"code":"not_done"'])],
    # a fault that is there still, or comes back, is no success
    "clear-fault": [
        ({}, {"operating_state": "DISABLED"}, 0, ["no fault is latched; it is DISABLED"]),
        ({}, {"operating_state": "PAUSED"}, 0, ["no fault is latched; it is PAUSED"]),
    ],
    "--json clear-fault": [
        (IN_FAULT, {"operating_state": "DISABLED"}, 4, ['"code":"fault"', "came back: SUPPLY: supply voltage low"]),
        *UNDONE,
    ],
    "--json home": [(IN_FAULT | {"is_busy": True}, {}, 4, ['"code":"fault"', '"hint":"check the power supply"'])],
    **{f"--json {command}": UNDONE for command in ("enable", "disable", "pause", "resume", "stop")},
}


@pytest.mark.parametrize(
    ("command", "status", "result", "code", "words"),
    [(command, *row) for command, rows in ANSWERS.items() for row in rows],
)
def test_what_a_daemon_answers_decides_the_exit_code_and_is_told(
    fake_daemon, capsys, command, status, result, code, words
):
    fake_daemon.says(**status)
    name = command.removeprefix("--json ").split()[0]
    if name != "status":
        fake_daemon.answers[name] = lambda: {"ok": True, "result": result}
    assert main(["--endpoint", fake_daemon.control, *command.split()]) == code
    printed = "".join(capsys.readouterr())
    assert [word for word in words if word not in printed] == []
    assert command != "take b" or fake_daemon.requests[-1]["args"] == {"source": "b"}


@pytest.mark.parametrize(("code", "expected"), [("not_homed", 1), ("fault", 4), ("device_latched", 4)])
def test_a_refusal_tells_code_message_and_hint(fake_daemon, capsys, code, expected):
    """As keys for a script; for a person on stderr, with the next step last."""
    fake_daemon.refuse("enable", code)
    exit_code, printed = run_json(capsys, "--endpoint", fake_daemon.control, "enable")
    assert exit_code == expected
    assert printed["error"] == {"code": code, "message": "cannot enable", "hint": "do this first"}
    assert main(["--endpoint", fake_daemon.control, "enable"]) == expected
    captured = capsys.readouterr()
    assert (captured.out, captured.err) == ("", "tormagctl enable: cannot enable\n  next: do this first\n")


@pytest.mark.parametrize("command", ["status", "firmware", "home"])
@pytest.mark.parametrize("changes", [{"is_homed": None}, {"link": 3}, {"rates": {"control": {}}}, {"limits": None}])
def test_a_status_that_is_not_understood_names_what_and_the_daemons_version(fake_daemon, capsys, command, changes):
    fake_daemon.says(version="0.0.9", **changes)
    code, printed = run_json(capsys, "--endpoint", fake_daemon.control, command)
    assert (code, printed["error"]["code"]) == (3, "unintelligible")
    assert "tormagd 0.0.9" in printed["error"]["message"]
    assert next(iter(changes)) in printed["error"]["message"]


def test_a_status_without_a_key_names_it(fake_daemon, capsys):
    fake_daemon.answers["status"] = lambda: {"ok": True, "result": {"operating_state": "ENABLED"}}
    code, printed = run_json(capsys, "--endpoint", fake_daemon.control, "status")
    assert (code, printed["error"]["code"]) == (3, "unintelligible")
    assert "tormagd of an unknown version" in printed["error"]["message"]
    assert "missing required field" in printed["error"]["message"]


@pytest.mark.parametrize(
    ("build", "lines"),
    [
        ("compiled", ["core      compiled"]),
        (
            "interpreted: no C compiler",
            ["core      interpreted: no C compiler", f"          {COST}", f"          next: {REMEDY}"],
        ),
        ("", []),
    ],
)
def test_status_says_which_build_runs_and_what_an_interpreted_one_costs(fake_daemon, capsys, build, lines):
    """An older daemon does not say, and nothing is made up for it."""
    fake_daemon.says(build=build)
    assert main(["--endpoint", fake_daemon.control, "status"]) == 0
    shown = capsys.readouterr().out.splitlines()
    at = shown.index(lines[0]) if lines else len(shown)
    assert shown[at : at + len(lines)] == lines
    assert sum(line.startswith("core") for line in shown) == bool(lines)


@pytest.mark.parametrize("command", ["enable", "disable", "pause", "resume", "stop", "clear-fault"])
def test_a_command_reaches_the_daemon_under_its_name(fake_daemon, capsys, command):
    done = {"operating_state": DONE[command][1][0]}
    fake_daemon.answers[command] = lambda: {"ok": True, "result": done}
    code, printed = run_json(capsys, "--endpoint", fake_daemon.control, command)
    assert (code, printed["command"], printed["result"]) == (0, command, done)
    assert fake_daemon.commands == (["status", command] if command == "clear-fault" else [command])


def test_a_fault_that_is_cleared_is_watched_until_it_would_have_come_back(fake_daemon, capsys):
    def clear():
        fake_daemon.says(operating_state="DISABLED")
        return {"ok": True, "result": {"operating_state": "DISABLED"}}

    fake_daemon.answers["clear-fault"] = clear
    fake_daemon.says(operating_state="FAULT", faults=["STOPPED"])
    assert main(["--endpoint", fake_daemon.control, "clear-fault"]) == 0
    assert "fault cleared. tormagctl home, then enable" in capsys.readouterr().out
    assert fake_daemon.commands[:2] == ["status", "clear-fault"]
    assert set(fake_daemon.commands[2:]) == {"status"}


@pytest.mark.parametrize(
    "arguments",
    [["status"], ["home"], ["send", "step"], ["record", "out.mcap"], ["firmware"], ["metrics"], ["dashboard"]],
)
def test_without_a_daemon_every_command_ends_with_3(run_dir, capsys, arguments, monkeypatch):
    monkeypatch.chdir(run_dir)
    code, printed = run_json(capsys, "--endpoint", f"ipc://{run_dir}/control", "--wait", "0.05", *arguments)
    assert code == 3
    assert printed["error"]["code"] == "unreachable"
    assert "start the daemon" in printed["error"]["hint"]
    assert list(run_dir.iterdir()) == []


@pytest.mark.parametrize(
    "answer",
    [
        {"ok": "perhaps"},
        {"ok": False},
        {"ok": True},
        {"ok": True, "result": None},
        {"ok": True, "result": [1]},
        {"ok": True, "result": {"operating_state": "PAUSED"}, "error": {"code": "a", "message": "b", "hint": "c"}},
        {"ok": True, "result": {"operating_state": "PAUSED"}, "id": None},
        {"ok": True, "result": {"operating_state": "PAUSED"}, "v": 2},
        {"ok": False, "error": {"code": "a"}},
        {"ok": True, "result": {"operating_state": "PAUSED" * 1_000}},
    ],
)
def test_an_answer_that_is_no_reply_is_not_believed(fake_daemon, capsys, answer):
    fake_daemon.answers["pause"] = lambda: answer
    code, printed = run_json(capsys, "--endpoint", fake_daemon.control, "pause")
    assert (code, printed["error"]["code"]) == (3, "unintelligible")


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["fly"],
        ["send"],
        ["send", "step", "--rate", "nan"],
        ["send", "step", "--rate", "0"],
        ["send", "step", "--valid-for-ms", "-1"],
        ["send", "step", "--source", ""],
        ["home", "--timeout", "0"],
        ["plot", "a.mcap"],
        ["dashboard", "--port", "70000"],
        ["scene", "burn"],
    ],
)
def test_usage_errors_exit_2(arguments, capsys):
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2
    assert "usage:" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--endpoint", "tcp://192.0.2.1:5555", "status"], "CURVE"),
        (["--endpoint", "carrier-pigeon", "status"], "carrier-pigeon"),
        (["--endpoint", "ipc://" + "x" * 200, "status"], "107"),
        (["--config", "/nowhere/tormagd.toml", "status"], "/nowhere/tormagd.toml"),
        (["send", "sawtooth"], "step, sine, ramp, pulse"),
        (["send", "step", "--to-N", "-1"], "--to-N = -1"),
        (["send", "step", "--rate", "5"], "at least one period, 200 ms"),
        (["scene", "show", "unheard-of"], "coronary"),
        (["scene", "show", "x" * 300], "File name too long"),
        (["plot", "/nowhere/a.mcap", "-o", "a.png"], "/nowhere/a.mcap"),
        (["dashboard", "/nowhere/a.mcap"], "/nowhere/a.mcap"),
        (["send", "/nowhere/a.csv"], "/nowhere/a.csv: No such file"),
        (["scene", "new", __file__], "allowed is a new file in a folder that exists"),
        (["scene", "new", "vein.toml"], "nobody to ask"),
    ],
)
def test_what_cannot_be_used_is_named_and_exits_2(arguments, named, capsys):
    code, printed = run_json(capsys, *arguments)
    assert code == 2
    assert named in printed["error"]["message"] + printed["error"]["hint"]


def test_a_configuration_names_the_endpoints(fake_daemon, tmp_path, capsys):
    config = tmp_path / "tormagd.toml"
    config.write_text(f'[endpoints]\ncontrol = "{fake_daemon.control}"\n')
    assert run_json(capsys, "--config", str(config), "status")[0] == 0


def test_scenes_are_listed_and_shown(capsys):
    names = [scene["name"] for scene in run_json(capsys, "scene", "list")[1]["result"]["scenes"]]
    assert {"coronary", "pulse", "brain"} <= set(names)
    shown = run_json(capsys, "scene", "show", "pulse")[1]["result"]
    assert shown["name"] == "pulse"
    assert shown["insert"]["gap_open_mm"] == 95.0
    # without a name: the configuration's
    assert run_json(capsys, "scene", "show")[1]["result"]["name"] == "coronary"


def test_scene_text_is_toml_that_loads_again(tmp_path, capsys):
    assert main(["scene", "show", "pulse"]) == 0
    copy = tmp_path / "copy.toml"
    copy.write_text(capsys.readouterr().out)
    assert run_json(capsys, "scene", "show", str(copy)) == run_json(capsys, "scene", "show", "pulse")


def test_a_scene_without_a_signal_is_shown_as_toml(tmp_path, capsys):
    scene = tmp_path / "scene.toml"
    text = 'name = "x"\ndescription = ""\n[force]\nleast_N = 0.0\nmost_N = 2.0\nresolution_N = 0.1\n'
    scene.write_text(f'{text}tolerance_rms_N = 0.05\n[insert]\nname = "MRE-50-40"\nmodel = "torque_mre_50_40"\n')
    assert main(["scene", "show", str(scene)]) == 0
    shown = capsys.readouterr().out
    assert "signal" not in shown
    assert "rate = true" in shown


def test_a_scene_is_checked_as_the_daemon_does(tmp_path, capsys):
    code, printed = run_json(capsys, "scene", "check", "brain")
    assert code == 0
    result = printed["result"]
    assert result["least_N"] == pytest.approx(0.157, abs=0.01)
    assert 0.0 < result["core_share"] < result["core_share_allowed"]
    assert result["missed_rms_N"] < 0.001
    fast = tmp_path / "fast.toml"
    fast.write_text(Path(scene_path("coronary")).read_text().replace("step_N = 0.1\n", ""))
    code, printed = run_json(capsys, "scene", "check", str(fast))
    assert code == 1
    assert "N/s at" in printed["error"]["message"]


def test_a_scene_over_its_budget_is_refused(tmp_path, capsys):
    poor = tmp_path / "poor.toml"
    poor.write_text(Path(scene_path("brain")).read_text() + "\n[budget]\ncore_share = 1e-6\n")
    code, printed = run_json(capsys, "scene", "check", str(poor))
    assert code == 1
    assert printed["error"]["code"] == "budget"
    assert "budget.core_share = 1e-06" in printed["error"]["message"]


def test_a_decision_is_explained_with_what_was_measured(tmp_path, capsys):
    assert main(["scene", "explain", "brain"]) == 0
    text = capsys.readouterr().out
    assert all(term in text for term in TERMS)
    assert "500 Hz      83 Hz" in text
    assert "coarse-to-fine" in text
    assert "sample_3 learning" in text
    other = tmp_path / "other.toml"
    other.write_text(Path(scene_path("coronary")).read_text().replace("most_N = 2.0", "most_N = 1.9"))
    code, printed = run_json(capsys, "scene", "explain", str(other))
    assert code == 1
    assert printed["error"]["code"] == "not_measured"
    assert "docs/guides/scene.md" in printed["error"]["hint"]


@pytest.mark.parametrize(("link", "is_shown"), [("RUNNING", True), ("BACK_OFF", False), ("REFUSED", False)])
def test_no_command_is_said_to_be_next_that_a_missing_device_would_refuse(status_with, link, is_shown):
    report = status_with()["link"] | {"state": link, "cause": "there is no such port", "remedy": "plug the device in"}
    known = status_with(next_commands=("home", "enable"), link=report)
    shown = status_text(msgspec.convert(known, Status), Colour(sys.stdout))
    assert ("next      home, enable" in shown) == is_shown
    assert "next: plug the device in" in shown


@pytest.fixture
def states(status_with: Any) -> Any:
    """Makes answers to `status`, one (is_homed, is_busy) after the other, the last one for ever."""

    def answers(*pairs: tuple[bool, bool], **changes: Any) -> Any:
        sequence = chain(pairs, repeat(pairs[-1]))

        def answer() -> dict[str, Any]:
            is_homed, is_busy = next(sequence)
            shown = {"is_homed": is_homed, "is_busy": is_busy, "operating_state": "DISABLED"}
            return {"ok": True, "result": status_with(**shown | changes)}

        return answer

    return answers


@pytest.mark.parametrize(
    "sequence",
    [
        [(False, False), (False, False), (False, True), (False, True), (True, False)],
        [(True, False), (True, False), (False, True), (True, False)],  # homed before: the old state is not the answer
        [(False, False), (True, False)],  # over between two looks
    ],
)
def test_home_waits_until_the_device_is_homed(fake_daemon, capsys, states, sequence):
    fake_daemon.answers["status"] = states(*sequence)
    code, printed = run_json(capsys, "--endpoint", fake_daemon.control, "home")
    assert code == 0
    assert printed["result"]["seconds"] >= 0.0
    assert fake_daemon.commands == ["status", "home", *["status"] * (len(sequence) - 1)]


@pytest.mark.parametrize(
    ("sequence", "timeout", "expected"),
    [
        ([(False, False), (False, True), (False, False)], "5", "not_homed"),
        ([(False, False), (False, True)], "0.15", "timeout"),
        ([(True, False)], "5", "not_begun"),
    ],
)
def test_home_that_does_not_succeed_says_how(fake_daemon, capsys, monkeypatch, states, sequence, timeout, expected):
    monkeypatch.setattr("tormagd.ctl.operate.BEGIN_S", 0.2)
    fake_daemon.answers["status"] = states(*sequence)
    code, printed = run_json(capsys, "--endpoint", fake_daemon.control, "home", "--timeout", timeout)
    assert (code, printed["error"]["code"]) == (1, expected)


def test_home_no_wait_returns_at_once(fake_daemon, capsys, states):
    fake_daemon.answers["status"] = states((False, False), (False, True))
    assert run_json(capsys, "--endpoint", fake_daemon.control, "home", "--no-wait")[0] == 0
    assert fake_daemon.commands == ["status", "home"]


class Terminal:
    def isatty(self) -> bool:
        return True


def test_colours_only_on_a_terminal_and_not_with_no_color(monkeypatch):
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setenv("TERM", "xterm")
    assert Colour(Terminal()).red("x") == "\x1b[31mx\x1b[0m"  # type: ignore[arg-type]
    monkeypatch.setenv("NO_COLOR", "1")
    assert Colour(Terminal()).red("x") == "x"  # type: ignore[arg-type]
    monkeypatch.delenv("NO_COLOR")
    monkeypatch.setenv("TERM", "dumb")
    assert Colour(Terminal()).red("x") == "x"  # type: ignore[arg-type]


def test_status_text_shows_what_is_not_known_as_such(status_with):
    nothing = ("setpoint_cf", "governed_cf", "measured_cf", "gap_mm", "gap_setpoint_mm", "skew_mm", "setpoint_age_ms")
    counters = dict.fromkeys(("frames", "bytes", "corrupt", "lost", "repeated", "resynchronisations"))
    known = status_with(**dict.fromkeys(nothing), link=status_with()["link"] | counters | {"state": "BACK_OFF"})
    lines = status_text(msgspec.convert(known, Status), Colour(sys.stderr)).splitlines()
    assert "force     asked -, governed -, measured -" in lines
    assert "gap       -, wanted -, skew -" in lines
    assert "link      BACK_OFF, 1 losses" in lines
    assert "setpoint  - old, 3 accepted, 1 refused, 0 dropped, 0 oversize" in lines
    assert lines[-1] == "refused   too much"
    assert "late by" not in "\n".join(lines)


def test_status_text_shows_what_is_believed_and_acts(status_with):
    belief = {
        "scale": {"value": 0.75, "sd": 0.01, "unit": "", "acts": True},
        "low_speed_factor": {"value": 1.12, "sd": None, "unit": "", "acts": True},
        "carriage_lag": {"value": 0.035, "sd": 0.002, "unit": "s", "acts": True},
        "relaxed": {"value": 0.2, "sd": None, "unit": "N", "acts": False},
    }
    known = msgspec.convert(status_with(belief=belief), Status)
    shown = status_text(known, Colour(sys.stderr)).splitlines()
    assert "believed  low_speed_factor 1.12, carriage_lag 0.035 ± 0.002 s" in shown


@pytest.mark.parametrize("folder", ["", "/var/lib/tormag/profiles"])
def test_status_text_says_why_a_profile_is_not_used_where_one_was_to_be(status_with, folder):
    profile = {"is_used": False, "age_s": None, "refusal": "it is of another serial", "folder": folder}
    shown = status_text(msgspec.convert(status_with(profile=profile), Status), Colour(sys.stdout))
    assert ("it is of another serial\n          next: tormagctl calibrate --device" in shown) == bool(folder)


def test_status_text_says_what_to_do_next(status_with):
    known = msgspec.convert(status_with(next_commands=("clear-fault", "home", "enable")), Status)
    assert "next      clear-fault, home, enable" in status_text(known, Colour(sys.stderr)).splitlines()
    assert "next  " not in status_text(msgspec.convert(status_with(), Status), Colour(sys.stderr))


def test_status_text_says_how_each_rate_is_kept_and_who_made_ticks_late(status_with):
    exec_us = {"p50": 12.0, "p99": 80.0, "p999": 90.0, "max": 95.0}
    counts = {"runs": 999, "overruns": 9, "stalls": 2, "merged": 4}
    group = {"grade": "error", "hz": 999.6, "lateness_us": exec_us | {"worst": 99.0}, "exec_us": exec_us} | counts
    blamed = {"TelemetryLoop.publish": 1, "kernel": 7, "Connection.receive": 1}
    known = status_with(rates={"control": group}, late_ticks_by=blamed)
    lines = status_text(msgspec.convert(known, Status), Colour(sys.stderr)).splitlines()
    assert "control   error, 1000 Hz, late 12 us (p50) 80 us (p99), overruns 9, stalls 2, merged 4" in lines
    assert "late by   7 kernel, 1 Connection.receive, 1 TelemetryLoop.publish" in lines


def test_status_text_shows_each_source_and_the_way(status_with, source_with):
    fine = {"cause": "", "remedy": ""}
    source = source_with()
    other = source_with(state="refused", clock_behind_ms=None, clock=None, restarts=0, **fine)
    silent = source_with(state="stale", silent_ms=2_340.0, **fine)
    delay_us = source["delay_us"]
    setpoints = status_with()["setpoints"] | {"by_source": {"a": source, "b\x1b[2J": other, "c": silent}}
    way = {"to_duty_us": delay_us, "device_us": 400.0, "carriages_ms": 12.3, "total_ms": 16.1, "budget_ms": 400.0}
    known = msgspec.convert(status_with(setpoints=setpoints, way=way), Status)
    lines = status_text(known, Colour(sys.stderr)).splitlines()
    at = lines.index(
        "source    'a': holds the brake, delay 1.2 ms (p50) 3.4 ms (p99), jitter 0.5 ms, 3 lost, "
        "clock 1001.0 ms behind, -201 ppm, 1 restarts"
    )
    assert lines[at + 1 : at + 3] == [f"          {source['cause']}", "          next: keep the clocks"]
    assert lines[at + 3].startswith("source    'b\\x1b[2J': refused, ")
    assert lines[at + 3].endswith("clock not known yet")
    assert lines[at + 4].startswith("source    'c': silent for 2.3 s, ")
    assert lines[at + 5] == (
        "way       16.1 ms of 400 ms, stamp to duty 1.2 ms (p50) 3.4 ms (p99), device 0.4 ms, carriages 12.3 ms"
    )
    late = way | {"to_duty_us": delay_us | {"p99": 420e3}, "total_ms": 432.7}
    text = status_text(msgspec.convert(status_with(way=late), Status), Colour(sys.stderr))
    assert "the force comes too late\n          next: most is from the stamp to the duty" in text


@pytest.mark.parametrize("command", [["status"], ["send", "step"], ["scene", "list"]])
def test_a_command_loads_only_what_it_needs(command, run_dir):
    script = (
        "import sys; from tormagd.ctl.main import main; main(sys.argv[1:]);"
        "print([m for m in ('torch', 'matplotlib', 'can', 'mcap', 'numpy', 'scipy', 'tormagd.daemon', 'serial',"
        "'rich', 'aiohttp', 'prometheus_client')"
        " if m in sys.modules], file=sys.stderr)"
    )
    ran = subprocess.run(
        [sys.executable, "-c", script, "--endpoint", f"ipc://{run_dir}/control", "--wait", "0.01", *command],
        capture_output=True,
        text=True,
        check=True,
        cwd=Path(__file__).parent,
    )
    assert ran.stderr.splitlines()[-1] == "[]"


def test_a_black_box_is_fetched_once_it_is_written(fake_daemon, status_with, capsys, tmp_path):
    original, copy = tmp_path / "20260101T000000.000Z-REQUEST.mcap", tmp_path / "mine.mcap"
    original.write_bytes(b"what is in it")
    boxes = iter([{"newest": "an older one"}, {"newest": original.name}])
    fake_daemon.answers["blackbox"] = lambda: {"ok": True, "result": {"file": str(original)}}
    fake_daemon.answers["status"] = lambda: {
        "ok": True,
        "result": status_with(black_box={"folder": str(tmp_path)} | next(boxes)),
    }
    code, printed = run_json(capsys, "--endpoint", fake_daemon.control, "blackbox", str(copy))
    assert (code, printed["result"]) == (0, {"file": str(copy), "original": str(original)})
    assert copy.read_bytes() == b"what is in it"
    # nothing is overwritten, and nothing asked for
    asked = list(fake_daemon.commands)
    assert run_json(capsys, "--endpoint", fake_daemon.control, "blackbox", str(copy))[0] == 2
    assert fake_daemon.commands == asked


def test_a_black_box_that_cannot_be_had_says_why(fake_daemon, capsys, tmp_path):
    fake_daemon.answers["blackbox"] = lambda: {"ok": True, "result": {"file": "/nowhere/a.mcap"}}
    fake_daemon.says(black_box={"folder": "/nowhere", "refusal": "/nowhere/a.mcap: No space left on device"})
    code, printed = run_json(capsys, "--endpoint", fake_daemon.control, "blackbox")
    assert (code, printed["error"]["code"]) == (1, "not_written")
    assert "No space left" in printed["error"]["message"]
    fake_daemon.refuse("blackbox", "no_black_box")
    assert run_json(capsys, "--endpoint", fake_daemon.control, "blackbox")[1]["error"]["code"] == "no_black_box"
    fake_daemon.answers["blackbox"] = lambda: {"ok": True, "result": {"file": "/nowhere/b.mcap"}}
    fake_daemon.says(black_box={"newest": "b.mcap"})
    code, printed = run_json(capsys, "--endpoint", fake_daemon.control, "blackbox", str(tmp_path / "a.mcap"))
    assert (code, printed["error"]["code"]) == (2, "usage")
    assert "/nowhere/b.mcap on the daemon's machine" in printed["error"]["hint"]
