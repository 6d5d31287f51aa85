"""The README's client, taken from the README, drives the daemon."""

import re
import subprocess
import sys
import tempfile
from pathlib import Path

import msgpack
import pytest
import zmq

pytestmark = pytest.mark.live

README = Path(__file__).parents[2] / "README.md"


def client() -> str:
    """The README's client."""
    (script,) = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    return str(script)


def test_the_client_says_how_to_call_it():
    done = subprocess.run([sys.executable, "-c", client()], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 1
    assert done.stderr == "usage: python client.py FOLDER PROFILE.csv\n"


def test_the_client_waits_for_the_end_of_homing_and_publishes_nothing_when_it_is_refused(tmp_path):
    profile = tmp_path / "profile.csv"
    profile.write_text("t_s,force_N\n0,1\n1,1\n")
    context = zmq.Context()
    asked = []
    refusals = iter([("busy", "homing"), ("not_neutral", "the setpoint is 1.40 N")])
    with tempfile.TemporaryDirectory() as folder:  # a short path, as sockets need
        control, setpoints = context.socket(zmq.ROUTER), context.socket(zmq.SUB)
        setpoints.subscribe(b"")
        control.bind(f"ipc://{folder}/control")
        setpoints.bind(f"ipc://{folder}/setpoint")
        playing = subprocess.Popen(
            [sys.executable, "-c", client(), folder, str(profile)], stderr=subprocess.PIPE, text=True
        )
        try:
            while len(asked) < 3 and control.poll(30_000):
                *envelope, data = control.recv_multipart()
                request = msgpack.unpackb(data)
                asked.append(request["command"])
                reply = {"v": 1, "id": request["id"], "ok": asked[-1] == "home", "result": {}}
                if asked[-1] == "enable":
                    code, message = next(refusals)
                    reply["error"] = {"code": code, "message": message, "hint": "lower it"}
                control.send_multipart([*envelope, msgpack.packb(reply)])
            _, said = playing.communicate(timeout=30)
        finally:
            playing.kill()
            playing.wait()
            heard = setpoints.poll(0)
            context.destroy(linger=0)
    assert asked == ["home", "enable", "enable"]
    assert playing.returncode == 1
    assert said == "enable: the setpoint is 1.40 N; lower it\n"
    assert not heard


def test_the_client_in_the_readme_sees_the_force_follow(rig, tmp_path):
    script = client()
    assert len(script.splitlines()) <= 18
    profile = tmp_path / "profile.csv"
    rows = [(k * 0.02, 0.6 + min(k * 0.01, 0.9)) for k in range(150)]
    profile.write_text("t_s,force_N\n" + "".join(f"{t:.3f},{force:.3f}\n" for t, force in rows))
    done = subprocess.run(
        [sys.executable, "-c", script, str(rig.folder), str(profile)],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    lines = [line.split() for line in done.stdout.splitlines() if " asked " in line]
    assert len(lines) > 50
    assert lines[-1][-1] == "ENABLED"
    asked, measured = float(lines[-1][2]), float(lines[-1][4])
    assert asked == 1.5
    assert abs(measured - asked) < 0.08
