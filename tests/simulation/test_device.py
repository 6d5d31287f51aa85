"""The device as a serial line: pacing, clocks, garbage, determinism."""

import math
import random
from itertools import pairwise

import msgspec
import pytest

from firmware_protocol.codec import (
    FUNCTION,
    PROTOCOL_VERSION,
    SCHEMA_HASH,
    Clear,
    Drive,
    DriveMode,
    Hello,
    Home,
    Identity,
    Message,
    Sense,
    State,
    Status,
    Switches,
    decode,
    encode,
    period,
)
from firmware_protocol.framing import FrameDecoder, encode_frame
from tormagd.simulation.device import MessageDevice, Packet, VirtualDevice
from tormagd.simulation.faults import KNOWN, SIZED, parse_fault
from tormagd.simulation.hand import SteadyHand
from tormagd.simulation.parameters import load_plant

SAMPLE_1 = load_plant("sample_1")
HELLO = encode_frame(FUNCTION[Hello], 0, encode(Hello(SCHEMA_HASH, PROTOCOL_VERSION, 1)))
IDENTITY_BYTES = 1 + 2 + 8 + 2 + 1  # COBS, header, payload, CRC, delimiter


def a_device(baud: int = 1_000_000, seed: int = 0, ppm: float = 0.0, jitter_us: float = 0.0) -> VirtualDevice:
    timing = msgspec.structs.replace(SAMPLE_1.firmware, clock_ppm=ppm, reply_jitter_us=jitter_us)
    return VirtualDevice(msgspec.structs.replace(SAMPLE_1, firmware=timing), SteadyHand(), seed=seed, baud=baud)


@pytest.mark.parametrize("baud", [9600, 115_200, 1_000_000])
def test_bytes_take_ten_bits_each_in_both_directions(baud: int) -> None:
    device = a_device(baud)
    byte_s = 10.0 / baud
    arrived_s = len(HELLO) * byte_s
    start_s = 0.001
    device.receive(start_s, HELLO)
    out = b""
    for count in range(1, IDENTITY_BYTES + 1):
        leaves_s = start_s + arrived_s + count * byte_s
        assert device.transmit(leaves_s - 0.01 * byte_s) == b""
        byte = device.transmit(leaves_s + 1e-9)
        assert len(byte) == 1
        out += byte
        if leaves_s > 0.018:  # before the first Status of the device gets in line
            return
    (frame,) = FrameDecoder().feed(out)
    assert isinstance(decode(frame.function, frame.payload), Identity)


def test_a_written_burst_arrives_one_byte_after_the_other() -> None:
    device = a_device(baud=115_200)
    frames = b"".join(encode_frame(2, n, encode(Drive(0.0, 0.0, DriveMode.OFF, n))) for n in range(1, 6))
    device.receive(0.0, frames)
    duration_s = len(frames) * 10 / 115_200
    decoder = FrameDecoder()
    received = decoder.feed(device.transmit(duration_s / 2.0))
    assert len(received) < 6
    received += decoder.feed(device.transmit(1.0))
    states = [decode(f.function, f.payload) for f in received if f.function == FUNCTION[State]]
    assert len(states) == 5
    gaps_s = [after.device_time_s - before.device_time_s for before, after in pairwise(states)]
    assert gaps_s == pytest.approx([len(frames) / 5 * 10 / 115_200] * 4, abs=2e-5)


def test_replies_are_delayed_by_the_stated_jitter() -> None:
    device = MessageDevice(SAMPLE_1, SteadyHand(), seed=5)
    delays_us = []
    for n in range(1, 501):
        device.receive(n * 1e-3, FUNCTION[Drive], encode(Drive(0.0, 0.0, DriveMode.OFF, n % 256)))
        device.advance(n * 1e-3 + 9e-4)
        answer = next(packet for packet in device.outbox if packet.function == FUNCTION[State])
        delays_us.append((answer.time_s - n * 1e-3) * 1e6)
        device.outbox.clear()
    assert min(delays_us) >= 0.0
    assert max(delays_us) <= 50.0 + 1e-6
    assert sum(delays_us) / len(delays_us) == pytest.approx(25.0, abs=3.0)


@pytest.mark.parametrize("ppm", [-1000.0, 30.0, 1000.0])
def test_the_device_clock_runs_off_by_its_ppm_and_wraps(ppm: float) -> None:
    device = MessageDevice(
        msgspec.structs.replace(SAMPLE_1, firmware=msgspec.structs.replace(SAMPLE_1.firmware, clock_ppm=ppm)),
        SteadyHand(),
    )
    span_s = period(State, "device_time_s")
    seen_s = 0.0
    sent_s = 0.0
    for n in range(1, 40):
        device.receive(n * 0.05, FUNCTION[Drive], encode(Drive(0.0, 0.0, DriveMode.OFF, n)))
        device.advance(n * 0.05 + 0.01)
        packet = next(packet for packet in device.outbox if packet.function == FUNCTION[State])
        device.outbox.clear()
        state = decode(packet.function, packet.payload)
        seen_s += (state.device_time_s - seen_s) % span_s
        sent_s = packet.time_s
    assert seen_s > 2.0 * span_s
    assert seen_s == pytest.approx(sent_s * (1.0 + ppm * 1e-6), abs=2e-5)


def test_status_comes_on_the_devices_own_clock() -> None:
    device = a_device(ppm=1000.0)
    device.advance(20.0)
    frames = FrameDecoder().feed(device.transmit(20.0))
    assert len(frames) == math.floor(20.0 * 1.001 / 0.02)


def test_handle_and_force_are_those_of_the_plant_in_sensor_steps() -> None:
    device = a_device()
    device.receive(13.0, encode_frame(2, 0, encode(Drive(0.0, 0.0, DriveMode.OFF, 1))))
    frames = FrameDecoder().feed(device.transmit(13.01))
    sense = next(message for f in frames if isinstance(message := decode(f.function, f.payload), Sense))
    span_mm = period(Sense, "handle_position_mm")
    turned_mm = 13.0 * SteadyHand().rpm / 60.0 * math.tau * 20.0
    assert turned_mm > span_mm
    assert sense.handle_position_mm == pytest.approx(turned_mm % span_mm, abs=0.05)
    assert sense.force_N == pytest.approx(device.truth.force_N, abs=0.05)


def test_corrupt_and_foreign_payloads_are_counted_and_dropped() -> None:
    device = MessageDevice(SAMPLE_1, SteadyHand())
    drive = bytearray(encode(Drive(0.5, 0.5, DriveMode.RUN, 1)))
    drive[0] ^= 1
    device.receive(0.001, FUNCTION[Drive], bytes(drive))
    device.receive(0.001, 99, b"\x00")
    device.receive(0.001, FUNCTION[Drive], b"")
    device.receive(0.001, FUNCTION[State], encode(State(0.0, 0.0, 0.0, 0)))
    device.advance(0.01)
    assert device.undecodable == 3
    assert not device.outbox


def test_a_flood_is_bounded_and_the_device_recovers() -> None:
    device = a_device()
    noise = random.Random(1)
    for _ in range(20):
        device.receive(0.0, noise.randbytes(100_000))
    assert device.statistics.bytes <= 65_536
    device.receive(1.0, b"\x00" + HELLO)
    frames = FrameDecoder().feed(device.transmit(1.1))
    assert any(frame.function == FUNCTION[Identity] for frame in frames)


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
    device = a_device()
    device.advance(1.0)
    for attempt in (device.advance, device.transmit, lambda now_s: device.receive(now_s, b"")):
        for now_s in (0.5, math.nan, math.inf):
            with pytest.raises(ValueError, match="allowed is from"):
                attempt(now_s)


def test_next_event_is_never_behind_and_always_comes() -> None:
    device = a_device()
    device.receive(0.0, HELLO)
    now_s = 0.0
    events = 0
    while now_s < 0.1:
        due_s = device.next_event_s
        assert due_s >= now_s
        now_s = max(due_s, now_s)
        device.transmit(now_s)
        events += 1
    assert 100 <= events < 300


def test_a_device_that_is_mended_homes_as_a_healthy_one() -> None:
    """After all faults that last have struck it at rest; what they made it latch, it clears."""
    passing = ("frozen", "reset", "encoder_jump", "encoder_jump_left")
    lasting = [f"{name}=+20%" if name in SIZED else name for name in KNOWN if name not in passing]
    mended = MessageDevice(SAMPLE_1, SteadyHand(), [parse_fault(f"{fault}@0.1") for fault in lasting])
    healthy = MessageDevice(SAMPLE_1, SteadyHand())
    for device in (mended, healthy):
        device.advance(0.2)
    assert mended.firmware.faults
    mended.mend()
    for device in (mended, healthy):
        for message in (Hello(SCHEMA_HASH, PROTOCOL_VERSION, 1), Clear(2), Home(3), Drive(0.0, 0.0, DriveMode.OFF, 1)):
            device.receive(0.2, FUNCTION[type(message)], encode(message))
        device.outbox.clear()
        device.advance(6.0)
        device.receive(6.0, FUNCTION[Drive], encode(Drive(0.0, 0.0, DriveMode.OFF, 2)))
        device.advance(6.1)
    last, usual = ({type(it): it for it in map(_decoded, device.outbox)} for device in (mended, healthy))
    assert set(last) == set(usual) == {Identity, State, Sense, Status}
    assert last[Status] == usual[Status]
    assert Switches.HOMED in last[Status].switches
    assert last[State].left_position_mm == pytest.approx(usual[State].left_position_mm, abs=0.01)
    assert last[Sense].handle_position_mm == usual[Sense].handle_position_mm


def _decoded(packet: Packet) -> Message:
    return decode(packet.function, packet.payload)
