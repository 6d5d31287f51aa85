"""What `tools/endure.py` runs for long, for a moment; and that it would notice: what cannot fail proves nothing."""

import contextlib
import math
import random
from contextlib import ExitStack
from dataclasses import dataclass, field

import endure
import pytest
from endurance import fuzz, replug, siege, soak, stalls
from endurance.stand import Stand

from firmware_protocol.codec import decode as decoded, encode
from firmware_protocol.framing import Frame, FrameDecoder, FramingStatistics, encode_frame
from tormagd.daemon.inbox import SetpointInbox
from tormagd.safety.operating_state import COMMANDS
from tormagd_client.messages import MessageError, Request, decode


def test_damage_does_no_harm_and_repeats_itself() -> None:
    result = endure.measured("fuzz", 3_000, 1)
    assert result["failures"] == []
    assert result["passed"]
    first, again = (endure.measured("fuzz", 400, 1) | {"seconds": 0} for _ in range(2))
    assert first == again


@pytest.mark.live
def test_a_device_is_unplugged_in_motion_and_plugged_in_again() -> None:
    result = replug.run("can", 1, seed=3)
    assert result["failures"] == []
    assert result["lost_after_ms"] > 0.0


@pytest.mark.live
def test_cases_in_real_time_hold_on_one_stand_one_after_the_other() -> None:
    with ExitStack() as stack:
        stand = Stand(stack)
        for case, count in ((soak, 8), (siege, 1), (stalls, 3)):
            assert case.run(stand, count, 1)["failures"] == []
        assert stand.latched == []
        assert stand.unhandled() == []


@pytest.mark.parametrize("wrong", [["nobody"], ["fuzz", "--count", "0"]])
def test_a_wrong_command_line_is_refused(wrong: list[str]) -> None:
    with pytest.raises(SystemExit, match=r"^2$"):
        endure.main(wrong)


# -- fuzz ----------------------------------------------------------------------------------------------------------


@dataclass
class Faulty:
    """A decoder with one fault: it takes what has no right CRC, gives repetitions, or finds back late."""

    fault: str
    statistics: FramingStatistics = field(default_factory=FramingStatistics)
    whole: FrameDecoder = field(default_factory=FrameDecoder)
    unfinished: bytes = b""
    before: int = 0

    def feed(self, data: bytes) -> list[Frame]:
        *pieces, self.unfinished = (self.unfinished + data).split(b"\0")
        return [frame for piece in pieces for frame in self.accepted(piece + b"\0")]

    def accepted(self, piece: bytes) -> list[Frame]:
        if self.fault == "repetitions":
            return FrameDecoder().feed(piece)
        corrupt, frames = self.whole.statistics.corrupt, self.whole.feed(piece)
        is_corrupt = self.whole.statistics.corrupt > corrupt
        self.before = 3 if is_corrupt else self.before - 1
        if self.fault == "late":
            return [] if self.before > 0 else frames
        return [Frame(piece[1], piece[2], piece[3:-3])] if is_corrupt and len(piece) > 6 else frames


@pytest.mark.parametrize(
    ("fault", "kind", "says"),
    [
        ("no CRC", "bytes overwritten", "wrong_frames"),
        ("repetitions", "frame repeated", "false_accepts"),
        ("late", "noise", "not resynchronised"),
    ],
)
def test_a_faulty_decoder_is_found_out(fault: str, kind: str, says: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for is_faulty in (False, True):
        if is_faulty:
            monkeypatch.setattr(fuzz, "FrameDecoder", lambda: Faulty(fault))
        one = fuzz.Fuzz()
        one.serial(kind, "host", random.Random(7), 2_000)
        assert any(says in failure for failure in fuzz.failures(one)) == is_faulty


@pytest.mark.parametrize("kind", fuzz.PAYLOAD_DAMAGE)
@pytest.mark.parametrize("carrier", ["serial", "can"])
def test_a_codec_that_checks_nothing_is_found_out(carrier: str, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fuzz, "decode", lambda function, payload: (function, payload))
    one = fuzz.Fuzz()
    getattr(one, carrier)(kind, "device", random.Random(7), 1_000)
    assert f"{kind}: 1000 false_accepts" in fuzz.failures(one)[0]


def test_both_languages_are_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fuzz, "accepted", lambda payloads: [None for _ in payloads])
    assert any("Python and C differ" in failure for failure in fuzz.run(1_000, 1)["failures"])


@pytest.mark.parametrize("receiver", fuzz.HEARD_BY)
def test_traffic_is_valid_and_damage_damages(receiver: str) -> None:
    draw = random.Random(3)
    for _ in range(300):
        function, payload = fuzz.drawn(draw, receiver)
        assert encode(decoded(function, payload)) == payload
        frame = encode_frame(function, 1, payload)
        assert all(fuzz.damaged(kind, draw, frame, frame + b"\1") != frame for kind in list(fuzz.WIRE_DAMAGE)[:3])


# -- in real time --------------------------------------------------------------------------------------------------

KIND = stalls.Stop("daemon", 40.0, (), 0, 0)
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
        # on the edge of the device's timeout either may happen, but it has to be safe
        (LONG._replace(took_ms=50.0), 1.0, 70.0, "gap 70.0 mm, not open"),
    ],
)
def test_a_stop_is_judged_by_what_it_really_was(stop: stalls.Stop, worst_N: float, gap_mm: float, says: str) -> None:
    assert says in stop.failure(worst_N, gap_mm)
    assert bool(says) == bool(stop.failure(worst_N, gap_mm))


def test_what_grows_or_is_missing_is_named() -> None:
    # of a long run the first two minutes do not count
    runs = ([1, 90, 100, 101, 102, 110, 104, 103], [*range(240), *(2_000 * [240]), 245])
    assert [soak.growth(run) for run in runs] == [10, 5]
    assert [soak.staying([3, 9, 5, 7, 6, 5, *last]) for last in ([9, 5], [7, 6])] == [0, 1]
    assert soak.failures({"daemon": 9}, {"daemon": 0}, [4, 5, 6]) == []
    said = soak.failures({"daemon": 5_000}, {"daemon": 1}, [4, 6])
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
    """Otherwise one that is taken would be no failure of the daemon's."""
    draw, inbox = random.Random(1), SetpointInbox()
    for _ in range(3_000):
        parts = siege.hostile(draw, siege.SETPOINT, siege.NO_SETPOINT)
        assert len(parts) > 1 or not inbox.take(parts[0], 0.0, siege.SETPOINT["stamp_ns"])
        parts = siege.hostile(draw, siege.REQUEST, siege.NO_REQUEST)
        with contextlib.suppress(MessageError):
            assert len(parts) > 1 or decode(parts[0], Request).command not in COMMANDS
    assert inbox.accepted == inbox.dropped == 0
