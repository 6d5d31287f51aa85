"""The device on its carriers: bytes of a serial line, frames of a bus, each as late as the carrier makes it."""

import math
import random

import pytest

from firmware_protocol.codec import (
    FUNCTION,
    PROTOCOL_VERSION,
    SCHEMA_HASH,
    Drive,
    DriveMode,
    Hello,
    Identity,
    Sense,
    State,
    Status,
    can_identifier,
    decode,
    encode,
    period,
)
from firmware_protocol.framing import FrameDecoder, encode_frame
from tormagd.simulation.can_device import DEVICE, MAX_WAITING, CanDevice, CanFrame, Delivery
from tormagd.simulation.device import MessageDevice, Packet, VirtualDevice
from tormagd.simulation.hand import SteadyHand
from tormagd.simulation.parameters import changed, load_plant

SAMPLE_1 = load_plant("sample_1")
HELLO = encode_frame(FUNCTION[Hello], 0, encode(Hello(SCHEMA_HASH, PROTOCOL_VERSION, 1)))
IDENTITY_BYTES = 1 + 2 + 8 + 2 + 1  # COBS, header, payload, CRC, delimiter


def a_device(baud: int = 1_000_000, seed: int = 0, ppm: float = 0.0, jitter_us: float = 0.0) -> VirtualDevice:
    plant = changed(SAMPLE_1, "firmware", clock_ppm=ppm, reply_jitter_us=jitter_us)
    return VirtualDevice(plant, SteadyHand(), seed=seed, baud=baud)


@pytest.mark.parametrize("baud", [9600, 115_200, 1_000_000])
def test_bytes_take_ten_bits_each_in_both_directions(baud: int) -> None:
    device, byte_s = a_device(baud), 10.0 / baud
    device.receive(0.001, HELLO)
    leave_s = [0.001 + (len(HELLO) + count) * byte_s for count in range(1, IDENTITY_BYTES + 1)]
    seen = [device.transmit(leaves_s + later_s) for leaves_s in leave_s for later_s in (-0.01 * byte_s, 1e-9)]
    assert [len(data) for data in seen] == [0, 1] * IDENTITY_BYTES
    (frame,) = FrameDecoder().feed(b"".join(seen))
    assert isinstance(decode(frame.function, frame.payload), Identity)


def answered(device: MessageDevice, time_s: float, counter: int) -> Packet:
    device.receive(time_s, FUNCTION[Drive], encode(Drive(0.0, 0.0, DriveMode.OFF, counter)))
    device.advance(time_s + 9e-4)
    answer = next(packet for packet in device.outbox if packet.function == FUNCTION[State])
    device.outbox.clear()
    return answer


def test_replies_are_delayed_by_the_stated_jitter() -> None:
    device = MessageDevice(SAMPLE_1, SteadyHand(), seed=5)
    delays_us = [(answered(device, n * 1e-3, n % 256).time_s - n * 1e-3) * 1e6 for n in range(1, 501)]
    assert 0.0 <= min(delays_us) <= max(delays_us) <= 50.0 + 1e-6
    assert sum(delays_us) / len(delays_us) == pytest.approx(25.0, abs=3.0)


@pytest.mark.parametrize("ppm", [-1000.0, 30.0, 1000.0])
def test_the_device_clock_runs_off_by_its_ppm_and_wraps(ppm: float) -> None:
    device = a_device(ppm=ppm, jitter_us=50.0).messages
    span_s = period(State, "device_time_s")
    seen_s = 0.0
    for n in range(1, 40):
        packet = answered(device, n * 0.05, n)
        seen_s += (decode(packet.function, packet.payload).device_time_s - seen_s) % span_s
    assert seen_s > 2.0 * span_s
    assert seen_s == pytest.approx(packet.time_s * (1.0 + ppm * 1e-6), abs=2e-5)


def test_status_comes_on_the_devices_own_clock() -> None:
    device = a_device(ppm=1000.0)
    device.advance(20.0)
    assert len(FrameDecoder().feed(device.transmit(20.0))) == math.floor(20.0 * 1.001 / 0.02)


def test_handle_and_force_are_those_of_the_plant_in_sensor_steps() -> None:
    device = a_device()
    device.receive(13.0, encode_frame(2, 0, encode(Drive(0.0, 0.0, DriveMode.OFF, 1))))
    frames = FrameDecoder().feed(device.transmit(13.01))
    sense = next(message for f in frames if isinstance(message := decode(f.function, f.payload), Sense))
    span_mm = period(Sense, "handle_position_mm")
    turned_mm = 13.0 * SteadyHand().rpm / 60.0 * math.tau * 20.0
    assert turned_mm > span_mm
    assert (sense.handle_position_mm, sense.force_N) == pytest.approx(
        (turned_mm % span_mm, device.messages.truth.force_N), abs=0.05
    )


def test_a_flood_is_bounded_and_the_device_recovers() -> None:
    device = a_device()
    noise = random.Random(1)
    for _ in range(20):
        device.receive(0.0, noise.randbytes(100_000))
    assert device.decoder.statistics.bytes <= 65_536
    device.receive(1.0, b"\x00" + HELLO)
    assert any(frame.function == FUNCTION[Identity] for frame in FrameDecoder().feed(device.transmit(1.1)))


def a_conversation(device: VirtualDevice, cuts_per_ms: int = 1) -> bytes:
    out = b""
    for millisecond in range(400):
        device.receive(
            millisecond * 1e-3,
            encode_frame(2, millisecond % 256, encode(Drive(0.0, 0.0, DriveMode.OFF, millisecond % 256))),
        )
        for cut in range(1, cuts_per_ms + 1):
            out += device.transmit((millisecond + cut / cuts_per_ms) * 1e-3)
    return out


def test_the_same_seed_gives_the_same_bytes_however_time_is_cut_and_another_seed_does_not() -> None:
    once = a_conversation(a_device(seed=1, jitter_us=50.0))
    assert a_conversation(a_device(seed=1, jitter_us=50.0)) == once
    assert a_conversation(a_device(seed=1, jitter_us=50.0), cuts_per_ms=7) == once
    assert a_conversation(a_device(seed=2, jitter_us=50.0)) != once


def test_time_that_falls_is_refused() -> None:
    line, bus = a_device(), CanDevice(MessageDevice(SAMPLE_1, SteadyHand()))
    for device in (line, bus):
        device.advance(1.0)
        for attempt in (device.advance, device.transmit):
            for now_s in (0.5, math.nan, math.inf):
                with pytest.raises(ValueError, match=r"now_s = .*: allowed is from"):
                    attempt(now_s)
    with pytest.raises(ValueError, match="allowed is from"):
        line.receive(0.5, b"")


def test_next_event_is_never_behind_and_always_comes() -> None:
    device, events_s = a_device(), [0.0]
    device.receive(0.0, HELLO)
    while events_s[-1] < 0.1:
        events_s.append(device.next_event_s)
        device.transmit(events_s[-1])
    assert events_s == sorted(events_s)
    assert 100 <= len(events_s) < 300


# -- frames of a bus ------------------------------------------------------------------------------------------------


def a_bus(bitrate: int = 1_000_000) -> CanDevice:
    return CanDevice(MessageDevice(SAMPLE_1, SteadyHand(), seed=1), bitrate)


HELLO_FRAME = CanFrame(can_identifier(FUNCTION[Hello]), encode(Hello(SCHEMA_HASH, PROTOCOL_VERSION, 1)))
IDENTITY = can_identifier(FUNCTION[Identity])
STATUS = can_identifier(FUNCTION[Status])


@pytest.mark.parametrize("bitrate", [1_000_000, 500_000, 125_000])
def test_a_frame_takes_its_bits_and_is_answered(bitrate: int) -> None:
    device = a_bus(bitrate)
    device.receive(0.0001, HELLO_FRAME)
    heard_s = 0.0001 + (47 + 8 * len(HELLO_FRAME.data)) / bitrate
    assert device.transmit(heard_s - 1e-9) == []
    hello, identity = [delivery for delivery in device.transmit(0.005) if delivery.frame.identifier != STATUS]
    assert hello == Delivery(1, HELLO_FRAME, pytest.approx(heard_s))
    assert (identity.sender, identity.frame.identifier) == (DEVICE, IDENTITY)
    assert identity.time_s >= heard_s + (47 + 8 * len(identity.frame.data)) / bitrate


def test_the_lowest_identifier_goes_first_once_the_bus_is_free() -> None:
    device = a_bus()
    frames = [CanFrame(identifier, b"12345678") for identifier in (0x700, 0x7F2, 0x012, 0x7F1, 0x012)]
    for host, frame in enumerate(frames, start=1):
        device.receive(0.0, frame, host)
    seen = [(sender, frame) for sender, frame, _ in device.transmit(0.002) if sender != DEVICE]
    # the first is on the bus before the others come; equal identifiers go in the order they came
    assert seen == [(host, frames[host - 1]) for host in (1, 3, 5, 4, 2)]


def test_what_the_controllers_cannot_hold_is_lost() -> None:
    device = a_bus(10_000)
    for _ in range(MAX_WAITING + 10):
        device.receive(0.0, CanFrame(0x7F2, bytes(8)))
    passed = [delivery for delivery in device.transmit(1.0) if delivery.sender != DEVICE]
    assert len(passed) == MAX_WAITING + 1, "one is on the bus at once"
    assert device.messages.undecodable == 0
