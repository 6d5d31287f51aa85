"""Every case of `judge.py endure` for a moment, and that each can fail."""

import contextlib
import math
import random
from contextlib import ExitStack
from pathlib import Path

import pytest
from judge import endure, fuzz, siege
from judge.frame import parsed
from judge.stand import Stand

from firmware_protocol.c.build import BuildError
from tormagd.control.safety.operating_state import COMMANDS
from tormagd.daemon.inbox import SetpointInbox
from tormagd_client.messages import MessageError, Request, decode


@pytest.mark.live
def test_a_device_is_unplugged_in_motion_and_plugged_in_again() -> None:
    result = endure.unplugged("can", 1, seed=3)
    assert result["failures"] == []
    assert result["lost_after_ms"] > 0.0


@pytest.mark.live
def test_cases_in_real_time_hold_on_one_stand_one_after_the_other() -> None:
    with ExitStack() as stack:
        stand = Stand(stack)
        for case, count in ((endure.soaked, 8), (siege.run, 1), (endure.stalled, 3)):
            assert case(stand, count, 1)["failures"] == []
        assert (stand.latched, stand.unhandled()) == ([], [])


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        (["nobody"], "invalid choice: 'nobody'"),
        (["endure", "nobody"], "invalid choice: 'nobody'"),
        (["endure", "fuzz", "--count", "0"], "0: allowed is at least 1"),
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


KIND = endure.Stop("daemon", 40.0, (), 0, 0)
LONG = KIND._replace(took_ms=83.0, faults=("HOST_STALL",))


@pytest.mark.parametrize(
    ("stop", "worst_N", "gap_mm", "says"),
    [
        (KIND, 0.02, 70.0, ""),
        (LONG, 1.0, 95.0, ""),
        (KIND._replace(faults=("MEASUREMENT_STALE",)), 0.0, 95.0, "fault MEASUREMENT_STALE"),
        (KIND, 1.0, 70.0, "force off by 1.000 N"),
        (LONG._replace(faults=("HOST_STALL", "LINK_LOST")), 1.0, 95.0, "told as HOST_STALL, LINK_LOST"),
        (LONG._replace(faults=()), 1.0, 95.0, "told as nothing"),
        # on the edge of the device's timeout either may happen, but it must be safe
        (LONG._replace(took_ms=50.0), 1.0, 70.0, "gap 70.0 mm, not open"),
    ],
)
def test_a_stop_is_judged_by_what_it_really_was(stop: endure.Stop, worst_N: float, gap_mm: float, says: str) -> None:
    assert says in stop.failure(worst_N, gap_mm)
    assert bool(says) == bool(stop.failure(worst_N, gap_mm))


def test_what_grows_or_is_missing_is_named() -> None:
    # the first two minutes of a long run do not count
    runs = ([1, 90, 100, 101, 102, 110, 104, 103], [*range(240), *(2_000 * [240]), 245])
    assert [endure.growth(run) for run in runs] == [10, 5]
    assert [endure.staying([3, 9, 5, 7, 6, 5, *last]) for last in ([9, 5], [7, 6])] == [0, 1]
    assert endure.failures({"daemon": 9}, {"daemon": 0}, [4, 5, 6]) == []
    said = endure.failures({"daemon": 5_000}, {"daemon": 1}, [4, 6])
    assert [what.split(":")[0] for what in said] == ["daemon", "daemon", "recording"]


QUIET = {"peers": {"drops": [], "refused": 0}, "setpoints": {"refused": 0, "sources": {"client": 1}}}


@pytest.mark.parametrize(
    ("name", "times", "took_ms", "says"),
    [
        ("clients", 0, 1.0, "ended with 0 after 0 times"),
        ("clients", 9, math.inf, "a stop was not heard"),
        ("messages", 9, 1.0, "not counted as refused"),
        ("strangers", 9, 1.0, "not counted as refused"),
        ("flood of control", 9, 1.0, "its source is not named"),
    ],
)
def test_an_attack_that_got_somewhere_is_named(name: str, times: int, took_ms: float, says: str) -> None:
    assert says in siege.judged(name, times, [took_ms], QUIET, 0)[0]
    assert siege.judged("clients", 9, [1.0], QUIET, 0) == []


def test_no_hostile_message_is_valid() -> None:
    draw, inbox = random.Random(1), SetpointInbox()
    for _ in range(3_000):
        parts = siege.hostile(draw, siege.SETPOINT, siege.NO_SETPOINT)
        assert len(parts) > 1 or not inbox.take(parts[0], 0.0, siege.SETPOINT["stamp_ns"])
        parts = siege.hostile(draw, siege.REQUEST, siege.NO_REQUEST)
        with contextlib.suppress(MessageError):
            assert len(parts) > 1 or decode(parts[0], Request).command not in COMMANDS
    assert inbox.accepted == inbox.dropped == 0
