"""Every publisher in examples/ against sockets that answer as the daemon does."""

import json
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import msgpack
import pytest
import zmq

from tormagd.record.writer import TELEMETRY_TOPIC, TICK_SCHEMA, TICKS_TOPIC, plain_schema
from tormagd_client.messages import Setpoint, Telemetry, decode

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"
ROWS = ((0.0, 0.6), (0.01, 0.7), (0.02, 1.0))
BUSY, SKEWED = ("busy", "homing"), ("skewed", "the carriages are 1.4 mm apart")
ASKED = (["home", "enable", "enable"], ["arm", "status", "status"])
"Of those without our client, and of the others."
PATIENCE_MS = 30_000


@pytest.fixture(scope="session")
def cpp(tmp_path_factory):
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
    if shutil.which("node") is None:
        pytest.skip("node is not installed")
    if not (EXAMPLES / "node" / "node_modules").is_dir():
        pytest.skip("no packages: npm install in examples/node")
    return ["node", str(EXAMPLES / "node" / "publish.js")]


@pytest.fixture(scope="session")
def python():
    return [sys.executable, str(EXAMPLES / "python" / "publish.py")]


@pytest.fixture(params=["python", "cpp", "node"])
def publisher(request):
    return request.getfixturevalue(request.param)


def answer(command, refusal):
    if command == "enable":
        error = refusal and {"code": refusal[0], "message": refusal[1], "hint": "home"}
        return {"ok": False, "error": error} if refusal else {}
    ended = refusal and refusal != BUSY and {"code": refusal[0], "cause": refusal[1], "remedy": "home"}
    return {"result": {"arm": {"given": ["home"], "is_over": refusal != BUSY, "error": ended or None}}}


def played(publisher, tmp_path, refusals):
    """Return what it asked and published and how it ended, when arming meets these refusals."""
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
            for _ in range(2 + len(refusals) - (SKEWED in refusals)):
                assert control.poll(PATIENCE_MS)
                *envelope, data = control.recv_multipart()
                request = msgpack.unpackb(data)
                asked.append(request["command"])
                reply = {"v": 1, "id": request["id"], "ok": True, "result": {}}
                if asked[-1] in ("enable", "status"):
                    reply |= answer(asked[-1], left.pop(0) if left else None)
                control.send_multipart([*envelope, msgpack.packb(reply)])
            while SKEWED not in refusals and len(heard) < len(ROWS):
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
    assert (asked in ASKED, code, said) == (True, 0, "")
    assert [(setpoint.seq, setpoint.servo_cf) for setpoint in heard] == list(enumerate(force for _, force in ROWS))
    assert len({(setpoint.source, setpoint.session) for setpoint in heard}) == 1
    assert heard[0].session is not None
    assert [setpoint.stamp_ns - heard[0].stamp_ns for setpoint in heard] == [round(t * 1e9) for t, _ in ROWS]


def test_it_publishes_nothing_when_it_is_refused(publisher, tmp_path):
    asked, _, code, said = played(publisher, tmp_path, [BUSY, SKEWED])
    last = "arm" if asked[0] == "arm" else "enable"
    assert (asked in ASKED, code, said) == (True, 1, f"{last}: the carriages are 1.4 mm apart; home\n")


def test_the_one_in_python_is_the_readmes():
    shown = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    assert shown == [(EXAMPLES / "python" / "publish.py").read_text(encoding="utf-8")]


def test_it_says_how_to_call_it(publisher):
    done = subprocess.run(publisher, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 1
    assert done.stderr.startswith("usage: ")
    assert done.stderr.endswith(" FOLDER PROFILE.csv\n")
    assert done.stderr.count("\n") == 1


SCHEMAS = {TELEMETRY_TOPIC: plain_schema(Telemetry), TICKS_TOPIC: TICK_SCHEMA}
PAIRS = {name for name, kind in Telemetry.__annotations__.items() if "tuple[float, float]" in str(kind)}
"Lists of a number for each carriage; the others are of codes."


def fields(schema: dict[str, Any], prefix: str, join: str) -> Iterator[tuple[str, str]]:
    for name, inner in schema.get("properties", {}).items():  # the publisher names what a map holds
        path = f"{prefix}{join}{name}"
        if inner["type"] == "object":
            yield from fields(inner, path, join)
        elif inner["type"] == "array":
            yield from ((f"{path}[{k}]", inner["items"]["type"]) for k in range(2 if name in PAIRS else 9))
        else:
            yield path, inner["type"]


def leaves(node: str | dict[str, Any]) -> Iterator[str]:
    if isinstance(node, str):
        yield node
        return
    assert node["direction"] in ("row", "column")
    assert 0 < node["splitPercentage"] < 100
    yield from leaves(node["first"])
    yield from leaves(node["second"])


@pytest.mark.parametrize(
    ("name", "topics"),
    [("plotjuggler_recording.xml", SCHEMAS), ("plotjuggler_live.xml", {"": plain_schema(Telemetry)})],
)
def test_plotjuggler_finds_its_curves(name: str, topics: dict[str, dict[str, Any]]) -> None:
    known = {path: kind for topic, schema in topics.items() for path, kind in fields(schema, topic, "/")}
    root = ElementTree.parse(EXAMPLES / name).getroot()
    curves = [curve.attrib["name"] for curve in root.iter("curve")]
    assert len(curves) >= 10
    assert {known.get(curve) for curve in curves} <= {"number", "integer", "boolean"}, set(curves) - set(known)
    for plot in root.iter("plot"):
        shown = [curve.attrib["color"] for curve in plot.iter("curve")]
        assert 0 < len(shown) == len(set(shown))
    for splitter in root.iter("DockSplitter"):
        parts = [float(size) for size in splitter.attrib["sizes"].split(";")]
        assert len(splitter) == len(parts) == int(splitter.attrib["count"])
        assert sum(parts) == pytest.approx(1.0)


def test_foxglove_finds_its_paths() -> None:
    layout = json.loads((EXAMPLES / "foxglove.json").read_text(encoding="utf-8"))
    known = {path: kind for topic, schema in SCHEMAS.items() for path, kind in fields(schema, topic, ".")}
    assert sorted(leaves(layout["layout"])) == sorted(layout["configById"])
    for panel, config in layout["configById"].items():
        asked = [path["value"] for path in config.get("paths", [])]
        assert all(path in known for path in asked), (panel, asked)
        if panel.startswith("Plot!"):
            assert {known[path] for path in asked} == {"number"}
        assert asked or config["topicPath"] in SCHEMAS
