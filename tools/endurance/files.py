"""Files that somebody made to hang, fill or crash whoever reads them: is each refused at once, in one sentence?

Daemon, simulator and `tormagctl` are run on each file, in place of each kind that they read. Each has to end with
status 2 and one printable line (`tormagctl`: and a hint), within a second of what it takes to refuse a file that is not
there, and with less than 100 MB of memory.
"""

import json
import os
import random
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from tqdm import tqdm

from tormagd.scenes.scene import scene_path

TERABYTE = 1 << 40
WITHIN_S = 1.0
MEMORY_MB = 100
KINDS = ("config", "scene", "plant", "model", "csv", "key", "profile")


def _write(content: bytes) -> Callable[[Path], object]:
    return lambda path: path.write_bytes(content)


def _link(target: str) -> Callable[[Path], object]:
    return lambda path: path.symlink_to(target)


def _sparse(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(TERABYTE)


def _socket(path: Path) -> None:
    # a socket's path is short; the file stays when the socket has gone
    with tempfile.TemporaryDirectory() as folder, socket.socket(socket.AF_UNIX) as listener:
        listener.bind(f"{folder}/s")
        Path(folder, "s").rename(path)


HOSTILE: dict[str, Callable[[Path], object]] = {
    "pipe": os.mkfifo,
    "directory": Path.mkdir,
    "socket": _socket,
    "zeros without end": _link("/dev/zero"),
    "a terminal": _link("/dev/tty"),
    "noise without end": _link("/dev/urandom"),
    "a link to itself": lambda path: path.symlink_to(path),
    "a link to nothing": _link("/nowhere/at/all"),
    "sparse, 1 TB": _sparse,
    "17 MB of spaces": _write(b" " * 17_000_000),
    "empty lines, 17 MB": _write(b"\n" * 17_000_000),
    "key of 50,000 parts": _write(b".".join([b"a"] * 50_000) + b" = 1"),
    "key of 30,000 parts": _write(b".".join([b"a"] * 30_000) + b" = 1"),
    "heading of 30,000 parts": _write(b"[" + b".".join([b"a"] * 30_000) + b"]"),
    "100,000 arrays in each other": _write(b"a = " + b"[" * 100_000),
    "50,000 arrays in each other": _write(b"a = " + b"[" * 25_000 + b"]" * 25_000),
    "20,000 tables in each other": _write(b"a = " + b"{a=" * 15_000),
    "number of 5,001 digits": _write(b"scene = " + b"9" * 5_001),
    "number of 60,000 hexadecimal digits": _write(b"scene = 0x" + b"f" * 60_000),
    "text of 60,000 characters": _write(b'scene = "' + b"x" * 60_000 + b'"'),
    "30,000 unclosed texts": _write(b'a = """\\"' * 8_000),
    "escape sequences": _write(b'scene = "\\u001b]0;x\\u0007"\n"\\u001b[2J\\u009b1m\\n" = 1\n'),
    "raw escape sequences": _write(b"\x1b[2J\x1b]0;owned\x07\xc2\x9b31m = \x1b[1m\n"),
    "no UTF-8": _write(b"\xff\xfe" * 100),
    "a header of 2^63 bytes": _write((2**63 - 1).to_bytes(8, "little") + b"{}"),
    "a header of arrays in each other": _write((60_000).to_bytes(8, "little") + b"[" * 60_000),
}
"How each is made, at a path that is not there yet."


def make(name: str, folder: Path) -> Path:
    """One of HOSTILE, in a folder, under a name that fits every kind."""
    path = folder / "hostile.csv"
    HOSTILE[name](path)
    return path


class Read(NamedTuple):
    """How a program refused a file: exit code, what it said, processor time and memory."""

    code: int
    said: str
    processor_s: float
    memory_MB: float


def commands(path: Path, folder: Path) -> dict[str, list[str]]:
    """The command lines that read the file at `path`, by program and kind; what they need besides is in `folder`."""
    scene = folder / "scene.toml"
    shipped = scene_path("pulse").read_text(encoding="utf-8")
    scene.write_text(shipped.replace("torque_mre_50_40", str(path)), encoding="utf-8")
    named = {
        "scene": f"scene = {json.dumps(str(path))}\n",
        "model": f"scene = {json.dumps(str(scene))}\n",
        "key": '[endpoints]\ncontrol = "tcp://192.0.2.1:5555"\n'
        f"[endpoints.curve]\nserver_secret = {json.dumps(str(path))}\n",
    }
    daemon = [sys.executable, "-m", "tormagd.daemon.main", "--check", "--config"]
    ctl = [sys.executable, "-m", "tormagd.ctl.main", "--wait", "0.1"]
    found = {"daemon, config": [*daemon, str(path)]}
    for kind, text in named.items():
        config = folder / f"{kind}_config.toml"
        config.write_text(text, encoding="utf-8")
        found[f"daemon, {kind}"] = [*daemon, str(config)]
    keys = ["--endpoint", "tcp://127.0.0.1:9", "--key", str(path), "--server-key", str(path), "status"]
    return found | {
        "simulator, plant": [sys.executable, "-m", "tormagd.simulation", "--pty", "--plant", str(path)],
        "tormagctl, config": [*ctl, "--config", str(path), "status"],
        "tormagctl, scene": [*ctl, "scene", "show", str(path)],
        "tormagctl, csv": [*ctl, "send", str(path)],
        "tormagctl, key": [*ctl, *keys],
    }


def read(command: list[str], folder: Path) -> Read:
    """Runs a program; one that takes a minute is ended."""
    with (folder / "said").open("w+b") as said:
        process = subprocess.Popen(["timeout", "60", *command], stdin=subprocess.DEVNULL, stdout=said, stderr=said)
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        said.seek(0)
        text = said.read(1_000_000).decode(errors="backslashreplace")
    return Read(process.returncode, text, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024.0)


def wrong(program: str, found: Read, plain: Read) -> list[str]:
    """What is not as it is to be."""
    lines = [line for line in found.said.splitlines() if line.strip() and not line.startswith(("usage:", "   "))]
    most_lines = 2 if program.startswith("tormagctl") else 1
    checks = {
        f"exit status {found.code}": found.code == 2,
        f"{len(lines)} lines": 0 < len(lines) <= most_lines,
        "a traceback": "Traceback" not in found.said,
        "what is not printable": found.said.replace("\n", "").isprintable(),
        f"{len(found.said)} characters": len(found.said) < 3_000,
        f"{found.processor_s - plain.processor_s:.1f} s more": found.processor_s - plain.processor_s < WITHIN_S,
        f"{found.memory_MB:.0f} MB": found.memory_MB < MEMORY_MB,
    }
    return [what for what, is_so in checks.items() if not is_so]


def run(count: int, seed: int) -> dict[str, Any]:
    """`count` of the files, drawn by `seed`, on every program; the figures, and `failures`."""
    drawn = random.Random(seed).sample(sorted(HOSTILE), min(count, len(HOSTILE)))
    failures: list[str] = []
    runs, more_s, memory_MB = 0, 0.0, 0.0
    with tempfile.TemporaryDirectory(prefix="tormag-") as name:
        folder = Path(name)
        plain = {program: read(line, folder) for program, line in commands(folder / "none.csv", folder).items()}
        for number, hostile in enumerate(tqdm(drawn, desc="hostile files", unit="file", disable=None)):
            inside = folder / str(number)
            inside.mkdir()
            path = make(hostile, inside)
            for program, line in commands(path, folder).items():
                if program.endswith("key") and path.is_file() and not path.is_symlink():
                    path.chmod(0o600)
                found, before = read(line, folder), plain[program]
                runs += 1
                failures += [f"{program}, {hostile}: {what}" for what in wrong(program, found, before)]
                more_s = max(more_s, found.processor_s - before.processor_s)
                memory_MB = max(memory_MB, found.memory_MB)
    return {"runs": runs, "more_processor_s": round(more_s, 3), "memory_MB": round(memory_MB), "failures": failures}
