"""Which build of the core runs: compiled, or the very same files interpreted.

Both give the same results to the bit. `pip install` compiles where a compiler and Python's headers are (setup.py), and
records what it compiled. After an edit of any source the whole core is interpreted, with a warning, because compiled
modules know each other's insides; TORMAG_COMPILED=0 does so for one process, without a warning. `tormagd --version`,
`status` and `doctor` say which build runs.
"""

import importlib.machinery
import importlib.util
import json
import os
import sys
import warnings
import zlib
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

SWITCH = "TORMAG_COMPILED"
_HERE = Path(__file__).parent
REMEDY = "install it again with pip where a C compiler and Python's headers are"
COST = "a tick takes about five times as long as compiled"


class Build(NamedTuple):
    is_compiled: bool
    reason: str

    def __str__(self) -> str:
        return "compiled" if self.is_compiled else f"interpreted: {self.reason}"


class FromSource:
    """A finder for `sys.meta_path` that loads the given modules from their sources."""

    def __init__(self, modules: frozenset[str]) -> None:
        self._modules = modules

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        if fullname not in self._modules or path is None:
            return None
        sources = [Path(folder, fullname.rpartition(".")[2]).with_suffix(".py") for folder in path]
        found = next((source for source in sources if source.is_file()), None)
        return None if found is None else importlib.util.spec_from_file_location(fullname, found)


def judged(root: Path, switch: str | None) -> tuple[Build, frozenset[str]]:
    """Return which build of the packages in `root` may run, and the compiled modules' names."""
    try:
        record = json.loads((root / "firmware_protocol" / "core.json").read_bytes())
        sources: dict[str, int] = record["sources"]
        suffix, lacking = record["python"], record["interpreted"]
    except (OSError, ValueError, KeyError, TypeError):
        return Build(False, "it was not compiled"), frozenset()
    modules = frozenset(source.removesuffix(".py").replace("/", ".") for source in sources)
    if suffix != importlib.machinery.EXTENSION_SUFFIXES[0]:
        return Build(False, f"it was compiled for another Python ({suffix})"), modules
    if lacking:
        return Build(False, f"when it was installed, {lacking}"), modules
    if switch == "0":
        return Build(False, f"{SWITCH}=0"), modules
    edited = [source for source, known in sources.items() if check_sum(root / source) != known]
    if edited:
        more = f" and {len(edited) - 1} more" if len(edited) > 1 else ""
        return Build(False, f"{edited[0]}{more} changed since the core was compiled"), modules
    return Build(True, ""), modules


def check_sum(path: Path) -> int:
    """Return the CRC-32 of a source file, or -1 if it cannot be read."""
    try:
        return zlib.crc32(path.read_bytes())
    except OSError:
        return -1


@cache
def settle() -> Build:
    """Decide which build this process runs; call this before any module of the core is imported."""
    build, modules = judged(_HERE.parent, os.environ.get(SWITCH))
    if not build.is_compiled and modules:
        sys.meta_path.insert(0, FromSource(modules))
        if "changed since" in build.reason:
            warnings.warn(f"the core runs {build}; {REMEDY}", RuntimeWarning, stacklevel=2)
    return build
