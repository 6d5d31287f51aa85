"""The simulated device: plant, electronics and firmware, spoken to in messages or over a paced serial line.

Nothing here reads a clock: time is what the caller passes, in seconds since power-on on the host's clock, and never
falls. So the same object runs in virtual time, as fast as it computes, and in real time behind a door.
"""

import math
import random
from collections import deque
from collections.abc import Callable, Iterable
from typing import NamedTuple

from firmware_protocol.codec import FUNCTION, DecodeError, Message, Switches, decode, encode
from firmware_protocol.framing import DELIMITER, FrameDecoder, FramingStatistics, encode_frame
from tormagd.simulation.compiled_firmware import CompiledFirmware
from tormagd.simulation.faults import Fault
from tormagd.simulation.firmware import NO_SWITCH, OFF, TICK_S, Answer, Firmware, Output, Sensors
from tormagd.simulation.hand import ROLLER_RADIUS_MM, Hand
from tormagd.simulation.parameters import PlantParameters
from tormagd.simulation.plant import Plant, Truth

BITS_PER_BYTE = 10  # start, eight data bits, stop
DEFAULT_BAUD = 1_000_000
FirmwareKind = Callable[[PlantParameters], Firmware | CompiledFirmware]
"""What boots: `Firmware`, or the C sources of the same rules as `CompiledFirmware`."""
WEAR = 4.0
MAX_BACKLOG_BYTES = 65_536
"""What the serial buffers of both ends and the adapter between them hold; more is lost, as on a real port."""


class Packet(NamedTuple):
    """One message's payload and when it is handed to, or came from, the link."""

    time_s: float
    function: int
    payload: bytes


class MessageDevice:
    """The device at the level of messages: payloads in, payloads out, whatever carries them.

    `receive` queues a payload for its time of arrival; `advance` lets time pass and fills `outbox`.
    """

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
        self.firmware = boot(parameters)
        self.outbox: deque[Packet] = deque()
        self.undecodable = 0
        """Payloads that arrived and were no message."""
        self._faults = deque(sorted(faults, key=lambda fault: fault.at_s))
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
        self._answers: deque[tuple[float, Answer]] = deque()
        self._deaf = False
        self._output: Output = OFF
        self._stuck_left: int | None = None
        self._counts_at_boot = (0, 0)
        self._boot_s = 0.0
        self._ticks = 0
        self._tick_due_s = TICK_S / self._rate
        self._time_s = 0.0

    @property
    def truth(self) -> Truth:
        """What really is, at the time of the last `advance`."""
        return self.plant.truth

    def receive(self, time_s: float, function: int, payload: bytes) -> None:
        """Queue a payload that arrives at that time. Raises ValueError for one before those already queued."""
        latest_s = self._inbox[-1].time_s if self._inbox else self._time_s
        if not latest_s <= time_s < math.inf:
            raise ValueError(f"time_s = {time_s}: allowed is from {latest_s} on")
        self._inbox.append(Packet(time_s, function, payload))

    def advance(self, now_s: float) -> None:
        """Let time pass until `now_s`. Raises ValueError for a time before the last one."""
        if not self._time_s <= now_s < math.inf:
            raise ValueError(f"now_s = {now_s}: allowed is from {self._time_s} on")
        inbox, answers = self._inbox, self._answers
        while (event_s := self.next_event_s) <= now_s:
            self._pass_time(event_s)
            if inbox and inbox[0].time_s <= event_s:
                self._deliver(event_s, inbox.popleft())
            elif answers and answers[0][0] <= event_s:
                self._send_answer(event_s, answers.popleft()[1])
            else:
                self._tick(event_s)
            if self.firmware.output is not self._output:
                self._switch()
        self._pass_time(now_s)

    @property
    def next_event_s(self) -> float:
        """When something will happen next, at the latest the next tick of the firmware."""
        event_s = self._tick_due_s
        if self._inbox and (arrival_s := self._inbox[0].time_s) < event_s:
            event_s = arrival_s
        if self._answers and (answer_s := self._answers[0][0]) < event_s:
            event_s = answer_s
        return event_s if event_s > self._time_s else self._time_s

    def _pass_time(self, time_s: float) -> None:
        if time_s > self._time_s:
            self.plant.advance(time_s - self._time_s)
            self._time_s = time_s

    def _switch(self) -> None:
        """Let the bridges do what the firmware wants of them now."""
        self._output = output = self.firmware.output
        if output.enabled and self._supply_V > 0.0:
            self.plant.drive(self._volts(output.left_duty), self._volts(output.right_duty))
        else:
            self.plant.drive(None, None)

    def _volts(self, duty: float) -> float:
        return round(duty * self._pwm_steps) / self._pwm_steps * self._supply_V

    def _device_time_s(self, time_s: float) -> float:
        return (time_s - self._boot_s) * self._rate

    def _tick(self, time_s: float) -> None:
        self._ticks += 1
        while self._faults and self._faults[0].at_s <= time_s:
            self._strike(time_s, self._faults.popleft())
        self._tick_due_s = self._boot_s + (self._ticks + 1) * TICK_S / self._rate
        status = self.firmware.tick(self._device_time_s(time_s), self._sensors())
        if status is not None:
            self._send(time_s, status)

    def _deliver(self, time_s: float, packet: Packet) -> None:
        if self._deaf:
            return
        try:
            message = decode(packet.function, packet.payload)
        except DecodeError:
            self.undecodable += 1
            return
        answer = self.firmware.receive(self._device_time_s(time_s), message, self._sensors())
        if answer is not Answer.NONE:
            answer_s = time_s + self._jitter.uniform(0.0, self._jitter_s)
            self._answers.append((max(answer_s, self._answers[-1][0] if self._answers else 0.0), answer))

    def _send_answer(self, time_s: float, answer: Answer) -> None:
        if answer is Answer.IDENTITY:
            self._send(time_s, self.firmware.identity())
            return
        for message in self.firmware.measurement(self._device_time_s(time_s), self._sensors()):
            self._send(time_s, message)

    def _send(self, time_s: float, message: Message) -> None:
        self.outbox.append(Packet(time_s, FUNCTION[type(message)], encode(message)))

    def _sensors(self) -> Sensors:
        plant = self.plant
        left_m, right_m = plant.left.position_m, plant.right.position_m
        switches = NO_SWITCH
        if left_m >= self._home_m:
            switches |= Switches.LEFT_OPEN
        elif left_m <= self._closed_m:
            switches |= Switches.LEFT_CLOSED
        if right_m >= self._home_m:
            switches |= Switches.RIGHT_OPEN
        elif right_m <= self._closed_m:
            switches |= Switches.RIGHT_CLOSED
        (left_rad, left_A), (right_rad, right_A) = plant.shafts
        left_counts, right_counts = self._encoders(left_rad, right_rad)
        left_start, right_start = self._counts_at_boot
        return Sensors(
            left_counts - left_start,
            right_counts - right_start,
            left_A,
            right_A,
            plant.sensed_force_N,
            math.floor(plant.handle_mm * self._handle_counts_per_mm),
            switches,
            self._supply_V,
            plant.element.temperature_C,
        )

    def _encoders(self, left_rad: float, right_rad: float) -> tuple[int, int]:
        stuck = self._stuck_left
        left_counts = math.floor(left_rad * self._counts_per_rad) if stuck is None else stuck
        return left_counts, math.floor(right_rad * self._counts_per_rad)

    def _strike(self, time_s: float, fault: Fault) -> None:
        match fault.name:
            case "worn_gearbox":
                self.plant.wear(WEAR)
            case "drag_left":
                self.plant.left.drag_N *= 1.0 + fault.percent / 100.0
            case "encoder_stuck_left":
                (left_rad, _), (right_rad, _) = self.plant.shafts
                self._stuck_left, _ = self._encoders(left_rad, right_rad)
            case "reset":
                self.firmware = self._boot(self.parameters)
                self._answers.clear()
                (left_rad, _), (right_rad, _) = self.plant.shafts
                self._counts_at_boot = self._encoders(left_rad, right_rad)
                self._boot_s = time_s
                self._ticks = 0
            case "commands_vanish":
                self._deaf = True
            case "supply_loss":
                self._supply_V = 0.0
                self._switch()
            case _:
                raise ValueError(f"fault {fault.name!r} has no effect defined")


class VirtualDevice:
    """The device behind a serial line: bytes in, bytes out, both paced to the baud rate.

    receive(now_s, data)   the host hands bytes to its port; they arrive one by one from then on
    transmit(now_s)        lets time pass until then, and gives the bytes whose last bit has left the line by then
    advance(now_s)         only lets time pass

    Times are the host's, seconds from power-on, and must not fall over all three (ValueError).
    """

    def __init__(
        self,
        parameters: PlantParameters,
        hand: Hand,
        faults: Iterable[Fault] = (),
        seed: int = 0,
        baud: int = DEFAULT_BAUD,
        boot: FirmwareKind = Firmware,
    ) -> None:
        if baud <= 0:
            raise ValueError(f"baud = {baud}: allowed are numbers over 0")
        self.messages = MessageDevice(parameters, hand, faults, seed, boot)
        self._byte_s = BITS_PER_BYTE / baud
        self._decoder = FrameDecoder()
        self._receiver_free_s = 0.0
        self._sequence = 0
        self._line: deque[tuple[float, bytes]] = deque()
        self._sender_free_s = 0.0

    @property
    def truth(self) -> Truth:
        """What really is, at the time of the last call."""
        return self.messages.truth

    @property
    def statistics(self) -> FramingStatistics:
        """What the device's frame decoder has seen."""
        return self._decoder.statistics

    def receive(self, now_s: float, data: bytes) -> None:
        """The host writes `data` now; what exceeds the line's buffers is lost."""
        self.messages.advance(now_s)
        start_s = max(now_s, self._receiver_free_s)
        room = MAX_BACKLOG_BYTES - math.ceil((start_s - now_s) / self._byte_s)
        data = data[: max(room, 0)]
        taken = 0
        for stretch in _stretches(data):
            taken += len(stretch)
            for frame in self._decoder.feed(stretch):
                self.messages.receive(start_s + taken * self._byte_s, frame.function, frame.payload)
        self._receiver_free_s = start_s + taken * self._byte_s

    def advance(self, now_s: float) -> None:
        """Let time pass until `now_s`."""
        self.messages.advance(now_s)
        outbox = self.messages.outbox
        while outbox:
            packet = outbox.popleft()
            frame = encode_frame(packet.function, self._sequence, packet.payload)
            self._sequence = (self._sequence + 1) % 256
            start_s = max(packet.time_s, self._sender_free_s)
            self._sender_free_s = start_s + len(frame) * self._byte_s
            self._line.append((start_s, frame))

    def transmit(self, now_s: float) -> bytes:
        """The bytes that have come out of the line since the last call."""
        self.advance(now_s)
        out = bytearray()
        while self._line:
            start_s, frame = self._line[0]
            # a millionth of a byte of tolerance: sums of times are not exact
            done = int((now_s - start_s) / self._byte_s + 1e-6)
            if done < len(frame):
                if done > 0:
                    out += frame[:done]
                    self._line[0] = start_s + done * self._byte_s, frame[done:]
                break
            out += frame
            self._line.popleft()
        return bytes(out)

    @property
    def next_event_s(self) -> float:
        """When there is next something to do: a frame that ends on the line, or an event inside the device."""
        event_s = self.messages.next_event_s
        if self._line:
            start_s, frame = self._line[0]
            event_s = min(event_s, start_s + len(frame) * self._byte_s)
        return event_s


def _stretches(data: bytes) -> list[bytes]:
    """`data` cut behind each delimiter, because a frame has arrived when its delimiter has."""
    if data.find(DELIMITER) == len(data) - 1:  # one frame, as nearly always
        return [data]
    *ended, rest = data.split(DELIMITER)
    return [*(stretch + DELIMITER for stretch in ended), rest]
