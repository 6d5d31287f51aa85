"""A new user's first minutes: what the README has under "Operate it", on a wheel in an empty folder; then mistakes.

The lines are the README's own, typed into three shells as it says. Nothing of the checkout is in sight of them: another
folder, an environment of their own, no PYTHONPATH. Building and installing are told and not counted. Each of the twenty
mistakes has to be answered in one sentence with its remedy and the documented exit code. Ends with 0 where all of that
held, the lines in under 3 minutes, and else with 1.
"""

import argparse
import json
import os
import queue
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple, Self

ROOT = Path(__file__).parents[1]
NOT_THE_TREE = shutil.ignore_patterns(".*", "build", "run", "*.so", "*.egg-info", "core.json")
EXTRAS = "record,plot,dashboard"
ALLOWED_S = 180.0
PATIENCE_S = 60.0
"For one line; only a failure waits for it."
SHOWN_PORT, SHOWN_FOLDER = 'port = "/dev/pts/3"', "/tmp/tormag"
"What the README's configuration has in place of its reader's own."
PORT = re.compile(r"^/dev/\S+$", re.MULTILINE)
LASTING = "Ctrl-C"
"In the comment of a line that goes on until it is told to end."
READY = {"simulation": PORT, "tormagd ": re.compile("next: home"), "dashboard": re.compile(r"http://\S+")}
"What such a line has in it, and what it prints once others may go on."
UP = re.compile("running scene")
"What a daemon prints once it answers, with a device or without."
ENDED = re.compile(r"^\[ended (\d+)\]$", re.MULTILINE)
USAGE = re.compile(r"^usage:.*?(?=^\S.*: error:)", re.MULTILINE | re.DOTALL)

Environment = Mapping[str, str]


class Readme(NamedTuple):
    """The section "Operate it": a configuration, and the lines for each terminal with their comments."""

    configuration: str
    lines: tuple[tuple[str, str, str], ...]


class Step(NamedTuple):
    """A line that was typed: how long it took, and what went wrong, if anything did."""

    line: str
    seconds: float
    wrong: str = ""


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
    "import time; from tormagd.client import Client; client = Client.local('sockets', 5.0, 'behind'); "
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


class Terminal:
    """A shell in the new user's folder."""

    def __init__(self, folder: Path, environment: Environment) -> None:
        self._shell = subprocess.Popen(
            ["bash"],
            cwd=folder,
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,  # Ctrl-C goes to the shell and to what runs in it, and to nobody else
        )
        self._is_busy = False
        self._printed: queue.Queue[str] = queue.Queue()
        threading.Thread(target=self._listen, daemon=True).start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        try:
            if self._is_busy:
                self.end()
        except (TimeoutError, OSError):
            os.killpg(self._shell.pid, signal.SIGKILL)
        assert self._shell.stdin is not None
        self._shell.stdin.close()
        self._shell.wait()

    def run(self, line: str) -> tuple[int, str]:
        """Types a line: its exit code and what it printed. Raises TimeoutError."""
        printed, _, code = self._until(f'{line}\necho "[ended $?]"', ENDED).rpartition("[ended ")
        return int(code.rstrip("]\n")), printed

    def start(self, line: str, said: re.Pattern[str]) -> str:
        """Types a line that goes on: the first that it printed of `said`. Raises TimeoutError."""
        self._is_busy = True
        found = said.search(self._until(line, said))
        assert found is not None
        return found[0]

    def end(self) -> tuple[int, str]:
        """Ctrl-C: the exit code of what was started, and what it still printed. Raises TimeoutError."""
        os.killpg(self._shell.pid, signal.SIGINT)
        self._is_busy = False
        return self.run("")

    def _until(self, line: str, said: re.Pattern[str]) -> str:
        assert self._shell.stdin is not None
        self._shell.stdin.write(f"{line}\n")
        self._shell.stdin.flush()
        text, until_s = "", time.monotonic() + PATIENCE_S
        while not said.search(text):
            try:
                text += self._printed.get(timeout=max(0.0, until_s - time.monotonic()))
            except queue.Empty:
                raise TimeoutError(f"not within {PATIENCE_S:g} s; it said {text.strip()[-300:]!r}") from None
        return text

    def _listen(self) -> None:
        assert self._shell.stdout is not None
        for line in self._shell.stdout:
            self._printed.put(line)


def readme() -> Readme:
    """What there is to be typed."""
    section = (ROOT / "README.md").read_text(encoding="utf-8").split("\n## Operate it\n")[1].split("\n## ")[0]
    blocks = re.findall(r"```(\w*)\n(.*?)```", section, re.DOTALL)
    ((_, configuration),) = [block for block in blocks if block[0] == "toml"]
    ((_, typed),) = [block for block in blocks if block[0] == ""]
    lines = [line.partition("#") for line in typed.splitlines()]
    return Readme(
        configuration, tuple((comment.split()[0].rstrip(":"), line.strip(), comment) for line, _, comment in lines)
    )


def configured(device: str, folder: Path) -> str:
    """The README's configuration with this [device] table, and its sockets in a folder of `folder`."""
    return readme().configuration.replace(SHOWN_PORT, device).replace(SHOWN_FOLDER, str(folder / "sockets"))


def walk(folder: Path, environment: Environment) -> Iterator[Step]:
    """Types the README's lines, then Ctrl-C in each terminal; ends at the first that goes wrong."""
    with ExitStack() as stack:
        terminals: dict[str, Terminal] = {}
        for number, line, comment in readme().lines:
            if number not in terminals:
                terminals[number] = stack.enter_context(Terminal(folder, environment))
            began_s = time.monotonic()
            wrong = typed(terminals[number], line, LASTING in comment, folder)
            yield Step(line, time.monotonic() - began_s, wrong)
            if wrong:
                return
        for number in ("2", "1"):
            began_s = time.monotonic()
            code, said = terminals[number].end()
            wrong = f"exit code {code}: {said.strip()[-300:]}" if code else ""
            yield Step(f"Ctrl-C in terminal {number}", time.monotonic() - began_s, wrong)


def typed(terminal: Terminal, line: str, is_lasting: bool, folder: Path) -> str:
    """Types one line, and does what its reader does then: what went wrong."""
    try:
        if not is_lasting:
            code, said = terminal.run(line)
            return f"exit code {code}: {said.strip()[-300:]}" if code else ""
        (ready,) = [said for part, said in READY.items() if part in line]
        found = terminal.start(line, ready)
        if ready is PORT:
            (folder / "my.toml").write_text(configured(f'port = "{found}"', folder), encoding="utf-8")
        elif found.startswith("http"):
            with urllib.request.urlopen(found, timeout=PATIENCE_S) as page:
                is_page = b"<html" in page.read()
            code, said = terminal.end()
            return "" if is_page and code == 0 else f"no page, or exit code {code}: {said.strip()[-300:]}"
        return ""
    except (TimeoutError, OSError) as error:
        return str(error)


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


@contextmanager
def simulated(folder: Path, environment: Environment, options: str) -> Iterator[str]:
    """A simulated device: its port."""
    with Terminal(folder, environment) as terminal:
        yield terminal.start(f"python -m tormagd.simulation --pty {options}", PORT)


@contextmanager
def daemon(folder: Path, environment: Environment, device: str, is_there: re.Pattern[str]) -> Iterator[None]:
    """A daemon with this [device] table, once it has printed `is_there`."""
    (folder / "my.toml").write_text(configured(device, folder), encoding="utf-8")
    with Terminal(folder, environment) as terminal:
        terminal.start("tormagd --config my.toml", is_there)
        yield


def mistakes(folder: Path, environment: Environment) -> Iterator[Answer]:
    """Makes all of them, in order."""
    with (
        simulated(folder, environment, "") as port,
        daemon(folder, environment, f'port = "{port}"', READY["tormagd "]),
        Terminal(folder, environment) as terminal,
    ):
        for mistake in ALONE + BESIDE:
            if mistake.device:
                own = folder / mistake.name.replace(" ", "_")
                own.mkdir()
                yield made_beside_its_own(mistake, own, environment)
            else:
                put(mistake.files, folder)
                yield judged(mistake, *terminal.run(mistake.command))


def made_beside_its_own(mistake: Mistake, folder: Path, environment: Environment) -> Answer:
    """One that is about a device and a daemon of its own."""
    put(mistake.files, folder)
    with ExitStack() as stack:
        device = mistake.device
        if mistake.simulated is not None:
            device = device.format(port=stack.enter_context(simulated(folder, environment, mistake.simulated)))
        stack.enter_context(daemon(folder, environment, device, UP))
        return judged(mistake, *stack.enter_context(Terminal(folder, environment)).run(mistake.command))


def install(folder: Path, has_compiler: bool) -> tuple[dict[str, str], dict[str, float]]:
    """Builds the wheel of this tree and installs it into an environment: that, and what each took, s."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    source, venv, dist = folder / "source", folder / ".venv", folder / "dist"
    shutil.copytree(ROOT, source, ignore=NOT_THE_TREE)
    without = {} if has_compiler else {"CC": "no-compiler"}
    took_s: dict[str, float] = {}

    def timed(name: str, *command: str | Path, **changed: str) -> None:
        began_s = time.monotonic()
        subprocess.run(command, check=True, cwd=folder, env=environment | changed, stdout=sys.stderr)
        took_s[name] = round(time.monotonic() - began_s, 1)

    pip = (venv / "bin/python", "-m", "pip", "--quiet", "--disable-pip-version-check")
    timed("environment", sys.executable, "-m", "venv", venv)
    timed("wheel", *pip, "wheel", "--no-deps", "--wheel-dir", dist, source, **without)
    shutil.rmtree(source)
    (wheel,) = dist.glob("*.whl")
    timed("install", *pip, "install", f"{wheel}[{EXTRAS}]")
    return {"PATH": f"{venv}/bin:/usr/bin:/bin", "HOME": str(folder), "LANG": "C.UTF-8"}, took_s


def main() -> int:
    """Installs, walks, errs; prints each with its time and verdict."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--without-compiler", action="store_true", help="build the wheel where no C compiler is")
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="tormag-") as root:
        folder = Path(root)
        environment, installed_s = install(folder, not options.without_compiler)
        version = subprocess.run(
            ["tormagd", "--version"], env=environment, cwd=folder, check=True, capture_output=True, text=True
        )
        for name in ("walk", "mistakes"):
            (folder / name).mkdir()
        steps = list(walk(folder / "walk", environment))
        answers = list(mistakes(folder / "mistakes", environment))
    seconds = sum(step.seconds for step in steps)
    result: dict[str, Any] = {
        "version": version.stdout.strip(),
        "installed_s": installed_s,
        "steps": [step._asdict() for step in steps],
        "seconds": round(seconds, 1),
        "allowed_s": ALLOWED_S,
        "mistakes": [answer._asdict() for answer in answers],
        "passed": seconds < ALLOWED_S and not any(each.wrong for each in (*steps, *answers)),
    }
    if options.json:
        print(json.dumps(result))
    else:
        print_table(result)
    return 0 if result["passed"] else 1


def print_table(result: Mapping[str, Any]) -> None:
    """The same for a person."""
    print(result["version"])
    print("not counted: " + ", ".join(f"{name} {seconds:.0f} s" for name, seconds in result["installed_s"].items()))
    for step in result["steps"]:
        print(f"{step['seconds']:7.1f} s  {step['line']}  {step['wrong'] or 'done'}")
    print(f"{result['seconds']:7.1f} s  of {result['allowed_s']:g} s")
    for mistake in result["mistakes"]:
        print(f"{mistake['name']}: {mistake['wrong'] or 'answered'} (exit code {mistake['code']})")
        print("\n".join(f"    {line}" for line in mistake["said"].splitlines()[:4]))


if __name__ == "__main__":
    sys.exit(main())
