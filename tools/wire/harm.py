"""What a false accept can do: it is put into a running closed loop at the patient's force, and the brake is watched.

The daemon's core, the link, the firmware and the plant run in virtual time, as in every closed-loop test. Each life
starts from the same armed loop, armed anew.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from tqdm import tqdm

from firmware_protocol.codec import FUNCTION, DeviceMode, Drive, DriveMode, Message, State, encode
from firmware_protocol.framing import FrameDecoder, encode_frame
from tormagd.closed_loop import ClosedLoop
from tormagd.config import load_config
from tormagd.control.core import build_core
from tormagd.control.governor import TimedSetpoint
from tormagd.simulation.device import SerialDevice, VirtualDevice
from tormagd.simulation.hand import SteadyHand
from tormagd.simulation.parameters import load_plant
from tormagd.simulation.plant import Truth
from wire.receivers import firmware_kind

FORCE_N = 1.8
SETTLING_S = 1.0
LIFE_TICKS = 60
"""Longer than the device's command timeout."""
BARRAGE = 50
"""False accepts in a row, one a millisecond."""
AFTER_DRIVE_S = 6e-4
"""Where in a millisecond a false message reaches the device: behind the daemon's own."""
STUCK_TICKS = 200
RISE_ALLOWED_N = 0.5
"""How far over the setpoint one false accept may carry the force."""


@dataclass
class Harm:
    """The worst of all lives. `violations` are ticks with a duty out of bounds or not finite."""

    lives: int = 0
    false_accepts: int = 0
    violations: int = 0
    greatest_duty: float = 0.0
    greatest_force_N: float = 0.0
    least_gap_mm: float = math.inf
    ended: dict[str, int] = field(default_factory=dict)

    @property
    def rise_N(self) -> float:
        """Force over the setpoint."""
        return self.greatest_force_N - FORCE_N

    def see(self, loop: ClosedLoop, duty_limit: float, duties: tuple[float, float]) -> None:
        """Takes one tick."""
        device = loop.device.messages.firmware.output
        asked = max(map(abs, duties))
        done = max(abs(device.left_duty), abs(device.right_duty))
        values = (*duties, device.left_duty, device.right_duty, loop.device.truth.force_N, loop.device.truth.gap_mm)
        if not all(map(math.isfinite, values)) or asked > duty_limit or done > 1.0:
            self.violations += 1
        self.greatest_duty = max(self.greatest_duty, asked, done)
        self.greatest_force_N = max(self.greatest_force_N, loop.device.truth.force_N)
        self.least_gap_mm = min(self.least_gap_mm, loop.device.truth.gap_mm)

    def end(self, loop: ClosedLoop) -> None:
        """Takes the end of a life."""
        self.lives += 1
        state = f"daemon {loop.step_state.safety.operating_state}, device {loop.device.messages.firmware.mode.name}"
        self.ended[state] = self.ended.get(state, 0) + 1


class Patient:
    """A loop that renders a steady force, and what is done to it."""

    def __init__(self) -> None:
        self._config = load_config(None)
        self._core = build_core(self._config)
        self._plant, self._boot = load_plant("sample_1"), firmware_kind()
        self._duty_limit = self._config.position.duty_limit

    def _armed(self) -> ClosedLoop:
        """The same loop every time, to the bit."""
        device = VirtualDevice(self._plant, SteadyHand(), seed=1, boot=self._boot)
        loop = ClosedLoop(self._config, self._core.stepper, self._core.planner, device)
        loop.arm()
        for _ in loop.run(SETTLING_S, _publisher):
            pass
        return loop

    def suffer(self, messages: Iterable[Message], at_once: int, rng: np.random.Generator, progress: str) -> Harm:
        """Each life gets `at_once` of the messages, one a tick from a random tick on."""
        harm = Harm()
        waiting = list(messages)
        for start in tqdm(range(0, len(waiting), at_once), desc=progress, unit="life", disable=None, leave=False):
            loop = self._armed()
            volley = waiting[start : start + at_once]
            first = int(rng.integers(0, 10))
            for tick in range(first + len(volley) + LIFE_TICKS):
                if 0 <= tick - first < len(volley):
                    _inject(loop, volley[tick - first])
                output = loop.tick(_publisher(loop.now_s)).output
                harm.see(loop, self._duty_limit, (output.left_duty, output.right_duty))
            harm.false_accepts += len(volley)
            harm.end(loop)
        return harm

    def stuck_drive_ms(self) -> float | None:
        """How long a device in RUN goes on with a host that repeats one Drive for ever; null for ever."""
        loop = self._armed()
        loop.tick(_publisher(loop.now_s))
        drive = encode(Drive(-0.2, -0.2, DriveMode.RUN, counter=77))
        loop.device.messages.receive(loop.now_s + AFTER_DRIVE_S, FUNCTION[Drive], drive)
        started_s = loop.now_s
        for _ in range(STUCK_TICKS):
            loop.skip()
            if loop.device.messages.firmware.mode is not DeviceMode.RUN:
                return round((loop.now_s - started_s) * 1e3, 1)
            loop.device.messages.receive(loop.now_s, FUNCTION[Drive], drive)
        return None

    def stuck_state_ms(self) -> float | None:
        """How long the daemon goes on with a device that repeats one State for ever; null for ever."""
        loop = self._armed()
        loop.device = StuckSender(loop.device)
        started_s = loop.now_s
        for _ in range(STUCK_TICKS):
            if loop.tick(_publisher(loop.now_s)).state.safety.faults:
                return round((loop.now_s - started_s) * 1e3, 1)
        return None


class StuckSender:
    """A `SerialDevice` whose States all repeat its first one; frames, sequence numbers and checksums are right."""

    def __init__(self, device: SerialDevice) -> None:
        self._device = device
        self.messages = device.messages
        self._heard = FrameDecoder()
        self._sent = 0
        self._stuck: bytes | None = None

    @property
    def truth(self) -> Truth:
        """As the device's own."""
        return self._device.truth

    def receive(self, now_s: float, data: bytes) -> None:
        """As the device's own."""
        self._device.receive(now_s, data)

    def transmit(self, now_s: float) -> bytes:
        """As the device's own, with the State replaced."""
        out = b""
        for frame in self._heard.feed(self._device.transmit(now_s)):
            payload = frame.payload
            if frame.function == FUNCTION[State]:
                payload = self._stuck = self._stuck or payload
            out += encode_frame(frame.function, self._sent, payload)
            self._sent = (self._sent + 1) % 256
        return out


def _publisher(now_s: float) -> TimedSetpoint:
    return TimedSetpoint(FORCE_N, now_s, 0.1)


def _inject(loop: ClosedLoop, message: Message) -> None:
    """The message comes to both ends; each makes of it what it does."""
    if loop.connection.link is not None:
        loop.connection.link.receive(loop.now_s, message)
    loop.device.messages.receive(loop.now_s + AFTER_DRIVE_S, FUNCTION[type(message)], encode(message))
