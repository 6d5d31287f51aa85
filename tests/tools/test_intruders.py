"""What the tool that troubles the daemon calls a failure, on made-up figures: it must not pass what did not hold."""

import contextlib
import json
import random
from typing import Any

import intruders
import numpy as np
import pytest
from benchmarks.loop import Block
from intrusion import floods, messages, pulse_from_afar, stop_lane, strangers
from intrusion.besieged import Line
from machines.host import Host

from tormagd.daemon.inbox import SetpointInbox
from tormagd.safety.operating_state import COMMANDS
from tormagd_client.messages import MessageError, Request, decode

GREETING = bytes(64)
WELCOME = b"\x04\xa8" + b"\x07WELCOME" + bytes(160)
REFUSED = b"\x04\x0a" + b"\x05ERROR\x03400"
QUIET = np.full(1_000, 40.0)


# -- strangers -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("said", [b"", GREETING[:11], GREETING, GREETING + WELCOME, GREETING + WELCOME + REFUSED])
def test_what_everybody_may_be_told(said: bytes) -> None:
    assert strangers.beyond_mechanism(said) == b""


@pytest.mark.parametrize("more", [b"\x04\x06\x05READY", b"\x00\x01a", b"\x01\x01a", b"\x06" + bytes(8), b"\x04"])
def test_what_only_those_hear_who_were_let_in(more: bytes) -> None:
    assert strangers.beyond_mechanism(GREETING + WELCOME + more) == more


def knocked(**changed: Any) -> Line:
    found = {"tries": 10_000, "most_bytes": 246, "beyond": 0, "per_s": 530.0, "counted": 10_000}
    late = {"without_p99_us": 40.0, "next_door_p99_us": 90.0, "late_p99_us": 71.0}
    return strangers.judged({"plain": found | late | changed}, [])


def test_strangers_that_got_nowhere() -> None:
    line = knocked()
    assert line.failures == []
    assert line.figures["kinds"]["plain"]["allowed_p99_us"] == pytest.approx(1.3 * 40.0 + 20.0)


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"beyond": 1}, "1 were told more than"),
        ({"counted": 9_999}, "9999 of 10000 counted"),
        ({"per_s": 499.0}, "only 499 tries a second"),
        ({"late_p99_us": 73.0}, "control late by 73 us (p99), allowed 72"),
    ],
)
def test_strangers_that_got_somewhere(changed: dict[str, Any], says: str) -> None:
    (failure,) = knocked(**changed).failures
    assert says in failure


# -- stop ----------------------------------------------------------------------------------------------------------


def test_stops_that_were_heard() -> None:
    assert stop_lane.judged(np.full(1_000, 1.5), np.array([-36.0]), np.array([20.0])).failures == []


@pytest.mark.parametrize(
    ("took_ms", "before", "after", "says"),
    [
        (5.1, -36.0, 20.0, "RETRACT 5.1 ms after stop"),
        (1.5, -36.0, -0.2, "a gap closed by 0.2 mm/s 60 ms after stop"),
        (1.5, -3.0, 20.0, "a gap that was to close moved by -3.0 mm/s"),
    ],
)
def test_stops_that_were_not(took_ms: float, before: float, after: float, says: str) -> None:
    (failure,) = stop_lane.judged(np.full(1_000, took_ms), np.array([before]), np.array([after])).failures
    assert says in failure


def test_the_speed_of_a_gap_is_that_of_the_time() -> None:
    time_ns = np.arange(0, 200_000_000, 1_000_000)
    gap = np.column_stack([time_ns, np.where(time_ns < 100_000_000, -30e-9, 15e-9) * (time_ns - 100_000_000)])
    assert stop_lane.speed_mm_s(gap, 50_000_000) == pytest.approx(-30.0)
    assert stop_lane.speed_mm_s(gap, 160_000_000) == pytest.approx(15.0)


# -- floods --------------------------------------------------------------------------------------------------------


def bore(**changed: Any) -> Line:
    bare = Block(QUIET, QUIET, 10_000, 0, 10.0)
    ticks = changed.pop("ticks", 9_950)
    found = floods.Flooded(bare._replace(ticks=ticks), bare, 100_000.0, True, [])
    return floods.judged({"control": found._replace(**changed)})


def test_floods_that_were_borne() -> None:
    assert bore().failures == []


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"ticks": 9_899}, "control at 989.9 Hz, a bare timer at 1000.0"),
        ({"per_s": 98_000.0}, "only 98000 messages a second"),
        ({"named": False}, "its source is not named"),
        ({"troubles": ["fault HOST_STALL"]}, "flood of control: fault HOST_STALL"),
    ],
)
def test_floods_that_were_not(changed: dict[str, Any], says: str) -> None:
    (failure,) = bore(**changed).failures
    assert says in failure


# -- hostile messages ----------------------------------------------------------------------------------------------


def test_no_hostile_message_is_valid() -> None:
    """Otherwise one that is taken would be no failure of the daemon's."""
    random_, inbox = random.Random(1), SetpointInbox()
    for _ in range(3_000):
        parts = messages.hostile(random_, messages.SETPOINT, messages.NO_SETPOINT)
        assert sum(map(len, parts)) < 16_384
        if len(parts) == 1:
            assert not inbox.take(parts[0], 0.0, messages.SETPOINT["stamp_ns"])
        parts = messages.hostile(random_, messages.REQUEST, messages.NO_REQUEST)
        if len(parts) == 1:
            with contextlib.suppress(MessageError):
                assert decode(parts[0], Request).command not in COMMANDS
    assert inbox.accepted == inbox.dropped == 0


def refused(**changed: Any) -> Line:
    status = {
        "setpoints": {"refused": 800, "oversize": 3, "sources": {"tormagctl": 1}},
        "peers": {"drops": []},
        "operating_state": "ENABLED",
    }
    asked = changed.pop("asked", messages.Asked(100, 100, 0))
    return messages.judged(800, asked, 100, status | changed, [])


def test_messages_that_nobody_took() -> None:
    assert refused().failures == []


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"asked": messages.Asked(100, 100, 1)}, "1 requests were carried out"),
        ({"asked": messages.Asked(100, 99, 0)}, "99 of 100 requests were answered"),
        ({"setpoints": {"refused": 799, "oversize": 0, "sources": {}}}, "799 of 800 setpoints"),
        ({"setpoints": {"refused": 800, "oversize": 0, "sources": {"hostile": 7}}}, "1 sources taken for one"),
        ({"operating_state": "FAULT"}, "the device was FAULT"),
    ],
)
def test_messages_that_somebody_took(changed: dict[str, Any], says: str) -> None:
    (failure,) = refused(**changed).failures
    assert says in failure


# -- the pulse, and all of it --------------------------------------------------------------------------------------


def test_a_pulse_from_afar_is_held_against_the_one_from_here_pair_by_pair() -> None:
    assert pulse_from_afar.judged([3.4e-3, 9.0e-3, 3.4e-3], [3.5e-3, 9.2e-3, 12e-3]).failures == []
    (failure,) = pulse_from_afar.judged([3.4e-3], [4.5e-3]).failures
    assert "differs by +1.10 mN RMS, allowed 1" in failure


@pytest.mark.parametrize(("failures", "status"), [([], 0), (["it did not hold"], 1)])
def test_the_status_says_whether_all_held(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], failures: list[str], status: int
) -> None:
    monkeypatch.setattr(intruders, "watched", lambda part, share: (part(share), Host(0.0, 1.0, 0.0, {})))
    parts = {"good": lambda share: Line("good", [], {}), "other": lambda share: Line("other", failures, {"n": share})}
    monkeypatch.setattr(intruders, "PARTS", parts)
    assert intruders.main(["--json", "--share", "0.5"]) == status
    printed = json.loads(capsys.readouterr().out)
    assert printed["passed"] == (not failures)
    assert printed["lines"]["other"]["figures"] == {"n": 0.5}
    assert intruders.main(["other"]) == status
    assert ("FAILED: it did not hold" in capsys.readouterr().out) == bool(failures)


@pytest.mark.parametrize("wrong", [["nobody"], ["--share", "0"], ["--share", "2"]])
def test_a_wrong_command_line_is_refused(wrong: list[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        intruders.main(wrong)
    assert caught.value.code == 2


# -- what the machine has to answer for ----------------------------------------------------------------------------


@pytest.mark.parametrize(("stood_still_ms", "failures"), [(24.0, ["fault OLD", "too slow"]), (26.0, ["too slow"])])
def test_a_fault_is_the_machines_where_it_stood_still(stood_still_ms: float, failures: list[str]) -> None:
    host = Host(steal=0.0, bare_kept=0.99, bare_worst_ms=stood_still_ms, waited={})
    line = intruders.attributed(Line("said", ["fault OLD", "too slow"], {}), host)
    assert line.failures == failures
    assert [*line.held_against_machine, *line.failures] == ["fault OLD", "too slow"]
