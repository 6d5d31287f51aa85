"""The simulated device: plant, electronics and firmware, spoken to in messages or over a paced serial line.

Nothing here reads a clock: time is what the caller passes, in seconds since power-on on the host's clock, and never
falls. So the same object runs in virtual time, as fast as it computes, and in real time behind a door.
"""

import math
import random
from collections import deque
from collections.abc import Callable, Iterable
from operator import attrgetter
from typing import Final, Protocol, final

from firmware_protocol.codec import (
    FUNCTION,
    DecodeError,
    DeviceMode,
    Drive,
    Identity,
    Message,
    Sense,
    State,
    Status,
    Switches,
    decode,
    encode,
)
from firmware_protocol.framing import DELIMITER, FrameDecoder, encode_frame
from firmware_protocol.value import Value
from tormagd.simulation.compiled_firmware import CompiledFirmware
from tormagd.simulation.emulated_firmware import EmulatedFirmware
from tormagd.simulation.faults import Fault
from tormagd.simulation.firmware import IDENTITY, NO_ANSWER, OFF, TICK_S, Answer, Firmware, Output, Sensors
from tormagd.simulation.hand import ROLLER_RADIUS_MM, Hand
from tormagd.simulation.parameters import PlantParameters
from tormagd.simulation.plant import Plant, Truth

BITS_PER_BYTE: Final = 10  # start, eight data bits, stop
DEFAULT_BAUD: Final = 1_000_000
FirmwareKind = Callable[[PlantParameters], Firmware | CompiledFirmware | EmulatedFirmware]
"What boots: `Firmware`, its rules in C, or these on their processor."
BYTES: Final = 0
"The function of bytes on a serial line."
WEAR: Final = 4.0
JUMP_MM: Final = 4.0
WATCHDOG_S: Final = 0.1
"A firmware that hangs is reset after this time."
HOT_C: Final = 70.0
JAMMED_N: Final = 1e5
"More drag than any motor overcomes."
MAX_BACKLOG_BYTES: Final = 65_536
"What the buffers hold; more is lost, as on a real port."
SILENCES: Final = {FUNCTION[State]: "no_state", FUNCTION[Sense]: "no_sense", FUNCTION[Status]: "no_status"}
DRIVE: Final = bytes((FUNCTION[Drive],))
LEFT_OPEN: Final = 1
RIGHT_OPEN: Final = 2
LEFT_CLOSED: Final = 4
RIGHT_CLOSED: Final = 8
END_SWITCHES: Final = [Switches(bits) for bits in range(16)]
"Flags are made here, not in a tick."


@final
class Packet(Value):
    """One message's payload, and when the link delivers or takes it."""

    def __init__(self, time_s: float, function: int, payload: bytes) -> None:
        self.time_s: Final = time_s
        self.function: Final = function
        self.payload: Final = payload


@final
class MessageDevice:
    """The simulated device at the level of messages, whatever carries them."""

    def __init__(
        self,
        parameters: PlantParameters,
        hand: Hand,
        faults: Iterable[Fault] = (),
        seed: int = 0,
        boot: FirmwareKind = Firmware,
    ) -> None:
        self.parameters = parameters
        self.plant = Plant(parameters, hand, seed)
        self._boot = boot
        self.outbox: deque[Packet] = deque()
        self.undecodable = 0
        "Payloads that were no message."
        self._faults: deque[Fault] = deque(sorted(faults, key=attrgetter("at_s")))
        self._jitter = random.Random(f"reply jitter {seed}")
        self._jitter_s = parameters.firmware.reply_jitter_us * 1e-6
        self._rate = 1.0 + parameters.firmware.clock_ppm * 1e-6
        self._supply_V = parameters.electronics.supply_V
        self._pwm_steps = float(2**parameters.electronics.pwm_bits - 1)
        self._counts_per_rad = parameters.electronics.encoder_counts_per_rev / math.tau
        self._handle_counts_per_mm = parameters.assumed.handle_counts_per_rev / (math.tau * ROLLER_RADIUS_MM)
        self._home_m = parameters.assumed.home_mm * 1e-3
        self._closed_m = parameters.assumed.closed_mm * 1e-3
        self._inbox: deque[Packet] = deque()
        self._struck: dict[str, float] = {}
        "Faults that last, each with the factor on what it changes."
        self._output: Output = OFF
        self._stuck_left: int | None = None
        self._stuck_handle: int | None = None
        self._frozen_until_s = -math.inf
        self._drives = 0
        self._left_count_sign = 1
        self._left_extra_counts = 0
        self._right_extra_counts = 0
        self._time_s = 0.0
        self._reset(0.0)

    @property
    def truth(self) -> Truth:
        """The plant's true state at the time of the last call."""
        return self.plant.truth

    def receive(self, time_s: float, function: int, payload: bytes) -> None:
        """Queue a payload that arrives at `time_s`, none before those that came before."""
        self._inbox.append(Packet(time_s, function, payload))

    def advance(self, now_s: float) -> None:
        """Let time pass until `now_s`: messages arrive, faults strike, the firmware ticks and answers into `outbox`."""
        if not self._time_s <= now_s < math.inf:
            raise ValueError(f"now_s = {now_s}: allowed is from {self._time_s} on")
        while (event_s := self.next_event_s) <= now_s:
            self._pass_time(event_s)
            if self._inbox and self._inbox[0].time_s <= event_s:
                self._deliver(event_s, self._inbox.popleft())
            elif self._answers and self._answers[0][0] <= event_s:
                _, answer = self._answers.popleft()
                self._send_answer(event_s, answer)
            else:
                self._tick(event_s)
            if self.firmware.output is not self._output:
                self._drive_bridges()
        self._pass_time(now_s)

    @property
    def next_event_s(self) -> float:
        event_s = self._tick_due_s
        if self._inbox:
            event_s = min(event_s, self._inbox[0].time_s)
        if self._answers:
            event_s = min(event_s, self._answers[0][0])
        return max(event_s, self._time_s)

    def _pass_time(self, time_s: float) -> None:
        if time_s > self._time_s:
            self.plant.advance(time_s - self._time_s)
            self._time_s = time_s

    def _drive_bridges(self) -> None:
        """Put the firmware's output at the motors, as supply and faults let it."""
        self._output = output = self.firmware.output
        if output.enabled and self._supply_V > 0.0:
            left_V, right_V = self._volts(output.left_duty), self._volts(output.right_duty)
            if "duties_reversed" in self._struck and self.firmware.mode is DeviceMode.RUN:
                left_V, right_V = -left_V, -right_V
            if "opening" in self._struck and self.firmware.mode is DeviceMode.RETRACTING:
                left_V, right_V = self._struck["opening"] * left_V, self._struck["opening"] * right_V
            if "motor_reversed_left" in self._struck:
                left_V = -left_V
            self.plant.drive(None if "motor_dead_left" in self._struck else left_V, right_V)
        else:
            self.plant.drive(None, None)

    def _volts(self, duty: float) -> float:
        return float(math.floor(duty * self._pwm_steps + 0.5)) / self._pwm_steps * self._supply_V

    def _device_time_s(self, time_s: float) -> float:
        return (time_s - self._boot_s) * self._rate

    def _tick(self, time_s: float) -> None:
        """Begin the faults that are due, let the firmware tick, and send its Status."""
        self._ticks += 1
        while self._faults and self._faults[0].at_s <= time_s:
            self._strike(time_s, self._faults.popleft())
        self._tick_due_s = self._boot_s + (self._ticks + 1) * TICK_S / self._rate
        if self._frozen_until_s > 0.0:
            if time_s < self._frozen_until_s:
                return
            self._frozen_until_s = -math.inf
            self._reset(time_s)
        status = self.firmware.tick(self._device_time_s(time_s), self._sensors())
        if status is not None:
            self._send(time_s, status)

    def _deliver(self, time_s: float, packet: Packet) -> None:
        """Give the firmware a packet, and queue its answer with jitter."""
        if "commands_vanish" in self._struck or time_s < self._frozen_until_s:
            return
        if "answers_half" in self._struck and _is_drive(packet):
            self._drives += 1
            if self._drives % 2:
                return
        answer = self._hear(self._device_time_s(time_s), packet)
        if answer is not NO_ANSWER:
            answer_s = time_s + self._jitter_s * self._jitter.random()
            if self._answers:  # none overtakes the one before it
                answer_s = max(answer_s, self._answers[-1][0])
            self._answers.append((answer_s, answer))

    def _hear(self, device_s: float, packet: Packet) -> Answer:
        if packet.function == BYTES and isinstance(self.firmware, EmulatedFirmware):
            return self.firmware.hear(device_s, packet.payload, self._sensors())
        try:
            message = decode(packet.function, packet.payload)
        except DecodeError:
            self.undecodable += 1
            return NO_ANSWER
        return self.firmware.receive(device_s, message, self._sensors())

    def _send_answer(self, time_s: float, answer: Answer) -> None:
        if answer is IDENTITY:
            known = self.firmware.identity()
            if "other_schema" in self._struck:
                known = Identity(known.schema_hash ^ 1, known.firmware_major, known.firmware_minor, known.serial_number)
            self._send(time_s, known)
            return
        state, sense = self.firmware.measurement(self._device_time_s(time_s), self._sensors())
        self._send(time_s, state)
        self._send(time_s, sense)

    def _send(self, time_s: float, message: Message) -> None:
        """Put a message into `outbox`, unless a fault silences or spoils it."""
        function, payload = FUNCTION[type(message)], encode(message)
        if SILENCES.get(function) in self._struck:
            return
        if "state_crc" in self._struck and isinstance(message, State):
            payload = payload[:-1] + bytes((payload[-1] ^ 0xFF,))
        self.outbox.append(Packet(time_s, function, payload))

    def _sensors(self) -> Sensors:
        """Return what the electronics measure now, faults included."""
        plant, struck = self.plant, self._struck
        left_m, right_m = plant.left.position_m, plant.right.position_m
        switches = 0
        if (left_m >= self._home_m and "switch_dead_left" not in struck) or "switch_stuck_left" in struck:
            switches = LEFT_OPEN
        elif left_m <= self._closed_m or "end_stop_left" in struck:
            switches = LEFT_CLOSED
        if right_m >= self._home_m:
            switches += RIGHT_OPEN
        elif right_m <= self._closed_m:
            switches += RIGHT_CLOSED
        (left_rad, left_A), (right_rad, right_A) = plant.shafts
        left_counts, right_counts = self._encoders(left_rad, right_rad)
        return Sensors(
            left_counts - self._left_boot_counts,
            right_counts - self._right_boot_counts,
            left_A,
            right_A,
            plant.force_sensor.reading_N,
            self._handle_counts() if self._stuck_handle is None else self._stuck_handle,
            END_SWITCHES[switches],
            self._supply_V,
            HOT_C if "overheated" in struck else plant.element.warmth.temperature_C,
        )

    def _handle_counts(self) -> int:
        return math.floor(self.plant.handle_mm * self._handle_counts_per_mm)

    def _reset(self, time_s: float) -> None:
        """Boot the firmware: mode, zero, clock and pending answers are lost."""
        self.firmware: Firmware | CompiledFirmware | EmulatedFirmware = self._boot(self.parameters)
        self._answers: deque[tuple[float, Answer]] = deque()
        (left_rad, _), (right_rad, _) = self.plant.shafts
        self._left_boot_counts, self._right_boot_counts = self._encoders(left_rad, right_rad)
        self._boot_s = time_s
        self._ticks = 0
        self._tick_due_s = time_s + TICK_S / self._rate

    def _encoders(self, left_rad: float, right_rad: float) -> tuple[int, int]:
        stuck = self._stuck_left
        left_counts = math.floor(left_rad * self._counts_per_rad) if stuck is None else stuck
        return (
            self._left_count_sign * left_counts + self._left_extra_counts,
            math.floor(right_rad * self._counts_per_rad) + self._right_extra_counts,
        )

    def _count_on(self, left_count_sign: int) -> None:
        """Let the left encoder go on from its present count, without a leap."""
        (left_rad, _), (right_rad, _) = self.plant.shafts
        left_counts, _ = self._encoders(left_rad, right_rad)
        self._stuck_left, self._left_count_sign = None, left_count_sign
        self._left_extra_counts += left_counts - self._encoders(left_rad, right_rad)[0]

    def mend(self) -> None:
        """End all faults that act on the device now."""
        self._struck.clear()
        self._stuck_handle = None
        if self._stuck_left is not None or self._left_count_sign < 0:
            self._count_on(1)
        self._suffer()
        self._run_clock_at(self._time_s)
        self._drive_bridges()

    def _strike(self, time_s: float, fault: Fault) -> None:
        match fault.name:
            case "reset":
                self._reset(time_s)
            case "frozen":
                self._frozen_until_s = time_s + WATCHDOG_S
                self._answers.clear()
            case "encoder_jump" | "encoder_jump_left":
                counts_rev = self.parameters.electronics.encoder_counts_per_rev
                counts = round(JUMP_MM / self.parameters.screw.lead_mm * counts_rev)
                self._left_extra_counts += counts
                if fault.name == "encoder_jump":
                    self._right_extra_counts += counts
            case "encoder_reversed_left":
                self._count_on(-self._left_count_sign)
            case "encoder_stuck_left":
                (left_rad, _), (right_rad, _) = self.plant.shafts
                self._stuck_left, _ = self._encoders(left_rad, right_rad)
            case "no_handle":
                self._stuck_handle = self._handle_counts()
            case _:
                self._struck[fault.name] = self._share(fault.name) * (1.0 + fault.percent / 100.0)
                self._suffer()
                self._drive_bridges()
                if fault.name == "clock":
                    self._run_clock_at(time_s)

    def _share(self, fault: str) -> float:
        return self._struck.get(fault, 1.0)

    def _suffer(self) -> None:
        """Give motors and screws what the lasting faults leave of them."""
        plant, screw = self.plant, self.parameters.screw
        plant.wear(WEAR if "worn_gearbox" in self._struck else 1.0)
        plant.left.drag_N = JAMMED_N if "blocked_left" in self._struck else screw.drag_left_N * self._share("drag_left")
        plant.right.drag_N = JAMMED_N if "blocked_right" in self._struck else screw.drag_right_N
        for axis in (plant.left, plant.right):
            axis.backlash_m = 0.5e-6 * screw.backlash_um * self._share("backlash")
        self._supply_V = 0.0 if "supply_loss" in self._struck else self.parameters.electronics.supply_V

    def _run_clock_at(self, time_s: float) -> None:
        """Let the firmware's clock run at its own rate, or a fault's, from now on."""
        rate = (1.0 + self.parameters.firmware.clock_ppm * 1e-6) * self._share("clock")
        self._boot_s = time_s - (time_s - self._boot_s) * self._rate / rate
        self._rate = rate
        self._tick_due_s = self._boot_s + (self._ticks + 1) * TICK_S / rate


class SerialDevice(Protocol):
    """A `VirtualDevice`, or something in front of one."""

    @property
    def messages(self) -> MessageDevice:
        """The device itself."""

    def receive(self, now_s: float, data: bytes) -> None:
        """Take the bytes that the host writes at `now_s`."""

    def transmit(self, now_s: float) -> bytes:
        """Return the bytes that have left the line by `now_s` since the last call."""


@final
class VirtualDevice:
    """The device behind a serial line: bytes in, bytes out, both paced to the baud rate."""

    def __init__(
        self,
        parameters: PlantParameters,
        hand: Hand,
        faults: Iterable[Fault] = (),
        seed: int = 0,
        baud: int = DEFAULT_BAUD,
        boot: FirmwareKind = Firmware,
    ) -> None:
        self.messages = MessageDevice(parameters, hand, faults, seed, boot)
        self._byte_s = BITS_PER_BYTE / baud
        self.decoder = FrameDecoder()
        self._reads_frames = isinstance(self.messages.firmware, EmulatedFirmware)
        self._receiver_free_s = 0.0
        self._sequence = 0
        self._line: deque[tuple[float, bytes]] = deque()
        self._sender_free_s = 0.0

    def receive(self, now_s: float, data: bytes) -> None:
        self.messages.advance(now_s)
        start_s = max(now_s, self._receiver_free_s)
        room = MAX_BACKLOG_BYTES - math.ceil((start_s - now_s) / self._byte_s)
        data = data[: max(room, 0)]
        taken = 0
        for stretch in _stretches(data):
            taken += len(stretch)
            if self._reads_frames:
                self.messages.receive(start_s + taken * self._byte_s, BYTES, stretch)
                continue
            for frame in self.decoder.feed(stretch):
                self.messages.receive(start_s + taken * self._byte_s, frame.function, frame.payload)
        self._receiver_free_s = start_s + taken * self._byte_s

    def advance(self, now_s: float) -> None:
        """Queue what the device has sent by `now_s` as frames on the line."""
        self.messages.advance(now_s)
        outbox = self.messages.outbox
        while outbox:
            packet = outbox.popleft()
            frame = encode_frame(packet.function, self._sequence, packet.payload)
            self._sequence = (self._sequence + 1) % 256
            start_s = max(packet.time_s, self._sender_free_s)
            self._sender_free_s = start_s + float(len(frame)) * self._byte_s
            self._line.append((start_s, frame))

    def transmit(self, now_s: float) -> bytes:
        self.advance(now_s)
        out: list[bytes] = []
        line, byte_s = self._line, self._byte_s
        while line:
            start_s, data = line[0]
            # sums of times are not exact
            done = int((now_s - start_s) / byte_s + 1e-6)
            if done < len(data):
                if done > 0:
                    out.append(data[:done])
                    line[0] = (start_s + done * byte_s, data[done:])
                break
            out.append(data)
            line.popleft()
        return b"".join(out)

    @property
    def next_event_s(self) -> float:
        event_s = self.messages.next_event_s
        if self._line:
            start_s, data = self._line[0]
            event_s = min(event_s, start_s + len(data) * self._byte_s)
        return event_s


def _is_drive(packet: Packet) -> bool:
    # behind the first byte of COBS, a frame's next one is its function
    return (packet.payload[1:2] if packet.function == BYTES else bytes((packet.function,))) == DRIVE


def _stretches(data: bytes) -> list[bytes]:
    if data.find(DELIMITER) == len(data) - 1:  # one frame, as nearly always
        return [data]
    *ended, rest = data.split(DELIMITER)
    return [*[stretch + DELIMITER for stretch in ended], rest]
