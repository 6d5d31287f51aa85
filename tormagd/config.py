"""One typed, validated configuration.

A TOML file, or the defaults. Unknown keys, wrong types, NaN and infinities, values out of range and impossible
orderings are refused with the key's path, the value and what is allowed.
"""

import ipaddress
import os
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args

import msgspec
from msgspec import Meta

from tormagd.toml_file import TomlError, in_short, line_of, toml_tables, toml_text

LEAST_INFERENCE_HZ = 83  # the thesis's own rate, 1 / (4 + 8 ms): slower than this is not worth running
DEFAULT_RUN_DIR = "/run/tormag"
MOST_LISTED = 8
"Sources in the order of priority: fewer than are kept apart, so that one that is not listed is heard, too."
LONGEST_IPC_PATH = 107  # bytes that the kernel takes of a socket's path
ENDPOINTS = ("setpoint", "telemetry", "control", "recording")
ROLES = ("publish", "operate", "observe")

T = TypeVar("T")
_OURS = re.compile(r"([a-z_A-Z.]+)(?: =|:) ")
"The key, or the table, that a refusal of ours begins with."
_PLACE = re.compile(r"`\$([^`]*)`")
"The place that one of msgspec's ends with."
_UNKNOWN = re.compile(r"unknown field `(\w+)`")
_TCP = re.compile(r"tcp://(localhost|[0-9.]+):([0-9]{1,5})")


class ConfigError(ValueError):
    """A configuration that was refused: the text names the key, the value and what is allowed."""


class Strict(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A table of the configuration."""


class Device(Strict, frozen=True):
    """Where the firmware is. `backend` names an entry point of the group `tormagd.backends`."""

    backend: str = "serial"
    "How the device is reached: `serial`, `can`, or an installed plugin's. A USB serial line is what most have."
    port: str = "/dev/tormag"
    "Path of the serial port; with the backend `can`, the channel: `can0`, or an adapter's path."
    options: dict[str, Any] = msgspec.field(default_factory=dict)
    "The backend's own settings; what they are and may be is the backend's to say."
    profiles: str = ""
    """Folder in which it is kept what each device has shown of itself; without one that of the service
    ($STATE_DIRECTORY/profiles), and where there is none nothing is kept."""
    command_timeout_ms: Annotated[float, Meta(ge=5.0, le=1_000.0)] = 50.0
    "What the firmware does without us: its own timeout, stated here so that it can be checked against ours."
    measurement_timeout_ms: Annotated[float, Meta(ge=2.0, le=1_000.0)] = 50.0
    "Oldest device state the controller accepts while it drives; from some milliseconds on it only holds the gap."
    retract_mm_s: Annotated[float, Meta(gt=0.0, le=100.0)] = 15.0
    "What the firmware does without us: how fast a carriage opens, stated here for scenes to be checked against."

    def __post_init__(self) -> None:
        _order(self.port.isprintable(), "device.port", self.port, "printable characters")


class Curve(Strict, frozen=True):
    """Key files. The daemon has `server_secret` and a folder of public keys for each role, a client the last two keys.

    A folder that is not named is the one of its role's name beside `server_secret`.
    """

    server_secret: str = ""
    "The daemon's own pair, `server.key_secret`, which `tormagctl keys generate` makes."
    publish: str = ""
    "Who may send setpoints, and nothing else."
    operate: str = ""
    "Who may give commands, and look."
    observe: str = ""
    "Who may look: telemetry, recording, `status`."
    also_local: bool = False
    "Whether `ipc://` and loopback demand keys, too."
    client_secret: str = ""
    "What `tormagctl` shows."
    server_public: str = ""
    "The daemon that `tormagctl` believes; by default the `.key` beside `server_secret`."


class Endpoints(Strict, frozen=True):
    """ZeroMQ addresses. Only `ipc://` and loopback are open; any other address is refused without CURVE keys."""

    setpoint: str = f"ipc://{DEFAULT_RUN_DIR}/setpoint"
    "Where publishers connect; in the service's own folder, as all four are."
    telemetry: str = f"ipc://{DEFAULT_RUN_DIR}/telemetry"
    "Where whoever looks subscribes."
    control: str = f"ipc://{DEFAULT_RUN_DIR}/control"
    "Where commands are given."
    recording: str = f"ipc://{DEFAULT_RUN_DIR}/recording"
    "Where the recorder hears every control tick."
    curve: Curve | None = None
    "Keys, for who connects from elsewhere."

    def is_guarded(self, name: str) -> bool:
        """Whether the daemon lets in only whom it has the key of."""
        return not _is_local(getattr(self, name)) or (self.curve is not None and self.curve.also_local)


class Sources(Strict, frozen=True):
    """Who may hold the brake before whom."""

    priority: tuple[Annotated[str, Meta(min_length=1, max_length=64)], ...] = ()
    "Names of sources. Each takes the brake over from those after it, and from all that are not listed."

    def __post_init__(self) -> None:
        names = self.priority
        _order(
            len(set(names)) == len(names) <= MOST_LISTED and all(name.isprintable() for name in names),
            "sources.priority",
            names,
            f"at most {MOST_LISTED} different printable names",
        )


class Rates(Strict, frozen=True):
    """How often each rate group runs, Hz."""

    control_hz: Annotated[int, Meta(ge=LEAST_INFERENCE_HZ, le=4_000)] = 1_000
    "Ticks: the position loop's gains are for it, and a serial line and a CAN bus carry it."
    inference_hz: Annotated[int, Meta(ge=LEAST_INFERENCE_HZ, le=4_000)] = 250
    "Plans that are made at the least; a setpoint that arrives is planned for at once. Below 83 the thesis was faster."
    telemetry_hz: Annotated[int, Meta(ge=1, le=200)] = 50
    "Messages: as often as an eye sees, and no load."
    of_scene: bool = False
    "Whether the daemon runs at the rates that its scene needs, in place of these two; control at 500 Hz at the least."


class RealTime(Strict, frozen=True):
    """Each of these is optional; one that is refused by the kernel is a plain warning and a line of `doctor`."""

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
    """The DC motor and lead screw the controller believes in (37D class, 70:1); see `control/motor.py`."""

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
    """Voltage that the magnets' pull takes besides at a gap of 45 mm, to open: 50 to 80 N through a screw with an
    efficiency of 0.65, the gears and R / Ke come to 0.40 to 0.64 V."""


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
    most: Annotated[float, Meta(ge=1.0, le=5.0)] = 1.6
    "The same for what is above."


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
    neutral_margin_N: Annotated[float, Meta(gt=0.0, le=10.0)] = 0.1
    "So much above the least force a setpoint may be when the device is enabled: nothing jumps."


class BlackBox(Strict, frozen=True):
    """What is kept of the last half minute, to be written on a fault."""

    folder: str = ""
    """For the files; without one that of the service ($STATE_DIRECTORY/blackbox), and where there is none nothing is
    kept."""


class Config(Strict, frozen=True):
    """Everything `tormagd` can be told."""

    scene: Annotated[str, Meta(max_length=4_096)] = "coronary"
    "A scene file, or the name of a shipped one."
    device: Device = msgspec.field(default_factory=Device)
    endpoints: Endpoints = msgspec.field(default_factory=Endpoints)
    sources: Sources = msgspec.field(default_factory=Sources)
    rates: Rates = msgspec.field(default_factory=Rates)
    realtime: RealTime = msgspec.field(default_factory=RealTime)
    motor: Motor = msgspec.field(default_factory=Motor)
    position: Position = msgspec.field(default_factory=Position)
    trim: Trim = msgspec.field(default_factory=Trim)
    limits: Limits = msgspec.field(default_factory=Limits)
    black_box: BlackBox = msgspec.field(default_factory=BlackBox)

    def __post_init__(self) -> None:
        rates, device, limits = self.rates, self.device, self.limits
        _order(
            rates.inference_hz <= rates.control_hz,
            "rates.inference_hz",
            rates.inference_hz,
            f"at most rates.control_hz = {rates.control_hz}",
        )
        _order(
            rates.control_hz % rates.telemetry_hz == 0,
            "rates.telemetry_hz",
            rates.telemetry_hz,
            f"a divisor of rates.control_hz = {rates.control_hz}",
        )
        _order(
            device.command_timeout_ms < self.realtime.watchdog_ms,
            "device.command_timeout_ms",
            device.command_timeout_ms,
            f"under realtime.watchdog_ms = {self.realtime.watchdog_ms:g}: the device must act before systemd does",
        )
        _order(
            device.measurement_timeout_ms <= device.command_timeout_ms,
            "device.measurement_timeout_ms",
            device.measurement_timeout_ms,
            f"at most device.command_timeout_ms = {device.command_timeout_ms:g}",
        )
        _order(
            limits.skew_warning_mm <= limits.skew_fault_mm,
            "limits.skew_warning_mm",
            limits.skew_warning_mm,
            f"at most limits.skew_fault_mm = {limits.skew_fault_mm:g}",
        )
        taken: dict[str, str] = {}
        curve = self.endpoints.curve
        has_keys = curve is not None and bool(curve.server_secret or curve.client_secret)
        _order(
            has_keys or curve is None or not curve.also_local,
            "endpoints.curve.also_local",
            True,
            "false without keys, which are server_secret or client_secret",
        )
        for name in ENDPOINTS:
            address = getattr(self.endpoints, name)
            place = _ipc_place(name, address) if address.startswith("ipc://") else _tcp_place(name, address, has_keys)
            _order(
                place not in taken,
                f"endpoints.{name}",
                address,
                f"an address other than that of endpoints.{taken.get(place)}",
            )
            taken[place] = name


def _ipc_place(name: str, address: str) -> str:
    """What an `ipc://` address comes to, however it is spelt."""
    path = address.removeprefix("ipc://")
    _order(
        path not in ("", "@", "*")
        and path.isprintable()
        and not path.endswith("/")
        and len(path.encode()) <= LONGEST_IPC_PATH,
        f"endpoints.{name}",
        address,
        f"after ipc:// the path of a socket, or @ and a name, of at most {LONGEST_IPC_PATH} bytes",
    )
    return path if path.startswith("@") else os.path.realpath(path)


def _tcp_place(name: str, address: str, has_keys: bool) -> str:
    """The same of a `tcp://` address. IPv4 only: a ZeroMQ socket speaks no IPv6 unless it is told to, at both ends."""
    matched = _TCP.fullmatch(address)
    host, port = matched.groups() if matched else ("", "0")
    _order(
        (_is_loopback(host) or (has_keys and _is_ipv4(host))) and 0 < int(port) < 65_536,
        f"endpoints.{name}",
        address,
        "ipc:// or tcp:// with an IPv4 address and a port of 1..65535"
        if has_keys
        else "ipc:// or a loopback tcp:// address with a port of 1..65535; others need CURVE keys in [endpoints.curve]",
    )
    return f"{'127.0.0.1' if host == 'localhost' else host}:{int(port)}"


def _is_local(address: str) -> bool:
    matched = _TCP.fullmatch(address)
    return matched is None or _is_loopback(matched[1])


def _is_loopback(host: str) -> bool:
    return host == "localhost" or (_is_ipv4(host) and ipaddress.IPv4Address(host).is_loopback)


def _is_ipv4(host: str) -> bool:
    try:
        ipaddress.IPv4Address(host)
    except ValueError:
        return False
    return True


def _order(condition: bool, key: str, value: object, allowed: str) -> None:
    if not condition:
        raise ValueError(f"{key} = {in_short(value)}: allowed is {allowed}")


def in_folder(folder: str) -> Endpoints:
    """The endpoints of a daemon whose sockets are in `folder`. Raises ConfigError: the path is too long, or none."""
    try:
        placed = msgspec.convert({name: f"ipc://{folder}/{name}" for name in ENDPOINTS}, Endpoints)
        return Config(endpoints=placed).endpoints
    except ValueError as error:
        raise ConfigError(str(error)) from error


def load_config(path: Path | None) -> Config:
    """The configuration in `path`, or the defaults. Raises ConfigError."""
    if path is None:
        return Config()
    return convert(path, Config)


def convert(path: Path, kind: type[T]) -> T:
    """The file's tables as a `kind`. Raises ConfigError naming file, key, value, what is allowed, and the line."""
    try:
        text = toml_text(path)
        try:
            return checked(toml_tables(text), kind)
        except (TomlError, ConfigError) as error:
            raise ConfigError(f"{error}{_line(text, str(error))}") from error
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from error
    except (TomlError, ConfigError) as error:
        raise ConfigError(f"{path}: {error}") from error


def placed(path: Path | None, message: str) -> str:
    """A refusal of what a file, which has been read, says: with its name and the line, where it names a key there."""
    where = "" if path is None else _line(toml_text(path), message)
    return f"{path}: {message}{where}" if where else message


def checked(tables: dict[str, Any], kind: type[T], where: str = "$") -> T:
    """The tables as a `kind`, whose root is at `where`. Raises ConfigError naming key, value and what is allowed."""
    try:
        return msgspec.convert(tables, kind)
    except msgspec.ValidationError as error:
        text = str(error)
        told = _value_at(tables, text) + _known_key(kind, text)
        refused = text if "`$" in text or where == "$" else f"{text} - at `$`"
        raise ConfigError(refused.replace("`$", f"`{where}") + told) from error


def did_you_mean(word: str, allowed: Iterable[str]) -> str:
    """`; did you mean ...?` where one of the allowed words is near, or nothing."""
    import difflib  # takes a moment, and most configurations are right

    near = difflib.get_close_matches(word, list(allowed), n=1)
    return f"; did you mean `{near[0]}`?" if near else ""


def table_in(kind: Any) -> type[msgspec.Struct] | None:
    """The table that a field of this type holds, optional or not; None where it is a plain value."""
    structs = (each for each in (kind, *get_args(kind)) if isinstance(each, type) and issubclass(each, msgspec.Struct))
    return next(structs, None)


def _known_key(kind: Any, message: str) -> str:
    """The known key that is nearest to an unknown one of msgspec's message."""
    if (unknown := _UNKNOWN.search(message)) is None:
        return ""
    table = table_in(kind)
    for name in _key_in(message)[:-1]:
        fields = {field.name: field.type for field in msgspec.structs.fields(table)} if table else {}
        table = table_in(fields.get(name))
    return did_you_mean(unknown[1], [field.name for field in msgspec.structs.fields(table)]) if table else ""


def _line(text: str, message: str) -> str:
    """` (line N)` of the key that the message is about, or of the table it is missing in; nothing without either."""
    key = _key_in(message)
    lines = (line_of(text, key[:size]) for size in range(len(key), 0, -1))
    return next((f" (line {line})" for line in lines if line is not None), "")


def _key_in(message: str) -> list[str]:
    """The key that a refusal names: ours begin with it, msgspec's end with its place, and may name an unknown one."""
    if ours := _OURS.match(message):
        return ours[1].split(".")
    place, unknown = _PLACE.search(message), _UNKNOWN.search(message)
    key = [name for name in place[1].split("[")[0].split(".") if name] if place else []
    return [*key, unknown[1]] if unknown else key


def _value_at(tables: dict[str, Any], message: str) -> str:
    """` (it is VALUE)` for the `$.a.b` path msgspec puts at the end of its message; msgspec leaves the value out.

    An element of an array, `$.a[...]`, is not told from its neighbours, so the value is the array.
    """
    if "`$." not in message:
        return ""
    value: Any = tables
    for key in message.rsplit("`$.", 1)[1].rstrip("`").split("[")[0].split("."):
        if not isinstance(value, dict) or key not in value:
            return ""
        value = value[key]
    return "" if isinstance(value, dict) else f" (it is {in_short(value)})"
