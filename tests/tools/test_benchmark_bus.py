"""Load of the bus: computed from the DBC, measured on the simulated device, and 30 % left free."""

import random

import benchmark_bus
import pytest
from benchmark_bus import Meter, can_bits, computed, most_can_bits, schedule, serial_bits

from firmware_protocol.codec import FUNCTION, Drive, DriveMode, encode
from firmware_protocol.framing import encode_frame


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


def test_serial_bits_are_those_of_the_framing() -> None:
    assert serial_bits(8) == 10 * 14
    meter = Meter()
    payload = encode(Drive(0.1, 0.2, DriveMode.RUN, 5))
    meter(0.0, encode_frame(FUNCTION[Drive], 7, payload))
    assert sum(bits for _, bits in meter.serial) == serial_bits(7)
    assert meter.can == [(0.0, can_bits(0x021, payload))]


def test_a_third_of_every_bus_is_free_and_the_device_needs_no_more_than_computed() -> None:
    bits = computed(schedule())
    seen = benchmark_bus.measured(0.5)
    assert set(bits) == set(seen)
    for way, rate in bits.items():
        bitrate = benchmark_bus.CAN_BITRATE if way == "CAN" else benchmark_bus.SERIAL_BAUD
        assert max(rate, seen[way]["fullest"]) <= 0.7 * bitrate
        # homing, with its handshake and commands, is in the mean too
        assert 0.7 * rate < seen[way]["mean"] <= rate
