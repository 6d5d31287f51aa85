"""Twenty hostile files of each kind are refused by size, kind or shape, in one sentence, by whoever reads that kind.

`tools/endure.py files` reads all of them in one process, and looks at its memory.
"""

from pathlib import Path

import pytest
from endurance.files import HOSTILE, READERS, make, refusal

from tormagd.bounded_file import read_bounded
from tormagd.toml_file import LONGEST_LINE, TomlError, toml_tables
from tormagd_client.regular_file import require_regular


@pytest.mark.parametrize("kind", READERS)
@pytest.mark.parametrize("name", HOSTILE)
def test_it_is_refused_in_one_printable_sentence(tmp_path: Path, kind: str, name: str) -> None:
    assert refusal(name, kind, tmp_path) == ""
    assert len(HOSTILE) >= 20


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


def test_a_file_that_does_not_know_its_size_is_read_to_the_limit_only() -> None:
    with pytest.raises(OSError, match="at most 10 bytes; this has more"):
        read_bounded(Path("/proc/self/status"), 10)
    assert b"Name:" in read_bounded(Path("/proc/self/status"), 100_000)


def test_a_file_of_the_greatest_size_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(bytes(100))
    assert read_bounded(path, 100) == bytes(100)
    path.write_bytes(bytes(101))
    with pytest.raises(OSError, match="this has 101"):
        read_bounded(path, 100)


def test_a_name_that_no_file_can_have_is_refused() -> None:
    with pytest.raises(OSError, match="no file can have this name"):
        read_bounded(Path("a\0b"), 100)


def test_a_link_to_what_may_be_read_is_followed(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("x")
    (tmp_path / "b").symlink_to(tmp_path / "a")
    assert read_bounded(tmp_path / "b", 100) == b"x"


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
    with pytest.raises(TomlError) as refused:
        toml_tables(text)
    assert said in str(refused.value)
