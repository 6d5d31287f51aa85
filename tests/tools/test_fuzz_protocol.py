"""A sample of the fuzz, and that it would notice: a fuzz that cannot fail proves nothing."""

from collections import Counter

import fuzz_protocol
import numpy as np
import pytest
from wire import receivers, traffic

from firmware_protocol import framing
from firmware_protocol.codec import DecodeError, decode, encode
from firmware_protocol.framing import encode_frame

FRAMES, CAN_FRAMES = 20_000, 4_000


def test_a_sample_holds() -> None:
    result = fuzz_protocol.run(FRAMES, CAN_FRAMES, seed=1, lives=6)
    assert result["failures"] == []
    assert result["frames"] == FRAMES
    assert result["can_frames"] == CAN_FRAMES
    assert result["clean"]["runs_of_damage"] > 1_000
    # chance had its turn: a right CRC-8 by accident, which then went into a closed loop
    assert result["false_accepts"] >= result["harm"]["one_false_accept"]["lives"] == 6


def fuzzed(kind: str, rows: int = 2_000, direction: traffic.Direction = traffic.TO_HOST) -> fuzz_protocol.Fuzz:
    """One kind of damage against Python's decoder alone."""
    fuzz = fuzz_protocol.Fuzz(None)
    rng = np.random.default_rng(7)
    if kind in traffic.WIRE_DAMAGE:
        fuzz.wire(kind, direction, rng, rows)
    else:
        fuzz.payload(kind, direction, rng, rows)
    return fuzz


@pytest.mark.parametrize("direction", [traffic.TO_HOST, traffic.TO_DEVICE], ids=lambda d: d.receiver)
def test_its_traffic_is_what_codec_and_framing_write(direction: traffic.Direction) -> None:
    rng = np.random.default_rng(3)
    messages = traffic.draw(rng, direction.messages, 3_000)
    sequence = np.arange(3_000).astype(np.uint8)
    sealed = traffic.cut_up(traffic.seal(traffic.bodies(messages, sequence)))
    payloads = traffic.cut_up(messages.payload)
    for function, payload, number, frame in zip(messages.function.tolist(), payloads, sequence, sealed, strict=True):
        assert encode(decode(function, payload)) == payload
        assert encode_frame(function, int(number), payload) == frame


@pytest.mark.parametrize("kind", traffic.WIRE_DAMAGE)
def test_every_damage_damages(kind: str) -> None:
    rng = np.random.default_rng(4)
    messages = traffic.draw(rng, traffic.TO_HOST.messages, 1_000)
    whole = traffic.seal(traffic.bodies(messages, np.zeros(1_000, dtype=np.uint8)))
    damaged = traffic.WIRE_DAMAGE[kind](rng, whole)
    same = [a == b for a, b in zip(traffic.cut_up(whole), traffic.cut_up(damaged), strict=True)]
    assert sum(same) < 20


@pytest.mark.parametrize("kind", traffic.PAYLOAD_DAMAGE)
def test_a_codec_that_checks_nothing_is_found_out(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(receivers, "decode", lambda function, payload: (function, payload))
    (tally,) = fuzzed(kind).tallies.values()
    assert tally.false_accepts > tally.allowed


@pytest.mark.interpreted
def test_a_decoder_without_its_crc_is_found_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(framing, "crc_hqx", lambda data, initial: framing.CRC_RESIDUE)
    (tally,) = fuzzed("bytes overwritten").tallies.values()
    assert tally.false_accepts > tally.allowed
    assert tally.wrong_frames > tally.wrong_frames_allowed


@pytest.mark.interpreted
@pytest.mark.parametrize("direction", [traffic.TO_HOST, traffic.TO_DEVICE], ids=lambda d: d.receiver)
def test_a_crc_without_a_final_xor_is_found_out(direction: traffic.Direction, monkeypatch: pytest.MonkeyPatch) -> None:
    kind = "a zero more or less at the end"
    (tally,) = fuzzed(kind, direction=direction).tallies.values()
    assert (tally.judged, tally.wrong_frames, tally.false_accepts) == (2_000, 0, 0)
    monkeypatch.setattr(traffic, "CRC_FINAL_XOR", 0)
    monkeypatch.setattr(framing, "CRC_FINAL_XOR", 0)
    monkeypatch.setattr(framing, "CRC_RESIDUE", 0)
    (tally,) = fuzzed(kind, direction=direction).tallies.values()
    assert tally.wrong_frames > tally.wrong_frames_allowed


@pytest.mark.interpreted
def test_a_decoder_that_gives_repetitions_is_found_out(monkeypatch: pytest.MonkeyPatch) -> None:
    accept = framing.FrameDecoder._accept

    def forgetful(decoder: framing.FrameDecoder, encoded: bytes) -> framing.Frame | None:
        decoder._last = None
        return accept(decoder, encoded)

    monkeypatch.setattr(framing.FrameDecoder, "_accept", forgetful)
    (tally,) = fuzzed("frame repeated").tallies.values()
    assert tally.false_accepts > tally.allowed


@pytest.mark.interpreted
def test_a_decoder_that_resynchronises_late_is_found_out(monkeypatch: pytest.MonkeyPatch) -> None:
    accept = framing.FrameDecoder._accept
    grudges: Counter[framing.FrameDecoder] = Counter()

    def slow(decoder: framing.FrameDecoder, encoded: bytes) -> framing.Frame | None:
        frame = accept(decoder, encoded)
        if frame is None:
            grudges[decoder] = 2
        elif grudges[decoder] > 0:
            grudges[decoder] -= 1
            return None
        return frame

    monkeypatch.setattr(framing.FrameDecoder, "_accept", slow)
    assert fuzzed("noise").lost_second > 100


@pytest.mark.interpreted
def test_a_decoder_without_a_bound_is_found_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(framing, "MAX_ENCODED", 100_000)
    monkeypatch.setattr(fuzz_protocol, "ENDLESS_PIECES", 2)
    assert fuzz_protocol.retained_bytes() > fuzz_protocol.RETAINED_ALLOWED_BYTES


def test_an_escaping_exception_names_its_seed(monkeypatch: pytest.MonkeyPatch) -> None:
    def careless(function: int, payload: bytes) -> None:
        if len(payload) == 3:
            raise IndexError("out of bounds")
        raise DecodeError

    monkeypatch.setattr(receivers, "decode", careless)
    with pytest.raises(IndexError) as caught:
        fuzz_protocol.run(FRAMES, 0, seed=9, lives=0)
    assert any("--seed 9" in note for note in caught.value.__notes__)


@pytest.mark.parametrize("carrier", ["serial", "CAN"])
@pytest.mark.parametrize("direction", [traffic.TO_HOST, traffic.TO_DEVICE], ids=lambda d: d.receiver)
def test_a_repeated_counter_is_no_news(carrier: str, direction: traffic.Direction) -> None:
    fuzz = fuzz_protocol.Fuzz(None)
    fuzz.counters(carrier, direction, np.random.default_rng(5), 500)
    (tally,) = fuzz.tallies.values()
    assert (tally.frames, tally.false_accepts, fuzz.missed_news) == (500, 0, 0)


def test_a_stuck_sender_taken_for_alive_is_found_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fuzz_protocol, "measured", lambda messages: (message is not None for message in messages))
    fuzz = fuzz_protocol.Fuzz(None)
    fuzz.counters("serial", traffic.TO_HOST, np.random.default_rng(5), 500)
    (tally,) = fuzz.tallies.values()
    assert tally.false_accepts == 500
