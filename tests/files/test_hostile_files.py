"""Twenty hostile files of each kind are refused by size, kind or shape, by whoever reads that kind.

A reader must refuse each in one printable sentence, within a second of processor time, and without 100 MB of memory.
"""

import errno
import os
import re
import resource
import socket
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tormagd.config import Config, load_calibration, load_config
from tormagd.ctl.waveform import read_csv
from tormagd.daemon.profiles import ProfileError, ProfileFolder
from tormagd.element.model.model_file import ModelFileError, load_model
from tormagd.ground.files import in_place_of, new_file, read_bounded
from tormagd.ground.force_file import read_forces
from tormagd.ground.table import TableError
from tormagd.ground.toml_file import LONGEST_LINE, TomlError, toml_tables
from tormagd.scenes.scene import load_scene
from tormagd.scenes.signal import recorded
from tormagd.simulation.parameters import PlantError, load_plant
from tormagd_client.endpoints import ConfigError
from tormagd_client.keys import load_pair
from tormagd_client.printable import printable
from tormagd_client.regular_file import require_regular

TERABYTE = 1 << 40
WITHIN_S, MEMORY_MB = 1.0, 100.0
MAX_CHARACTERS = 600


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


def _profile(path: Path) -> None:
    folder = ProfileFolder(path.parent, "MRE-50-40", "ab" * 32, Config().trim)
    path.rename(folder.path(7))
    if folder.read(7) is None:
        raise ProfileError("No such file")


def _key(path: Path) -> None:
    if path.is_file():
        path.chmod(0o600)
    load_pair(path)


READERS: dict[str, Callable[[Path], object]] = {
    "config": lambda path: load_scene(load_config(path).scene),
    "calibration": lambda path: load_calibration(path, Config(), 7),
    "scene": lambda path: load_scene(str(path)),
    "plant": load_plant,
    "model": lambda path: load_model(path, element="torque"),
    "csv": read_csv,
    "key": _key,
    "profile": _profile,
}


def make(name: str, folder: Path) -> Path:
    path = folder / "hostile.csv"
    HOSTILE[name](path)
    return path


def refusal(name: str, kind: str, folder: Path) -> str:
    """Return what is wrong with the refusal of a HOSTILE file in place of one of READERS."""
    path, start_s = make(name, folder), time.process_time()
    before_kB = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        READERS[kind](path)
    except (ConfigError, PlantError, ModelFileError, TableError, ProfileError) as error:
        said = printable(str(error))
        if not said.isprintable() or len(said) >= MAX_CHARACTERS:
            return f"{name} as {kind}: {said[:MAX_CHARACTERS]!r}"
        spent_s = time.process_time() - start_s
        grown_MB = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kB) / 1024.0
        is_late = spent_s > WITHIN_S or grown_MB > MEMORY_MB
        return f"{name} as {kind}: after {spent_s:.1f} s and {grown_MB:.0f} MB" if is_late else ""
    return f"{name} as {kind}: not refused"


def test_a_scene_that_is_a_link_to_itself_is_told_so(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="Too many levels of symbolic links"):
        load_scene(str(make("a link to itself", tmp_path)))


@pytest.mark.parametrize("kind", READERS)
def test_each_is_refused_in_one_printable_sentence(tmp_path_factory: pytest.TempPathFactory, kind: str) -> None:
    wrong = [refusal(name, kind, tmp_path_factory.mktemp("hostile")) for name in HOSTILE]
    assert [said for said in wrong if said] == []
    assert len(wrong) >= 20


def test_a_file_that_is_read_is_found_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(READERS, "csv", lambda path: path)
    assert refusal("pipe", "csv", tmp_path) == "pipe as csv: not refused"


@pytest.mark.parametrize("name", ["pipe", "directory", "zeros without end", "socket", "sparse, 1 TB"])
def test_the_kind_or_the_size_is_named_and_nothing_opened(tmp_path: Path, name: str) -> None:
    path = make(name, tmp_path)
    with pytest.raises(OSError, match=r"allowed is a regular file of at most 100 bytes; this (is a|has 1)"):
        read_bounded(path, 100)
    with pytest.raises(OSError, match="allowed is a regular file"):
        require_regular(path, 100)


@pytest.mark.parametrize(
    ("path", "said"),
    [("/proc/self/status", "at most 10 bytes; this has more"), ("a\0b", "no file can have this name")],
)
def test_a_file_that_does_not_know_its_size_or_cannot_be_is_refused(path: str, said: str) -> None:
    with pytest.raises(OSError, match=said):
        read_bounded(Path(path), 10)


def test_a_file_of_the_greatest_size_is_read_through_a_link_too(tmp_path: Path) -> None:
    path, link = tmp_path / "a", tmp_path / "b"
    link.symlink_to(path)
    path.write_bytes(bytes(100))
    assert read_bounded(path, 100) == read_bounded(link, 100) == bytes(100)
    path.write_bytes(bytes(101))
    with pytest.raises(OSError, match="this has 101"):
        read_bounded(path, 100)
    assert b"Name:" in read_bounded(Path("/proc/self/status"), 100_000)


@pytest.mark.parametrize(
    "text",
    [
        f"{'.'.join('a' * 16)} = 1",
        f"[{'.'.join('a' * 16)}]",
        "a = " + "[" * 16 + "]" * 16,
        "a = [" + ",".join(["0.5"] * 1_000) + "]",
        'a = "' + "[." * 2_000 + '"',
        "# " + "[." * 2_000 + "\na = 1",
        f"a = {-(2**63)}",
        f"a = {2**63 - 1}",
    ],
)
def test_what_is_as_deep_as_allowed_or_only_looks_deeper_is_read(text: str) -> None:
    assert "a" in toml_tables(text)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("b = 1\n" + ".".join("a" * LONGEST_LINE) + " = 1", f"line 2 has {2 * LONGEST_LINE + 3} characters"),
        ("[" + " . ".join("a" * LONGEST_LINE) + "]", f"allowed are {LONGEST_LINE}"),
        (".".join("a" * 2_000) + " = 1", "too deep in each other"),
        ("[" + ".".join("a" * 2_000) + "]", "too deep in each other"),
        ("a = " + "[" * 2_000, "too deep in each other"),
        ("a = " + "{a=[" * 1_000, "too deep in each other"),
        ("a = inf", "a = inf: allowed is a finite number"),
        ("[t]\na = [1, {b = nan}]", "t.a[1].b = nan: allowed is a finite number"),
        (f"a = {2**63}", "a: an integer of 64 bits"),
        ("a = 0x" + "f" * 2_000, "a: an integer of 8000 bits"),
        ("a = " + "9" * 5_001, "more digits than any that is allowed"),
    ],
)
def test_what_is_deeper_or_no_number_is_refused_with_its_place(text: str, said: str) -> None:
    with pytest.raises(TomlError, match=re.escape(said)):
        toml_tables(text)


@pytest.mark.parametrize("text", ["t_s,force_N\n0,1\n1,2\n3,1\n", "rate_mm_s,force_N,t_s\n5,1,7\n5,2,8\n-5,0,9.5\n"])
def test_all_read_the_same_files(tmp_path: Path, text: str) -> None:
    path = tmp_path / "task.csv"
    path.write_text(text)
    sent, (time_s, force_N), table = read_csv(path), recorded(path), read_forces(path)
    assert [sent.at(at_s).force_N for at_s in time_s] == force_N.tolist() == list(table.values["force_N"])
    assert [at_s - table.values["time_s"][0] for at_s in table.values["time_s"]] == time_s.tolist()


@pytest.mark.parametrize(
    "text",
    [
        "",
        "t_s,force_N\n0,1\n",
        "t_s,force_N\n0,1\n1,-0.5\n2,1\n",
        "t_s,force_N\n0,1\n1,1001\n2,1\n",
        "t_s,force_N\n0,1\n1,nan\n2,1\n",
        "t_s,force_N\n0,1\n1,1_5\n2,1\n",
        "t_s,force_N\n0,1\n0,2\n2,1\n",
        "t_s,force_N\n0,1\n1\n2,1\n",
        't_s,force_N\n0,"1\n',
        None,
    ],
)
def test_the_same_mistake_is_told_in_the_same_words(tmp_path: Path, text: str | None) -> None:
    path = tmp_path / "task.csv"
    if text is not None:
        path.write_text(text)
    said = set()
    for read in (read_csv, recorded, read_forces):
        with pytest.raises(ValueError, match=str(path)) as refused:
            read(path)
        said.add(str(refused.value).removeprefix("signal.file = "))
    assert len(said) == 1


@pytest.mark.parametrize("leave", [os.mkfifo, lambda part: part.symlink_to("other")], ids=["a pipe", "a link"])
def test_what_another_left_is_not_written_through(tmp_path: Path, leave: Callable[[Path], object]) -> None:
    (tmp_path / "other").write_text("another's")
    leave(tmp_path / "a.part")
    with in_place_of(tmp_path / "a") as beside:
        os.close(os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_NONBLOCK))  # a pipe without a reader refuses that
        beside.write_text("ours")
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"a": "ours", "other": "another's"}


def test_what_replaces_a_file_is_on_the_disk_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, synced = tmp_path / "a", []
    path.write_text("old")
    monkeypatch.setattr(os, "fsync", lambda descriptor: synced.append((path.read_text(), os.fstat(descriptor).st_size)))
    with in_place_of(path) as beside:
        beside.write_text("newer")
    assert (synced, path.read_text()) == ([("old", 5)], "newer")


def test_what_could_not_be_written_whole_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(UnicodeEncodeError), in_place_of(tmp_path / "a") as beside:
        beside.write_text("half of it\ud800", "utf-8")
    with pytest.raises(OSError, match="No space") as full, new_file(tmp_path / "a"):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert full.value.filename == str(tmp_path / "a")
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (os.mkdir, "allowed is a regular file; this is a directory"),
        (os.mkfifo, "allowed is a regular file; this is a pipe"),
        (lambda path: path.symlink_to("pipe"), "this is a pipe"),
        (lambda path: path.hardlink_to(path.with_name("source")), "this is read here: allowed is another file"),
    ],
    ids=["a directory", "a pipe", "a link to a pipe", "the source"],
)
def test_no_other_file_is_replaced(tmp_path: Path, make: Callable[[Path], object], said: str) -> None:
    path, source = tmp_path / "a", tmp_path / "source"
    os.mkfifo(tmp_path / "pipe")
    source.write_text("precious")
    make(path)
    before = path.lstat()
    with pytest.raises(OSError, match=said), in_place_of(path, source):
        pass
    with pytest.raises(FileExistsError), new_file(path):
        pass
    assert path.lstat() == before
