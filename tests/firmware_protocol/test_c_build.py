"""The C sources keep to C99 and to what a bare microcontroller has."""

import re
import shutil
import subprocess
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import firmware_protocol.c.build as c_build
from firmware_protocol.c.build import FIRMWARE, ROOM, STRICT, BuildError, Target, build, compiler
from tormagd.simulation.__main__ import main as simulate

# memory and strings without a heap, and four functions of the mathematics library
ALLOWED_FROM_OUTSIDE = {"memcpy", "memset", "memcmp", "fabs", "rint", "fmod", "isfinite", "__isfinite"}
BEYOND_STRICT = ("-Wconversion", "-Wshadow", "-Wvla", "-Wstrict-prototypes", "-Wmissing-prototypes", "-Wcast-qual")


def compiled(c_compiler: str, folder: Path, *flags: str) -> "subprocess.CompletedProcess[str]":
    """Compile each firmware source by itself, without what a host's compiler adds."""
    sources = [str(ROOM / f"{name}.c") for name in FIRMWARE]
    command = [c_compiler, "-O1", "-fno-stack-protector", *flags, "-c", *sources]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


def test_the_firmware_needs_no_heap_and_hardly_a_library(c_compiler: str, tmp_path: Path) -> None:
    nm = shutil.which("nm")
    if nm is None:
        pytest.skip("no nm to list symbols")
    result = compiled(c_compiler, tmp_path, "-U_FORTIFY_SOURCE", *STRICT, *BEYOND_STRICT)
    assert result.returncode == 0, result.stderr
    listing = subprocess.run([nm, *tmp_path.glob("*.o")], capture_output=True, text=True, check=True).stdout
    symbols = [line.split() for line in listing.splitlines() if line and not line.endswith(":")]
    assert ["tormag_device_tick"] in [words[2:] for words in symbols]
    defined = {words[-1] for words in symbols if words[-2] != "U"}
    assert {words[-1] for words in symbols if words[-2] == "U"} - defined <= ALLOWED_FROM_OUTSIDE
    # all state is the caller's
    assert {words[-1] for words in symbols if words[-2] in "bBdDC"} == set()


def test_the_firmware_does_not_recurse_and_its_stack_is_bounded(c_compiler: str, tmp_path: Path) -> None:
    if compiled(c_compiler, tmp_path, "-std=c99", "-fcallgraph-info=su").returncode != 0:
        pytest.skip(f"{c_compiler} writes no call graph")
    graph = "".join(path.read_text(encoding="utf-8") for path in tmp_path.glob("*.ci"))
    stack = {
        node: int(size)
        for node, size, kind in re.findall(r'node: \{ title: "([^"]+)" label: "[^"]*?(\d+) bytes \((\w+)\)"', graph)
        if kind == "static"
    }
    calls: dict[str, set[str]] = {node: set() for node in stack}
    for caller, callee in re.findall(r'sourcename: "([^"]+)" targetname: "([^"]+)"', graph):
        calls[caller].add(callee)
    assert "tormag_device_tick" in stack
    # every function after those that it calls; a recursion raises CycleError
    deepest: dict[str, int] = {}
    for node in TopologicalSorter(calls).static_order():
        deepest[node] = stack.get(node, 0) + max((deepest[callee] for callee in calls.get(node, ())), default=0)
    assert set(deepest) - set(stack) <= ALLOWED_FROM_OUTSIDE  # nothing of unknown size, no pointers
    assert 100 < max(deepest.values()) < 512


def test_a_build_is_kept_and_follows_its_sources(c_compiler, tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    first = build(Target.LIBRARY)
    written = first.stat().st_mtime_ns
    assert first.is_relative_to(tmp_path)
    assert (build(Target.LIBRARY), first.stat().st_mtime_ns) == (first, written)
    monkeypatch.setattr(c_build, "SAME_DOUBLES", (*c_build.SAME_DOUBLES, "-DANOTHER"))
    assert build(Target.LIBRARY) != first
    assert len(list(first.parent.iterdir())) == 2


def test_without_a_compiler_the_reason_and_the_remedy_are_given(capsys, monkeypatch, tmp_path) -> None:
    monkeypatch.setenv("CC", "cc-that-is-not-there")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    c_build.load_library.cache_clear()
    monkeypatch.setattr("tormagd.simulation.compiled_firmware._library", c_build.load_library)
    with pytest.raises(BuildError, match="no C compiler: 'cc-that-is-not-there' is not on the path; install"):
        compiler()
    with pytest.raises(SystemExit, match="2"):
        simulate(["--pty", "--firmware", "c"])
    assert "no C compiler" in capsys.readouterr().err


def test_a_failed_compilation_shows_the_compilers_words(c_compiler, tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(c_build, "SAME_DOUBLES", ("-include", "header-that-is-not-there.h"))
    with pytest.raises(BuildError, match=r"header-that-is-not-there\.h"):
        build(Target.LIBRARY)
    assert list((tmp_path / "tormagd").iterdir()) == []


def test_a_cache_that_cannot_be_written_is_named(c_compiler, tmp_path, monkeypatch) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("", encoding="ascii")
    monkeypatch.setenv("XDG_CACHE_HOME", str(blocked))
    with pytest.raises(BuildError, match="XDG_CACHE_HOME names another cache"):
        build(Target.LIBRARY)
