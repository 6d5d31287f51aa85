"""The virtual firmware: a state machine of device time, messages and sensors, without a clock or a line of its own.

    IDLE --Home--> HOMING --> IDLE, homed --Drive RUN--> RUN --Drive OFF, Retract, silence, fault--> RETRACTING
    RETRACTING --> IDLE at the open end, or LATCHED there when a fault is behind it; LATCHED --Clear--> IDLE

The safe state is the open gap, reached at a bounded speed: friction holds the gap when the drives go off, and when it
does not, the magnets pull it shut. So everything that ends a run opens first and switches off then.
"""

import math
from enum import Enum, auto
from typing import NamedTuple

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
from tormagd.simulation.hand import ROLLER_RADIUS_MM
from tormagd.simulation.motion import Carriage, Homing, Outcome, Retraction
from tormagd.simulation.parameters import PlantParameters

TICK_S = 1e-3
STATUS_TICKS = 20  # 50 Hz
COMMAND_TIMEOUT_S = 0.05
OVERCURRENT_S = 0.15  # a reversal at full speed takes about 50 ms of high current
MAX_SKEW_MM = 2.0
MAX_SLIP_MM = 0.2
COASTING_S = 0.1  # a carriage may go on this long before its motion counts as uncommanded
SUPPLY_RANGE_V = (9.0, 15.0)
MAX_TEMPERATURE_C = 60.0
VERSION = (1, 0)
SERIAL_NUMBER = 1

# Operations on flags make new ones, at a microsecond each: what is needed in every tick is made here
NO_SWITCH = Switches(0)
CLOSED_SWITCHES = Switches.LEFT_CLOSED | Switches.RIGHT_CLOSED
NO_FAULT = DeviceFault(0)

MOTORS_OFF_MODES = (DeviceMode.IDLE, DeviceMode.LATCHED)
LASTING_CAUSES = DeviceFault.SUPPLY | DeviceFault.TEMPERATURE


class Sensors(NamedTuple):
    """What the electronics measure; encoder counts since power-on, positive opening."""

    left_counts: int
    right_counts: int
    left_current_A: float
    right_current_A: float
    force_N: float
    handle_counts: int
    switches: Switches
    supply_V: float
    temperature_C: float


class Output(NamedTuple):
    """What the bridges do: duties in [-1, 1], or open."""

    left_duty: float
    right_duty: float
    enabled: bool


OFF = Output(0.0, 0.0, enabled=False)


class Answer(Enum):
    """What a received message calls for."""

    NONE = auto()
    IDENTITY = auto()
    MEASUREMENT = auto()


class Firmware:
    """One device's firmware from its boot on. All times are device time, in seconds since the boot, never falling."""

    def __init__(self, plant: PlantParameters) -> None:
        self._lead_mm_rev = plant.screw.lead_mm
        self._mm_per_count = plant.screw.lead_mm / plant.electronics.encoder_counts_per_rev
        self._handle_mm_per_count = math.tau * ROLLER_RADIUS_MM / plant.assumed.handle_counts_per_rev
        self._retract_mm_s = plant.assumed.retract_mm_s
        self._homing_mm_s = plant.assumed.homing_mm_s
        self._overcurrent_A = plant.assumed.overcurrent_A

        self.mode = DeviceMode.IDLE
        self.faults = DeviceFault(0)
        self.homed = False
        self.output = OFF
        self._zeros_mm = (0.0, 0.0)
        self._compatible = False
        self._may_run = True
        self._motion: Retraction | Homing | None = None
        self._drive_counter: int | None = None
        self._drive_s = 0.0
        self._nonce: int | None = None
        self._calm_s = [0.0, 0.0]
        self._watch_since_s = 0.0
        self._watch_counts: tuple[int, int] | None = None
        self._ticks = 0
        self._state_counter = 0

    # -- messages ------------------------------------------------------------------------------------------------

    def receive(self, time_s: float, message: Message, sensors: Sensors) -> Answer:
        """Act on one message of the host; those of a device are ignored."""
        match message:
            case Drive():
                return self._drive(time_s, message, sensors)
            case Hello():
                # accepted whatever it was before, so that a new host starts from a known nonce
                self._nonce = message.nonce
                self._compatible = message.schema_hash == SCHEMA_HASH and message.protocol_version == PROTOCOL_VERSION
                if not self._compatible:
                    self._fail(time_s, DeviceFault.SCHEMA_MISMATCH, sensors)
                return Answer.IDENTITY
            case Retract() | Home() | Clear():
                if message.nonce != self._nonce and self._obey(time_s, message, sensors):
                    self._nonce = message.nonce
                return Answer.NONE
            case _:
                return Answer.NONE

    def _drive(self, time_s: float, drive: Drive, sensors: Sensors) -> Answer:
        """A Drive with a new counter is answered in every mode, so that a host can always measure."""
        if drive.counter == self._drive_counter:
            return Answer.NONE
        self._drive_counter = drive.counter
        if drive.mode is DriveMode.OFF:
            if self.mode is DeviceMode.RUN:
                self._retract(time_s, sensors)
            # a host that was put off RUN has to let go once before it gets there again
            self._may_run = True
            return Answer.MEASUREMENT
        if self.mode is DeviceMode.IDLE and self._may_run and self.homed and self._compatible and not self.faults:
            self.mode = DeviceMode.RUN
            self._calm_s = [time_s, time_s]
        if self.mode is DeviceMode.RUN:
            self._drive_s = time_s
            self.output = self._bounded(Output(drive.left_duty, drive.right_duty, enabled=True), sensors)
        return Answer.MEASUREMENT

    def _obey(self, time_s: float, command: Retract | Home | Clear, sensors: Sensors) -> bool:
        """Whether the command was accepted; only an accepted one is acknowledged in Status."""
        match command:
            case Retract():
                if self.mode is DeviceMode.LATCHED:
                    return False
                if self.mode is not DeviceMode.RETRACTING:
                    self._retract(time_s, sensors)
                return True
            case Home():
                if self.mode is not DeviceMode.IDLE:
                    return False
                self.mode = DeviceMode.HOMING
                self.homed = False
                self._calm_s = [time_s, time_s]
                self._motion = Homing(
                    time_s,
                    self._carriages(sensors),
                    lead_mm_rev=self._lead_mm_rev,
                    stall_A=self._overcurrent_A,
                    speed_mm_s=self._homing_mm_s,
                )
                return True
            case Clear():
                causes = self._lasting_causes(sensors)
                mismatch = DeviceFault.SCHEMA_MISMATCH in self.faults and not self._compatible
                if self.mode not in MOTORS_OFF_MODES or causes or mismatch:
                    return False
                self.faults = DeviceFault(0)
                self._rest(time_s, DeviceMode.IDLE)
                return True

    # -- time ----------------------------------------------------------------------------------------------------

    def tick(self, time_s: float, sensors: Sensors) -> Status | None:
        """The 1 kHz tick: motions and watches; every twentieth gives a Status."""
        match self.mode:
            case DeviceMode.RUN:
                self._tick_run(time_s, sensors)
            case DeviceMode.HOMING | DeviceMode.RETRACTING:
                self._tick_motion(time_s, sensors)
            case DeviceMode.IDLE | DeviceMode.LATCHED:
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
        homing = isinstance(motion, Homing)
        if homing and (causes := self._causes(time_s, sensors)):
            self._fail(time_s, causes, sensors)
            return
        if isinstance(motion, Retraction) and not motion.blocked and self._slip_mm(time_s, sensors) > MAX_SLIP_MM:
            self.faults |= DeviceFault.UNCOMMANDED_MOTION
        outcome = motion.step(time_s, TICK_S, self._carriages(sensors))
        left_duty, right_duty = motion.duties
        self.output = Output(left_duty, right_duty, enabled=True)
        if outcome is Outcome.MOVING:
            return
        if outcome is Outcome.FAILED and homing:
            self._fail(time_s, DeviceFault.HOMING_FAILED, sensors)
            return
        if outcome is Outcome.FAILED:
            self.faults |= DeviceFault.RETRACT_FAILED
        elif isinstance(motion, Homing):
            left_mm, right_mm = motion.zeros_mm
            self._zeros_mm = self._zeros_mm[0] + left_mm, self._zeros_mm[1] + right_mm
            self.homed = True
        self._rest(time_s, DeviceMode.LATCHED if self.faults else DeviceMode.IDLE)

    def _tick_rest(self, time_s: float, sensors: Sensors) -> None:
        if self._slip_mm(time_s, sensors) > MAX_SLIP_MM:
            self._fail(time_s, DeviceFault.UNCOMMANDED_MOTION, sensors)
            return
        causes = self._lasting_causes(sensors)
        if causes and (new := causes & ~self.faults):
            self._fail(time_s, new, sensors)

    @staticmethod
    def _bounded(output: Output, sensors: Sensors) -> Output:
        """A carriage at its open switch is not driven on into the stop."""
        if not sensors.switches:
            return output
        return Output(
            min(output.left_duty, 0.0) if Switches.LEFT_OPEN in sensors.switches else output.left_duty,
            min(output.right_duty, 0.0) if Switches.RIGHT_OPEN in sensors.switches else output.right_duty,
            output.enabled,
        )

    # -- transitions ---------------------------------------------------------------------------------------------

    def _fail(self, time_s: float, fault: DeviceFault, sensors: Sensors) -> None:
        """Latch a fault and open the gap; drives that are off stay off, unless the carriages move by themselves."""
        self.faults |= fault
        if self.mode in MOTORS_OFF_MODES and DeviceFault.UNCOMMANDED_MOTION not in fault:
            self._rest(time_s, DeviceMode.LATCHED)
        elif self.mode is not DeviceMode.RETRACTING:
            self._retract(time_s, sensors)

    def _retract(self, time_s: float, sensors: Sensors) -> None:
        if self.mode is DeviceMode.RUN:
            self._may_run = False
        self.mode = DeviceMode.RETRACTING
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
        """Drives off; a latched fault also takes away the trust in the zero."""
        self.mode = mode
        self.output = OFF
        self._motion = None
        self._watch_since_s = time_s
        self._watch_counts = None
        if mode is DeviceMode.LATCHED:
            self.homed = False

    # -- watches -------------------------------------------------------------------------------------------------

    def _lasting_causes(self, sensors: Sensors) -> DeviceFault:
        """Faults whose cause is there now, whatever the device does."""
        causes = NO_FAULT
        if not SUPPLY_RANGE_V[0] <= sensors.supply_V <= SUPPLY_RANGE_V[1]:
            causes |= DeviceFault.SUPPLY
        if sensors.temperature_C > MAX_TEMPERATURE_C:
            causes |= DeviceFault.TEMPERATURE
        return causes

    def _causes(self, time_s: float, sensors: Sensors) -> DeviceFault:
        """The lasting ones, and OVERCURRENT once a motor has drawn more than the level for too long without a break."""
        calm_s = self._calm_s
        if abs(sensors.left_current_A) < self._overcurrent_A:
            calm_s[0] = time_s
        if abs(sensors.right_current_A) < self._overcurrent_A:
            calm_s[1] = time_s
        causes = self._lasting_causes(sensors)
        return causes | DeviceFault.OVERCURRENT if time_s - min(calm_s) > OVERCURRENT_S else causes

    def _slip_mm(self, time_s: float, sensors: Sensors) -> float:
        """How far a carriage has moved from where it rested; while opening, inward from where it had come to."""
        counts = (sensors.left_counts, sensors.right_counts)
        if time_s - self._watch_since_s < COASTING_S:
            return 0.0
        if self._watch_counts is None:
            self._watch_counts = counts
        elif self.mode is DeviceMode.RETRACTING:
            self._watch_counts = max(counts[0], self._watch_counts[0]), max(counts[1], self._watch_counts[1])
        return max(abs(now - then) for now, then in zip(counts, self._watch_counts, strict=True)) * self._mm_per_count

    def _positions_mm(self, sensors: Sensors) -> tuple[float, float]:
        left_mm, right_mm = self._zeros_mm
        mm_per_count = self._mm_per_count
        return sensors.left_counts * mm_per_count - left_mm, sensors.right_counts * mm_per_count - right_mm

    def _carriages(self, sensors: Sensors) -> tuple[Carriage, Carriage]:
        left_mm, right_mm = self._positions_mm(sensors)
        return (
            Carriage(left_mm, Switches.LEFT_OPEN in sensors.switches, sensors.left_current_A),
            Carriage(right_mm, Switches.RIGHT_OPEN in sensors.switches, sensors.right_current_A),
        )

    # -- reports -------------------------------------------------------------------------------------------------

    def identity(self) -> Identity:
        """Who this device is."""
        return Identity(SCHEMA_HASH, *VERSION, SERIAL_NUMBER)

    def status(self, sensors: Sensors) -> Status:
        """Mode, switches, faults, and what was last accepted (0 before anything was)."""
        return Status(
            mode=self.mode,
            switches=sensors.switches | Switches.HOMED if self.homed else sensors.switches,
            faults=self.faults,
            temperature_C=sensors.temperature_C,
            supply_V=sensors.supply_V,
            drive_counter=self._drive_counter or 0,
            command_nonce=self._nonce or 0,
        )

    def measurement(self, time_s: float, sensors: Sensors) -> tuple[State, Sense]:
        """State and Sense of that moment."""
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
