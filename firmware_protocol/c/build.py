"""Builds the C sources on this machine, for the simulated device and for tests.

What is built is kept in the user's cache, under a name made from the sources, the compiler and its flags.
"""

import ctypes
import hashlib
import os
import shutil
import subprocess
import tempfile
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Final

ROOM: Final = Path(__file__).parent
FIRMWARE: Final = ("codec", "crc", "device", "framing", "messages", "motion", "reports", "tormag")
STRICT: Final = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic")
# a fused multiplication rounds once where Python rounds twice; without it the doubles are equal to the last bit
SAME_DOUBLES: Final = ("-ffp-contract=off",)
SANITIZED: Final = ("-O1", "-g", "-fno-sanitize-recover=all", "-fno-omit-frame-pointer")
TIME_LIMIT_S: Final = 120
_EMULATION: Final = "gcc-arm-none-eabi, libnewlib-arm-none-eabi and qemu-system-arm"
DEBIAN: Final = {
    "arm-none-eabi-gcc": _EMULATION,
    "qemu-system-arm": _EMULATION,
    "arm-none-eabi-size": _EMULATION,
    "clang": "clang and libclang-rt-14-dev",
}


class BuildError(RuntimeError):
    """The C sources could not be built here; the text says why and what helps."""


class Target(Enum):
    """A program or library to build: its sources besides the firmware's, its flags, and a compiler that it needs."""

    LIBRARY = ("host/bridge",), ("-O2", "-fPIC", "-shared")
    SANITIZED_EXCHANGE = ("host/bridge", "host/exchange"), (*SANITIZED, "-fsanitize=address,undefined")
    FUZZ = (
        ("fuzz/fuzz", "fuzz/codec", "fuzz/framing", "fuzz/device"),
        (*SANITIZED, "-fsanitize=fuzzer,address,undefined"),
        "clang",
    )
    MPS2 = (
        ("mps2/board", "mps2/main"),
        (
            *("-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=soft", "-Os", "-ffunction-sections", "-Wl,--gc-sections"),
            *("-nostartfiles", "--specs=nano.specs", "-T", str(ROOM / "mps2" / "mps2.ld")),
        ),
        "arm-none-eabi-gcc",
    )

    def __init__(self, sources: tuple[str, ...], flags: tuple[str, ...], needs: str | None = None) -> None:
        self.sources = tuple(ROOM / f"{name}.c" for name in (*FIRMWARE, *sources))
        self.flags, self.needs = flags, needs


def compiler() -> str:
    wanted = os.environ.get("CC", "cc")
    found = shutil.which(wanted)
    if found is None:
        raise BuildError(f"no C compiler: {wanted!r} is not on the path; install gcc or clang, or name one in CC")
    return found


def debian_tool(name: str) -> str:
    found = shutil.which(name)
    if found is None:
        raise BuildError(f"{name} is not on the path; install the Debian packages {DEBIAN[name]}")
    return found


def build(target: Target) -> Path:
    """Build a target, unless the cache has it from the present sources, and return its path."""
    command = [debian_tool(target.needs) if target.needs else compiler(), *STRICT, *SAME_DOUBLES, *target.flags]
    user_cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    path = user_cache / "tormagd" / f"{target.name.lower()}-{_fingerprint(command)}"
    if path.exists():
        return path
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        # built beside its place and moved there whole, because another process may be building it too
        with tempfile.TemporaryDirectory(dir=path.parent) as folder:
            built = Path(folder) / path.name
            _compile([*command, *map(str, target.sources), "-lm", "-o", str(built)])
            built.replace(path)
    except OSError as error:
        raise BuildError(f"cannot write {path}: {error}; XDG_CACHE_HOME names another cache") from error
    return path


@cache
def load_library() -> ctypes.CDLL:
    path = build(Target.LIBRARY)
    try:
        return ctypes.CDLL(str(path))
    except OSError as error:
        raise BuildError(f"cannot load {path}: {error}; delete it to have it built again") from error


def _fingerprint(command: list[str]) -> str:
    """Return 16 hexadecimal digits that change with the command and with any C source, header or linker script."""
    digest = hashlib.sha256("\0".join(command).encode())
    for path in sorted([*ROOM.rglob("*.[ch]"), *ROOM.rglob("*.ld")]):
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:16]


def _compile(command: list[str]) -> None:
    try:
        result = subprocess.run(command, capture_output=True, text=True, timeout=TIME_LIMIT_S, check=False)
    except subprocess.TimeoutExpired as error:
        raise BuildError(f"{command[0]} did not finish in {TIME_LIMIT_S} s") from error
    if result.returncode != 0:
        raise BuildError(f"{' '.join(command)} failed:\n{result.stderr.strip()}")
