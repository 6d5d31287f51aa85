"""Frames over streams that are whole, cut, damaged, repeated and endless."""

import contextlib
import pickle
from itertools import pairwise

import pytest
from cobs import cobs  # type: ignore[import-untyped]
from hypothesis import assume, given, strategies as st

from firmware_protocol.codec import EncodeError
from firmware_protocol.framing import (
    MAX_ENCODED,
    Frame,
    FrameDecoder,
    cobs_decode,
    cobs_encode,
    encode_frame,
)
from firmware_protocol.golden import bitwise_crc16

byte = st.integers(0, 255)
frames = st.builds(Frame, byte, byte, st.binary(max_size=8))


def wire(frame: Frame) -> bytes:
    return encode_frame(frame.function, frame.sequence, frame.payload)


def numbered(count: int, start: int = 0) -> list[Frame]:
    return [Frame(3, (start + index) % 256, bytes((index % 256, 0, 255))) for index in range(count)]


@given(st.binary(max_size=253))
def test_cobs_is_the_cobs_of_the_reference(data: bytes) -> None:
    encoded = cobs_encode(data)
    assert (encoded, cobs_decode(encoded)) == (cobs.encode(data), data)


@given(st.binary(min_size=1, max_size=20).map(lambda data: data.replace(b"\0", b"\1")))
def test_cobs_refuses_what_the_reference_refuses(data: bytes) -> None:
    expected = None
    with contextlib.suppress(cobs.DecodeError):
        expected = cobs.decode(data)
    assert cobs_decode(data) == expected


def test_crc_is_genibus_in_big_endian() -> None:
    assert bitwise_crc16(b"123456789") == 0xD64E
    assert cobs.decode(encode_frame(0x31, 0x32, b"3456789")[:-1]) == b"123456789\xd6\x4e"


@given(frames)
def test_a_frame_comes_back(frame: Frame) -> None:
    encoded = wire(frame)
    assert encoded.index(0) == len(encoded) - 1
    assert len(encoded) == len(frame.payload) + 6 <= MAX_ENCODED + 1
    assert FrameDecoder().feed(encoded) == [frame]


@pytest.mark.parametrize(
    ("function", "sequence", "length"), [(256, 0, 0), (-1, 0, 0), (1, 256, 0), (1, -1, 0), (1, 0, 9)]
)
def test_what_does_not_fit_a_frame_is_refused(function: int, sequence: int, length: int) -> None:
    with pytest.raises(EncodeError, match=f"function {function}, sequence {sequence}, {length} bytes"):
        encode_frame(function, sequence, bytes(length))


@given(st.lists(frames.map(wire) | st.binary(max_size=40), max_size=12), st.data())
def test_how_a_stream_is_cut_makes_no_difference(pieces: list[bytes], data: st.DataObject) -> None:
    stream = b"".join(pieces)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=20)))
    whole, cut = FrameDecoder(), FrameDecoder()
    expected = whole.feed(stream)
    assert [frame for a, b in pairwise([0, *cuts, len(stream)]) for frame in cut.feed(stream[a:b])] == expected
    assert cut.statistics == whole.statistics


@given(st.binary(max_size=400))
def test_garbage_costs_at_most_one_frame_and_none_where_a_delimiter_ends_it(garbage: bytes) -> None:
    sent = numbered(3)
    stream = b"".join(map(wire, sent))
    assert FrameDecoder().feed(garbage + stream)[-2:] == sent[1:]
    assert FrameDecoder().feed(garbage + b"\0" + stream)[-3:] == sent


@given(frames, st.data())
def test_a_flipped_bit_in_a_frame_is_found(frame: Frame, data: st.DataObject) -> None:
    encoded = bytearray(wire(frame))
    position = data.draw(st.integers(0, len(encoded) - 2))
    encoded[position] ^= 1 << data.draw(st.integers(0, 7))
    assume(encoded[position] != 0)  # a zero cuts the frame in two, which is another test
    decoder = FrameDecoder()
    assert (decoder.feed(bytes(encoded)), decoder.statistics.corrupt) == ([], 1)


@pytest.mark.parametrize("piece", [b"\xff" * 65536, b"\x01" * 65536, bytes(65536), bytes(range(256)) * 256])
def test_memory_is_bounded_whatever_arrives(piece: bytes) -> None:
    decoder = FrameDecoder()
    for _ in range(20):
        assert decoder.feed(piece) == []
        assert len(pickle.dumps(decoder)) < 1000
    assert decoder.feed(b"\0" + wire(Frame(1, 2, b"x"))) == [Frame(1, 2, b"x")]


@pytest.mark.parametrize("excess", [0, 1, 2, 100])
def test_the_longest_frame_passes_and_a_longer_stretch_does_not(excess: int) -> None:
    body = bytes((1, 2)) + bytes(8 + excess)
    encoded = cobs.encode(body + bitwise_crc16(body).to_bytes(2, "big")) + b"\0"
    for size in (1, 5, 200):
        decoder = FrameDecoder()
        assert [f for i in range(0, len(encoded), size) for f in decoder.feed(encoded[i : i + size])] == (
            [Frame(1, 2, bytes(8))] if excess == 0 else []
        )
        assert decoder.statistics.corrupt == (excess > 0)


# -- what is overtaken is not lost ---------------------------------------------------------------------------------


@pytest.mark.parametrize("start", [0, 100, 250])
@pytest.mark.parametrize(
    ("order", "lost"),
    [
        *([(0, missing + 1), missing] for missing in (1, 7, 239)),  # with more, the next would look overtaken
        *([(*range(10), *range(11, 11 + late), 10, *range(11 + late, 40)), 0] for late in (1, 2, 7, 15)),
        # a second gap does not forget the first, and a late repetition fills none
        ((0, 2, 4, 1, 3, 0, 6), 1),
    ],
)
def test_gaps_are_counted_through_zero_and_what_comes_late_is_not_lost(
    start: int, order: tuple[int, ...], lost: int
) -> None:
    sent, decoder = numbered(max(order) + 1, start), FrameDecoder()
    assert decoder.feed(b"".join(wire(sent[number]) for number in order)) == [sent[number] for number in order]
    assert (decoder.statistics.lost, decoder.statistics.repeated) == (lost, 0)


@pytest.mark.parametrize(
    ("damaged", "why"),
    [
        (wire(numbered(1)[0])[:-3] + b"\x11\x22\x00", "CRC-16"),
        (b"\x01" * 40 + b"\x00", "over 13 bytes"),
        (b"\x09\x01\x00", "COBS"),
        (b"\x02\x07\x00", "too short"),
    ],
)
def test_why_a_frame_was_refused(damaged: bytes, why: str) -> None:
    decoder = FrameDecoder()
    assert (decoder.feed(damaged), decoder.statistics.refused) == ([], {"frame": why})
