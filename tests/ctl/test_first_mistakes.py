"""What is done wrong first, without a daemon: each gets one sentence with its remedy, and the documented exit code."""

import re
import shlex
from pathlib import Path

import pytest

from tormagd.ctl import main as ctl
from tormagd.daemon import main as daemon
from tormagd.scenes.scene import scene_path
from tormagd_client.errors import unreachable

COMMANDS = {"tormagctl": ctl.main, "tormagd": daemon.main}
USAGE = re.compile(r"^usage:.*?(?=^\S.*: error:)", re.MULTILINE | re.DOTALL)
SCENE = """name = "mine"
description = "a task"
[force]
least_N = 0.0
most_N = 2.0
resolution_N = 0.1
tolerance_rms_N = 0.05
[insert]
name = "MRE-50-40"
model = "cut.safetensors"
"""
OPEN = '[endpoints]\nsetpoint = "tcp://0.0.0.0:5555"\n'
KEYED = OPEN + '[endpoints.curve]\nserver_secret = "server.key_secret"\n'
CORONARY, BRAIN = (Path(scene_path(name)).read_text(encoding="utf-8") for name in ("coronary", "brain"))


@pytest.mark.parametrize(
    ("command", "code", "says", "files"),
    [
        ("tormagctl stauts", 2, "invalid choice: 'stauts' (choose from", {}),
        ("tormagctl --endpoint ipc:///nowhere/control status", 3, "start the daemon", {}),
        (
            "tormagd --check --config misspelt.toml",
            2,
            "unknown field `prot` - at `$.device`; did you mean `port`? (line 2)",
            {"misspelt.toml": '[device]\nprot = "/dev/ttyACM0"\n'},
        ),
        (  # a byte order mark is no mistake: what is wrong behind it is found
            "tormagd --check --config bom.toml",
            2,
            "`int` >= 83 - at `$.rates.control_hz` (it is 1) (line 2)",
            {"bom.toml": "\ufeff[rates]\ncontrol_hz = 1\n"},
        ),
        ("tormagctl send nan.csv", 2, "row 2, force_N = 'nan'", {"nan.csv": "t_s,force_N\n0,nan\n"}),
        (
            "tormagd --check --config scene.toml",
            2,
            "did you mean `coronary`? (line 1)",
            {"scene.toml": 'scene = "coronry"\n'},
        ),
        (
            "tormagd --check --scene mine.toml",
            2,
            "cut.safetensors: damaged or not a model file",
            {"mine.toml": SCENE, "cut.safetensors": "cut"},
        ),
        ("tormagd --check --config open.toml", 2, "others need CURVE keys in [endpoints.curve]", {"open.toml": OPEN}),
        (
            "tormagd --check --config keyed.toml",
            2,
            "endpoints.curve.server_secret is missing",
            {"keyed.toml": KEYED.replace("server_secret", "client_secret"), "server.key_secret": "secret"},
        ),
        (
            "tormagd --check --config keyed.toml",
            2,
            ("server.key_secret can be read by others (mode 0644)", "chmod 600 server.key_secret"),
            {"keyed.toml": KEYED, "server.key_secret": "secret"},
        ),
        (
            "tormagctl plot empty.mcap -o empty.png",
            2,
            "next: give a file that tormagctl record has made",
            {"empty.mcap": ""},
        ),
        ("tormagctl --endpoint tcp://192.0.2.1:5555 status", 2, "CURVE", {}),
        ("tormagctl --endpoint carrier-pigeon status", 2, "carrier-pigeon", {}),
        (f"tormagctl --endpoint ipc://{'x' * 200} status", 2, "107", {}),
        ("tormagctl --config /nowhere/tormagd.toml status", 2, "/nowhere/tormagd.toml", {}),
        ("tormagctl send sawtooth", 2, "step, sine, ramp, pulse", {}),
        ("tormagctl send step --to-N -1", 2, "--to-N = -1", {}),
        ("tormagctl send step --rate 5", 2, "at least one period, 200 ms", {}),
        ("tormagctl send /nowhere/a.csv", 2, "/nowhere/a.csv: No such file", {}),
        ("tormagctl plot /nowhere/a.mcap -o a.png", 2, "/nowhere/a.mcap", {}),
        ("tormagctl dashboard /nowhere/a.mcap", 2, "/nowhere/a.mcap", {}),
        ("tormagctl scene show unheard-of", 2, "coronary", {}),
        (f"tormagctl scene show {'x' * 300}", 2, "File name too long", {}),
        ("tormagctl scene new a.toml", 2, "allowed is a new file in a folder that exists", {"a.toml": ""}),
        ("tormagctl scene new vein.toml", 2, "nobody to ask", {}),
        ("tormagctl scene check fast.toml", 1, "N/s at", {"fast.toml": CORONARY.replace("step_N = 0.1\n", "")}),
        (
            "tormagctl --json scene check poor.toml",
            1,
            ('"code":"budget"', "budget.core_share = 1e-06"),
            {"poor.toml": f"{BRAIN}\n[budget]\ncore_share = 1e-6\n"},
        ),
        (
            "tormagctl --json scene explain other.toml",
            1,
            ('"code":"not_measured"', "docs/guides/scene.md"),
            {"other.toml": CORONARY.replace("most_N = 2.0", "most_N = 1.9")},
        ),
        ("tormagctl scene check pulse --share 0.001", 1, "allowed is at least", {}),
        ("tormagctl scene check pulse --tolerance 0.0001", 1, "allowed is at least", {}),
        ("tormagctl scene explain pulse --share 0.5", 2, "tormagctl scene check NAME with one of", {}),
        (
            "tormagctl scene check pulse --share 0.5 --out a.toml",
            2,
            "File exists: allowed is a new file",
            {"a.toml": ""},
        ),
        (
            "tormagctl --config unfit.toml --json doctor --measure",
            1,
            ('"code":"not_measured"', "nowhere"),
            {"unfit.toml": 'scene = "nowhere"\n'},
        ),
    ],
)
def test_a_mistake_is_answered_in_a_sentence(command, code, says, files, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name, text in files.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
        (tmp_path / name).chmod(0o644)
    name, *arguments = shlex.split(command)
    try:
        ended = COMMANDS[name](arguments)
    except SystemExit as caught:
        ended = int(str(caught.code))
    said = USAGE.sub("", "".join(capsys.readouterr())).strip()
    assert ended == code
    assert [words for words in ((says,) if isinstance(says, str) else says) if words not in said] == []
    assert "Traceback" not in said
    assert len([line for line in said.splitlines() if not line.startswith(" ")]) <= 2


def test_who_may_not_enter_the_sockets_folder_is_told_the_group(monkeypatch):
    def refused(_path):
        raise PermissionError

    monkeypatch.setattr(Path, "stat", refused)
    assert unreachable("ipc:///run/tormag/control", "no answer").hint.startswith("you may not enter /run/tormag: join")
