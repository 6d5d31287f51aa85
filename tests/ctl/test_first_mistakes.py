"""First mistakes without a daemon: each gets one sentence with its remedy, and its exit code."""

import errno
import json
import resource
import shlex
import shutil
from pathlib import Path
from unittest.mock import Mock

import pytest
import zmq.auth

from tormagd.ctl import main as ctl
from tormagd.daemon import main as daemon
from tormagd.scenes.scene import scene_path
from tormagd_client.errors import unreachable

COMMANDS = {"tormagctl": ctl.main, "tormagd": daemon.main}
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
FORCES = {"f.csv": "t_s,force_N\n0,1\n1,1.2\n2,1.4\n"}
NEW = "tormagctl scene new a.toml --force f.csv"
OPEN = '[endpoints]\nsetpoint = "tcp://0.0.0.0:5555"\n'
KEYED = OPEN + '[endpoints.curve]\nserver_secret = "server.key_secret"\n'
CORONARY, BRAIN = (Path(scene_path(name)).read_text(encoding="utf-8") for name in ("coronary", "brain"))


MISTAKES: list[tuple[str, int, str | tuple[str, ...], dict[str, str]]] = [
    ("tormagctl", 2, "the following arguments are required: COMMAND", {}),
    ("tormagctl stauts", 2, "COMMAND: 'stauts'; did you mean `status`?", {}),
    ("tormagctl clear_fault", 2, "did you mean `clear-fault`?", {}),
    ("tormagctl fly", 2, "COMMAND: 'fly': allowed are status, top, ", {}),
    ("tormagctl status --jsn", 2, "unrecognized arguments: --jsn; did you mean `--json`?", {}),
    ("tormagctl status now", 2, "unrecognized arguments: now", {}),
    ("tormagctl --wait nan status", 2, "--wait: 'nan': allowed is a finite number", {}),
    ("tormagctl --wait 0 status", 2, "--wait: 0: allowed is 0.001..1000000", {}),
    ("tormagctl --config", 2, "--config: expected one argument", {}),
    ("tormagctl send", 2, "the following arguments are required: {step|sine|ramp|pulse|FILE.csv}", {}),
    ("tormagctl send sawtooth", 2, "step, sine, ramp, pulse", {}),
    ("tormagctl send pules", 2, "did you mean `pulse`?", {}),
    ("tormagctl send step --column x", 2, "--column: allowed only with a file", {}),
    ("tormagctl send f.csv --to-N 3", 2, "--to-N: allowed only with a shape", FORCES),
    ("tormagctl keys generate k --publish a --operate a", 2, "a: allowed is one folder", {}),
    ("tormagctl send step --rate nan", 2, "--rate: 'nan': allowed is a finite number", {}),
    ("tormagctl send step --rate 0", 2, "--rate: 0: allowed is 1..4000 Hz", {}),
    ("tormagctl send step --valid-for-ms -1", 2, "allowed is 0.25..60000 ms", {}),
    ("tormagctl send step --source ''", 2, "allowed are 1..64 printable characters", {}),
    ("tormagctl send step --to-N -1", 2, "--to-N = -1", {}),
    ("tormagctl send step --rate 5", 2, "at least one period, 200 ms", {}),
    ("tormagctl send step --rate 4000 --preview-ms 900", 2, "allowed are 256", {}),
    ("tormagctl send /nowhere/a.csv", 2, "/nowhere/a.csv: No such file", {}),
    ("tormagctl send nan.csv", 2, "row 2 lacks one", {"nan.csv": "t_s,force_N\n0,nan\n"}),
    ("tormagctl send newtons.csv", 2, "force_N", {"newtons.csv": "t_s,newtons\n0,1\n"}),
    ("tormagctl send empty.csv", 2, "empty.csv", {"empty.csv": ""}),
    ("tormagctl take", 2, "the following arguments are required: SOURCE", {}),
    ("tormagctl confirm handle", 2, "what: 'handle': allowed are device, sensor", {}),
    ("tormagctl plot a.mcap", 2, "the following arguments are required: -o/--output", {}),
    ("tormagctl plot /nowhere/a.mcap -o a.png", 2, "/nowhere/a.mcap", {}),
    (
        "tormagctl plot empty.mcap -o a.png",
        2,
        "next: give files that tormagctl record has made",
        {"empty.mcap": ""},
    ),
    (
        "tormagctl report a.mcap -o a.mcap",
        2,
        "allowed is a name that ends with .html",
        {"a.mcap": "precious"},
    ),
    ("tormagctl recordings export a.mcap --to a.mcap", 2, "a.mcap: File exists", {"a.mcap": "precious"}),
    ("tormagctl replay /nowhere/a.mcap", 2, "/nowhere/a.mcap", {}),
    ("tormagctl replay \udcff.mcap", 2, "\\udcff.mcap", {}),
    ("tormagctl replay a.mcap --plant sample_1", 2, "--plant: allowed only with --set or --fault", {}),
    ("tormagctl replay a.mcap --from 1 --fault x", 2, "--from: allowed only without --set or --fault", {}),
    *(
        (f"tormagctl mark {text}", 2, "allowed are 1..200 printable characters", {})
        for text in ("''", "'a\nb'", "x" * 201, "\udcff")
    ),
    ("tormagctl dashboard /nowhere/a.mcap", 2, "/nowhere/a.mcap", {}),
    ("tormagctl dashboard --port 70000", 2, "--port: 70000: allowed is a whole number 0..65535", {}),
    *(
        (f"tormagctl dashboard --origin {origin}", 2, "allowed are https://HOST", {})
        for origin in ("*", "null", "http://elsewhere.example", "https://a/b", "https://", "ftp://a")
    ),
    ("tormagctl dashboard --port 1.5", 2, "--port: 1.5: allowed is a whole number", {}),
    ("tormagctl metrics --port http", 2, "--port: 'http': allowed is a finite number", {}),
    ("tormagctl completion fish", 2, "shell: 'fish': allowed are bash, zsh", {}),
    ("tormagctl guide recovery", 2, "no such guide; did you mean `recover`?", {}),
    ("tormagctl calibrate", 2, "calibrate takes one of three things", {}),
    ("tormagctl calibrate --insert MRE-50-40 --rates 1", 2, "--rates: '1': allowed are 3..60 rates", {}),
    ("tormagctl calibrate --out m", 2, "--motors", {}),
    ("tormagctl calibrate --device --out m", 2, "--out is not for --device", {}),
    ("tormagctl calibrate --device --motors --out m", 2, "--device", {}),
    ("tormagctl calibrate --motors", 2, "--out is missing", {}),
    ("tormagctl calibrate --insert A --motors --out m", 2, "--motors", {}),
    ("tormagctl calibrate --insert A --law --out m.csv", 2, "unrecognized arguments: --law", {}),
    ("tormagctl calibrate --motors --out there", 2, "--out there: allowed is a new file", {"there": "precious"}),
    ("tormagctl calibrate --insert A --out none/m.csv", 2, "--out none/m.csv: allowed is a new file in a folder", {}),
    ("tormagctl calibrate --insert A --out m.csv", 2, "--yes", {}),
    (
        "tormagctl scene check mine.toml",
        1,
        "insert.name = 'MRE-9' is not allowed: with insert.model = 'auto' one of MRE-10-10, ",
        {"mine.toml": SCENE.replace("cut.safetensors", "auto").replace("MRE-50-40", "MRE-9")},
    ),
    ("tormagctl record ''", 2, "'': allowed are names of 1..255 bytes", {}),
    (f"tormagctl plot {'x' * 252}.mcap", 2, "allowed are names of 1..255 bytes", {}),
    ("tormagctl recordings export a.mcap --to stick/", 2, "stick: no such folder", {"a.mcap": "precious"}),
    ("tormagctl record nowhere", 2, "nowhere: No such file or directory", {}),
    ("tormagctl record /dev/full", 2, "/dev/full: Not a directory", {}),
    ("tormagctl recordings list /dev/full", 2, "/dev/full: Not a directory", {}),
    ("tormagctl keys generate", 2, "the following arguments are required: DIR", {}),
    ("tormagctl keys show /nowhere/a.key", 2, "/nowhere/a.key", {}),
    ("tormagctl keys show a.key", 2, "a.key", {"a.key": "no key"}),
    ("tormagctl recordings list . --to b", 2, "--to: allowed only for recordings export", {}),
    ("tormagctl top", 2, "next: tormagctl status", {}),
    ("tormagctl --endpoint ipc:///nowhere/control status", 3, "start the daemon", {}),
    ("tormagctl --endpoint tcp://192.0.2.1:5555 status", 2, "CURVE", {}),
    ("tormagctl --endpoint carrier-pigeon status", 2, "carrier-pigeon", {}),
    (f"tormagctl --endpoint ipc://{'x' * 200} status", 2, "107", {}),
    ("tormagctl --config /nowhere/tormagd.toml status", 2, "/nowhere/tormagd.toml", {}),
    ("tormagctl scene burn", 2, "ACTION: 'burn': allowed are list, show", {}),
    ("tormagctl scene sohw", 2, "did you mean `show`?", {}),
    ("tormagctl scene show unheard-of", 2, "coronary", {}),
    ("tormagctl scene show coronry", 2, "did you mean `coronary`?", {}),
    (f"tormagctl scene show {'x' * 300}", 2, "File name too long", {}),
    ("tormagctl scene new", 2, "the following arguments are required: FILE.toml", {}),
    ("tormagctl scene new a.toml", 2, "allowed is a new file in a folder that exists", {"a.toml": ""}),
    (f"{NEW} --scale 0", 2, "has no range", FORCES),
    (NEW, 2, "has no range", {"f.csv": "t_s,force_N\n0,0\n1,5e-324\n"}),
    (f"{NEW} --column torque_mNm", 2, "no column is called 'torque_mNm'", FORCES),
    (f"{NEW} --offset -2", 2, "force_N = -1: allowed is 0..1000 N", FORCES),
    (f"{NEW} --scale nan", 2, "--scale", FORCES),
    (f"{NEW} --insert nope", 2, "insert = 'nope' is not allowed: one of MRE-10-10, ", FORCES),
    ("tormagctl scene new \udcff.toml --force f.csv", 2, "'\\udcff': allowed is UTF-8 text", FORCES),
    ("tormagctl scene use \udcff", 2, "'\\udcff': allowed is UTF-8 text", {}),
    ("tormagctl scene show \udcff", 2, "scene = '\\udcff': no UTF-8 text; allowed is a file", {}),
    ("tormagctl scene list pulse", 2, "unrecognized arguments: pulse", {}),
    ("tormagctl scene new f.toml --force f.csv --offset 0.1", 2, "f.csv exists, where the scene's forces go", FORCES),
    ("tormagctl scene check pulse --share 0.001", 1, "allowed is at least", {}),
    ("tormagctl scene check pulse --tolerance 0.001", 1, "allowed is at least", {}),
    ("tormagctl scene check pulse --share 1 --tolerance 1", 2, "tormagctl scene check NAME with one of", {}),
    ("tormagctl scene check pulse --share 0.5 --out a.toml", 2, "allowed is a new file", {"a.toml": ""}),
    ("tormagctl scene new vein.toml", 2, "nobody to ask", {}),
    (
        "tormagctl scene check fast.toml",
        1,
        "of the time it is faster",
        {"fast.toml": CORONARY.replace("step_N = 0.1\n", "")},
    ),
    (
        "tormagctl scene check poor.toml",
        1,
        "budget.core_share = 1e-06",
        {"poor.toml": f"{BRAIN}\n[budget]\ncore_share = 1e-6\n"},
    ),
    (
        "tormagctl scene explain other.toml",
        1,
        "tormagctl scene measure other.toml",
        {"other.toml": CORONARY.replace("most_N = 2.0", "most_N = 1.9")},
    ),
    (
        "tormagctl scene measure silent.toml",
        2,
        "signal is missing",
        {"silent.toml": SCENE.replace("cut.safetensors", "torque_mre_50_40")},
    ),
    ("tormagctl --config unfit.toml doctor --measure", 1, "nowhere", {"unfit.toml": 'scene = "nowhere"\n'}),
    ("tormagd --chek", 2, "unrecognized arguments: --chek; did you mean `--check`?", {}),
    (
        "tormagd --check --config misspelt.toml",
        2,
        "unknown field `prot` - at `$.device`; did you mean `port`? (line 2)",
        {"misspelt.toml": '[device]\nprot = "/dev/ttyACM0"\n'},
    ),
    (  # a byte order mark is no mistake
        "tormagd --check --config bom.toml",
        2,
        "`int` >= 83 - at `$.rates.control_hz` (it is 1) (line 2)",
        {"bom.toml": "\ufeff[rates]\ncontrol_hz = 1\n"},
    ),
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
]


def ended(command: str, files: dict[str, str]) -> int:
    for file, text in files.items():
        Path(file).write_text(text, encoding="utf-8")
        Path(file).chmod(0o644)
    name, *arguments = shlex.split(command)
    return COMMANDS[name](arguments)


@pytest.mark.parametrize(("command", "code", "says", "files"), MISTAKES, ids=[row[0][:60] for row in MISTAKES])
def test_a_mistake_is_answered_in_a_sentence(command, code, says, files, tmp_path, monkeypatch, capsys, checked_here):
    monkeypatch.chdir(tmp_path)
    assert ended(command, files) == code
    said = "".join(capsys.readouterr()).strip()
    assert [words for words in ((says,) if isinstance(says, str) else says) if words not in said] == []
    assert "Traceback" not in said
    sentence, *more = said.splitlines()
    assert sentence.startswith(f"{command.split()[0]}")
    # a sentence, and what to do next
    assert [line for line in more if not line.startswith("  ")] == []
    assert "  next: " in said or command.startswith("tormagd --check")
    assert {path.name: path.read_text(encoding="utf-8") for path in tmp_path.iterdir()} == files


@pytest.mark.parametrize(("command", "most", "code"), [("status", 31, 1), ("stop", 9, 1), ("stop", 31, 3)])
def test_too_few_open_files_are_told_and_to_open_the_gap_fewer_will_do(
    command, most, code, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(resource, "getrlimit", lambda _: (most, most))
    monkeypatch.setattr(resource, "setrlimit", Mock())
    assert ctl.main(["--endpoint", f"ipc://{tmp_path}/control", "--wait", "0.05", command]) == code
    assert (f"the hard limit of open files is {most}" in capsys.readouterr().err) is (code == 1)


JSON = [row for row in MISTAKES if row[0].startswith("tormagctl") and "--measure" not in row[0]]


@pytest.mark.parametrize(("command", "code", "says", "files"), JSON, ids=[row[0][:60] for row in JSON])
def test_with_json_it_is_one_object(command, code, says, files, tmp_path, monkeypatch, capsys, checked_here):
    monkeypatch.chdir(tmp_path)
    assert ended(f"{command} --json", files) == code
    out, err = capsys.readouterr()
    told = json.loads(out)
    assert (list(told), told["ok"], told["result"]) == (["command", "ok", "result", "error"], False, None)
    assert told["command"] in command
    assert told["error"]["message"] in err
    assert says in f"{told['error']['message']} next: {told['error']['hint']}"


RECORDED = Path(__file__).parents[1] / "recording/sealed.mcap"


def precious(folder: Path) -> dict[str, bytes]:
    """Make two copies of a recording and a table in `folder`, and return what is there."""
    for name in ("r.html", "r.png"):
        shutil.copy(RECORDED, folder / name)
    (folder / "f.csv").write_text(FORCES["f.csv"])
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("command", ["plot r.png -o r.png", "report r.html -o r.html", "report r.png r.html -o r.html"])
def test_a_recording_is_not_replaced_by_what_is_made_of_it(command, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    files = precious(tmp_path)
    assert ended(f"tormagctl {command}", {}) == 2
    assert ": this is read here: allowed is another file" in capsys.readouterr().err
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == files


@pytest.mark.parametrize(
    ("command", "name"),
    [
        ("plot r.html -o a.png", "a.png"),
        ("report r.html -o a.html", "a.html"),
        ("recordings export r.html --to a.mcap", "a.mcap"),
        (NEW.removeprefix("tormagctl "), "a.toml"),
        (f"{NEW.removeprefix('tormagctl ')} --scale 1.1", "a.csv"),
        ("scene check pulse --tolerance 0.5 --out a.toml", "a.toml"),
        ("keys generate .", "."),
    ],
)
def test_a_full_disk_is_no_mistake_and_nothing_stays_on_it(command, name, tmp_path, monkeypatch, capsys, checked_here):
    def half(path: Path, *_: object, **__: object) -> None:
        path.open("w").close()
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.chdir(tmp_path)
    files = precious(tmp_path)
    monkeypatch.setattr(Path, "write_text", half)
    monkeypatch.setattr(Path, "write_bytes", half)
    monkeypatch.setattr(shutil, "copyfile", lambda _, target: half(target))
    monkeypatch.setattr(zmq.auth, "create_certificates", lambda folder, key: half(Path(folder, key)))
    assert ended(f"tormagctl {command}", {}) == 1
    assert f": {name}: No space left on device\n  next: make room on its disk\n" in capsys.readouterr().err
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == files


def test_who_may_not_enter_the_sockets_folder_is_told_the_group(monkeypatch):
    monkeypatch.setattr(Path, "stat", Mock(side_effect=PermissionError))
    assert unreachable("ipc:///run/tormag/control", "no answer").hint.startswith("you may not enter /run/tormag: join")
