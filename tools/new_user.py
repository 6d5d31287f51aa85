"""A new user's first minutes: what the README has under "Operate it", on a wheel in an empty folder; then mistakes.

The lines are the README's own, typed into three shells as it says. Nothing of the checkout is in sight of them: another
folder, an environment of their own, no PYTHONPATH. Building and installing are told and not counted. Each of the twenty
mistakes has to be answered in one sentence with its remedy and the documented exit code. Ends with 0 where all of that
held, the lines in under 3 minutes, and else with 1.
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from first_use.mistakes import ALONE, BESIDE, Answer, Mistake, judged, put
from first_use.terminal import PATIENCE_S, Environment, Terminal

ROOT = Path(__file__).parents[1]
NOT_THE_TREE = shutil.ignore_patterns(".*", "build", "run", "*.so", "*.egg-info", "core.json")
EXTRAS = "record,plot,dashboard"
ALLOWED_S = 180.0
SHOWN_PORT, SHOWN_FOLDER = 'port = "/dev/pts/3"', "/tmp/tormag"
"What the README's configuration has in place of its reader's own."
PORT = re.compile(r"^/dev/\S+$", re.MULTILINE)
LASTING = "Ctrl-C"
"In the comment of a line that goes on until it is told to end."
READY = {"simulation": PORT, "tormagd ": re.compile("next: home"), "dashboard": re.compile(r"http://\S+")}
"What such a line has in it, and what it prints once others may go on."
UP = re.compile("running scene")
"What a daemon prints once it answers, with a device or without."


class Readme(NamedTuple):
    """The section "Operate it": a configuration, and the lines for each terminal with their comments."""

    configuration: str
    lines: tuple[tuple[str, str, str], ...]


class Step(NamedTuple):
    """A line that was typed: how long it took, and what went wrong, if anything did."""

    line: str
    seconds: float
    wrong: str = ""


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
    timed("wheel", *pip, "wheel", "--no-deps", "--wheel-dir", dist, source / "client", source, **without)
    shutil.rmtree(source)
    (client,), (wheel,) = dist.glob("tormagd_client-*.whl"), dist.glob("tormagd-*.whl")
    timed("install", *pip, "install", client, f"{wheel}[{EXTRAS}]")
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
        try:
            answers = list(mistakes(folder / "mistakes", environment))
        except TimeoutError as error:
            answers = [Answer("what they are made beside", 0, "", str(error))]
    seconds, wrong = sum(step.seconds for step in steps), [step.wrong for step in steps] + [it.wrong for it in answers]
    result: dict[str, Any] = {
        "version": version.stdout.strip(),
        "installed_s": installed_s,
        "steps": [step._asdict() for step in steps],
        "seconds": round(seconds, 1),
        "allowed_s": ALLOWED_S,
        "mistakes": [answer._asdict() for answer in answers],
        "passed": seconds < ALLOWED_S and not any(wrong),
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
