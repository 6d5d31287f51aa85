"""One typed, validated configuration: a TOML file, or the defaults.

Unknown keys, wrong types, NaN and infinities, values out of range and impossible orderings are refused. The error names
the key's path, the value and what is allowed.
"""

import re
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from tormagd.toml_file import checked as checked, convert, convert_as, placed, table_in as table_in
from tormagd_client.endpoints import ConfigError, Endpoints, Strict, require_usable
from tormagd_client.printable import require

MIN_INFERENCE_HZ = 83  # the thesis's own rate, 1 / (4 + 8 ms); slower is not worth running
MAX_LISTED = 8
"Fewer sources than are kept apart, so that an unlisted one is heard too."
MAX_PLAYOUT_MS = 200.0
"Half of what the whole way from sensor to force may take."


class Device(Strict, frozen=True):
    """Where the firmware is. `backend` names an entry point of the group `tormagd.backends`."""

    backend: str = "serial"
    "How the device is reached: `serial`, `can`, or an installed plugin's. A USB serial line is what most have."
    port: str = "/dev/tormag"
    "Path of the serial port; with the backend `can`, the channel: `can0`, or an adapter's path."
    options: dict[str, Any] = msgspec.field(default_factory=dict)
    "The backend's own settings; what they are and may be is the backend's to say."
    profiles: str = ""
    """Folder for the profiles: what each device has shown of itself. Without one it is the service's,
    $STATE_DIRECTORY/profiles. Where there is none nothing is kept."""
    calibrations: str = ""
    """Folder of what `tormagctl commission` found: a device's SERIAL.toml goes before [motor], [position] and [trim].
    Without one it is the service's, $STATE_DIRECTORY/calibrations."""
    command_timeout_ms: Annotated[float, Meta(ge=5.0, le=1_000.0)] = 50.0
    "What the firmware does without us: its own timeout, stated here so that it can be checked against ours."
    measurement_timeout_ms: Annotated[float, Meta(ge=2.0, le=1_000.0)] = 50.0
    "Oldest device state the controller accepts while it drives; from some milliseconds on it only holds the gap."
    retract_mm_s: Annotated[float, Meta(ge=0.1, le=100.0)] = 15.0
    "What the firmware does without us: how fast a carriage opens, stated here for scenes to be checked against."

    def __post_init__(self) -> None:
        is_usable = self.port.isprintable() and self.port != ""
        require(is_usable, "device.port", self.port, "at least one printable character")


class Sources(Strict, frozen=True):
    """Who may hold the brake before whom, who may send under which name, and how long setpoints are held back."""

    priority: tuple[Annotated[str, Meta(min_length=1, max_length=64)], ...] = ()
    "Names of sources. Each takes the brake over from those after it, and from all that are not listed."
    keys: dict[str, tuple[str, ...]] = msgspec.field(default_factory=dict)
    """Fingerprints of the keys that may send as a source, by its name. Any key that may publish may send under a name
    that is not listed."""
    playout_ms: Annotated[float, Meta(ge=0.0, le=MAX_PLAYOUT_MS)] = 0.0
    "Setpoints are followed so long after their stamps, as evenly as they were stamped. 0: as soon as they come."

    def __post_init__(self) -> None:
        names = self.priority
        require(
            len(set(names)) == len(names) <= MAX_LISTED and all(name.isprintable() for name in names),
            "sources.priority",
            names,
            f"at most {MAX_LISTED} different printable names",
        )
        for name, keys in self.keys.items():
            require(
                keys != () and all(re.fullmatch("[0-9a-f]{4}(:[0-9a-f]{4}){3}", key) for key in keys),
                f"sources.keys.{name}",
                keys,
                "fingerprints as tormagctl keys show says them, one or more",
            )


class Handle(Strict, frozen=True):
    """The handle of the brake."""

    push_sign: Annotated[int, Meta(ge=-1, le=1)] = 1
    "1 where pushing on moves the handle to greater places of its encoder, else -1."

    def __post_init__(self) -> None:
        require(self.push_sign != 0, "handle.push_sign", self.push_sign, "1 or -1")


class Rates(Strict, frozen=True):
    """How often each rate group runs, Hz."""

    control_hz: Annotated[int, Meta(ge=MIN_INFERENCE_HZ, le=4_000)] = 1_000
    "Ticks: the position loop's gains are for it, and a serial line and a CAN bus carry it."
    inference_hz: Annotated[int, Meta(ge=MIN_INFERENCE_HZ, le=4_000)] = 500
    "Plans that are made at the least; a setpoint is planned for in the next tick. Below 83 the thesis was faster."
    telemetry_hz: Annotated[int, Meta(ge=1, le=200)] = 50
    "Messages: as often as an eye sees, and no load."
    motion_hz: Annotated[int, Meta(ge=1, le=4_000)] = 500
    "Of the topic `motion`, for whoever subscribes; no more than `control_hz`."
    of_scene: bool = False
    """Whether the daemon runs at the rates of its scene in place of these two, control at 500 Hz at the least. Where a
    file states neither, it does."""


class RealTime(Strict, frozen=True):
    """Each of these is optional; one that the kernel refuses stands in `status` until a start is granted it."""

    fifo_priority: Annotated[int, Meta(ge=0, le=90)] = 0
    "Of SCHED_FIFO; 0 asks for none, because only a machine that is set up for it allows one."
    lock_memory: bool = False
    "Whether no page may be swapped out: it keeps all of the daemon in memory."
    cpus: tuple[Annotated[int, Meta(ge=0, le=4095)], ...] = ()
    "Processors for the control thread; none named: any."
    keep_awake: bool = False
    "Idle processors do not sleep while the daemon runs: they wake up at once, and take the power for it."
    watchdog_ms: Annotated[float, Meta(ge=100.0, le=60_000.0)] = 500.0
    "Without a plan or, while the link runs, a device state for this long, systemd's watchdog is no longer fed."


class Motor(Strict, frozen=True):
    """The DC motor and lead screw the controller believes in (37D class, 70:1); see `control/move/motor.py`."""

    supply_V: Annotated[float, Meta(ge=3.0, le=60.0)] = 12.0
    "What full duty puts on the motor: its rated voltage."
    resistance_ohm: Annotated[float, Meta(ge=0.05, le=100.0)] = 2.2
    "Of the armature: 12 V over the stall current of 5.5 A."
    inductance_mH: Annotated[float, Meta(ge=0.01, le=100.0)] = 1.5
    "Of the armature; with the resistance the motor's fastest time constant, 0.7 ms."
    back_emf_V_s: Annotated[float, Meta(ge=1e-4, le=1.0)] = 0.011
    "V at 1 rad/s of the motor, and N m at 1 A: what its no-load speed at 12 V comes to."
    inertia_kg_m2: Annotated[float, Meta(ge=1e-9, le=1e-2)] = 8e-7
    "Of the rotor; gears and screw add little behind the gears."
    gear_ratio: Annotated[float, Meta(ge=1.0, le=1_000.0)] = 70.0
    "Turns of the motor to one of the screw."
    screw_lead_mm: Annotated[float, Meta(ge=0.2, le=50.0)] = 8.0
    "A carriage's way in one turn of the screw."
    gear_efficiency: Annotated[float, Meta(gt=0.1, le=1.0)] = 0.7
    "What the gears leave of the torque."
    coulomb_V: Annotated[float, Meta(ge=0.0, le=12.0)] = 0.5
    "Voltage that just overcomes the dry friction of gearbox and screw."
    pull_V: Annotated[float, Meta(ge=0.0, le=12.0)] = 0.5
    """Voltage that the magnets' pull takes besides at a gap of 45 mm, to open. A pull of 50 to 80 N, a screw with an
    efficiency of 0.65, the gears and R / Ke make 0.40 to 0.64 V."""


class Position(Strict, frozen=True):
    """The carriage position loop: PID with filtered derivative, back-calculation and feed-forward.

    The gains come from `tormag-lab tune-position`.
    """

    proportional_per_mm: Annotated[float, Meta(gt=0.0, le=1_000.0)] = 3.6
    "Duty for 1 mm of error: the most that keeps 6 dB and 45 degrees at every corner of the motor's parameters."
    integral_time_s: Annotated[float, Meta(ge=0.005, le=100.0)] = 0.1
    "Shorter, and stiction makes the carriages hunt by a count."
    derivative_time_s: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.02
    "Near the motor's mechanical time constant of 15 ms, which it makes up for."
    derivative_filter_s: Annotated[float, Meta(ge=1e-4, le=0.1)] = 0.003
    "Takes the encoder's steps out of the derivative."
    back_calculation_s: Annotated[float, Meta(ge=0.001, le=10.0)] = 0.1
    "In which the integral lets go once the duty is limited: as fast as it winds up."
    synchronisation: Annotated[float, Meta(ge=0.0, le=10.0)] = 1.0
    "Extra proportional action on the skew between the carriages, as a multiple of the carriage's own."
    gap_speed_mm_s: Annotated[float, Meta(gt=0.0, le=500.0)] = 38.0
    "How fast the gap may change: both carriages together, less than motors on a full supply reach."
    gap_acceleration_mm_s2: Annotated[float, Meta(gt=0.0, le=100_000.0)] = 1_600.0
    """From rest; with speed it falls along the motors' torque-speed line. Carriages that show more are asked for up to
    twice as much."""
    duty_limit: Annotated[float, Meta(gt=0.0, le=1.0)] = 1.0
    "The most that a motor is given; less spares it, and makes the gap slower."


class Trim(Strict, frozen=True):
    """What the force sensor may correct of the force model: a device's scale within bounds, its offset at a speed."""

    time_s: Annotated[float, Meta(ge=0.05, le=1_000.0)] = 0.5
    "In which the force's offset is learned anew in the long run; a new device shows itself sooner."
    least: Annotated[float, Meta(gt=0.0, le=1.0)] = 0.6
    "Of a device's force over the model's; what is below is not corrected, and the limit `TRIM` says so."
    most: Annotated[float, Meta(ge=1.0, le=5.0)] = 2.0
    "The same for what is above. No device is taken for stronger, so its greatest force rests on this."
    least_offset_N: Annotated[float, Meta(ge=-2.0, le=0.0)] = -0.2
    "Of a device's force at speed: another field law and what relaxes look like -0.15 N at most."
    most_offset_N: Annotated[float, Meta(ge=0.0, le=2.0)] = 0.3
    "The same for what is above; more is the sensor's zero."


class Limits(Strict, frozen=True):
    """What counts as a fault, and what only as a warning."""

    skew_warning_mm: Annotated[float, Meta(gt=0.0, le=10.0)] = 0.2
    "Carriages further apart than usual: the limit `SKEW`."
    skew_fault_mm: Annotated[float, Meta(gt=0.0, le=10.0)] = 1.0
    "The fault `SKEW`: before the firmware's own, at 2 mm."
    following_error_mm: Annotated[float, Meta(gt=0.0, le=50.0)] = 3.0
    "How far the gap may be from its reference for a moment."
    no_motion_duty: Annotated[float, Meta(gt=0.0, le=1.0)] = 0.35
    "A carriage driven harder than this must move: it is well above what friction and the magnets hold."
    no_motion_time_s: Annotated[float, Meta(gt=0.0, le=10.0)] = 0.06
    "For how long it may not: a motor that turns shows hundreds of counts by then."
    following_time_s: Annotated[float, Meta(gt=0.0, le=10.0)] = 0.25
    "For how long, before it is the fault `FOLLOWING_ERROR`."
    low_confidence: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.5
    "Below it the limit `LOW_CONFIDENCE` says that the model was asked outside its training."


class BlackBox(Strict, frozen=True):
    """What is kept of the last half minute, to be written on a fault."""

    folder: str = ""
    """For the files; without one that of the service ($STATE_DIRECTORY/blackbox), and where there is none nothing is
    kept."""


class Recordings(Strict, frozen=True):
    """What `tormagctl record` keeps in a folder."""

    folder: str = "/var/lib/tormag/recordings"
    "Where `tormagctl recordings` looks."
    segment_MB: Annotated[float, Meta(ge=0.1, le=100_000.0)] = 250.0
    "A recording in a folder goes on in a new file then,"
    segment_minutes: Annotated[float, Meta(ge=0.01, le=1_440.0)] = 10.0
    "or after so long."
    most_MB: Annotated[float, Meta(gt=0.0, le=1e8)] = 20_000.0
    "The folder's budget: the oldest unmarked go first."
    most_days: Annotated[float, Meta(gt=0.0, le=36_500.0)] = 30.0
    "The same for age, before the newest; what is before a pause of over three days goes by `most_MB` alone."
    free_MB: Annotated[float, Meta(ge=1.0, le=1e8)] = 500.0
    "Stays free on that disk, for black boxes and profiles."
    one_tick_of: Annotated[int, Meta(ge=1, le=1_000)] = 1
    "Of so many ticks one is recorded, and all within 10 s of a fault or a mark."

    def __post_init__(self) -> None:
        require(
            2.0 * self.segment_MB + 1.0 <= self.most_MB,
            "recordings.most_MB",
            self.most_MB,
            f"at least twice recordings.segment_MB = {self.segment_MB:g}, and 1",
        )


class Config(Strict, frozen=True):
    """Everything `tormagd` can be told."""

    scene: Annotated[str, Meta(max_length=4_096)] = "coronary"
    "A scene file, or the name of a shipped one."
    device: Device = msgspec.field(default_factory=Device)
    endpoints: Endpoints = msgspec.field(default_factory=Endpoints)
    sources: Sources = msgspec.field(default_factory=Sources)
    handle: Handle = msgspec.field(default_factory=Handle)
    rates: Rates = msgspec.field(default_factory=Rates)
    realtime: RealTime = msgspec.field(default_factory=RealTime)
    motor: Motor = msgspec.field(default_factory=Motor)
    position: Position = msgspec.field(default_factory=Position)
    trim: Trim = msgspec.field(default_factory=Trim)
    limits: Limits = msgspec.field(default_factory=Limits)
    black_box: BlackBox = msgspec.field(default_factory=BlackBox)
    recordings: Recordings = msgspec.field(default_factory=Recordings)

    def __post_init__(self) -> None:
        rates, device, limits = self.rates, self.device, self.limits
        require(
            rates.inference_hz <= rates.control_hz,
            "rates.inference_hz",
            rates.inference_hz,
            f"at most rates.control_hz = {rates.control_hz}",
        )
        require(
            rates.control_hz % rates.telemetry_hz == 0,
            "rates.telemetry_hz",
            rates.telemetry_hz,
            f"a divisor of rates.control_hz = {rates.control_hz}",
        )
        require(
            device.command_timeout_ms < self.realtime.watchdog_ms,
            "device.command_timeout_ms",
            device.command_timeout_ms,
            f"under realtime.watchdog_ms = {self.realtime.watchdog_ms:g}: the device must act before systemd does",
        )
        require(
            device.measurement_timeout_ms <= device.command_timeout_ms,
            "device.measurement_timeout_ms",
            device.measurement_timeout_ms,
            f"at most device.command_timeout_ms = {device.command_timeout_ms:g}",
        )
        require(
            limits.skew_warning_mm <= limits.skew_fault_mm,
            "limits.skew_warning_mm",
            limits.skew_warning_mm,
            f"at most limits.skew_fault_mm = {limits.skew_fault_mm:g}",
        )
        require_usable(self.endpoints)
        require(
            not self.sources.keys or self.endpoints.is_guarded("setpoint"),
            "sources.keys",
            list(self.sources.keys),
            "none where endpoints.setpoint asks for no keys; endpoints.curve.also_local lets it ask",
        )


class Calibration(Strict, frozen=True):
    """What a commissioning found of the device `serial_number`: keys that go before those of a configuration."""

    serial_number: Annotated[int, Meta(ge=0, lt=2**32)]
    motor: dict[str, float] = msgspec.field(default_factory=dict)
    position: dict[str, float] = msgspec.field(default_factory=dict)
    trim: dict[str, float] = msgspec.field(default_factory=dict)


def load_calibration(path: Path, config: Config, serial_number: int) -> Config:
    """Return `config` with the motor, position and trim of the calibration file `path`."""
    found = convert(path, Calibration)
    stated = msgspec.to_builtins(found)
    try:
        require(
            found.serial_number == serial_number, "serial_number", found.serial_number, f"{serial_number}, the device's"
        )
        own = msgspec.to_builtins(config)
        return checked(own | {key: own[key] | stated[key] for key in stated if key in own}, Config)
    except ValueError as error:
        raise ConfigError(placed(path, str(error))) from error


def load_config(path: Path | None) -> Config:
    """Read the configuration file `path`; None: take the defaults."""
    stated: set[str] = set()

    def kind_of(tables: dict[str, Any]) -> type[Config]:
        rates = tables.get("rates")
        stated.update(rates if isinstance(rates, dict) else ())
        return Config

    config = Config() if path is None else convert_as(path, kind_of)
    if stated & {"control_hz", "inference_hz", "of_scene"}:
        return config
    return msgspec.structs.replace(config, rates=msgspec.structs.replace(config.rates, of_scene=True))
