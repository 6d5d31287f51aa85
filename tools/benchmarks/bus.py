"""`benchmark bus`: how much of the bus 1 kHz control takes, and what the codec costs in every control cycle.

Computed from the DBC: every message at its rate, CAN frames with the most stuff bits their length allows, commands and
handshake as often as they are ever repeated. Measured on the simulated device in virtual time, homing and handshake
included: the frames as they were sent, each with the stuff bits it has, and the fullest 20 ms. Headroom is what the
fullest way leaves free; `highest_rate_hz` is the control rate up to which 30 % would be left.
"""

import argparse
import statistics
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cantools.database.can
import numpy as np

import firmware_protocol
from firmware_protocol.codec import (
    FUNCTION,
    DeviceFault,
    DeviceMode,
    Drive,
    DriveMode,
    Message,
    Sense,
    State,
    Status,
    Switches,
    can_identifier,
    decode,
    encode,
)
from firmware_protocol.framing import FrameDecoder, encode_frame
from tormagd.hardware.link import HELLO_S, REPEAT_S
from tormagd.lab.session import virtual_session

DBC = Path(firmware_protocol.__file__).parent / "tormag.dbc"
CAN_BITRATE, SERIAL_BAUD = 1_000_000, 1_000_000
SLOWER = {"CAN": (500_000,), "serial": (460_800, 921_600)}
HEADROOM = 0.3
CONTROL_HZ = 1_000.0
WINDOW_S = 0.020
SERIAL_BITS = 10  # start, eight data bits, stop
CAN_STUFFABLE = 34  # start, identifier, control and CRC of a classical base frame
CAN_FIXED = 13  # delimiters, acknowledge, end of frame, gap to the next
CRC15_POLYNOMIAL = 0x4599
HANDSHAKE_HZ, COMMAND_HZ = 1.0 / HELLO_S, 1.0 / REPEAT_S
CODEC_BATCHES, CODEC_CYCLES = 200, 50
CODEC_ALLOWED_US = 15.0


class Traffic(NamedTuple):
    """One message on the bus: bytes of payload and how often it is sent."""

    name: str
    sender: str
    length: int
    rate_hz: float


def schedule(control_hz: float = CONTROL_HZ) -> list[Traffic]:
    """Every message of the DBC at its rate; what is sent on event at the rate of its repetitions."""
    database = cantools.database.can.Database()
    database.add_dbc_file(DBC)
    events = {"Hello": HANDSHAKE_HZ, "Identity": HANDSHAKE_HZ}
    traffic = []
    for message in database.messages:
        cycle_ms = message.cycle_time or 0
        # what has the cycle time of the control loop goes with it; Status runs on the device's own clock
        rate_hz = control_hz if cycle_ms == 1 else 1e3 / cycle_ms if cycle_ms else events.get(message.name, COMMAND_HZ)
        traffic.append(Traffic(message.name, message.senders[0], message.length, rate_hz))
    return traffic


def most_can_bits(length: int) -> int:
    """Bits of a classical base frame with as many stuff bits as `length` bytes of data can need."""
    stuffable = CAN_STUFFABLE + 8 * length
    return stuffable + (stuffable - 1) // 4 + CAN_FIXED


def can_bits(identifier: int, data: bytes) -> int:
    """Bits of that classical base frame on the bus, its own stuff bits included."""
    header = f"0{identifier:011b}000{len(data):04b}"
    bits = [int(bit) for bit in header + "".join(f"{byte:08b}" for byte in data)]
    crc = 0
    for bit in bits:
        crc = crc << 1 ^ (CRC15_POLYNOMIAL if bit ^ crc >> 14 else 0)
        crc &= 0x7FFF
    stuffed = run = 0
    last = -1
    for bit in [*bits, *(int(bit) for bit in f"{crc:015b}")]:
        run = run + 1 if bit == last else 1
        last = bit
        if run == 5:
            stuffed += 1
            last, run = 1 - bit, 1  # the stuff bit is the first of the next run
    return len(bits) + 15 + stuffed + CAN_FIXED


def serial_bits(length: int) -> int:
    """Bits of a payload's frame on a serial line."""
    return SERIAL_BITS * len(encode_frame(1, 0, bytes(length)))


def computed(traffic: Sequence[Traffic]) -> dict[str, float]:
    """Bits a second: of the CAN bus, and of each way of a serial line."""
    return {
        "CAN": sum(most_can_bits(message.length) * message.rate_hz for message in traffic),
        "serial, to the device": _one_way(traffic, "Host"),
        "serial, to the host": _one_way(traffic, "Device"),
    }


def _one_way(traffic: Sequence[Traffic], sender: str) -> float:
    return sum(serial_bits(message.length) * message.rate_hz for message in traffic if message.sender == sender)


class Meter:
    """Adds up what passes on one way."""

    def __init__(self) -> None:
        self._decoder = FrameDecoder()
        self.serial: list[tuple[float, int]] = []
        self.can: list[tuple[float, int]] = []

    def __call__(self, time_s: float, data: bytes) -> None:
        """Takes the bytes that passed at that time."""
        self.serial.append((time_s, SERIAL_BITS * len(data)))
        for frame in self._decoder.feed(data):
            self.can.append((time_s, can_bits(can_identifier(frame.function), frame.payload)))


def measured(seconds: float) -> dict[str, dict[str, float]]:
    """Bits a second in the mean and in the fullest window, of a session in virtual time."""
    to_device, to_host = Meter(), Meter()
    end_s = virtual_session(seconds, to_device, to_host).now_s
    ways = {
        "CAN": to_device.can + to_host.can,
        "serial, to the device": to_device.serial,
        "serial, to the host": to_host.serial,
    }
    return {way: _rates(passed, end_s) for way, passed in ways.items()}


def _rates(passed: Iterable[tuple[float, int]], end_s: float) -> dict[str, float]:
    times_s, bits = np.array(list(passed)).T
    windows = np.bincount((times_s / WINDOW_S).astype(np.int64), weights=bits)
    return {"mean": float(bits.sum() / end_s), "fullest": float(windows.max() / WINDOW_S)}


def codec_us() -> dict[str, float]:
    """Time for one control cycle's messages, the best and the median batch: payloads alone, and with their frames."""
    drive = Drive(0.125, -0.5, DriveMode.RUN, 17)
    replies: tuple[Message, ...] = (
        State(-12.0, -12.1, 0.25, 3),
        Sense(0.5, 0.4, 1.8, 120.0),
        Status(DeviceMode.RUN, Switches.HOMED, DeviceFault(0), 25.0, 12.0, 16, 3),
    )
    payloads = [(FUNCTION[type(message)], encode(message)) for message in replies]
    stream = b"".join(encode_frame(function, number, payload) for number, (function, payload) in enumerate(payloads))
    payload_us, frame_us = [], []
    for _ in range(CODEC_BATCHES):
        started = time.perf_counter()
        for _ in range(CODEC_CYCLES):
            encode(drive)
            for function, payload in payloads:
                decode(function, payload)
        payload_us.append((time.perf_counter() - started) / CODEC_CYCLES * 1e6)
        decoder = FrameDecoder()
        started = time.perf_counter()
        for _ in range(CODEC_CYCLES):
            encode_frame(FUNCTION[Drive], 1, encode(drive))
            for frame in decoder.feed(stream):
                decode(frame.function, frame.payload)
        frame_us.append((time.perf_counter() - started) / CODEC_CYCLES * 1e6)
    return {
        "payloads_best": min(payload_us),
        "payloads_median": statistics.median(payload_us),
        "with_frames_best": min(frame_us),
        "with_frames_median": statistics.median(frame_us),
    }


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """The whole; loads and headrooms are shares of the bit rate."""
    bits = computed(schedule())
    seen = measured(options.seconds)
    fixed, moving = computed(schedule(0.0)), computed(schedule(1.0))
    ways: dict[str, dict[str, Any]] = {}
    for way, needed in bits.items():
        carrier = way.split(",")[0]
        bitrate = CAN_BITRATE if carrier == "CAN" else SERIAL_BAUD
        ways[way] = {
            "bitrate": bitrate,
            "computed_load": needed / bitrate,
            "measured_load": seen[way]["mean"] / bitrate,
            "measured_fullest_20ms": seen[way]["fullest"] / bitrate,
            "headroom": 1.0 - max(needed, seen[way]["fullest"]) / bitrate,
            "highest_rate_hz": ((1.0 - HEADROOM) * bitrate - fixed[way]) / (moving[way] - fixed[way]),
            "computed_load_at": {str(slower): needed / slower for slower in SLOWER[carrier]},
        }
    codec = codec_us()
    return {
        "control_hz": CONTROL_HZ,
        "ways": ways,
        "codec_us": codec,
        "passed": all(way["headroom"] >= HEADROOM for way in ways.values())
        and codec["payloads_best"] <= CODEC_ALLOWED_US,
    }


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds `--seconds`."""
    parser.add_argument("--seconds", type=float, default=5.0, help="of virtual time, after homing")


def print_table(result: dict[str, Any]) -> None:
    """The result for people."""
    title = f"{result['control_hz']:g} Hz control"
    print(f"{title:22}{'bit rate':>12}{'computed':>10}{'mean':>8}{'fullest':>9}{'headroom':>10}")
    for name, way in result["ways"].items():
        print(
            f"{name:22}{way['bitrate']:12}{way['computed_load']:10.1%}{way['measured_load']:8.1%}"
            f"{way['measured_fullest_20ms']:9.1%}{way['headroom']:10.1%}  up to {way['highest_rate_hz']:.0f} Hz, "
            + ", ".join(f"{load:.0%} of {slower}" for slower, load in way["computed_load_at"].items())
        )
    codec = result["codec_us"]
    print(
        f"codec a cycle, best and median batch: payloads {codec['payloads_best']:.1f} and "
        f"{codec['payloads_median']:.1f} us, with serial frames {codec['with_frames_best']:.1f} and "
        f"{codec['with_frames_median']:.1f} us"
    )
    print("passed" if result["passed"] else "FAILED")
