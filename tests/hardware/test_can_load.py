"""What an exchange takes of a CAN bus, by the DBC: the bound over every payload, and that real frames come near it."""

import struct
from pathlib import Path

import cantools.database.can

import firmware_protocol
from firmware_protocol.codec import DecodeError, can_identifier, crc8, decode
from firmware_protocol.layouts import LAYOUTS
from firmware_protocol.schema import Layout
from tormagd.hardware.can_backend import EXCHANGE_BITS
from tormagd.simulation.can_frame import CanFrame, frame_bits

DBC = Path(firmware_protocol.__file__).parent / "tormag.dbc"
STUFFABLE_BITS, FIXED_BITS = 34, 13
"Start, identifier, control and CRC of a classical base frame; delimiters, acknowledge, end and gap to the next."


def most_bits(length: int) -> int:
    """Of a frame with as many stuff bits as its data can need (Davis et al., Real-Time Systems 35, 2007)."""
    stuffable = STUFFABLE_BITS + 8 * length
    return stuffable + (stuffable - 1) // 4 + FIXED_BITS


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
    database = cantools.database.can.Database()
    database.add_dbc_file(DBC)
    each_tick = {message.name for message in database.messages if message.cycle_time == 1}
    layouts = [layout for layout in LAYOUTS if layout.message.__name__ in each_tick]
    assert len(layouts) == len(each_tick) == 3
    most = [most_bits(struct.calcsize(layout.format)) for layout in layouts]
    assert sum(most) == EXCHANGE_BITS
    fullest = [fullest_bits(layout, node=0) for layout in layouts]
    assert sum(fullest) > 0.95 * EXCHANGE_BITS
    assert all(bits <= bound for bits, bound in zip(fullest, most, strict=True))
