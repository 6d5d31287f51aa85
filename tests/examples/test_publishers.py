"""Every publisher in examples/ is run against sockets that answer as the daemon does: it waits for homing, sends what
the table of setpoints says, and sends nothing where it is refused."""

import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zmq

from tormagd_client.messages import Setpoint, decode

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"
ROWS = ((0.0, 0.6), (0.01, 0.7), (0.02, 1.0))
BUSY, NOT_NEUTRAL = ("busy", "homing"), ("not_neutral", "the setpoint is 1.40 N")
PATIENCE_MS = 30_000


@pytest.fixture(scope="session")
def cpp(tmp_path_factory):
    """The C++ publisher, compiled."""
    if shutil.which("g++") is None:
        pytest.skip("g++ is not installed")
    headers = "#include <zmq.hpp>\n#include <msgpack.hpp>\n"
    found = subprocess.run(["g++", "-E", "-x", "c++", "-"], input=headers, capture_output=True, text=True, check=False)
    if found.returncode:
        pytest.skip("no headers: apt install libzmq3-dev cppzmq-dev libmsgpack-cxx-dev")
    made = tmp_path_factory.mktemp("cpp") / "publish"
    subprocess.run(
        ["g++", "-std=c++17", "-Wall", "-Wextra", "-Werror", EXAMPLES / "cpp" / "publish.cpp", "-lzmq", "-o", made],
        check=True,
    )
    return [str(made)]


@pytest.fixture(scope="session")
def node():
    """The one in JavaScript."""
    if shutil.which("node") is None:
        pytest.skip("node is not installed")
    if not (EXAMPLES / "node" / "node_modules").is_dir():
        pytest.skip("no packages: npm install in examples/node")
    return ["node", str(EXAMPLES / "node" / "publish.js")]


@pytest.fixture(scope="session")
def python():
    """The one of the README."""
    return [sys.executable, str(EXAMPLES / "python" / "publish.py")]


@pytest.fixture(params=["python", "cpp", "node"])
def publisher(request):
    """The command line of each."""
    return request.getfixturevalue(request.param)


def played(publisher, tmp_path, refusals):
    """What it asked, what it published, and how it ended, where `enable` is answered with the refusals, one by one."""
    profile = tmp_path / "profile.csv"
    profile.write_text("t_s,force_N\n" + "".join(f"{t},{force}\n" for t, force in ROWS))
    asked: list[Any] = []
    heard: list[Any] = []
    left = list(refusals)
    context = zmq.Context()
    with tempfile.TemporaryDirectory() as folder:  # a short path, as sockets need
        control, setpoints = context.socket(zmq.ROUTER), context.socket(zmq.SUB)
        setpoints.subscribe(b"")
        control.bind(f"ipc://{folder}/control")
        setpoints.bind(f"ipc://{folder}/setpoint")
        playing = subprocess.Popen([*publisher, folder, str(profile)], stderr=subprocess.PIPE, text=True)
        try:
            for _ in range(2 + len(refusals) - (NOT_NEUTRAL in refusals)):
                assert control.poll(PATIENCE_MS)
                *envelope, data = control.recv_multipart()
                request = msgpack.unpackb(data)
                asked.append(request["command"])
                reply = {"v": 1, "id": request["id"], "ok": True, "result": {}}
                if asked[-1] == "enable" and left:
                    code, message = left.pop(0)
                    reply |= {"ok": False, "error": {"code": code, "message": message, "hint": "lower it"}}
                control.send_multipart([*envelope, msgpack.packb(reply)])
            while NOT_NEUTRAL not in refusals and len(heard) < len(ROWS):
                assert setpoints.poll(PATIENCE_MS)
                heard.append(decode(setpoints.recv(), Setpoint))
            _, said = playing.communicate(timeout=PATIENCE_MS / 1e3)
            assert not setpoints.poll(0)
        finally:
            playing.kill()
            playing.wait()
            context.destroy(linger=0)
    return asked, heard, playing.returncode, said


def test_it_waits_for_the_end_of_homing_and_publishes_every_row(publisher, tmp_path):
    asked, heard, code, said = played(publisher, tmp_path, [BUSY])
    assert (asked, code, said) == (["home", "enable", "enable"], 0, "")
    assert [setpoint.servo_cf for setpoint in heard] == [force for _, force in ROWS]
    assert [setpoint.seq for setpoint in heard] == [0, 1, 2]
    assert len({(setpoint.source, setpoint.session) for setpoint in heard}) == 1
    assert heard[0].session is not None
    assert [setpoint.stamp_ns - heard[0].stamp_ns for setpoint in heard] == [round(t * 1e9) for t, _ in ROWS]


def test_it_publishes_nothing_when_it_is_refused(publisher, tmp_path):
    asked, _, code, said = played(publisher, tmp_path, [BUSY, NOT_NEUTRAL])
    assert (asked, code) == (["home", "enable", "enable"], 1)
    assert said == "enable: the setpoint is 1.40 N; lower it\n"


def test_the_one_in_python_is_the_readmes():
    shown = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    assert shown == [(EXAMPLES / "python" / "publish.py").read_text(encoding="utf-8")]


def test_it_says_how_to_call_it(publisher):
    done = subprocess.run(publisher, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 1
    assert done.stderr.startswith("usage: ")
    assert done.stderr.endswith(" FOLDER PROFILE.csv\n")
    assert done.stderr.count("\n") == 1
