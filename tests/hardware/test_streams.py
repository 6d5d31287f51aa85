"""What each stream makes of bytes and frames, good and damaged, and what an exchange takes of a bus."""

import struct
from pathlib import Path

import cantools.database.can
import pytest
from hypothesis import given, strategies as st

import firmware_protocol
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
from firmware_protocol.framing import encode_frame
from firmware_protocol.layouts import LAYOUTS
from tormagd.hardware.can_backend import EXCHANGE_BITS
from tormagd.hardware.streams import UNREADABLE, CanStream, FrameStream, SecondHostError

STATUS = Status(DeviceMode.IDLE, Switches(0), DeviceFault(0), 23.0, 12.0, 0, 0)


def test_a_whole_frame_with_an_impossible_message_is_counted() -> None:
    stream = FrameStream()
    for corrupt, frame in enumerate(
        ((99, 0, b"\x01"), (6, 1, b"\x01\x02"), (2, 2, b"\x00\x00\x00\x00\x01\x05\x00")), 1
    ):
        assert (stream.unpack(encode_frame(*frame)), stream.statistics.corrupt) == ([], corrupt)
    assert stream.statistics.refused.keys() == {"function 99", "Home", "Drive"}
    assert stream.unpack(encode_frame(6, 3, b"\x05")) == [Home(5)]


def state(counter: int) -> State:
    return State(-12.0, -12.1, 0.25, counter)


def frame_of(message: Message, node: int = 1) -> tuple[int, bytes]:
    return CanStream(node).pack(message)


@pytest.fixture
def stream() -> CanStream:
    return CanStream(1)


def test_the_frame_of_the_firmware_page() -> None:
    assert frame_of(Drive(0.125, 0.1234, DriveMode.RUN, 200)) == (0x021, bytes.fromhex("e204d20401c865"))
    assert frame_of(Home(3), node=15) == (0x06F, b"\x03")


@pytest.mark.parametrize("node", [-1, 16])
def test_a_node_that_is_none_is_refused(node: int) -> None:
    with pytest.raises(EncodeError, match="nodes 0 to 15"):
        CanStream(node)


def test_what_the_device_says_comes_through_and_other_nodes_and_hosts_commands_are_not_ours(stream: CanStream) -> None:
    others = (frame_of(STATUS, node=2), frame_of(Hello(1, 1, 1)), frame_of(Home(1)))
    assert [stream.unpack(*other) for other in others] == [None] * 3
    assert (stream.statistics.frames, stream.statistics.bytes) == (0, 7)
    assert stream.unpack(*frame_of(STATUS)) == STATUS
    assert stream.unpack(*frame_of(state(7))) == decode(FUNCTION[State], encode(state(7)))
    assert (stream.statistics.frames, stream.statistics.bytes, stream.statistics.corrupt) == (2, 23, 0)


def test_a_drive_that_is_not_ours_is_another_host(stream: CanStream) -> None:
    assert stream.unpack(*stream.pack(Drive(0.5, 0.5, DriveMode.RUN, 9))) is None, "its echo"
    with pytest.raises(SecondHostError):
        stream.unpack(*frame_of(Drive(0.5, 0.5, DriveMode.RUN, 10)))


def test_what_is_damaged_is_counted_and_the_next_good_one_found_again(stream: CanStream) -> None:
    identifier, data = frame_of(state(7))
    damaged = [(identifier, spoilt) for spoilt in (data[:-1], data[:-1] + bytes((data[-1] ^ 1,)), b"")]
    assert [stream.unpack(*frame) for frame in (*damaged, (0x7F1, b""))] == [None] * 4
    known = stream.statistics
    assert (known.corrupt, known.resynchronisations, known.refused.keys()) == (4, 0, {"State", "function 127"})
    assert [stream.unpack(identifier, data), stream.unpack(*frame_of(STATUS))] == [state(7), STATUS]
    assert (known.corrupt, known.resynchronisations) == (4, 1)


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
def test_the_states_own_counter_shows_what_is_missing(counters: list[int], lost: int, stream: CanStream) -> None:
    assert None not in [stream.unpack(*frame_of(state(counter))) for counter in counters]
    assert (stream.statistics.lost, stream.statistics.repeated) == (lost, 0), "no news is for the link to count"


@given(frames=st.lists(st.tuples(st.integers(0, 0x7FF), st.binary(max_size=8)), max_size=50))
def test_no_frame_raises_or_is_more_than_it_is(frames: list[tuple[int, bytes]]) -> None:
    stream = CanStream(1)
    for identifier, data in frames:
        try:
            message = stream.unpack(identifier, data)
        except SecondHostError:
            assert identifier == 0x021
            continue
        if message is not None:
            assert identifier & 0xF == 1
            assert identifier >> 4 in FUNCTION.values()
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


DBC = Path(firmware_protocol.__file__).parent / "tormag.dbc"
STUFFABLE_BITS, FIXED_BITS = 34, 13
"Of a classical base frame: start, identifier, control and CRC; delimiters, acknowledge, end and gap."


def max_bits(length: int) -> int:
    stuffable = STUFFABLE_BITS + 8 * length
    return stuffable + (stuffable - 1) // 4 + FIXED_BITS


def test_the_configuration_knows_what_an_exchange_takes_of_a_bus() -> None:
    database = cantools.database.can.Database()
    database.add_dbc_file(DBC)
    each_tick = {message.name for message in database.messages if message.cycle_time == 1}
    layouts = [layout for layout in LAYOUTS if layout.message.__name__ in each_tick]
    assert len(layouts) == len(each_tick) == 3
    # Davis et al., Real-Time Systems 35, 2007; as firmware_protocol/README.md says
    assert sum(max_bits(struct.calcsize(layout.format)) for layout in layouts) == EXCHANGE_BITS == 395
