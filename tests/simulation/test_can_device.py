"""The simulated bus: bits, arbitration, and what they leave room for."""

import random
from collections.abc import Callable

import pytest

from firmware_protocol.codec import (
    FUNCTION,
    PROTOCOL_VERSION,
    SCHEMA_HASH,
    Drive,
    DriveMode,
    Hello,
    Identity,
    Message,
    Sense,
    State,
    Status,
    can_identifier,
    encode,
)
from tormagd.simulation.can_device import DEVICE, MAX_WAITING, CanDevice, Delivery
from tormagd.simulation.can_frame import (
    ERROR_FLAG,
    SOCKET_FRAME,
    CanFrame,
    frame_bits,
    from_socket,
    to_socket,
)
from tormagd.simulation.device import MessageDevice
from tormagd.simulation.hand import SteadyHand
from tormagd.simulation.parameters import PlantParameters


def bits_by_hand(frame: CanFrame) -> int:
    """ISO 11898-1, bit by bit: an oracle without tables."""
    sent = "0" + f"{frame.identifier:011b}" + "000" + f"{len(frame.data):04b}" + "".join(f"{b:08b}" for b in frame.data)
    crc = 0
    for bit in sent:
        crc = (crc << 1) ^ (0x4599 if (crc >> 14 & 1) ^ int(bit) else 0)
        crc &= 0x7FFF
    stuffed = ""
    for bit in sent + f"{crc:015b}":
        stuffed += bit
        if stuffed[-5:] in ("00000", "11111"):
            stuffed += "1" if bit == "0" else "0"
    return len(stuffed) + 13


def test_bits_are_those_of_the_standard() -> None:
    noise = random.Random(1)
    frames = [CanFrame(noise.randrange(0x800), noise.randbytes(noise.randrange(9))) for _ in range(2_000)]
    frames += [CanFrame(0, bytes(n)) for n in range(9)] + [CanFrame(0x7FF, b"\xff" * n) for n in range(9)]
    frames += [CanFrame(0x041, bytes([b]) * 8) for b in (0x0F, 0xF0, 0x78, 0x87, 0x1E)]
    for frame in frames:
        assert frame_bits(frame) == bits_by_hand(frame), frame


def test_a_frame_survives_the_socket_and_what_is_none_is_refused() -> None:
    for frame in (CanFrame(0x7FF, b""), CanFrame(0x021, b"1234567"), CanFrame(ERROR_FLAG | 0x40, bytes(8))):
        assert from_socket(to_socket(frame)) == frame
    for packet in (b"", bytes(15), bytes(17), SOCKET_FRAME.pack(0x21, 9, bytes(8)), SOCKET_FRAME.pack(0x800, 0, b"")):
        assert from_socket(packet) is None


# -- the bus -------------------------------------------------------------------------------------------------------


@pytest.fixture
def make(sample_1: PlantParameters) -> Callable[..., CanDevice]:
    def build(bitrate: int = 1_000_000, node: int = 1) -> CanDevice:
        return CanDevice(MessageDevice(sample_1, SteadyHand(), seed=1), bitrate, node)

    return build


def frame_of(message: Message, node: int = 1) -> CanFrame:
    return CanFrame(can_identifier(FUNCTION[type(message)], node), encode(message))


HELLO = frame_of(Hello(SCHEMA_HASH, PROTOCOL_VERSION, 1))
IDENTITY = can_identifier(FUNCTION[Identity])
STATUS = can_identifier(FUNCTION[Status])


def run(device: CanDevice, from_s: float, until_s: float, step_s: float = 1e-5) -> list[tuple[float, Delivery]]:
    """What goes by, and when it had."""
    seen = []
    for tick in range(1, round((until_s - from_s) / step_s) + 1):
        now_s = from_s + tick * step_s
        seen += [(now_s, delivery) for delivery in device.transmit(now_s)]
    return seen


@pytest.mark.parametrize("bitrate", [1_000_000, 500_000, 125_000])
def test_a_frame_takes_its_bits_and_is_answered(make: Callable[..., CanDevice], bitrate: int) -> None:
    device = make(bitrate)
    device.receive(0.0001, HELLO)
    seen = run(device, 0.0001, 0.005)
    (heard_s, hello), (answered_s, identity) = [item for item in seen if item[1].frame.identifier != STATUS]
    assert hello == Delivery(1, HELLO)
    assert heard_s == pytest.approx(0.0001 + frame_bits(HELLO) / bitrate, abs=1.1e-5)
    assert (identity.sender, identity.frame.identifier) == (DEVICE, IDENTITY)
    assert answered_s >= heard_s + frame_bits(identity.frame) / bitrate - 1e-9


def test_the_lowest_identifier_goes_first_once_the_bus_is_free(make: Callable[..., CanDevice]) -> None:
    device = make()
    frames = [CanFrame(identifier, b"12345678") for identifier in (0x700, 0x7F2, 0x012, 0x7F1, 0x012)]
    for host, frame in enumerate(frames, start=1):
        device.receive(0.0, frame, host)
    seen = [delivery for _, delivery in run(device, 0.0, 0.002) if delivery.sender != DEVICE]
    # the first is on the bus before the others come; equal identifiers go in the order they came
    order = [frames[0], frames[2], frames[4], frames[3], frames[1]]
    assert [delivery.frame for delivery in seen] == order
    assert [delivery.sender for delivery in seen] == [1, 3, 5, 4, 2]


def test_only_its_own_node_reaches_the_device(make: Callable[..., CanDevice]) -> None:
    device = make(node=2)
    device.receive(0.0, HELLO)
    assert not any(delivery.sender == DEVICE for _, delivery in run(device, 0.0, 0.005))
    device.receive(0.005, frame_of(Hello(SCHEMA_HASH, PROTOCOL_VERSION, 1), node=2))
    answers = [delivery.frame for _, delivery in run(device, 0.005, 0.01) if delivery.sender == DEVICE]
    assert [frame.identifier for frame in answers] == [can_identifier(FUNCTION[Identity], 2)]


def test_what_the_controllers_cannot_hold_is_lost_and_counted(make: Callable[..., CanDevice]) -> None:
    device = make(10_000)
    for _ in range(MAX_WAITING + 10):
        device.receive(0.0, CanFrame(0x7F2, bytes(8)))
    assert device.lost == 9, "one is on the bus"
    run(device, 0.0, 0.5, 1e-3)
    assert device.messages.undecodable == 0


def test_time_does_not_run_backwards(make: Callable[..., CanDevice]) -> None:
    device = make()
    device.advance(0.01)
    with pytest.raises(ValueError, match="now_s"):
        device.advance(0.009)


def test_control_at_a_kilohertz_leaves_thirty_percent_of_the_bus(make: Callable[..., CanDevice]) -> None:
    device = make()
    device.receive(0.0, HELLO)
    device.transmit(0.01)
    busy_s = device.busy_s
    answers: dict[int, int] = {}
    for tick in range(500):
        now_s = 0.01 + tick * 1e-3
        device.receive(now_s, frame_of(Drive(0.1234, -0.1234, DriveMode.OFF, tick % 256)))
        for delivery in device.transmit(now_s + 0.999e-3):
            answers[delivery.frame.identifier] = answers.get(delivery.frame.identifier, 0) + 1
    assert answers[can_identifier(FUNCTION[State])] == answers[can_identifier(FUNCTION[Sense])] == 500
    assert 0.3 < (device.busy_s - busy_s) / 0.5 < 0.7
