"""Messages to CAN frames and back: identifiers, counters, and whatever a bus may carry besides."""

import pytest
from hypothesis import given, strategies as st

from firmware_protocol.codec import (
    FUNCTION,
    DeviceFault,
    DeviceMode,
    Drive,
    DriveMode,
    EncodeError,
    Hello,
    Home,
    Message,
    State,
    Status,
    Switches,
    decode,
    encode,
)
from tormagd.hardware.can_stream import UNREADABLE, CanStream, SecondHostError

STATUS = Status(DeviceMode.IDLE, Switches(0), DeviceFault(0), 23.0, 12.0, 0, 0)


def state(counter: int) -> State:
    return State(-12.0, -12.1, 0.25, counter)


def frame_of(message: Message, node: int = 1) -> tuple[int, bytes]:
    return CanStream(node).pack(message)


def test_the_frame_of_the_firmware_page() -> None:
    assert frame_of(Drive(0.125, 0.1234, DriveMode.RUN, 200)) == (0x021, bytes.fromhex("e204d20401c865"))
    assert frame_of(Home(3), node=15) == (0x06F, b"\x03")


@pytest.mark.parametrize("node", [-1, 16])
def test_a_node_that_is_none_is_refused(node: int) -> None:
    with pytest.raises(EncodeError, match="nodes 0 to 15"):
        CanStream(node)


def test_what_the_device_says_comes_through_and_is_counted() -> None:
    stream = CanStream(1)
    assert stream.unpack(*frame_of(STATUS)) == STATUS
    assert stream.unpack(*frame_of(state(7))) == decode(FUNCTION[State], encode(state(7)))
    assert (stream.statistics.frames, stream.statistics.bytes, stream.statistics.corrupt) == (2, 16, 0)


def test_other_nodes_and_other_hosts_commands_are_not_ours() -> None:
    stream = CanStream(1)
    assert stream.unpack(*frame_of(STATUS, node=2)) is None
    assert stream.unpack(*frame_of(Hello(1, 1, 1))) is None
    assert stream.unpack(*frame_of(Home(1))) is None
    assert (stream.statistics.frames, stream.statistics.corrupt) == (0, 0)


def test_a_drive_that_is_not_ours_is_another_host() -> None:
    stream = CanStream(1)
    own = stream.pack(Drive(0.5, 0.5, DriveMode.RUN, 9))
    assert stream.unpack(*own) is None, "its echo"
    with pytest.raises(SecondHostError):
        stream.unpack(*frame_of(Drive(0.5, 0.5, DriveMode.RUN, 10)))


def test_what_is_damaged_is_counted_and_the_next_good_one_found_again() -> None:
    stream = CanStream(1)
    identifier, data = frame_of(state(7))
    for damaged in (data[:-1], data[:-1] + bytes((data[-1] ^ 1,)), b""):
        assert stream.unpack(identifier, damaged) is None
    assert stream.unpack(0x7F1, b"") is None
    assert (stream.statistics.corrupt, stream.statistics.resynchronisations) == (4, 0)
    assert stream.unpack(identifier, data) is not None
    assert stream.unpack(*frame_of(STATUS)) == STATUS
    assert (stream.statistics.corrupt, stream.statistics.resynchronisations) == (4, 1)


@pytest.mark.parametrize(
    ("counters", "lost"),
    [
        ([254, 255, 0, 1], 0),
        ([3, 4, 7], 2),
        ([250, 3], 8),
        ([5, 5, 5, 6], 0),
        ([5, 7, 6, 8], 0),
        ([200, 0, 1], 55),
    ],
    ids=["over the end", "a gap", "a gap over the end", "a stuck sender", "overtaken", "a device that began anew"],
)
def test_the_states_own_counter_shows_what_is_missing(counters: list[int], lost: int) -> None:
    stream = CanStream(1)
    for counter in counters:
        assert stream.unpack(*frame_of(state(counter))) is not None
    assert (stream.statistics.lost, stream.statistics.repeated) == (lost, 0), "no news is for the link to count"


@given(frames=st.lists(st.tuples(st.integers(0, 0x7FF), st.binary(max_size=8)), max_size=50))
def test_no_frame_raises_or_is_more_than_it_is(frames: list[tuple[int, bytes]]) -> None:
    stream = CanStream(1)
    functions = set(FUNCTION.values())
    for identifier, data in frames:
        try:
            message = stream.unpack(identifier, data)
        except SecondHostError:
            assert identifier == 0x021
            continue
        if message is not None:
            assert identifier & 0xF == 1
            assert identifier >> 4 in functions
            assert len(encode(message)) == len(data)
    assert stream.statistics.frames + stream.statistics.corrupt <= len(frames)


def test_what_was_taken_apart_gives_the_same_to_another_stream() -> None:
    stream, other = CanStream(1), CanStream(1)
    frames = [
        frame_of(state(7)),
        frame_of(state(8), node=2),
        (frame_of(state(8))[0], b"?"),
        UNREADABLE,
        frame_of(STATUS),
    ]
    messages = stream.unpack_all(frames)
    assert [type(message) for message in messages] == [State, Status]
    assert stream.received == [frames[0], *frames[2:]]
    assert (other.unpack_all(stream.received), other.statistics) == (messages, stream.statistics)
    assert stream.statistics.corrupt == 2
    assert stream.pack(Home(3)) == stream.sent
