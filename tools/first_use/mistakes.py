"""Twenty mistakes, and what has to come of each: a sentence with its remedy, and the documented exit code."""

import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

USAGE = re.compile(r"^usage:.*?(?=^\S.*: error:)", re.MULTILINE | re.DOTALL)


class Mistake(NamedTuple):
    """What somebody does wrong (a command, and the files that lie there), and what has to come of it.

    `device` is the [device] table of a daemon of its own, in place of the one that is there for all; `simulated` the
    options of a simulated device of its own, which gives that table its `{port}`.
    """

    name: str
    command: str
    code: int
    says: str
    files: Mapping[str, str] = {}
    device: str = ""
    simulated: str | None = None


class Answer(NamedTuple):
    """What came of a mistake."""

    name: str
    code: int
    said: str
    wrong: str = ""


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
FOREIGN = {"v": 1, "serial_number": 7, "insert": "MRE-50-40", "model": "0" * 64, "saved_ns": 0, "scale": 1.0} | {
    "scale_sd": 0.1,
    "offset_N": 0.0,
    "slow_factor": 1.0,
    "slow_learned": 0.0,
    "sensor_zero_N": 0.0,
}
ALONE = (
    Mistake("unknown command", "tormagctl stauts", 2, "invalid choice: 'stauts' (choose from"),
    Mistake("daemon not running", "tormagctl --endpoint ipc:///nowhere/control status", 3, "start the daemon"),
    Mistake(
        "misspelt key",
        "tormagd --check --config misspelt.toml",
        2,
        "unknown field `prot` - at `$.device`; did you mean `port`? (line 2)",
        {"misspelt.toml": '[device]\nprot = "/dev/ttyACM0"\n'},
    ),
    Mistake(
        "TOML with a byte order mark",  # which is no mistake: what is wrong behind it is found
        "tormagd --check --config bom.toml",
        2,
        "`int` >= 83 - at `$.rates.control_hz` (it is 1) (line 2)",
        {"bom.toml": "\ufeff[rates]\ncontrol_hz = 1\n"},
    ),
    Mistake("NaN setpoint", "tormagctl send nan.csv", 2, "row 2, force_N = 'nan'", {"nan.csv": "t_s,force_N\n0,nan\n"}),
    Mistake(
        "wrong scene",
        "tormagd --check --config scene.toml",
        2,
        "did you mean `coronary`? (line 1)",
        {"scene.toml": 'scene = "coronry"\n'},
    ),
    Mistake(
        "unreadable model",
        "tormagd --check --scene mine.toml",
        2,
        "cut.safetensors: damaged or not a model file",
        {"mine.toml": SCENE, "cut.safetensors": "cut"},
    ),
    Mistake(
        "key that others may read",
        "tormagd --check --config keyed.toml",
        2,
        "chmod 600 server.key_secret",
        {"keyed.toml": KEYED, "server.key_secret": "secret"},
    ),
    Mistake(
        "plot of an empty file",
        "tormagctl plot empty.mcap -o empty.png",
        2,
        "next: give a file that tormagctl record has made",
        {"empty.mcap": ""},
    ),
)
"These need no daemon."

BEHIND = (
    "import time; from tormagd_client import Client; client = Client.local('sockets', 5.0, 'behind'); "
    "[(client.publish(0.5, stamp_ns=time.time_ns() - 10**10), time.sleep(0.01)) for _ in range(100)]"
)
AS_ANYBODY = "setpriv --bounding-set=-dac_override,-dac_read_search " if os.geteuid() == 0 else ""
"Root may enter every folder; this takes that away."
BESIDE = (
    Mistake("second daemon", "tormagd --config my.toml", 1, "already running, pid"),
    Mistake("enable before home", "tormagctl --config my.toml enable", 1, "next: tormagctl home"),
    Mistake("clear-fault without a fault", "tormagctl --config my.toml clear-fault", 0, "no fault is latched"),
    Mistake(
        "send while disabled",
        "tormagctl --config my.toml send step --duration 1",
        1,
        "the device is DISABLED\n  next: tormagctl home, then tormagctl enable",
    ),
    Mistake(
        "record to a full place",
        "(ulimit -f 16; tormagctl --config my.toml record full.mcap --duration 5)",
        1,
        "File too large",
    ),
    Mistake(
        "no permission on the socket",
        f"chmod 0 sockets; {AS_ANYBODY}tormagctl --config my.toml status; code=$?; chmod 755 sockets; (exit $code)",
        3,
        "next: you may not enter",
    ),
    Mistake(
        "clock behind",
        f'python -c "{BEHIND}"; tormagctl --config my.toml status',
        0,
        "next: keep the clocks of both machines by chrony",
    ),
    Mistake(
        "wrong port",
        "tormagctl --config my.toml home",
        1,
        "/dev/ttyACM9: cannot be opened: there is no such port\n  next: plug the device in",
        device='port = "/dev/ttyACM9"',
    ),
    Mistake(
        "CAN without its interface",
        "tormagctl --config my.toml home",
        1,
        "sudo ip link set can7 up type can bitrate 1000000",
        device='backend = "can"\nport = "can7"\noptions.interface = "socketcan"',
    ),
    Mistake(
        "firmware of another protocol",
        "sleep 1; tormagctl --config my.toml home",
        1,
        "next: install firmware and daemon of the same protocol schema",
        device='port = "{port}"',
        simulated="--fault other_schema",
    ),
    Mistake(
        "profile of another device",
        "sleep 1; tormagctl --config my.toml status",
        0,
        "it is of another serial, here is 1\n          next: tormagctl calibrate --device, which keeps a new profile",
        files={"profiles/00000001-MRE-50-40.json": json.dumps(FOREIGN)},
        device='port = "{port}"\nprofiles = "profiles"',
        simulated="",
    ),
)
"These are made beside a daemon that has just started."


def judged(mistake: Mistake, code: int, printed: str) -> Answer:
    """Whether the answer has what it has to say, in one sentence (two for what goes on), and the exit code."""
    said = USAGE.sub("", printed).strip()
    sentences = [line for line in said.splitlines() if not line.startswith(" ")]
    if code != mistake.code:
        return Answer(mistake.name, code, said, f"exit code {code}, {mistake.code} is documented")
    if mistake.says not in said:
        return Answer(mistake.name, code, said, f"it does not say {mistake.says!r}")
    if "Traceback" in said or (code and len(sentences) > 2):
        return Answer(mistake.name, code, said, "it is more than a sentence")
    return Answer(mistake.name, code, said)


def put(files: Mapping[str, str], folder: Path) -> None:
    """Writes what lies there when the mistake is made."""
    for name, text in files.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text, encoding="utf-8")
        (folder / name).chmod(0o644)
