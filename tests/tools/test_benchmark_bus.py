"""Load of the bus: computed from the DBC, measured on the simulated device, and 30 % left free."""

import random
import struct

import pytest
from benchmarks import bus
from benchmarks.bus import Meter, can_bits, computed, most_can_bits, schedule, serial_bits

from firmware_protocol.codec import FUNCTION, DecodeError, Drive, DriveMode, can_identifier, crc8, decode, encode
from firmware_protocol.framing import encode_frame
from firmware_protocol.layouts import LAYOUTS
from firmware_protocol.schema import Layout
from tormagd.hardware.can_backend import EXCHANGE_BITS
from tormagd.simulation.can_frame import CanFrame, frame_bits


def test_stuff_bits_of_a_frame_that_can_be_counted_by_hand() -> None:
    # 34 zeros, the CRC among them: a stuff bit after every fifth
    assert can_bits(0, b"") == 34 + 6 + 13


@pytest.mark.parametrize(("length", "most"), [(0, 55), (1, 65), (7, 125), (8, 135)])
def test_the_most_bits_are_those_of_the_literature(length: int, most: int) -> None:
    """8 n + 47 and a stuff bit for every four of the 34 + 8 n - 1 (Davis et al., Real-Time Systems 35, 2007)."""
    assert most_can_bits(length) == most


def test_no_frame_has_more_bits_than_the_most() -> None:
    generator = random.Random(6)
    seen = set()
    for _ in range(2_000):
        data = bytes(generator.choice((0x00, 0xFF, 0x0F, 0xF8, generator.randrange(256))) for _ in range(8))
        seen.add(can_bits(generator.randrange(1, 2**11), data))
    assert most_can_bits(8) >= max(seen) > min(seen) >= 34 + 64 + 13


def test_the_schedule_is_that_of_the_dbc() -> None:
    rates = {message.name: message.rate_hz for message in schedule()}
    assert (rates["Drive"], rates["State"], rates["Sense"], rates["Status"]) == (1_000.0, 1_000.0, 1_000.0, 50.0)
    assert set(rates) == {kind.__name__ for kind in FUNCTION}
    assert 0.0 < rates["Hello"] <= rates["Home"] == rates["Retract"] == rates["Clear"]
    assert {message.sender for message in schedule() if message.name in ("State", "Sense", "Status")} == {"Device"}


def fullest_bits(layout: Layout, node: int) -> int:
    """Bits of the longest frame with a payload of this layout that ascent, byte by byte, comes to."""
    length = struct.calcsize(layout.format) - layout.protected

    def bits(body: bytes) -> int:
        data = body + bytes([crc8(bytes([layout.function]) + body)]) if layout.protected else body
        try:
            decode(layout.function, data)
        except DecodeError:
            return 0
        return frame_bits(CanFrame(can_identifier(layout.function, node), data))

    ends = []
    for phase in range(8):
        body = bytes([0x0F0F >> phase & 0xFF] * length)  # behind a stuff bit, four equal bits need the next
        for at in (*range(length), *range(length)):
            body = max((body[:at] + bytes([byte]) + body[at + 1 :] for byte in range(256)), key=bits)
        ends.append(bits(body))
    return max(ends)


def test_the_configuration_knows_what_an_exchange_takes_of_a_bus() -> None:
    """The constant is the bound over every payload of these lengths, and real frames come near it."""
    each_tick = {message.name for message in schedule(1_234.0) if message.rate_hz == 1_234.0}
    layouts = [layout for layout in LAYOUTS if layout.message.__name__ in each_tick]
    assert len(layouts) == len(each_tick) == 3
    assert sum(most_can_bits(struct.calcsize(layout.format)) for layout in layouts) == EXCHANGE_BITS
    fullest = sum(fullest_bits(layout, node=0) for layout in layouts)
    assert 0.95 * EXCHANGE_BITS < fullest <= EXCHANGE_BITS


def test_serial_bits_are_those_of_the_framing() -> None:
    assert serial_bits(8) == 10 * 14
    meter = Meter()
    payload = encode(Drive(0.1, 0.2, DriveMode.RUN, 5))
    meter(0.0, encode_frame(FUNCTION[Drive], 7, payload))
    assert sum(bits for _, bits in meter.serial) == serial_bits(7)
    assert meter.can == [(0.0, can_bits(0x021, payload))]


def test_a_third_of_every_bus_is_free_and_the_device_needs_no_more_than_computed() -> None:
    bits = computed(schedule())
    seen = bus.measured(0.5)
    assert set(bits) == set(seen)
    for way, rate in bits.items():
        bitrate = bus.CAN_BITRATE if way == "CAN" else bus.SERIAL_BAUD
        assert max(rate, seen[way]["fullest"]) <= 0.7 * bitrate
        # homing, with its handshake and commands, is in the mean too
        assert 0.7 * rate < seen[way]["mean"] <= rate
