"""The closed loop in virtual time: the daemon's core against the simulated device, as fast as the processor goes.

`plan` and `step`, the connection and the protocol bytes are the daemon's own; only time, sockets and the port are
replaced.
"""

from bisect import bisect_right
from collections.abc import Callable, Iterable
from typing import Final, Self, final

import numpy as np
import numpy.typing as npt

from firmware_protocol.codec import Message
from firmware_protocol.value import Value
from tormagd.config import Config
from tormagd.control.assembly.conditions import conditions
from tormagd.control.core import Planner, Stepper
from tormagd.control.move.actuator import Reference
from tormagd.control.records import Duty, Measured, Plan, TimedSetpoint
from tormagd.control.safety.operating_state import Conditions, OperatingState, SafetyState
from tormagd.element.inverse.solution import Question
from tormagd.hardware.connection import Connection
from tormagd.hardware.measurement import Measurement
from tormagd.hardware.streams import CanStream, FrameStream
from tormagd.simulation.can_device import DEFAULT_NODE, DEVICE, CanFrame, CanLine
from tormagd.simulation.device import MessageDevice, SerialDevice
from tormagd.simulation.plant import Truth

Array = npt.NDArray[np.float64]
HOMING_S: Final = 10.0
"The slowest homing takes less."
SEARCH_S: Final = 0.012
"A search beside the plans takes a period of the thesis's 83 Hz."
MAX_UNREAD_BYTES: Final = 4096
"Bytes that a serial port keeps for a program that does not read."
MAX_UNREAD_FRAMES: Final = 512
"Frames that a CAN socket keeps for a program that does not read, about."


@final
class Sample(Value):
    """One control tick: what was asked, what the controller knew, and the plant's true state."""

    def __init__(
        self,
        time_s: float,
        measured: Measured | None,
        safety: SafetyState,
        reference: Reference | None,
        output: Duty,
        plan: Plan,
        truth: Truth,
        measurement: Measurement | None,
    ) -> None:
        self.time_s: Final = time_s
        self.measured: Final = measured
        self.safety: Final = safety
        self.reference: Final = reference
        self.output: Final = output
        self.plan: Final = plan
        self.truth: Final = truth
        self.measurement: Final = measurement


class VirtualPort:
    """Backend to the simulated device over serial bytes. `device` may be replaced by one that behaves badly."""

    def __init__(self, device: SerialDevice) -> None:
        self.now_s = 0.0
        self.device = device
        self.stream = FrameStream()
        self._unread = b""

    def open(self) -> Self:
        self.stream, self._unread = FrameStream(), b""
        return self

    def advance(self, now_s: float) -> None:
        self.now_s = now_s
        self._unread = self._unread[-MAX_UNREAD_BYTES:] + self.device.transmit(now_s)

    def receive(self) -> list[Message]:
        arrived, self._unread = self._unread, b""
        return self.stream.unpack(arrived)

    def send(self, message: Message) -> None:
        self.device.receive(self.now_s, self.stream.pack(message))

    def close(self) -> None:
        """Do nothing: a virtual port holds no resource."""


class VirtualBus:
    """Backend to a simulated device on a CAN bus, with the real backend's codec of frames."""

    def __init__(self, device: CanLine) -> None:
        self.now_s = 0.0
        self.device = device
        self.stream = CanStream(DEFAULT_NODE)
        self._unread: list[CanFrame] = []

    def open(self) -> Self:
        self.stream = CanStream(DEFAULT_NODE)
        self._unread.clear()
        return self

    def advance(self, now_s: float) -> None:
        self.now_s = now_s
        arrived = [delivery.frame for delivery in self.device.transmit(now_s) if delivery.sender == DEVICE]
        self._unread = [*self._unread, *arrived][-MAX_UNREAD_FRAMES:]

    def receive(self) -> list[Message]:
        """Return the device's valid messages in the frames that wait."""
        arrived, self._unread = self._unread, []
        self.stream.received = []
        return self.stream.unpack_all(arrived)

    def send(self, message: Message) -> None:
        identifier, data = self.stream.pack(message)
        self.device.receive(self.now_s, CanFrame(identifier, data))

    def close(self) -> None:
        """Do nothing: a virtual bus holds no resource."""


class ClosedLoop:
    """A daemon's core and its simulated device in one process and one virtual time, which starts at 0."""

    def __init__(
        self, config: Config, stepper: Stepper, planner: Planner | None, device: SerialDevice | VirtualBus
    ) -> None:
        self._config, self.stepper, self.planner = config, stepper, planner
        self._period_s = 1.0 / config.rates.control_hz
        self._inference_s = 1.0 / config.rates.inference_hz
        self._ticks = 0
        self._output: Duty | None = None
        self._asked: Question | None = None
        self.port: VirtualPort | VirtualBus = device if isinstance(device, VirtualBus) else VirtualPort(device)
        self.connection = Connection(config.device, self.port.open, stepper.lose_link)
        self.connection.open(0.0)

    @property
    def now_s(self) -> float:
        return self._ticks * self._period_s

    @property
    def simulated(self) -> MessageDevice:
        return self.port.device.messages

    @property
    def measurement(self) -> Measurement | None:
        return self.connection.measurement

    def tick(self, setpoint: TimedSetpoint | None = None, plan: Plan | None = None) -> Sample:
        """Run one control period, and return what happened in it."""
        self._ticks += 1
        now_s = self.now_s
        self.port.advance(now_s)
        self.connection.receive(now_s)
        used = self._infer(now_s, setpoint) if plan is None else plan
        measurement, stepper = self.connection.measurement, self.stepper
        output = stepper.step(now_s, measurement, used)
        self.connection.exchange(
            now_s, output.left_duty, output.right_duty, output.mode, output.request, output.request_number
        )
        self._output = output
        measured, safety, reference = stepper.measured, stepper.safety, stepper.move.reference
        return Sample(now_s, measured, safety, reference, output, used, self.simulated.truth, measurement)

    def skip(self) -> None:
        """Let one control period pass in which the daemon, stopped or killed, does nothing."""
        self._ticks += 1
        self.port.advance(self.now_s)

    def command(self, name: str) -> None:
        self.stepper.command(name, self.now_s, self.conditions())

    def conditions(self) -> Conditions:
        doubted = self.planner is not None and self.planner.believe.sensor.is_doubted
        connection, stepper = self.connection, self.stepper
        return conditions(self.now_s, self._config, connection, stepper, self._output, sensor_doubted=doubted)

    def run(
        self, duration_s: float, setpoint: Callable[[float], TimedSetpoint | None] = lambda now_s: None
    ) -> Iterable[Sample]:
        for _ in range(round(duration_s / self._period_s)):
            yield self.tick(setpoint(self.now_s))

    def hold(self, gap_mm: float, duration_s: float) -> Iterable[Sample]:
        """Run with plans that ask for a gap."""
        for _ in range(round(duration_s / self._period_s)):
            yield self.tick(plan=gap_plan(gap_mm, self.now_s))

    def arm(self, plan: Plan | None = None) -> None:
        """Connect, home and enable, as an operator does."""
        self._until(lambda m: True, "answer", plan)
        self.command("home")
        self._until(lambda m: m.is_busy, "start homing", plan)
        self._until(lambda m: not m.is_busy and m.is_homed, "home", plan)
        self.command("enable")
        if self.stepper.safety.operating_state is not OperatingState.ENABLED:
            raise RuntimeError(f"not enabled: {self.stepper.safety}")

    def _infer(self, now_s: float, setpoint: TimedSetpoint | None) -> Plan:
        """Plan where the setpoint is new or the inference period is over, and return the newest plan."""
        planner = self.planner
        assert planner is not None, "a loop without a planner takes a plan at every tick"
        is_new = setpoint is not None and setpoint.stamp_s > planner.planned.stamp_s
        is_asked = is_new and self._config.rates.plan_every_setpoint
        if is_asked or now_s - planner.planned.time_s >= self._inference_s - 1e-9:
            self._answer_question(planner, now_s)
            planner.plan(now_s, setpoint, self.stepper.measured, self.stepper.is_followed)
            planner.governor.foresee()
            self._asked = self._asked or planner.aim.question
        return planner.planned

    def _answer_question(self, planner: Planner, now_s: float) -> None:
        """Answer the pending question once SEARCH_S is over."""
        asked = self._asked
        if asked is not None and now_s - asked.time_s >= SEARCH_S - 1e-9:
            planner.aim.answer = planner.aim.answer_to(asked)
            self._asked = None

    def _until(self, reached: Callable[[Measurement], bool], what: str, plan: Plan | None) -> None:
        """Run at least one tick, without a setpoint, until `reached` is true of a measurement."""
        for _ in range(round(HOMING_S / self._period_s)):
            self.tick(plan=plan)
            if self.measurement is not None and reached(self.measurement):
                return
        link = f"{self.connection.state} {self.connection.cause}"
        raise RuntimeError(f"the device did not {what} within {HOMING_S:g} s: {link}")


def stream(times_s: Array, forces_N: Array, valid_for_s: float = 0.1) -> Callable[[float], TimedSetpoint | None]:
    """Return a function from the time to the newest setpoint of a publisher."""
    sent_s: list[float] = times_s.tolist()
    sent_N: list[float] = forces_N.tolist()

    def newest(now_s: float) -> TimedSetpoint | None:
        sent = bisect_right(sent_s, now_s)
        return TimedSetpoint(sent_N[sent - 1], sent_s[sent - 1], valid_for_s) if sent else None

    return newest


def gap_plan(gap_mm: float, now_s: float = 0.0) -> Plan:
    return Plan(1, now_s, None, None, 0.0, None, 0.0, gap_mm, 0.0, 1.0, ())
