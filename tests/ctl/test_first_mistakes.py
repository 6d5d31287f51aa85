"""What is done wrong first, without a daemon: each gets one sentence with its remedy, and the documented exit code."""

import re
import shlex
from pathlib import Path

import pytest

from tormagd.ctl import main as ctl
from tormagd.daemon import main as daemon
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
KEYED = """[endpoints]
setpoint = "tcp://0.0.0.0:5555"
[endpoints.curve]
server_secret = "server.key_secret"
"""


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
        (
            "tormagd --check --config keyed.toml",
            2,
            "chmod 600 server.key_secret",
            {"keyed.toml": KEYED, "server.key_secret": "secret"},
        ),
        (
            "tormagctl plot empty.mcap -o empty.png",
            2,
            "next: give a file that tormagctl record has made",
            {"empty.mcap": ""},
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
    assert says in said
    assert "Traceback" not in said
    assert len([line for line in said.splitlines() if not line.startswith(" ")]) <= 2


def test_who_may_not_enter_the_sockets_folder_is_told_the_group(monkeypatch):
    def refused(_path):
        raise PermissionError

    monkeypatch.setattr(Path, "stat", refused)
    assert unreachable("ipc:///run/tormag/control", "no answer").hint.startswith("you may not enter /run/tormag: join")
