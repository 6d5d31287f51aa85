"""Files that somebody made to hang, fill or crash whoever reads them: is each refused at once, in one sentence?

Each is read in place of each kind that is read anywhere. A reader has to refuse it in one printable sentence, within a
second of processor time, and without 100 MB of memory.
"""

import os
import random
import resource
import socket
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tqdm import tqdm

from tormagd.config import load_config
from tormagd.control.profile import ProfileError
from tormagd.ctl.waveform import read_csv
from tormagd.daemon.profiles import ProfileFolder
from tormagd.force_file import ForceFileError
from tormagd.model.model_file import ModelFileError, load_model
from tormagd.scenes.scene import load_scene
from tormagd.simulation.parameters import PlantError, load_plant
from tormagd_client.endpoints import ConfigError
from tormagd_client.keys import load_pair
from tormagd_client.printable import printable

TERABYTE = 1 << 40
WITHIN_S, MEMORY_MB = 1.0, 100.0
MOST_CHARACTERS = 600


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


def _profile(path: Path) -> None:
    folder = ProfileFolder(path.parent, "MRE-50-40", "ab" * 32)
    path.rename(folder.path(7))
    if folder.read(7) is None:
        raise ProfileError("No such file")


def _key(path: Path) -> None:
    if path.is_file():
        path.chmod(0o600)
    load_pair(path)


READERS: dict[str, Callable[[Path], object]] = {
    "config": lambda path: load_scene(load_config(path).scene),
    "scene": lambda path: load_scene(str(path)),
    "plant": load_plant,
    "model": lambda path: load_model(path, element="torque"),
    "csv": read_csv,
    "key": _key,
    "profile": _profile,
}
REFUSALS = (ConfigError, PlantError, ModelFileError, ForceFileError, ProfileError)


def make(name: str, folder: Path) -> Path:
    """One of HOSTILE, in a folder, under a name that fits every kind."""
    path = folder / "hostile.csv"
    HOSTILE[name](path)
    return path


def refusal(name: str, kind: str, folder: Path) -> str:
    """What is wrong with how a file of HOSTILE is refused in place of one of READERS; empty where nothing is."""
    path, start_s = make(name, folder), time.process_time()
    try:
        READERS[kind](path)
    except REFUSALS as error:
        said = printable(str(error))
        if not said.isprintable() or len(said) >= MOST_CHARACTERS:
            return f"{name} as {kind}: {said[:MOST_CHARACTERS]!r}"
        spent_s = time.process_time() - start_s
        return f"{name} as {kind}: after {spent_s:.1f} s" if spent_s > WITHIN_S else ""
    return f"{name} as {kind}: not refused"


def run(count: int, seed: int) -> dict[str, Any]:
    """`count` of the files, drawn by `seed`, in place of every kind; the figures, and `failures`."""
    drawn = random.Random(seed).sample(sorted(HOSTILE), min(count, len(HOSTILE)))
    failures: list[str] = []
    before_kB = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for name in tqdm(drawn, desc="hostile files", unit="file", disable=None):
        for kind in READERS:
            with tempfile.TemporaryDirectory(prefix="tormag-") as folder:
                failures += filter(None, [refusal(name, kind, Path(folder))])
    memory_MB = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kB) / 1024.0
    if memory_MB > MEMORY_MB:
        failures.append(f"{memory_MB:.0f} MB more than before")
    return {"files": len(drawn), "kinds": len(READERS), "memory_MB": round(memory_MB, 1), "failures": failures}
