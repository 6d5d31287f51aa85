"""Messages to serial bytes and back: what is damaged is counted, what is whole arrives."""

import pytest
from hypothesis import given, strategies as st

from firmware_protocol.codec import Drive, DriveMode, EncodeError, Home, Message, Retract
from firmware_protocol.framing import encode_frame
from tormagd.hardware.frame_stream import FrameStream

messages = st.lists(
    st.one_of(
        st.builds(Home, st.integers(0, 255)),
        st.builds(Retract, st.integers(0, 255)),
        st.builds(
            Drive,
            left_duty=st.integers(-10_000, 10_000).map(lambda steps: steps * 1e-4),
            right_duty=st.just(0.5),
            mode=st.sampled_from(DriveMode),
            counter=st.integers(0, 255),
        ),
    ),
    max_size=20,
)


def is_same(ours: Message, theirs: Message) -> bool:
    return type(ours) is type(theirs) and all(
        getattr(ours, name) == pytest.approx(getattr(theirs, name)) for name in ours.__match_args__
    )


@given(sent=messages, cuts=st.lists(st.integers(1, 9), min_size=1, max_size=50))
def test_what_is_packed_comes_out_however_it_is_cut(sent: list[Message], cuts: list[int]) -> None:
    sender, receiver = FrameStream(), FrameStream()
    line = b"".join(sender.pack(message) for message in sent)
    received: list[Message] = []
    for cut in cuts:
        received += receiver.unpack(line[:cut])
        line = line[cut:]
    received += receiver.unpack(line)
    assert len(received) == len(sent)
    assert all(is_same(*pair) for pair in zip(received, sent, strict=True))
    assert (receiver.statistics.frames, receiver.statistics.corrupt, receiver.statistics.lost) == (len(sent), 0, 0)


@given(noise=st.binary(max_size=300))
def test_noise_never_raises_and_does_not_outlive_a_delimiter(noise: bytes) -> None:
    stream = FrameStream()
    stream.unpack(noise + b"\x00")
    assert stream.unpack(FrameStream().pack(Home(3))) == [Home(3)]


def test_a_whole_frame_with_an_impossible_message_is_counted() -> None:
    stream = FrameStream()
    assert stream.unpack(
        encode_frame(99, 0, b"\x01") + encode_frame(6, 1, b"\x01\x02") + encode_frame(6, 2, b"\x05")
    ) == [Home(5)]
    assert stream.statistics.corrupt == 2


def test_a_drive_with_a_wrong_check_sum_of_its_own_is_counted() -> None:
    """The frame's CRC is right: the damage happened before the frame was made."""
    stream = FrameStream()
    assert stream.unpack(encode_frame(2, 0, b"\x00\x00\x00\x00\x01\x05\x00")) == []
    assert stream.statistics.corrupt == 1


def test_a_value_that_does_not_fit_is_refused_before_it_is_sent() -> None:
    with pytest.raises(EncodeError, match="left_duty"):
        FrameStream().pack(Drive(float("nan"), 0.0, DriveMode.RUN, 0))
