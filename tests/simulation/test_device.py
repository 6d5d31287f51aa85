"""The device on its carriers, a serial line or a bus, and what its firmware does with motors, switches and encoders."""

import math
import random
from collections import Counter
from collections.abc import Iterable
from itertools import pairwise
from typing import NamedTuple

import msgspec
import numpy as np
import pytest

from firmware_protocol.codec import (
    FUNCTION,
    PROTOCOL_VERSION,
    SCHEMA_HASH,
    Clear,
    DeviceFault,
    DeviceMode,
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
    can_identifier,
    decode,
    encode,
    period,
)
from firmware_protocol.conformance.host import Beat, Host
from firmware_protocol.conformance.line import SerialLine
from firmware_protocol.framing import FrameDecoder, encode_frame
from tormagd.simulation.can_device import DEVICE, MAX_WAITING, CanDevice, Delivery
from tormagd.simulation.can_frame import ERROR_FLAG, SOCKET_FRAME, CanFrame, frame_bits, from_socket, to_socket
from tormagd.simulation.device import MessageDevice, Packet, VirtualDevice
from tormagd.simulation.faults import KNOWN, SIZED, parse_fault
from tormagd.simulation.hand import SteadyHand
from tormagd.simulation.parameters import PlantParameters, load_plant

# -- a serial line -----------------------------------------------------------------------------------------------------


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
    arrived_s = 0.001 + len(HELLO) * byte_s
    device.receive(0.001, HELLO)
    out = b""
    for count in range(1, IDENTITY_BYTES + 1):
        leaves_s = arrived_s + count * byte_s
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


def answered(device: MessageDevice, time_s: float, counter: int) -> Packet:
    """The State that a Drive is answered with."""
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
        (turned_mm % span_mm, device.truth.force_N), abs=0.05
    )


def test_corrupt_and_foreign_payloads_are_counted_and_dropped() -> None:
    device = MessageDevice(SAMPLE_1, SteadyHand())
    drive = encode(Drive(0.5, 0.5, DriveMode.RUN, 1))
    for function, payload in (
        (FUNCTION[Drive], bytes((drive[0] ^ 1, *drive[1:]))),
        (99, b"\x00"),
        (FUNCTION[Drive], b""),
        (FUNCTION[State], encode(State(0.0, 0.0, 0.0, 0))),
    ):
        device.receive(0.001, function, payload)
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
    device = a_device()
    device.advance(1.0)
    for attempt in (device.advance, device.transmit, lambda now_s: device.receive(now_s, b"")):
        for now_s in (0.5, math.nan, math.inf):
            with pytest.raises(ValueError, match="allowed is from"):
                attempt(now_s)
    bus = CanDevice(MessageDevice(SAMPLE_1, SteadyHand()))
    bus.advance(0.01)
    with pytest.raises(ValueError, match="now_s"):
        bus.advance(0.009)


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


# -- frames of a bus ------------------------------------------------------------------------------------------------


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
    assert [frame for frame in frames if frame_bits(frame) != bits_by_hand(frame)] == []


def test_a_frame_survives_the_socket_and_what_is_none_is_refused() -> None:
    frames = [CanFrame(0x7FF, b""), CanFrame(0x021, b"1234567"), CanFrame(ERROR_FLAG | 0x40, bytes(8))]
    assert [from_socket(to_socket(frame)) for frame in frames] == frames
    none = (b"", bytes(15), bytes(17), SOCKET_FRAME.pack(0x21, 9, bytes(8)), SOCKET_FRAME.pack(0x800, 0, b""))
    assert {from_socket(packet) for packet in none} == {None}


# -- the bus -------------------------------------------------------------------------------------------------------


def a_bus(bitrate: int = 1_000_000, node: int = 1) -> CanDevice:
    return CanDevice(MessageDevice(SAMPLE_1, SteadyHand(), seed=1), bitrate, node)


def frame_of(message: Message, node: int = 1) -> CanFrame:
    return CanFrame(can_identifier(FUNCTION[type(message)], node), encode(message))


HELLO_FRAME = frame_of(Hello(SCHEMA_HASH, PROTOCOL_VERSION, 1))
IDENTITY = can_identifier(FUNCTION[Identity])
STATUS = can_identifier(FUNCTION[Status])


def run(device: CanDevice, from_s: float, until_s: float, step_s: float = 1e-5) -> list[tuple[float, Delivery]]:
    """What goes by, and when it had."""
    looks_s = (from_s + tick * step_s for tick in range(1, round((until_s - from_s) / step_s) + 1))
    return [(now_s, delivery) for now_s in looks_s for delivery in device.transmit(now_s)]


@pytest.mark.parametrize("bitrate", [1_000_000, 500_000, 125_000])
def test_a_frame_takes_its_bits_and_is_answered(bitrate: int) -> None:
    device = a_bus(bitrate)
    device.receive(0.0001, HELLO_FRAME)
    seen = run(device, 0.0001, 0.005)
    (heard_s, hello), (answered_s, identity) = [item for item in seen if item[1].frame.identifier != STATUS]
    assert hello == Delivery(1, HELLO_FRAME)
    assert heard_s == pytest.approx(0.0001 + frame_bits(HELLO_FRAME) / bitrate, abs=1.1e-5)
    assert (identity.sender, identity.frame.identifier) == (DEVICE, IDENTITY)
    assert answered_s >= heard_s + frame_bits(identity.frame) / bitrate - 1e-9


def test_the_lowest_identifier_goes_first_once_the_bus_is_free() -> None:
    device = a_bus()
    frames = [CanFrame(identifier, b"12345678") for identifier in (0x700, 0x7F2, 0x012, 0x7F1, 0x012)]
    for host, frame in enumerate(frames, start=1):
        device.receive(0.0, frame, host)
    seen = [delivery for _, delivery in run(device, 0.0, 0.002) if delivery.sender != DEVICE]
    # the first is on the bus before the others come; equal identifiers go in the order they came
    assert seen == [Delivery(host, frames[host - 1]) for host in (1, 3, 5, 4, 2)]


def test_only_its_own_node_reaches_the_device() -> None:
    device = a_bus(node=2)
    device.receive(0.0, HELLO_FRAME)
    assert not any(delivery.sender == DEVICE for _, delivery in run(device, 0.0, 0.005))
    device.receive(0.005, frame_of(Hello(SCHEMA_HASH, PROTOCOL_VERSION, 1), node=2))
    answers = [delivery.frame for _, delivery in run(device, 0.005, 0.01) if delivery.sender == DEVICE]
    assert [frame.identifier for frame in answers] == [can_identifier(FUNCTION[Identity], 2)]


def test_what_the_controllers_cannot_hold_is_lost_and_counted() -> None:
    device = a_bus(10_000)
    for _ in range(MAX_WAITING + 10):
        device.receive(0.0, CanFrame(0x7F2, bytes(8)))
    assert device.lost == 9, "one is on the bus"
    run(device, 0.0, 0.5, 1e-3)
    assert device.messages.undecodable == 0


def test_control_at_a_kilohertz_leaves_thirty_percent_of_the_bus() -> None:
    device = a_bus()
    device.receive(0.0, HELLO_FRAME)
    device.transmit(0.01)
    busy_s = device.busy_s
    answers: Counter[int] = Counter()
    for tick in range(500):
        now_s = 0.01 + tick * 1e-3
        device.receive(now_s, frame_of(Drive(0.1234, -0.1234, DriveMode.OFF, tick % 256)))
        answers.update(delivery.frame.identifier for delivery in device.transmit(now_s + 0.999e-3))
    assert answers[can_identifier(FUNCTION[State])] == answers[can_identifier(FUNCTION[Sense])] == 500
    assert 0.3 < (device.busy_s - busy_s) / 0.5 < 0.7


# -- the firmware, seen through the wire; the rules of the page are the conformance kit's, which it passes -------------


SAMPLES = ("sample_1", "sample_2", "sample_3")

PERIOD_S = 1e-3
COMMAND_TIMEOUT_S = 0.05
STATUS_PERIOD_S = 0.02


class Port:
    """The serial port of a simulated device, in virtual time: a `BytePort`."""

    def __init__(self, device: VirtualDevice) -> None:
        self.device = device
        self.time_s = 0.0

    def now_s(self) -> float:
        return self.time_s

    def write(self, data: bytes) -> None:
        self.device.receive(self.time_s, data)

    def read(self, until_s: float) -> list[tuple[float, bytes]]:
        self.time_s = until_s
        return [(until_s, self.device.transmit(until_s))]


class Bench(Host):
    """A simulated device and the conformance kit's host of it, which looks through the wire."""

    def __init__(self, faults: Iterable[str] = (), plant: PlantParameters | None = None) -> None:
        self.device = VirtualDevice(
            plant or load_plant("sample_1"), SteadyHand(), [parse_fault(fault) for fault in faults]
        )
        super().__init__(SerialLine(Port(self.device)))

    def go_to(self, gap_mm: float, seconds: float = 1.5) -> None:
        """Run to a gap with a plain proportional loop on each carriage, starting homed."""
        target_mm = gap_mm / 2.0 - 47.5
        for _ in range(round(seconds / PERIOD_S)):
            state = self.last(State)
            errors = (target_mm - state.left_position_mm, target_mm - state.right_position_mm)
            self.beat(Beat.RUN, *(min(max(2.0 * error, -1.0), 1.0) for error in errors))

    def run_until(self, time_s: float, duty: float = 0.0) -> None:
        while self.now_s < time_s:
            self.beat(Beat.RUN, duty, duty)

    def reaches(self, mode: DeviceMode, beat: Beat = Beat.NOTHING, limit_s: float = 10.0) -> None:
        """Waits until Status shows the mode."""
        assert self.until(lambda: self.status.mode is mode, limit_s, beat), self.status


def running(faults: Iterable[str] = (), *, gap_mm: float = 60.0, plant: str = "sample_1") -> Bench:
    """A device homed and at that gap, in RUN, which is before 3.4 s."""
    sample = load_plant(plant)
    near_home = msgspec.structs.replace(sample.assumed, start_left_mm=46.0, start_right_mm=45.5)
    host = Bench(faults, msgspec.structs.replace(sample, assumed=near_home))
    host.homed()
    host.go_to(gap_mm)
    assert host.status.mode is DeviceMode.RUN
    assert host.now_s < 3.4
    assert host.device.truth.gap_mm == pytest.approx(gap_mm, abs=0.3)
    return host


# -- status, and answers to Drives: exactly, where the kit allows for a wire ------------------------------------------


def test_status_comes_fifty_times_a_second_unasked_and_nothing_else_does() -> None:
    host = Bench()
    host.pass_time(2.0)
    assert 99 <= len(host.all_of(Status)) <= 101
    assert len(host.heard) == len(host.all_of(Status))


def test_each_accepted_drive_is_answered_once_by_state_and_sense() -> None:
    host = Bench()
    host.pass_time(0.5, Beat.OFF)
    host.pass_time(0.005)
    states = [message for _, message in host.all_of(State)]
    assert len(states) == len(host.all_of(Sense)) == 500
    assert all((after.counter - before.counter) % 256 == 1 for before, after in pairwise(states))
    host.pass_time(STATUS_PERIOD_S)
    assert host.status.drive_counter == 500 % 256


# -- what must come before a run -----------------------------------------------------------------------------------


def test_drive_run_moves_nothing_before_homing() -> None:
    host = Bench()
    host.hello()
    before_mm = host.device.truth.gap_mm
    host.run_until(host.now_s + 0.2, -1.0)
    assert (host.status.mode, host.device.truth.gap_mm) == (DeviceMode.IDLE, before_mm)


def test_drive_run_is_refused_without_a_hello() -> None:
    host = Bench()
    host.command(Home)
    host.pass_time(3.0, Beat.OFF)
    assert Switches.HOMED in host.status.switches
    host.run_until(host.now_s + 0.1, -1.0)
    assert host.status.mode is DeviceMode.IDLE
    host.hello()
    host.run_until(host.now_s + 0.1, -0.5)
    assert host.status.mode is DeviceMode.RUN


# -- homing --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SAMPLES)
def test_homing_zeroes_the_encoders_at_the_open_switches_repeatably(name: str) -> None:
    host = Bench(plant=load_plant(name))
    zeros = []
    for _ in range(2):
        host.hello()
        host.home()
        assert (host.status.mode, host.status.faults) == (DeviceMode.IDLE, DeviceFault(0))
        truth, state = host.device.truth, host.last(State)
        zeros.append((truth.left_mm - state.left_position_mm, truth.right_mm - state.right_position_mm))
        assert (truth.left_mm, truth.right_mm) == pytest.approx((47.5, 47.5), abs=0.05)
        assert host.status.switches == Switches.LEFT_OPEN | Switches.RIGHT_OPEN | Switches.HOMED
        host.go_to(80.0, 1.0)
        host.pass_time(2.0, Beat.OFF)
    assert [zero for pair in zeros for zero in pair] == pytest.approx([47.5] * 4, abs=0.02)
    assert zeros[0] == pytest.approx(zeros[1], abs=0.01)


@pytest.mark.parametrize("fault", ["encoder_stuck_left", "motor_reversed_left", "encoder_reversed_left"])
def test_homing_that_fails_opens_where_it_can_and_does_not_press_shut(fault: str) -> None:
    """Without an encoder it opens blind; what goes the wrong way cannot, and ends where it is at once."""
    host = Bench([fault])
    before = host.device.truth
    host.command(Home)
    smallest_mm = before.gap_mm
    is_reversed = "reversed" in fault
    while host.status.mode is not DeviceMode.LATCHED:
        host.pass_time(0.01, Beat.OFF)
        assert host.now_s < (2.0 if is_reversed else 20.0)
        smallest_mm = min(smallest_mm, host.device.truth.gap_mm)
    host.pass_time(3.0, Beat.OFF)
    assert (host.status.mode, host.status.faults) == (DeviceMode.LATCHED, DeviceFault.HOMING_FAILED)
    assert Switches.HOMED not in host.status.switches
    assert not host.device.messages.firmware.output.enabled
    if is_reversed:
        assert abs(host.device.truth.left_mm - before.left_mm) < 2.0
    else:
        assert host.device.truth.gap_mm == pytest.approx(95.0, abs=0.6)
        assert smallest_mm > 78.0


def test_duties_are_applied_in_steps_of_ten_bits() -> None:
    def travel(duty: float) -> float:
        host = running()
        host.run_until(host.now_s + 0.3, duty)
        return host.device.truth.gap_mm

    step = 1.0 / 1023.0
    assert travel(512.3 * step) == travel(511.7 * step) == travel(512 * step)
    assert travel(513 * step) > travel(512 * step) > 60.0


# -- ways out of a run ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SAMPLES)
def test_silence_opens_the_gap_and_latches(name: str) -> None:
    host = running(plant=name)
    host.run_until(host.now_s + 0.2)  # stand still first
    stood_mm, silent_s = host.device.truth.gap_mm, host.now_s
    trace = []
    while host.status.mode is not DeviceMode.LATCHED:
        host.beat(Beat.NOTHING)
        trace.append((host.now_s - silent_s, host.device.truth.gap_mm, host.device.truth.force_N))
    silence_s, gap_mm, force_N = np.array(trace).T
    assert COMMAND_TIMEOUT_S - 1e-3 <= silence_s[gap_mm > stood_mm + 0.05][0] < COMMAND_TIMEOUT_S + 0.03
    # from 60 mm, with what the sensorless watch waits and the bounded travel
    assert 0.3 < silence_s[force_N < 1.0][0] < 0.8
    assert np.diff(gap_mm, prepend=stood_mm).max() / PERIOD_S < 2 * 20.0
    assert host.status.faults == DeviceFault.COMMAND_TIMEOUT
    assert Switches.HOMED not in host.status.switches
    assert host.device.truth.gap_mm == pytest.approx(95.0, abs=0.6)
    assert host.device.truth.left_A == 0.0


class Ending(NamedTuple):
    """How a run from a gap of `gap_mm` ends, with these faults of the device, while the host drives so."""

    faults: tuple[str, ...]
    duties: tuple[float, float] | None
    "None: it falls silent."
    gap_mm: float
    at_once: DeviceFault
    "What is latched when it is out of RUN."
    latched: DeviceFault
    "And once the drives are off."
    left_mm: float
    right_mm: float
    "Where the carriages are then."
    within_mm: float = 0.3


OPEN_MM = 47.5
ENDINGS = {
    "a closed switch": Ending((), (-0.3, -0.3), 50.0, DeviceFault.END_STOP, DeviceFault.END_STOP, OPEN_MM, OPEN_MM),
    "skew": Ending((), (0.4, -0.4), 60.0, DeviceFault.SKEW, DeviceFault.SKEW, OPEN_MM, OPEN_MM),
    # the other carriage is opened all the same
    "a blocked carriage": Ending(
        ("blocked_left@3.5",),
        (1.0, 0.0),
        60.0,
        DeviceFault.OVERCURRENT,
        DeviceFault.OVERCURRENT | DeviceFault.RETRACT_FAILED,
        30.0,
        OPEN_MM,
    ),
    "a stiff guide": Ending(
        ("drag_left=+1000%@3.5",),
        None,
        60.0,
        DeviceFault.COMMAND_TIMEOUT,
        DeviceFault.COMMAND_TIMEOUT,
        OPEN_MM,
        OPEN_MM,
    ),
    # found by the skew, and opened blind
    "a stuck encoder": Ending(
        ("encoder_stuck_left@3.5",), (-0.3, -0.3), 60.0, DeviceFault.SKEW, DeviceFault.SKEW, OPEN_MM, OPEN_MM
    ),
    "no supply": Ending(
        ("supply_loss@3.5",),
        (0.0, 0.0),
        60.0,
        DeviceFault.SUPPLY,
        DeviceFault.SUPPLY | DeviceFault.RETRACT_FAILED,
        30.0,
        30.0,
        0.16,
    ),
    "a worn gearbox without supply": Ending(
        ("worn_gearbox@3.5", "supply_loss@3.5"),
        (0.0, 0.0),
        48.0,
        DeviceFault.SUPPLY,
        DeviceFault.SUPPLY | DeviceFault.UNCOMMANDED_MOTION | DeviceFault.RETRACT_FAILED,
        22.0,
        22.0,
        0.24,
    ),
    "a worn gearbox after a reset": Ending(
        ("worn_gearbox@3.6", "reset@3.5"),
        (0.0, 0.0),
        48.0,
        DeviceFault(0),
        DeviceFault.UNCOMMANDED_MOTION,
        OPEN_MM,
        OPEN_MM,
    ),
}


@pytest.mark.parametrize("ending", ENDINGS.values(), ids=ENDINGS)
def test_how_a_run_ends(ending: Ending) -> None:
    host = running(ending.faults, gap_mm=ending.gap_mm)
    host.run_until(3.5)
    beat = (Beat.NOTHING,) if ending.duties is None else (Beat.RUN, *ending.duties)
    while host.status.mode is DeviceMode.RUN:
        host.beat(*beat)
        assert host.now_s < 20.0
    assert host.status.faults == ending.at_once
    truth = host.device.truth
    assert abs(truth.left_mm - truth.right_mm) < 4.0
    assert truth.gap_mm > 44.0 - 1e-6
    host.reaches(DeviceMode.LATCHED)
    host.pass_time(1.0)
    truth = host.device.truth
    assert (host.status.faults, truth.left_A, truth.right_A) == (ending.latched, 0.0, 0.0)
    assert (truth.left_mm, truth.right_mm) == pytest.approx((ending.left_mm, ending.right_mm), abs=ending.within_mm)


def test_a_fault_is_not_cleared_while_its_cause_lasts() -> None:
    host = running(["supply_loss@3.5"])
    host.run_until(3.5)
    stood_mm = host.device.truth.gap_mm
    host.reaches(DeviceMode.LATCHED)
    assert host.status.supply_V == 0.0
    assert host.device.truth.gap_mm == pytest.approx(stood_mm, abs=0.02)
    assert host.is_refused(Clear)


# -- injected faults -----------------------------------------------------------------------------------------------


def test_reset_forgets_zero_handshake_and_mode_but_holds_the_gap() -> None:
    host = running(["reset@3.5"], gap_mm=60.0)
    host.run_until(3.6, -0.2)
    assert host.status.mode is DeviceMode.IDLE
    assert Switches.HOMED not in host.status.switches
    stood_mm = host.device.truth.gap_mm
    host.pass_time(0.5, Beat.OFF)
    assert host.device.truth.gap_mm == pytest.approx(stood_mm, abs=1e-6)
    assert host.last(State).left_position_mm == pytest.approx(0.0, abs=0.3)
    host.homed()
    host.go_to(60.0)


def test_a_gap_that_closes_fast_is_noticed_while_the_device_still_tries_to_open() -> None:
    host = running(["worn_gearbox@3.5", "supply_loss@3.5"], gap_mm=47.0, plant="sample_3")
    host.run_until(3.5)
    while DeviceFault.UNCOMMANDED_MOTION not in host.status.faults:
        host.beat(Beat.NOTHING)
        assert host.now_s < 5.0
    assert host.status.mode is DeviceMode.RETRACTING
    assert DeviceFault.RETRACT_FAILED not in host.status.faults


def test_a_device_that_is_mended_homes_as_a_healthy_one() -> None:
    """After all faults that last have struck it at rest; what they made it latch, it clears."""
    passing = ("frozen", "reset", "encoder_jump", "encoder_jump_left")
    lasting = [f"{name}=+20%" if name in SIZED else name for name in KNOWN if name not in passing]
    mended, healthy = Bench(f"{fault}@0.1" for fault in lasting), Bench()
    mended.pass_time(0.2)
    healthy.pass_time(0.2)
    assert mended.device.messages.firmware.faults
    mended.device.messages.mend()
    for host in (mended, healthy):
        for message in (Hello(SCHEMA_HASH, PROTOCOL_VERSION, 1), Clear(2), Home(3)):
            host.send(message)
        host.pass_time(5.8, Beat.OFF)
        host.pass_time(2.0 * STATUS_PERIOD_S)
    assert mended.status == healthy.status
    assert Switches.HOMED in mended.status.switches
    assert mended.last(State).left_position_mm == pytest.approx(healthy.last(State).left_position_mm, abs=0.01)
    assert mended.last(Sense).handle_position_mm == healthy.last(Sense).handle_position_mm
