"""The virtual firmware: a state machine of device time, messages and sensors, without a clock or a line of its own.

    IDLE --Home--> HOMING --> IDLE, homed --Drive RUN--> RUN --Drive OFF, Retract, silence, fault--> RETRACTING
    RETRACTING --> IDLE at the open end, or LATCHED there when a fault is behind it; LATCHED --Clear--> IDLE

The safe state is the open gap, reached at a bounded speed. Friction holds the gap when the drives go off; where it does
not, the magnets pull the gap shut. So everything that ends a run opens first and switches off then.
"""

import math
from enum import Enum, auto
from typing import Final, final

from firmware_protocol.codec import (
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
    Retract,
    Sense,
    State,
    Status,
    Switches,
)
from firmware_protocol.value import Value
from tormagd.simulation.hand import ROLLER_RADIUS_MM
from tormagd.simulation.motion import Carriage, HomingMotion, Outcome, Retraction
from tormagd.simulation.parameters import PlantParameters

TICK_S: Final = 1e-3
STATUS_TICKS: Final = 20  # 50 Hz
COMMAND_TIMEOUT_S: Final = 0.05
OVERCURRENT_S: Final = 0.15  # a reversal at full speed takes about 50 ms of high current
MAX_SKEW_MM: Final = 2.0
MAX_SLIP_MM: Final = 0.2
COASTING_S: Final = 0.1  # a carriage may go on this long before its motion counts as uncommanded
MIN_SUPPLY_V: Final = 9.0
MAX_SUPPLY_V: Final = 15.0
MAX_TEMPERATURE_C: Final = 60.0
VERSION: Final = (1, 0)
SERIAL_NUMBER: Final = 1

# looking up an enumeration's member takes a fifth of a microsecond, an operation on flags a whole one: what every tick
# needs is made here
HOMED_SWITCHES: Final = [Switches(bits) | Switches.HOMED for bits in range(16)]
CLOSED_SWITCHES: Final = Switches.LEFT_CLOSED | Switches.RIGHT_CLOSED
NO_FAULT: Final = DeviceFault(0)

IDLE: Final = DeviceMode.IDLE
RUN: Final = DeviceMode.RUN
HOMING: Final = DeviceMode.HOMING
RETRACTING: Final = DeviceMode.RETRACTING
LATCHED: Final = DeviceMode.LATCHED
DRIVES_OFF: Final = DriveMode.OFF


@final
class Sensors(Value):
    """What the electronics measure. Encoder counts are since boot, positive opening."""

    def __init__(
        self,
        left_counts: int,
        right_counts: int,
        left_current_A: float,
        right_current_A: float,
        force_N: float,
        handle_counts: int,
        switches: Switches,
        supply_V: float,
        temperature_C: float,
    ) -> None:
        self.left_counts: Final = left_counts
        self.right_counts: Final = right_counts
        self.left_current_A: Final = left_current_A
        self.right_current_A: Final = right_current_A
        self.force_N: Final = force_N
        self.handle_counts: Final = handle_counts
        self.switches: Final = switches
        self.supply_V: Final = supply_V
        self.temperature_C: Final = temperature_C


@final
class Output(Value):
    """State of both bridges: duties in -1..1, or open when not `enabled`."""

    def __init__(self, left_duty: float, right_duty: float, enabled: bool) -> None:
        self.left_duty: Final = left_duty
        self.right_duty: Final = right_duty
        self.enabled: Final = enabled


OFF: Final = Output(0.0, 0.0, enabled=False)


class Answer(Enum):
    NONE = auto()
    IDENTITY = auto()
    MEASUREMENT = auto()


NO_ANSWER: Final = Answer.NONE
IDENTITY: Final = Answer.IDENTITY
MEASUREMENT: Final = Answer.MEASUREMENT


@final
class Firmware:
    """One device's firmware from its boot on. Times are device time, seconds since boot, and never fall."""

    def __init__(self, plant: PlantParameters) -> None:
        self._lead_mm_rev = plant.screw.lead_mm
        self._mm_per_count = plant.screw.lead_mm / plant.electronics.encoder_counts_per_rev
        self._handle_mm_per_count = math.tau * ROLLER_RADIUS_MM / plant.assumed.handle_counts_per_rev
        self._retract_mm_s = plant.assumed.retract_mm_s
        self._homing_mm_s = plant.assumed.homing_mm_s
        self._overcurrent_A = plant.assumed.overcurrent_A

        self.mode: DeviceMode = IDLE
        self.faults: DeviceFault = NO_FAULT
        self.homed = False
        self.output: Output = OFF
        self._left_zero_mm = 0.0
        self._right_zero_mm = 0.0
        self._compatible = False
        self._may_run = True
        self._motion: Retraction | HomingMotion | None = None
        self._drive_counter: int | None = None
        self._drive_s = 0.0
        self._nonce = 0
        self._left_calm_s = 0.0
        self._right_calm_s = 0.0
        self._watch_since_s = 0.0
        self._watch_counts: tuple[int, int] | None = None
        self._ticks = 0
        self._state_counter = 0

    def receive(self, time_s: float, message: Message, sensors: Sensors) -> Answer:
        """Act on one message of the host, and return what to answer."""
        if isinstance(message, Drive):
            return self._drive(time_s, message, sensors)
        if isinstance(message, Hello):
            # a new host starts from a known nonce
            self._nonce = message.nonce
            self._compatible = message.schema_hash == SCHEMA_HASH and message.protocol_version == PROTOCOL_VERSION
            if not self._compatible:
                self._fail(time_s, DeviceFault.SCHEMA_MISMATCH, sensors)
            return IDENTITY
        if not isinstance(message, Retract | Home | Clear):
            return NO_ANSWER
        if message.nonce != self._nonce and self._obey(time_s, message, sensors):
            self._nonce = message.nonce
        return NO_ANSWER

    def _drive(self, time_s: float, drive: Drive, sensors: Sensors) -> Answer:
        """Act on a Drive; a new one is answered in every mode, so that a host can always measure."""
        if drive.counter == self._drive_counter:
            return NO_ANSWER
        self._drive_counter = drive.counter
        if drive.mode is DRIVES_OFF:
            if self.mode is RUN:
                self._retract(time_s, sensors)
            # a host that was put off RUN has to let go once before it gets there again
            self._may_run = True
            return MEASUREMENT
        if self.mode is IDLE and self._may_run and self.homed and self._compatible and not self.faults:
            self.mode = RUN
            self._calm(time_s)
        if self.mode is RUN:
            self._drive_s = time_s
            self.output = self._bounded(Output(drive.left_duty, drive.right_duty, enabled=True), sensors)
        return MEASUREMENT

    def _obey(self, time_s: float, command: Retract | Home | Clear, sensors: Sensors) -> bool:
        """Carry out `command` unless the mode forbids it, and return whether it did."""
        if isinstance(command, Retract):
            if self.mode is LATCHED:
                return False
            if self.mode is not RETRACTING:
                self._retract(time_s, sensors)
            return True
        if isinstance(command, Home):
            if self.mode is not IDLE:
                return False
            self.mode = HOMING
            self.homed = False
            self._calm(time_s)
            self._motion = HomingMotion(
                time_s,
                self._carriages(sensors),
                lead_mm_rev=self._lead_mm_rev,
                stall_A=self._overcurrent_A,
                speed_mm_s=self._homing_mm_s,
            )
            return True
        causes = self._lasting_causes(sensors)
        mismatch = DeviceFault.SCHEMA_MISMATCH in self.faults and not self._compatible
        if self._motors_on or causes or mismatch:
            return False
        self.faults = NO_FAULT
        self._rest(time_s, IDLE)
        return True

    def tick(self, time_s: float, sensors: Sensors) -> Status | None:
        """Run one 1 kHz tick: the motion under way and the watches."""
        if self.mode is RUN:
            self._tick_run(time_s, sensors)
        elif self._motors_on:
            self._tick_motion(time_s, sensors)
        else:
            self._tick_rest(time_s, sensors)
        self._ticks += 1
        return None if self._ticks % STATUS_TICKS else self.status(sensors)

    def _tick_run(self, time_s: float, sensors: Sensors) -> None:
        left_mm, right_mm = self._positions_mm(sensors)
        fault = self._causes(time_s, sensors)
        if time_s - self._drive_s > COMMAND_TIMEOUT_S:
            fault |= DeviceFault.COMMAND_TIMEOUT
        if sensors.switches and sensors.switches & CLOSED_SWITCHES:
            fault |= DeviceFault.END_STOP
        if abs(left_mm - right_mm) > MAX_SKEW_MM:
            fault |= DeviceFault.SKEW
        if fault:
            self._fail(time_s, fault, sensors)
            return
        self.output = self._bounded(self.output, sensors)

    def _tick_motion(self, time_s: float, sensors: Sensors) -> None:
        motion = self._motion
        assert motion is not None, "HOMING and RETRACTING always have their motion"
        homing = isinstance(motion, HomingMotion)
        if homing and (causes := self._causes(time_s, sensors)):
            self._fail(time_s, causes, sensors)
            return
        if isinstance(motion, Retraction) and not motion.blocked and self._slip_mm(time_s, sensors) > MAX_SLIP_MM:
            self.faults |= DeviceFault.UNCOMMANDED_MOTION
        if isinstance(motion, Retraction) and motion.is_late(time_s):
            self.faults |= DeviceFault.RETRACT_FAILED
        outcome = motion.step(time_s, TICK_S, self._carriages(sensors))
        left_duty, right_duty = motion.duties
        self.output = Output(left_duty, right_duty, enabled=True)
        if outcome is Outcome.MOVING:
            return
        if outcome is Outcome.REVERSED:
            # friction holds the gap where it is
            self.faults |= DeviceFault.HOMING_FAILED
            self._rest(time_s, LATCHED)
            return
        if outcome is Outcome.FAILED and homing:
            self._fail(time_s, DeviceFault.HOMING_FAILED, sensors)
            return
        if outcome is Outcome.FAILED:
            self.faults |= DeviceFault.RETRACT_FAILED
        elif isinstance(motion, HomingMotion):
            left_mm, right_mm = motion.zeros_mm
            self._left_zero_mm += left_mm
            self._right_zero_mm += right_mm
            self.homed = True
        self._rest(time_s, LATCHED if self.faults else IDLE)

    def _tick_rest(self, time_s: float, sensors: Sensors) -> None:
        if self._slip_mm(time_s, sensors) > MAX_SLIP_MM:
            self._fail(time_s, DeviceFault.UNCOMMANDED_MOTION, sensors)
            return
        causes = self._lasting_causes(sensors)
        if causes and (new := causes & ~self.faults):
            self._fail(time_s, new, sensors)

    @staticmethod
    def _bounded(output: Output, sensors: Sensors) -> Output:
        """Keep a carriage at its open switch from running into the stop."""
        if not sensors.switches:
            return output
        return Output(
            min(output.left_duty, 0.0) if Switches.LEFT_OPEN in sensors.switches else output.left_duty,
            min(output.right_duty, 0.0) if Switches.RIGHT_OPEN in sensors.switches else output.right_duty,
            output.enabled,
        )

    def _fail(self, time_s: float, fault: DeviceFault, sensors: Sensors) -> None:
        """Latch `fault` and open the gap; drives that are off stay off, unless the carriages move."""
        self.faults |= fault
        if not self._motors_on and DeviceFault.UNCOMMANDED_MOTION not in fault:
            self._rest(time_s, LATCHED)
        elif self.mode is not RETRACTING:
            self._retract(time_s, sensors)

    def _retract(self, time_s: float, sensors: Sensors) -> None:
        if self.mode is RUN:
            self._may_run = False
        self.mode = RETRACTING
        self._watch_since_s = time_s
        self._watch_counts = None
        self._motion = Retraction(
            time_s,
            self._carriages(sensors),
            lead_mm_rev=self._lead_mm_rev,
            stall_A=self._overcurrent_A,
            speed_mm_s=self._retract_mm_s if self.homed else self._homing_mm_s,
            tapered=self.homed,
        )

    def _rest(self, time_s: float, mode: DeviceMode) -> None:
        """Open the bridges and enter `mode`; LATCHED also makes the device unhomed."""
        self.mode = mode
        self.output = OFF
        self._motion = None
        self._watch_since_s = time_s
        self._watch_counts = None
        if mode is LATCHED:
            self.homed = False

    @property
    def _motors_on(self) -> bool:
        return self.mode is not IDLE and self.mode is not LATCHED

    def _lasting_causes(self, sensors: Sensors) -> DeviceFault:
        causes = NO_FAULT
        if not MIN_SUPPLY_V <= sensors.supply_V <= MAX_SUPPLY_V:
            causes |= DeviceFault.SUPPLY
        if sensors.temperature_C > MAX_TEMPERATURE_C:
            causes |= DeviceFault.TEMPERATURE
        return causes

    def _causes(self, time_s: float, sensors: Sensors) -> DeviceFault:
        """Return the lasting causes, and OVERCURRENT after too long a high current."""
        if abs(sensors.left_current_A) < self._overcurrent_A:
            self._left_calm_s = time_s
        if abs(sensors.right_current_A) < self._overcurrent_A:
            self._right_calm_s = time_s
        causes = self._lasting_causes(sensors)
        calm_s = self._left_calm_s if self._left_calm_s < self._right_calm_s else self._right_calm_s
        return causes | DeviceFault.OVERCURRENT if time_s - calm_s > OVERCURRENT_S else causes

    def _calm(self, time_s: float) -> None:
        self._left_calm_s = time_s
        self._right_calm_s = time_s

    def _slip_mm(self, time_s: float, sensors: Sensors) -> float:
        """Return how far a carriage has moved from where it rested."""
        if time_s - self._watch_since_s < COASTING_S:
            return 0.0
        left, right = sensors.left_counts, sensors.right_counts
        if self._watch_counts is None:
            self._watch_counts = left, right
        left_then, right_then = self._watch_counts
        if self.mode is RETRACTING and (left > left_then or right > right_then):
            left_then, right_then = max(left, left_then), max(right, right_then)
            self._watch_counts = left_then, right_then
        return max(abs(left - left_then), abs(right - right_then)) * self._mm_per_count

    def _positions_mm(self, sensors: Sensors) -> tuple[float, float]:
        mm_per_count = self._mm_per_count
        return (
            sensors.left_counts * mm_per_count - self._left_zero_mm,
            sensors.right_counts * mm_per_count - self._right_zero_mm,
        )

    def _carriages(self, sensors: Sensors) -> tuple[Carriage, Carriage]:
        left_mm, right_mm = self._positions_mm(sensors)
        return (
            Carriage(left_mm, Switches.LEFT_OPEN in sensors.switches, sensors.left_current_A),
            Carriage(right_mm, Switches.RIGHT_OPEN in sensors.switches, sensors.right_current_A),
        )

    def identity(self) -> Identity:
        return Identity(SCHEMA_HASH, VERSION[0], VERSION[1], SERIAL_NUMBER)

    def status(self, sensors: Sensors) -> Status:
        ends: int = sensors.switches
        return Status(
            mode=self.mode,
            switches=HOMED_SWITCHES[ends] if self.homed else sensors.switches,
            faults=self.faults,
            temperature_C=sensors.temperature_C,
            supply_V=sensors.supply_V,
            drive_counter=self._drive_counter or 0,
            command_nonce=self._nonce,
        )

    def measurement(self, time_s: float, sensors: Sensors) -> tuple[State, Sense]:
        """Return State and Sense, and advance State's counter."""
        left_mm, right_mm = self._positions_mm(sensors)
        self._state_counter = (self._state_counter + 1) % 256
        return (
            State(left_mm, right_mm, time_s, self._state_counter),
            Sense(
                sensors.left_current_A,
                sensors.right_current_A,
                sensors.force_N,
                sensors.handle_counts * self._handle_mm_per_count,
            ),
        )
