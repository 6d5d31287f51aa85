"""Every case of `judge.py endure` for a moment, and that each can fail."""

from contextlib import ExitStack
from pathlib import Path

import pytest
from judge import endure, fuzz
from judge.frame import parsed
from stand import Stand

from firmware_protocol.c.build import BuildError


@pytest.mark.live
def test_a_device_is_unplugged_in_motion_and_plugged_in_again() -> None:
    result = endure.unplugged("can", 1, seed=3)
    assert result["failures"] == []
    assert result["lost_after_ms"] > 0.0


@pytest.mark.live
def test_nothing_grows_while_a_force_is_rendered_and_recorded() -> None:
    with ExitStack() as stack:
        stand = Stand(stack)
        assert endure.soaked(stand, 8, 1)["failures"] == []
        assert (stand.latched, stand.unhandled()) == ([], [])


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        (["nobody"], "invalid choice: 'nobody'"),
        (["endure", "nobody"], "invalid choice: 'nobody'"),
        (["endure", "fuzz", "--count", "0"], "0: allowed is a whole number 1.."),
    ],
)
def test_a_wrong_command_line_is_refused(wrong: list[str], says: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match=r"^2$"):
        parsed("judge", {"endure": ""}, wrong)
    assert says in capsys.readouterr().err


def test_both_languages_hear_the_vectors_and_a_difference_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    inputs = list(fuzz.payloads()), [*fuzz.streams(), b"\x82\x01\x07\0\xff\xff", b"\x89" * 12]
    try:
        assert fuzz.differences(*inputs) == 0
    except BuildError as error:
        pytest.skip(str(error))
    monkeypatch.setattr(fuzz, "decode", lambda function, payload: None)
    assert fuzz.differences(*inputs) > 0


def test_what_does_not_hold_is_told_with_the_bytes_that_showed_it(tmp_path: Path) -> None:
    program, corpus = tmp_path / "program", tmp_path / "codec"
    program.write_text(
        f"#!/bin/sh\nprintf '\\001\\002' > {corpus}-crash-1\necho 'does not hold: x == 1, codec.c:7' >&2\nexit 77\n"
    )
    program.chmod(0o700)
    assert fuzz.fuzzed(program, corpus, 1, "-runs=0") == (0, ["codec: does not hold: x == 1, codec.c:7: 0102"])


def test_without_clang_the_reason_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    result = endure.measured("fuzz", 1, 1)
    assert (result["passed"], "clang is not on the path" in result["skipped"]) == (True, True)


def test_what_grows_or_is_missing_is_named() -> None:
    # the first two minutes of a long run do not count
    runs = ([1, 90, 100, 101, 102, 110, 104, 103], [*range(240), *(2_000 * [240]), 245])
    assert [endure.growth(run) for run in runs] == [10, 5]
    assert [endure.staying([3, 9, 5, 7, 6, 5, *last]) for last in ([9, 5], [7, 6])] == [0, 1]
    assert endure.failures({"daemon": 9}, {"daemon": 0}, [4, 5, 6]) == []
    said = endure.failures({"daemon": 5_000}, {"daemon": 1}, [4, 6])
    assert [what.split(":")[0] for what in said] == ["daemon", "daemon", "recording"]
