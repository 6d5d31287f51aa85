"""One typed, validated configuration: a TOML file, or the defaults.

Unknown keys, wrong types, NaN and infinities, values out of range and impossible orderings are refused. The error names
the key's path, the value and what is allowed.
"""

import re
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from tormagd.ground.toml_file import checked as checked, convert, convert_as, placed, table_in as table_in
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
    "`serial`, `can`, or the name of an installed plugin."
    port: str = "/dev/tormag"
    "Path of the serial port, or the CAN channel: `can0`, or an adapter's path."
    options: dict[str, Any] = msgspec.field(default_factory=dict)
    "The backend's own settings."
    profiles: str = ""
    """Folder for what is learned of each device. Empty: $STATE_DIRECTORY/profiles of the service; outside a service
    nothing is kept."""
    calibrations: str = ""
    """Folder of what `tormagctl commission` found. A device's SERIAL.toml overrides [motor], [position] and [trim].
    Empty: $STATE_DIRECTORY/calibrations of the service."""
    command_timeout_ms: Annotated[float, Meta(ge=5.0, le=1_000.0)] = 50.0
    "The firmware's own timeout, stated here for checks."
    measurement_timeout_ms: Annotated[float, Meta(ge=2.0, le=1_000.0)] = 50.0
    "The controller drives on no older device state, and holds the gap after some milliseconds."
    retract_mm_s: Annotated[float, Meta(ge=0.1, le=100.0)] = 15.0
    "The speed at which the firmware opens a carriage, stated here for the checks of scenes."

    def __post_init__(self) -> None:
        is_usable = self.port.isprintable() and self.port != ""
        require(is_usable, "device.port", self.port, "at least one printable character")
        for key in ("profiles", "calibrations"):
            require(getattr(self, key).isprintable(), f"device.{key}", getattr(self, key), "printable characters")


class Sources(Strict, frozen=True):
    """Who may hold the brake, under which name, and how long setpoints are held back."""

    priority: tuple[Annotated[str, Meta(min_length=1, max_length=64)], ...] = ()
    "Names of sources. Each takes the brake from later ones and from all unlisted ones."
    keys: dict[str, tuple[str, ...]] = msgspec.field(default_factory=dict)
    """Fingerprints of the keys that may send under a source's name. Any publishing key may use an unlisted name."""
    playout_ms: Annotated[float, Meta(ge=0.0, le=MAX_PLAYOUT_MS)] = 0.0
    "Delay from a setpoint's stamp until it is followed; evens out jitter. 0: at once."

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
    "1 if pushing on increases the encoder's position, else -1."

    def __post_init__(self) -> None:
        require(self.push_sign != 0, "handle.push_sign", self.push_sign, "1 or -1")


class Rates(Strict, frozen=True):
    """How often each rate group runs, Hz."""

    control_hz: Annotated[int, Meta(ge=MIN_INFERENCE_HZ, le=4_000)] = 1_000
    "Control ticks; the default gains are for 1000."
    inference_hz: Annotated[int, Meta(ge=MIN_INFERENCE_HZ, le=4_000)] = 500
    "Plans; more where each setpoint is planned for."
    plan_every_setpoint: bool = True
    "Whether a setpoint is planned in the tick that takes it; otherwise the newest waits for the next plan."
    telemetry_hz: Annotated[int, Meta(ge=1, le=200)] = 50
    "Telemetry messages."
    motion_hz: Annotated[int, Meta(ge=1, le=4_000)] = 500
    "Messages of the topic `motion`, at most `control_hz`."
    of_scene: bool = False
    """Whether the scene's rates replace `control_hz` and `inference_hz`, with control at 500 Hz or more. True where a
    file states none of the three."""


class RealTime(Strict, frozen=True):
    """Optional requests to the kernel. `status` lists those it refused at the start."""

    fifo_priority: Annotated[int, Meta(ge=0, le=90)] = 0
    "SCHED_FIFO priority; 0 asks for none."
    lock_memory: bool = False
    "Whether all of the daemon stays in memory."
    cpus: tuple[Annotated[int, Meta(ge=0, le=4095)], ...] = ()
    "Processors for the control thread; empty: any."
    keep_awake: bool = False
    "Whether idle processors stay awake while the daemon runs, which takes power."
    watchdog_ms: Annotated[float, Meta(ge=100.0, le=60_000.0)] = 500.0
    "systemd's watchdog is fed only while plans, and device states on a running link, are younger."


class Motor(Strict, frozen=True):
    """The DC motor and lead screw the controller believes in (37D class, 70:1); see `control/move/motor.py`."""

    supply_V: Annotated[float, Meta(ge=3.0, le=60.0)] = 12.0
    "Motor voltage at full duty."
    resistance_ohm: Annotated[float, Meta(ge=0.05, le=100.0)] = 2.2
    "Armature resistance: 12 V / 5.5 A at stall."
    inductance_mH: Annotated[float, Meta(ge=0.01, le=100.0)] = 1.5
    "Armature inductance."
    back_emf_V_s: Annotated[float, Meta(ge=1e-4, le=1.0)] = 0.011
    "V s/rad and N m/A, from the no-load speed."
    inertia_kg_m2: Annotated[float, Meta(ge=1e-9, le=1e-2)] = 8e-7
    "Rotor inertia; gears and screw add little."
    gear_ratio: Annotated[float, Meta(ge=1.0, le=1_000.0)] = 70.0
    "Motor turns per screw turn."
    screw_lead_mm: Annotated[float, Meta(ge=0.2, le=50.0)] = 8.0
    "Travel per screw turn."
    gear_efficiency: Annotated[float, Meta(gt=0.1, le=1.0)] = 0.7
    "Share of the torque that the gears pass on."
    coulomb_V: Annotated[float, Meta(ge=0.0, le=12.0)] = 0.5
    "Voltage that overcomes dry friction in gearbox and screw."
    pull_V: Annotated[float, Meta(ge=0.0, le=12.0)] = 0.5
    """Extra voltage against the magnets' pull when opening from a gap of 45 mm: 0.40 to 0.64 V at a pull of 50 to 80 N
    and a screw efficiency of 0.65."""


class Position(Strict, frozen=True):
    """The carriage position loop, a PID with feed-forward; `tormag-lab tune-position` finds its gains."""

    proportional_per_mm: Annotated[float, Meta(gt=0.0, le=1_000.0)] = 3.6
    "Proportional gain, duty/mm: the most that keeps 6 dB and 45 degrees at every corner of the motor's parameters."
    integral_time_s: Annotated[float, Meta(ge=0.005, le=100.0)] = 0.1
    "Integral time; if shorter, stiction makes the carriages hunt by a count."
    derivative_time_s: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.02
    "Derivative time, near the motor's mechanical time constant, 15 ms."
    derivative_filter_s: Annotated[float, Meta(ge=1e-4, le=0.1)] = 0.003
    "Filters encoder steps out of the derivative."
    back_calculation_s: Annotated[float, Meta(ge=0.001, le=10.0)] = 0.1
    "Anti-windup time of the integral."
    synchronisation: Annotated[float, Meta(ge=0.0, le=10.0)] = 1.0
    "Gain on the skew between the carriages, as a multiple of `proportional_per_mm`."
    gap_speed_mm_s: Annotated[float, Meta(ge=0.1, le=500.0)] = 38.0
    "Greatest speed of the opening gap, both carriages together."
    closing_mm_s: Annotated[float, Meta(ge=0.0, le=500.0)] = 0.0
    "The same for closing; 0: the motors' own. A file that states `gap_speed_mm_s` alone sets both."
    gap_acceleration_mm_s2: Annotated[float, Meta(gt=0.0, le=100_000.0)] = 1_600.0
    """Greatest acceleration of the gap from rest; it falls with speed, and rises up to twofold for carriages that
    show more."""
    duty_limit: Annotated[float, Meta(gt=0.0, le=1.0)] = 1.0
    "Greatest duty; less spares the motor and slows the gap."


class Trim(Strict, frozen=True):
    """How far the force sensor may correct the force model."""

    time_s: Annotated[float, Meta(ge=0.05, le=1_000.0)] = 0.5
    "Time in which the offset is learned; a new device is learned sooner."
    least: Annotated[float, Meta(ge=0.1, le=1.0)] = 0.6
    "Least ratio of the device's force to the model's; beyond it the limit `TRIM` shows."
    most: Annotated[float, Meta(ge=1.0, le=5.0)] = 2.0
    "Greatest ratio. No device counts as stronger, so the force ceiling depends on it."
    least_offset_N: Annotated[float, Meta(ge=-2.0, le=0.0)] = -0.2
    "Least offset of the force."
    most_offset_N: Annotated[float, Meta(ge=0.0, le=2.0)] = 0.3
    "Greatest offset; more counts as the sensor's zero."
    leash: Annotated[float, Meta(ge=0.02, le=0.3)] = 0.08
    "Share of the force first shown by which a falling reading is followed."
    way: Annotated[float, Meta(ge=-0.06, le=0.06)] = 0.0
    "Share by which friction is greater in the positive direction, and less in the other: where learning begins."


class Limits(Strict, frozen=True):
    """Bounds of faults and warnings."""

    skew_warning_mm: Annotated[float, Meta(gt=0.0, le=10.0)] = 0.2
    "Distance between the carriages that shows the limit `SKEW`."
    skew_fault_mm: Annotated[float, Meta(gt=0.0, le=10.0)] = 1.0
    "The same for the fault `SKEW`; the firmware's own is at 2 mm."
    following_error_mm: Annotated[float, Meta(gt=0.0, le=50.0)] = 3.0
    "Distance from gap to reference that may last `following_time_s`."
    no_motion_duty: Annotated[float, Meta(gt=0.0, le=1.0)] = 0.35
    "A carriage driven harder must move within `no_motion_time_s`."
    no_motion_time_s: Annotated[float, Meta(gt=0.0, le=10.0)] = 0.06
    "Time before the fault `NO_MOTION`."
    following_time_s: Annotated[float, Meta(gt=0.0, le=10.0)] = 0.25
    "Time before the fault `FOLLOWING_ERROR`."
    low_confidence: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.5
    "Confidence below which the limit `LOW_CONFIDENCE` shows."


class BlackBox(Strict, frozen=True):
    """The last half minute, written on a fault."""

    folder: str = ""
    """Folder of the files. Empty: $STATE_DIRECTORY/blackbox of the service; outside a service nothing is kept."""


class Recordings(Strict, frozen=True):
    """What `tormagctl record` keeps in a folder."""

    folder: str = "/var/lib/tormag/recordings"
    "Default of `tormagctl recordings`."
    segment_MB: Annotated[float, Meta(ge=0.1, le=100_000.0)] = 250.0
    "Size at which a recording continues in a new file."
    segment_minutes: Annotated[float, Meta(ge=0.01, le=1_440.0)] = 10.0
    "The same for time."
    most_MB: Annotated[float, Meta(gt=0.0, le=1e8)] = 20_000.0
    "The folder's budget; the oldest unmarked files go first."
    most_days: Annotated[float, Meta(gt=0.0, le=36_500.0)] = 30.0
    "The same for age before the newest. Before a pause of over three days only `most_MB` counts."
    free_MB: Annotated[float, Meta(ge=1.0, le=1e8)] = 500.0
    "Space that stays free on that disk."
    one_tick_of: Annotated[int, Meta(ge=1, le=1_000)] = 1
    "Records one of so many ticks, and all within 10 s of a fault or mark."

    def __post_init__(self) -> None:
        require(
            2.0 * self.segment_MB + 1.0 <= self.most_MB,
            "recordings.most_MB",
            self.most_MB,
            f"at least twice recordings.segment_MB = {self.segment_MB:g}, and 1",
        )


def _require_in_time(device: Device, rates: Rates, realtime: RealTime) -> None:
    require(
        device.command_timeout_ms < realtime.watchdog_ms,
        "device.command_timeout_ms",
        device.command_timeout_ms,
        f"under realtime.watchdog_ms = {realtime.watchdog_ms:g}: the device must act before systemd does",
    )
    require(
        device.measurement_timeout_ms <= device.command_timeout_ms,
        "device.measurement_timeout_ms",
        device.measurement_timeout_ms,
        f"at most device.command_timeout_ms = {device.command_timeout_ms:g}",
    )
    require(
        device.measurement_timeout_ms * rates.control_hz >= 2_000.0,
        "device.measurement_timeout_ms",
        device.measurement_timeout_ms,
        f"at least {2e3 / rates.control_hz:g}, two periods of rates.control_hz = {rates.control_hz}",
    )


class Config(Strict, frozen=True):
    """Top-level keys."""

    scene: Annotated[str, Meta(max_length=4_096)] = "coronary"
    "Scene file, or name of a shipped scene."
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
        _require_in_time(device, rates, self.realtime)
        require(
            limits.no_motion_duty < self.position.duty_limit,
            "limits.no_motion_duty",
            limits.no_motion_duty,
            f"under position.duty_limit = {self.position.duty_limit:g}, or NO_MOTION and WRONG_DIRECTION never show",
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
        _both_ways(stated["position"])
        return checked(own | {key: own[key] | stated[key] for key in stated if key in own}, Config)
    except ValueError as error:
        raise ConfigError(placed(path, str(error))) from error


def _both_ways(position: object) -> None:
    if isinstance(position, dict) and "gap_speed_mm_s" in position:
        position.setdefault("closing_mm_s", position["gap_speed_mm_s"])


class _Addressed(msgspec.Struct, frozen=True):
    endpoints: Endpoints = msgspec.field(default_factory=Endpoints)


def load_endpoints(path: Path | None) -> Endpoints:
    """Read the endpoints alone of a configuration file: who stops a daemon needs no more of it."""
    return Endpoints() if path is None else convert(path, _Addressed).endpoints


def load_config(path: Path | None) -> Config:
    """Read the configuration file `path`; None: take the defaults."""
    stated: set[str] = set()

    def kind_of(tables: dict[str, Any]) -> type[Config]:
        rates = tables.get("rates")
        stated.update(rates if isinstance(rates, dict) else ())
        _both_ways(tables.get("position"))
        return Config

    config = Config() if path is None else convert_as(path, kind_of)
    if stated & {"control_hz", "inference_hz", "of_scene"}:
        return config
    return msgspec.structs.replace(config, rates=msgspec.structs.replace(config.rates, of_scene=True))
