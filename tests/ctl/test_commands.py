import math
import re
import subprocess
import sys
from pathlib import Path
from typing import Any, get_args, get_type_hints

import msgspec
import pytest

from firmware_protocol.build import COST, REMEDY
from tormagd.ctl.outcome import Colour
from tormagd.ctl.status import firmware_text, status_text
from tormagd.scenes.measured import ENDING, MeasuredScene, OperatingPoint, Served
from tormagd.scenes.scene import load_scene, scene_path
from tormagd_client.endpoints import ENDPOINTS
from tormagd_client.messages import LinkReport, Status

SUPPLY = {"code": "SUPPLY", "cause": "supply voltage low", "remedy": "check the power supply, then tormagctl arm"}
IN_FAULT = {"operating_state": "FAULT", "faults": ["SUPPLY"], "fault_details": [SUPPLY]}
STOPPED = {"code": "STOPPED", "cause": "somebody gave the stop command", "remedy": "clear-fault"}
STANDS = {"code": "NOT_OPENING", "cause": "it stands", "remedy": "remove the insert by hand"}
SHUT = {"operating_state": "FAULT", "faults": ["STOPPED", "NOT_OPENING"], "fault_details": [STOPPED, STANDS]}
Row = tuple[dict[str, Any], dict[str, Any], int, list[str]]
UNDONE: list[Row] = [
    ({}, result, 1, ['"code":"not_done"']) for result in ({}, {"operating_state": None}, {"operating_state": "ASLEEP"})
]
NOT_UNDERSTOOD: list[Row] = [
    ({"version": "0.0.9", key: value}, {}, 3, ['"code":"unintelligible"', "tormagd 0.0.9", key])
    for key, value in (("is_homed", None), ("link", 3), ("rates", {"control": 3}), ("limits", None))
]
ARMED = {"given": ["home", "enable"], "is_over": True, "error": None}
A_FAULT = {"code": "fault", "cause": "it came back", "remedy": "tormagctl status"}
LINK_KEYS = [f'"{each.name}":' for each in msgspec.structs.fields(LinkReport) if each.required]
ANSWERS: dict[str, list[Row]] = {
    "status": [
        ({"operating_state": "ENABLED"}, {}, 0, ["state     ENABLED, homed"]),
        (IN_FAULT, {}, 4, ["fault     SUPPLY", "supply voltage low", "next: check the power supply"]),
    ],
    # a newer daemon's too
    "--json status": [
        ({"core_share": 0.1}, {}, 0, ['"core_share":0.1', '"measured_jp":[35.0,35.0]', '"frames":55096']),
        *NOT_UNDERSTOOD,
    ],
    "--json firmware": [
        # a newer daemon's too
        ({"link": {"newer": 1}}, {}, 0, ['"newer":1', '"port":"/dev/tormag"', '"frames":55096', *LINK_KEYS]),
        *NOT_UNDERSTOOD,
    ],
    "firmware": [({}, {}, 0, ["RUNNING"])],
    "top": [({}, {}, 2, ["next: tormagctl status"])],  # there is no terminal
    "--json scene list": [({}, {}, 0, [f'"name":"{scene}"' for scene in ("coronary", "pulse", "brain")])],
    "--json scene show pulse": [({}, {}, 0, ['"name":"pulse"', '"gap_open_mm":95.0'])],
    "--json scene show": [({}, {}, 0, ['"name":"coronary"'])],  # the configuration's
    "record /nowhere/a.mcap": [({}, {}, 2, ["/nowhere/a.mcap: No such file"])],
    "stop": [
        ({"is_open": True}, {"operating_state": "FAULT", "is_connected": True}, 0, ["latched; the gap is open"]),
        ({}, {"operating_state": "FAULT", "is_connected": False}, 1, ["nothing could be sent"]),
        (SHUT, {"operating_state": "FAULT", "is_connected": True}, 4, ["is not open: STOPPED, NOT_OPENING: it stands"]),
    ],
    "disable": [
        ({"is_open": True}, {"operating_state": "DISABLED"}, 0, ["disabled; the gap is open"]),
        (SHUT, {"operating_state": "DISABLED"}, 4, ["is not open: STOPPED, NOT_OPENING: it stands"]),
        (SHUT | {"is_busy": True}, {"operating_state": "DISABLED"}, 4, ["NOT_OPENING: it stands", "remove the insert"]),
        ({"is_busy": True, "is_open": True}, {"operating_state": "DISABLED"}, 1, ["0.2 s the gap is not open: 70.0"]),
        ({"gap_mm": None}, {"operating_state": "DISABLED"}, 1, ["after 0.2 s the gap is not known to be open"]),
    ],
    "take b": [
        ({}, {"source": "b", "instead_of": "a"}, 0, ["'b' holds the brake instead of 'a'"]),
        ({}, {"source": "b", "instead_of": "b"}, 0, ["'b' holds the brake already"]),
    ],
    "--json take b": [({}, {"source": "c", "instead_of": "a"}, 1, ['"code":"not_done"'])],
    "confirm device": [({}, {"confirmed": "device"}, 0, ["it is learned anew"])],
    "confirm sensor": [
        ({}, {"confirmed": "sensor"}, 0, ["the force sensor is wrong: SENSOR"]),
        ({}, {"confirmed": "device"}, 1, ["'device' is confirmed, not 'sensor'"]),
    ],
    "mark stuck": [({}, {"t_ns": 7, "text": "stuck"}, 0, ["marked: stuck\n"])],
    # a fault that stays or comes back is no success
    "clear-fault": [
        ({}, {"operating_state": "DISABLED"}, 0, ["no fault is latched; it is DISABLED"]),
        ({}, {"operating_state": "PAUSED"}, 0, ["no fault is latched; it is PAUSED"]),
    ],
    "--json clear-fault": [
        (IN_FAULT, {"operating_state": "DISABLED"}, 4, ['"code":"fault"', "came back: SUPPLY: supply voltage low"]),
        *UNDONE,
    ],
    "arm": [
        ({"arm": ARMED}, {}, 0, ["tormagctl arm: home\n", "the force goes to 1.50 N along the scene's ramp"]),
        ({"arm": ARMED | {"given": []}}, {}, 0, ["it was armed already"]),
        ({"arm": ARMED, "operating_state": "PAUSED"}, {}, 1, ["it was armed, and is PAUSED"]),
        (IN_FAULT | {"arm": ARMED | {"error": A_FAULT}}, {}, 4, ["tormagctl arm: home\n", "it came back"]),
    ],
    "--json home": [
        (IN_FAULT | {"is_busy": True}, {}, 4, ['"code":"fault"', "supply, then tormagctl clear-fault"]),
        *NOT_UNDERSTOOD,
    ],
    **{f"--json {command}": UNDONE for command in ("enable", "disable", "pause", "resume", "stop")},
    "enable": [({}, {"operating_state": "ENABLED"}, 0, ["enabled\n"])],
    "pause": [({}, {"operating_state": "PAUSED"}, 0, ["paused; the gap is held\n"])],
    "resume": [({}, {"operating_state": "ENABLED"}, 0, ["resumed\n"])],
}


ARGS = {
    "take b": {"source": "b"},
    "confirm device": {"what": "device"},
    "confirm sensor": {"what": "sensor"},
    "mark stuck": {"text": "stuck"},
}


@pytest.mark.parametrize(
    ("command", "status", "result", "code", "words"),
    [(command, *row) for command, rows in ANSWERS.items() for row in rows],
)
def test_what_a_daemon_answers_decides_the_exit_code_and_is_told(
    fake_daemon, ctl, monkeypatch, command, status, result, code, words
):
    monkeypatch.setattr("tormagd.ctl.operate.OPENS_S", 0.2)
    fake_daemon.says(**status)
    plain = command.removeprefix("--json ")
    name = plain.split()[0]
    if name != "status":
        fake_daemon.answers[name] = lambda: {"ok": True, "result": result}
    printed = "".join(ctl(*fake_daemon.at, *command.split()).ended(code)[1:])
    assert [word for word in words if word not in printed] == []
    assert all(each["args"] == ARGS.get(plain, {}) for each in fake_daemon.requests if each["command"] == name)


@pytest.mark.parametrize(("code", "expected"), [("not_homed", 1), ("fault", 4), ("device_latched", 4)])
def test_a_refusal_tells_code_message_and_hint(fake_daemon, ctl, code, expected):
    fake_daemon.refuse("enable", code)
    assert ctl(*fake_daemon.at, "--json", "enable").ended(expected).error == {
        "code": code,
        "message": "cannot enable",
        "hint": "do this first",
    }
    captured = ctl(*fake_daemon.at, "enable").ended(expected)
    assert (captured.out, captured.err) == ("", "tormagctl enable: cannot enable\n  next: do this first\n")


@pytest.mark.parametrize("command", ["stop", "disable", "status"])
def test_a_daemon_is_stopped_although_its_configuration_was_spoilt_since(fake_daemon, ctl, tmp_path, command):
    addresses = "\n".join(f'{name} = "ipc://{fake_daemon.directory}/{name}"' for name in ENDPOINTS)
    spoilt = tmp_path / "tormagd.toml"
    spoilt.write_text(f"[endpoints]\n{addresses}\n[limits]\nskew_fault_mm = 0.0001\n[typo]\n")
    ctl("--config", str(spoilt), "--wait", "5", command)
    assert fake_daemon.commands[0] == command
    spoilt.write_text("x = [")
    assert "or give --endpoint" in ctl("--config", str(spoilt), command).ended(2).err


def test_a_fault_that_is_cleared_is_watched_until_it_would_have_come_back(fake_daemon, ctl):
    def clear():
        fake_daemon.says(operating_state="DISABLED")
        return {"ok": True, "result": {"operating_state": "DISABLED"}}

    fake_daemon.answers["clear-fault"] = clear
    fake_daemon.says(operating_state="FAULT", faults=["STOPPED"])
    assert "fault cleared; nothing moves before tormagctl arm" in ctl(*fake_daemon.at, "clear-fault").ended(0).out
    assert (fake_daemon.commands[:2], set(fake_daemon.commands[2:])) == (["status", "clear-fault"], {"status"})


@pytest.mark.parametrize(
    "arguments",
    [["status"], ["home"], ["send", "step"], ["record", "out.mcap"], ["firmware"], ["metrics"], ["dashboard"]],
)
def test_without_a_daemon_every_command_ends_with_3(run_dir, ctl, arguments, monkeypatch):
    monkeypatch.chdir(run_dir)
    error = ctl("--endpoint", f"ipc://{run_dir}/control", "--wait", "0.05", "--json", *arguments).ended(3).error
    assert (error["code"], "start the daemon" in error["hint"]) == ("unreachable", True)
    assert list(run_dir.iterdir()) == []


def test_guides_are_listed_and_printed_as_they_are(ctl):
    listed = ctl("--json", "guide").result["guides"]
    assert (listed["recover"], listed["troubleshooting"]) == ("Recover from a fault", "Troubleshooting")
    for name in listed:
        (page,) = (Path(__file__).parents[2] / "docs").glob(f"**/{name}.md")
        assert ctl("guide", name).ended(0).out == page.read_text(encoding="utf-8").rstrip() + "\n"


def test_a_scene_without_a_signal_is_shown_as_toml(tmp_path, ctl):
    scene = tmp_path / "scene.toml"
    text = 'name = "x"\ndescription = ""\n[force]\nleast_N = 0.0\nmost_N = 2.0\nresolution_N = 0.1\n'
    scene.write_text(f'{text}tolerance_rms_N = 0.05\n[insert]\nname = "MRE-50-40"\nmodel = "torque_mre_50_40"\n')
    shown = ctl("scene", "show", str(scene)).ended(0).out
    assert "signal" not in shown
    assert "rate = true" in shown


def test_a_scene_is_checked_as_the_daemon_does(ctl):
    result = ctl("--json", "scene", "check", "brain").ended(0).result
    assert result["least_N"] == pytest.approx(0.157, abs=0.01)
    assert 0.0 < result["core_share"] < result["core_share_allowed"]
    assert result["missed_rms_N"] < 0.001
    waits_N, comes_s = zip(*result["approaches_s"], strict=True)
    assert list(waits_N) == sorted(waits_N)
    assert list(comes_s) == sorted(comes_s, reverse=True)


WAYS: dict[str, tuple[Any, ...]] = {
    "usual": (1000, 500, "newton"),
    "cheap": (500, 83, "newton"),
    "dear": (1000, 500, "nearest"),
    "nearer": (500, 83, "newton", 0.8),
}


def run_of(way: str, share: float, contact_N: float) -> Served:
    return Served(OperatingPoint(*WAYS[way]), "sample_2", {"signal": 0.01, "contact": contact_N}, share, 50.0)


@pytest.fixture
def fast(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A scene with what was measured of it beside it: the cheap way is as exact as its tolerance asks, but not more."""
    monkeypatch.setattr("tormagd.scenes.measured.SERIAL_SAVES", 0.0)
    path = tmp_path / "fast.toml"
    stated = scene_path("coronary").read_text(encoding="utf-8").replace("most_N = 2.0", "most_N = 1.9")
    path.write_text(stated, encoding="utf-8")
    usual, cheap, dear = run_of("usual", 0.2, 0.100), run_of("cheap", 0.1, 0.105), run_of("dear", 0.3, 0.02)
    nearer = run_of("nearer", 0.28, 0.015)
    scene = load_scene(str(path))
    assert scene.force.most_N == 1.9
    found = MeasuredScene(scene.fingerprint, 0.05, 1e3, (usual, cheap, dear), (cheap, usual), (nearer,))
    path.with_suffix(ENDING).write_bytes(msgspec.json.encode(found))
    return path


def test_every_measured_way_is_shown_with_what_it_costs(fast, ctl, checked_here):
    rows = ctl("scene", "explain", str(fast)).ended(0).out.splitlines()
    shown = {name: next(row for row in rows if row.startswith(str(OperatingPoint(*WAYS[name])))) for name in WAYS}
    assert [("chosen" in row, "runs here" in row) for row in shown.values()] == [
        (False, False),
        (True, True),
        (False, False),
        (False, False),
    ]
    assert "10.0    105.0" in shown["cheap"]
    assert (
        "The scene states 1000 / 500 Hz, nearest; 1000 / 500 Hz, newton serves it for"
        in ctl("scene", "explain", "pulse").ended(0).out
    )


@pytest.mark.parametrize(
    ("bound", "way"),
    [
        (("--tolerance", "0.11"), "cheap"),
        (("--tolerance", "0.1"), "usual"),
        (("--tolerance", "0.02"), "dear"),  # more of the processor, and nothing of a hand
        (("--tolerance", "0.016"), "nearer"),
        (("--share", "100"), "nearer"),
    ],
)
def test_the_cheapest_way_within_an_error_and_the_most_exact_at_a_price_are_written(
    bound, way, fast, ctl, checked_here, monkeypatch
):
    out = fast.with_name("mine.toml")
    with monkeypatch.context() as slow:
        slow.setattr("tormagd.ctl.scene.machine_us", lambda: 2e3)
        found = ctl("--json", "scene", "check", str(fast), *bound, "--out", str(out)).ended(0).result
    assert tuple(found["way"].values()) == WAYS[way]
    assert found["daemon_share"] == pytest.approx({"usual": 0.4, "cheap": 0.2, "dear": 0.6, "nearer": 0.56}[way])
    assert load_scene(str(out)).fingerprint == load_scene(str(fast)).fingerprint
    assert (load_scene(str(out)).force.standby_N or None) == (0.8 if way == "nearer" else None)
    derived = ctl("--json", "scene", "check", str(out)).ended(0).result  # what is written is taken, and keeps its rates
    assert (derived["control_hz"], derived["inference_hz"], derived["solver"]["solver"]) == WAYS[way][:3]


def test_of_ways_that_are_alike_the_cheaper_is_taken(fast, ctl, monkeypatch):
    monkeypatch.setattr("tormagd.ctl.scene.machine_us", lambda: 1e3)
    found = ctl("--json", "scene", "check", str(fast), "--share", "0.25").ended(0).result
    assert tuple(found["way"].values()) == WAYS["cheap"]
    refused = ctl("--json", "scene", "check", str(fast), "--share", "0.05").ended(1).error
    assert "--share = 0.05: allowed is at least 0.1 of a processor" in refused["message"]


AWAY, GOING, HOMED = (
    {"is_homed": is_homed, "is_busy": is_busy, "operating_state": "DISABLED"}
    for is_homed, is_busy in ((False, False), (False, True), (True, False))
)


@pytest.mark.parametrize(
    ("looks", "refused"),
    [
        ([AWAY, AWAY, GOING, GOING, HOMED], None),
        ([HOMED, HOMED, GOING, HOMED], None),  # homed before: the old state is no answer
        ([AWAY, HOMED], None),  # over between two looks
        ([AWAY, GOING, AWAY], "not_homed"),
        ([AWAY, GOING, AWAY | {"link": {"losses": 2, "last_loss": "no message"}}], "lost: no message"),
        ([AWAY, GOING], "timeout"),
        ([HOMED], "not_begun"),
    ],
)
def test_home_waits_until_the_device_is_homed_or_says_why_it_is_not(fake_daemon, ctl, monkeypatch, looks, refused):
    if refused:
        monkeypatch.setattr("tormagd.ctl.operate.BEGIN_S", 0.2)
        monkeypatch.setattr("tormagd.ctl.operate.HOMES_S", 1.0)
    fake_daemon.says_in_turn(*looks)
    said = ctl(*fake_daemon.at, "--json", "home").ended(1 if refused else 0).said
    assert refused in " ".join(said["error"].values()) if refused else "seconds" in said["result"]
    assert refused or fake_daemon.commands == ["status", "home", *["status"] * (len(looks) - 1)]


NO_PORT = {"cause": "there is no such port", "remedy": "plug the device in"}
ANOTHERS = {"is_used": False, "age_s": None, "refusal": "it is of another serial"}
UNKNOWN = dict.fromkeys(
    ("setpoint_cf", "governed_cf", "measured_cf", "gap_mm", "gap_setpoint_mm", "skew_mm", "setpoint_age_ms")
)
UNCOUNTED = dict.fromkeys(("frames", "bytes", "corrupt", "lost", "repeated", "resynchronisations"))
STATUS_TEXTS: dict[str, tuple[dict[str, Any], tuple[str, ...], tuple[str, ...]]] = {
    "what is not known is shown as such": (
        UNKNOWN | {"link": UNCOUNTED | {"state": "BACK_OFF"}},
        (
            "force     asked -, governed -, measured -",
            "gap       -, wanted -, skew -",
            "link      BACK_OFF, 1 losses",
            "setpoint  - old, 3 accepted, 1 refused, 0 dropped",
        ),
        ("late by",),
    ),
    "what is believed and acts": (
        {
            "belief": {
                "scale": {"value": 0.75, "sd": 0.01, "unit": "", "acts": True},
                "low_speed_factor": {"value": 1.12, "sd": None, "unit": "", "acts": True},
                "way": {"value": -0.021, "sd": 0.004, "unit": "", "acts": True},
                "ripple": {"value": 0.03, "sd": None, "unit": "", "acts": True},
                "carriage_lag": {"value": 0.035, "sd": 0.002, "unit": "s", "acts": True},
                "relaxed": {"value": 0.2, "sd": None, "unit": "N", "acts": False},
            }
        },
        (
            "believed  force at a creep over that at speed 1.12, friction's excess in the positive direction "
            "-2.1 ± 0.4 %, friction's greatest wave in a turn 3 %, carriages' delay 35 ± 2 ms",
        ),
        (),
    ),
    "why a profile is not used where one was to be": (
        {"profile": ANOTHERS | {"folder": "/var/lib/tormag/profiles"}},
        ("          it is of another serial\n          next: tormagctl calibrate --device, which keeps a new profile",),
        (),
    ),
    "the calibration in force": (
        {"calibration": {"file": "/c/00000007.toml"}},
        ("calibrated by /c/00000007.toml",),
        (),
    ),
    "why the device's calibration is not used": (
        {"calibration": {"refusal": "serial_number = 8: allowed is 7"}},
        (
            "          serial_number = 8: allowed is 7\n"
            "          next: tormagctl commission FOLDER writes a new one; then systemctl reload tormagd",
        ),
        ("calibrated",),
    ),
    "nothing of a profile where none was to be": ({"profile": ANOTHERS | {"folder": ""}}, (), ("another serial",)),
    "what to do next": (
        {"next_commands": ("clear-fault", "home", "enable")},
        ("next      tormagctl arm: clear-fault, home, enable",),
        (),
    ),
    "nothing to do next": ({}, (), ("next  ",)),
    "how each rate is kept and who made ticks late": (
        {
            "late_ticks_by": {"TelemetryLoop.publish": 1, "kernel": 7, "Connection.receive": 1},
        },
        (
            "control   warning, 1000 Hz, late 41 us (p50) 304 us (p99), overruns 2, stalls 3, merged 1",
            "late by   7 kernel, 1 Connection.receive, 1 TelemetryLoop.publish",
        ),
        (),
    ),
    "what the kernel refused": (
        {"not_granted": ["realtime.fifo_priority = 50: not permitted", "realtime.lock_memory: no"]},
        (
            "kernel    did not grant realtime.fifo_priority = 50: not permitted\n"
            "kernel    did not grant realtime.lock_memory: no\n          next: tormagctl doctor",
        ),
        (),
    ),
    "nothing of the kernel where it granted all": ({}, (), ("kernel", "doctor")),
    "when it was asked, where that was long ago": (
        {"setpoint_cf": 1.62, "setpoint_age_ms": 36_000.0, "measured_cf": None},
        ("force     asked 1.620 N 36 s ago, governed 1.500 N, measured -",),
        (),
    ),
    "how well the force was followed": (
        {"following": {"rms_N": 0.136, "aligned_rms_N": 0.044, "delay_ms": 180.0}},
        ("followed  to 136 mN RMS, 44 mN with a delay of 180 ms taken out",),
        (),
    ),
    "how old the search is": ({"search_age_ms": 12.0}, ("field     of a search 12 ms ago",), ()),
    "nothing of a search where there was none": ({"search_age_ms": 0.0}, (), ("of a search",)),
    "a compiled core": ({"build": "compiled"}, ("core      compiled",), (COST, REMEDY)),
    "what an interpreted core costs": (
        {"build": "interpreted: no C compiler"},
        (f"core      interpreted: no C compiler\n          {COST}\n          next: {REMEDY}",),
        ("core      compiled",),
    ),
    "nothing of the core of an older daemon": ({"build": ""}, (), ("\ncore",)),
    # no command is proposed that a missing device would refuse
    **{
        f"what is next at a link that is {state}": (
            {"next_commands": ("home", "enable"), "link": NO_PORT | {"state": state}},
            ("          there is no such port\n          next: plug the device in", *shown),
            () if shown else ("next  ",),
        )
        for state, shown in (("RUNNING", ("next      tormagctl arm: home, enable",)), ("BACK_OFF", ()), ("REFUSED", ()))
    },
}


@pytest.fixture
def shown(status_with: Any) -> Any:
    return lambda **changes: f"\n{status_text(msgspec.convert(status_with(**changes), Status), Colour(sys.stdout))}\n"


@pytest.mark.parametrize(("changes", "blocks", "absent"), STATUS_TEXTS.values(), ids=STATUS_TEXTS)
def test_status_text_shows(shown, changes, blocks, absent):
    text = shown(**changes)
    assert [block for block in blocks if f"\n{block}\n" not in text] == []
    assert [word for word in absent if word in text] == []
    assert text.endswith("\nrefused   too much\n")


def test_status_text_shows_each_source_and_the_way(shown, source_with):
    fine = {"cause": "", "remedy": ""}
    source = source_with()
    other = source_with(state="refused", clock_behind_ms=None, clock=None, restarts=0, **fine)
    silent = source_with(state="stale", silent_ms=2_340.0, **fine)
    delay_us = source["delay_us"]
    playout = {"playout_ms": 60.0, "held_us": delay_us, "jitter_us": 2_340.0, "setpoints": 900, "late": 7}
    setpoints = {"by_source": {"a": source, "b\x1b[2J": other, "c": silent}, "playout": playout}
    way = {"to_duty_us": delay_us, "device_us": 400.0, "carriages_ms": 12.3, "total_ms": 16.1, "budget_ms": 400.0}
    delay = "delay 1.2 ms (p50) 3.4 ms (p99), jitter 0.5 ms, 3 lost"
    lines = (
        f"source    'a': holds the brake, {delay}, clock 1001.0 ms behind, -201 ppm, 1 restarts",
        f"          {source['cause']}",
        "          next: keep the clocks",
        rf"source    'b\x1b[2J': refused, {delay}, clock not known yet",
        f"source    'c': silent for 2.3 s, {delay}, clock 1001.0 ms behind, -201 ppm, 1 restarts",
        "playout   60 ms after the stamp: adds 1.2 ms (p50), takes out 2.3 ms of jitter, 7 of 900 came too late",
        "way       16.1 ms of 400 ms, stamp to duty 1.2 ms (p50) 3.4 ms (p99), device 0.4 ms, carriages 12.3 ms",
    )
    assert "\n".join(lines) in shown(setpoints=setpoints, way=way)
    assert "way  " not in shown(way=way, setpoint_cf=None), "nothing is on its way any more"
    late = way | {"to_duty_us": delay_us | {"p99": 420e3}, "total_ms": 432.7}
    assert "the force comes too late\n          next: most is from the stamp to the duty" in shown(way=late)


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


def test_a_black_box_is_waited_for_until_it_is_written_or_cannot_be(fake_daemon, ctl):
    fetch = (*fake_daemon.at, "--json", "blackbox")
    fake_daemon.answers["blackbox"] = lambda: {"ok": True, "result": {"file": "/boxes/new.mcap"}}
    boxes = [{"folder": "/boxes", "newest": newest} for newest in ("an older one", "new.mcap")]
    fake_daemon.says_in_turn(*({"black_box": each} for each in boxes))
    assert ctl(*fetch).ended(0).result == {"file": "/boxes/new.mcap"}
    fake_daemon.says(black_box={"folder": "/boxes", "refusal": "/boxes/new.mcap: No space left on device"})
    error = ctl(*fetch).ended(1).error
    assert (error["code"], "No space left" in error["message"]) == ("not_written", True)
    fake_daemon.refuse("blackbox", "no_black_box")
    assert ctl(*fetch).error["code"] == "no_black_box"


# -- firmware ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def text(status_with: Any) -> Any:
    return lambda **changes: firmware_text(
        msgspec.convert(status_with(link=changes)["link"], LinkReport), Colour(sys.stdout)
    )


EVERYTHING = (
    "RUNNING on /dev/tormag (serial)",
    "1.0, device 7",
    "4b3a5911 (the daemon's too), protocol 1",
    "1 since the daemon started, the last: no message for 80 ms",
    "55096 frames",
    "2 lost",
    "402 us (p50)",
    "+30.1 ppm",
)
REFUSED = {"state": "REFUSED", "firmware_schema": "1f00c0de", "cause": "the schemas differ", "remedy": "install one"}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, EVERYTHING),
        (REFUSED, ("1f00c0de (the daemon's is 4b3a5911)", "the schemas differ", "next: install one")),
    ],
)
def test_everything_that_is_known_is_said(text: Any, changes: dict[str, str], said: tuple[str, ...]) -> None:
    assert [words for words in said if words not in text(**changes)] == []


def test_nothing_known_is_no_error(text: Any) -> None:
    nullable = {name for name, kind in get_type_hints(LinkReport).items() if type(None) in get_args(kind)}
    assert {"frames", "firmware", "clock"} < nullable
    shown = text(**dict.fromkeys(nullable))
    assert "not known yet" in shown
    assert "None" not in shown


# -- scene new ---------------------------------------------------------------------------------------------------------


def recording(path: Path, least_N: float, most_N: float, rate_hz: float) -> Path:
    middle, half = (least_N + most_N) / 2.0, (most_N - least_N) / 2.0
    rows = [f"{0.02 * n:.2f},{middle - half * math.cos(0.04 * math.pi * rate_hz * n):.5f}" for n in range(1000)]
    path.write_text("t_s,force_N\n" + "\n".join(rows) + "\n")
    return path


def test_a_recorded_force_becomes_a_scene_with_the_softest_insert_that_renders_it(tmp_path, ctl, checked_here):
    forces = recording(tmp_path / "forces.csv", 0.31, 0.62, 0.3)
    out = tmp_path / "scenes" / "mine.toml"
    out.parent.mkdir()
    assert ctl("scene", "new", str(out), "--force", str(forces), "--json").ended(0).result["insert"] == "MRE-10-10"
    scene = load_scene(str(out))
    assert (scene.name, scene.force.least_N, scene.force.most_N, scene.force.tolerance_rms_N) == (
        "mine",
        0.31,
        0.62,
        pytest.approx(0.016),
    )
    assert scene.signal.file == "../forces.csv"
    ctl("scene", "check", str(out)).ended(0)


@pytest.mark.parametrize(
    ("most_N", "rate_hz", "insert", "parts"),
    [
        (40.0, 0.1, "MRE-50-40", ["force.most_N = 40"]),
        (2.0, 5.0, "MRE-50-40", ["tolerance_rms_N = 0.065: allowed for its signal is at least"]),
        (1.5, 5.0, "MRE-10-20", ["tolerance_rms_N = 0.04: allowed for its signal is at least"]),
    ],
)
def test_a_force_that_no_insert_renders_is_written_and_marked(
    tmp_path, ctl, checked_here, most_N, rate_hz, insert, parts
):
    out = tmp_path / "mine.toml"
    result = (
        ctl("scene", "new", str(out), "--force", str(recording(tmp_path / "f.csv", 0.7, most_N, rate_hz)), "--json")
        .ended(1)
        .result
    )
    assert result["insert"] == insert
    assert all(any(part in line for line in result["unmet"]) for part in parts)
    head = " ".join(line.strip("# ") for line in out.read_text().partition("\n[")[0].splitlines())
    assert head.startswith(f"NOT MET: {result['unmet'][0]}")
    told = ctl("scene", "check", str(out), "--json").ended(1).error["message"]
    assert told == "scene mine: " + "; and ".join(result["unmet"])


def test_what_is_not_met_is_met_by_the_tolerance_that_is_named(tmp_path, ctl, checked_here):
    forces = recording(tmp_path / "f.csv", 0.7, 2.0, 5.0)
    unmet = ctl("scene", "new", str(tmp_path / "a.toml"), "--force", str(forces), "--json").ended(1).result["unmet"]
    [tolerance] = re.findall(r"at least ([0-9.]+):", unmet[0])
    out = str(tmp_path / "b.toml")
    ctl("scene", "new", out, "--force", str(forces), "--tolerance", tolerance, "--insert", "MRE-50-40").ended(0)
    assert load_scene(out).force.tolerance_rms_N == float(tolerance)


def test_another_quantity_becomes_a_force_by_scale_and_offset(tmp_path, ctl, checked_here):
    (tmp_path / "f.csv").write_text(
        "t_s,note,ABP_mmHg\n-1e-7,a,70\n" + "".join(f"{n},a,{70 + 50 * (n % 2)}\n" for n in range(30))
    )
    given = ("--force", str(tmp_path / "f.csv"), "--column", "ABP_mmHg", "--scale", "0.01", "--offset", "0.5")
    scene = load_scene(ctl("scene", "new", str(tmp_path / "mine.toml"), *given, "--json").ended(0).result["file"])
    assert (scene.force.least_N, scene.force.most_N, scene.signal.file) == (1.2, 1.7, "mine.csv")
    assert (tmp_path / "mine.csv").read_text().splitlines()[:3] == ["t_s,force_N", "-1e-07,1.2", "0.0,1.2"]


def test_without_a_recording_it_asks_and_enter_takes_what_is_proposed(
    tmp_path, ctl, monkeypatch, terminal, checked_here
):
    monkeypatch.setattr(sys, "stdin", terminal("A vein is held open.\n\n1.5\nmuch\n0.06\n" + "\n" * 6))
    scene = load_scene(ctl("scene", "new", str(tmp_path / "vein.toml"), "--json").ended(0).result["file"])
    assert (scene.description, scene.force.most_N, scene.force.tolerance_rms_N) == ("A vein is held open.", 1.5, 0.06)
    assert (scene.force.resolution_N, scene.signal.bandwidth_hz) == (0.12, 0.2)
