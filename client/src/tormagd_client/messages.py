"""The ZeroMQ messages: one msgpack map per frame, `v: 1`.

`decode` is the border: msgpack unpacks with size limits, msgspec checks names and types, each message checks its own
values. Unknown fields are ignored, so that a newer client can talk to an older daemon.

docs/messages.md lists the fields of all messages, and says when `v` rises.
"""

import re
from typing import Any, TypeVar

import msgpack
import msgspec

from tormagd_client.printable import in_short, require

VERSION = 1
TELEMETRY_TOPIC, MOTION_TOPIC, VERDICT_TOPIC = b"\xde", b"motion", b"verdict"
"Topics of the telemetry socket. A snapshot is a map of over 15 fields, which begins with this byte in msgpack."
MAX_MESSAGE_BYTES = 16_384  # a setpoint with the longest preview is under 3 kB; libzmq drops what is larger
MAX_SOURCE_CHARACTERS = 64
MAX_MARK_CHARACTERS = 200
MAX_PREVIEW_SAMPLES = 256
MIN_PREVIEW_DT_MS, MAX_PREVIEW_DT_MS = 0.1, 1_000.0  # no loop runs faster, and a closer one has a slope without measure
AROUND_ZERO_N = 0.005  # a signal around zero goes so far below it, and is taken as 0
NO_PUSH = "a brake cannot push"
MAX_FORCE_N = 1_000.0  # no brake of this size can mean more; `ask` keeps to the scene's own range
MAX_VALIDITY_MS = 60_000.0
MAX_DISPLACEMENT_MM = 2.0  # since the handle last turned: friction is mobilised there, and more means nothing
MAX_RATE_MM_S = 300.0  # no hand moves a handle faster
MAX_PLACE_MM = 10_000.0
MAX_STIFFNESS_N_MM = 100.0  # bone


class MessageError(ValueError):
    """A message that was refused: the text names the field, its value and what is allowed."""


def _require_within(key: str, value: float | None, least: float, most: float) -> None:
    if not (value is None or least <= value <= most):
        require(False, key, value, f"{least:g}..{most:g}")


def _require_force(key: str, force_N: float | None) -> None:
    if not (force_N is None or -AROUND_ZERO_N <= force_N <= MAX_FORCE_N):
        why = f"; {NO_PUSH}" if force_N < 0.0 else ""
        require(False, key, force_N, f"0..{MAX_FORCE_N:g} N{why}")


class Contact(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """An elastic wall on the handle's way, placed as telemetry's `handle_mm`, positive pushing on. How sure it is:
    standard deviations of its place and, as a share of it, of its stiffness.
    """

    handle_mm: float
    stiffness_N_mm: float
    friction_N: float = 0.0
    place_sd_mm: float = 0.0
    stiffness_share: float = 0.0

    def __post_init__(self) -> None:
        _require_within("contact.handle_mm", self.handle_mm, -MAX_PLACE_MM, MAX_PLACE_MM)
        _require_within("contact.stiffness_N_mm", self.stiffness_N_mm, 0.0, MAX_STIFFNESS_N_MM)
        _require_within("contact.friction_N", self.friction_N, 0.0, MAX_FORCE_N)
        _require_within("contact.place_sd_mm", self.place_sd_mm, 0.0, MAX_PLACE_MM)
        _require_within("contact.stiffness_share", self.stiffness_share, 0.0, 1.0)


class Setpoint(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A force to render, from one publisher. `stamp_ns` is the publisher's CLOCK_REALTIME.

    A force down to -AROUND_ZERO_N means 0. Raises ValueError out of range.
    """

    v: int
    source: str
    seq: int
    stamp_ns: int
    servo_cf: float
    valid_for_ms: float
    displacement_mm: float | None = None
    rate_mm_s: float | None = None
    preview_N: tuple[float, ...] | None = None
    preview_dt_ms: float | None = None
    session: int | None = None
    withdraw_cf: float | None = None
    contact: Contact | None = None

    def __post_init__(self) -> None:
        require(self.v == VERSION, "v", self.v, f"{VERSION}")
        is_named = 0 < len(self.source) <= MAX_SOURCE_CHARACTERS and self.source.isprintable()
        require(is_named, "source", self.source, "1..64 printable characters")
        require(0 <= self.seq < 2**63, "seq", self.seq, "0..2^63-1")
        require(self.session is None or 0 <= self.session < 2**63, "session", self.session, "0..2^63-1")
        require(0 <= self.stamp_ns < 2**63, "stamp_ns", self.stamp_ns, "0..2^63-1 ns since 1970")
        _require_force("servo_cf", self.servo_cf)
        require(0.0 < self.valid_for_ms <= MAX_VALIDITY_MS, "valid_for_ms", self.valid_for_ms, "above 0, to 60000 ms")
        _require_within("displacement_mm", self.displacement_mm, 0.0, MAX_DISPLACEMENT_MM)
        _require_within("rate_mm_s", self.rate_mm_s, -MAX_RATE_MM_S, MAX_RATE_MM_S)
        _require_force("withdraw_cf", self.withdraw_cf)
        spacing = self.preview_dt_ms
        if self.preview_N is not None or spacing is not None:
            is_spacing = spacing is not None and MIN_PREVIEW_DT_MS <= spacing <= MAX_PREVIEW_DT_MS
            require(is_spacing, "preview_dt_ms", spacing, f"{MIN_PREVIEW_DT_MS:g}..{MAX_PREVIEW_DT_MS:g} ms")
        if self.preview_N is not None:
            allowed = f"at most {MAX_PREVIEW_SAMPLES} forces of 0..{MAX_FORCE_N:g} N"
            require(len(self.preview_N) <= MAX_PREVIEW_SAMPLES, "preview_N", f"{len(self.preview_N)} values", allowed)
            for index, force_N in enumerate(self.preview_N):
                _require_force(f"preview_N[{index}]", force_N)


class Tick(msgspec.Struct, frozen=True):
    lateness_us: float
    exec_us: float


class BeliefReport(msgspec.Struct, frozen=True, kw_only=True):
    """One believed value in its unit, its standard deviation (null: not known), and whether it acts now."""

    value: float
    sd: float | None
    unit: str
    acts: bool


class Motion(msgspec.Struct, frozen=True, kw_only=True):
    """The handle's motion: positive pushing on."""

    v: int
    t_ns: int
    device_s: float
    handle_mm: float
    handle_mm_s: float


class Verdict(msgspec.Struct, frozen=True, kw_only=True):
    """What becomes of one setpoint: it is `rendered`, `arrives` in `arrives_ms`, or `cannot`, and `why`; `is_raised` if
    a force around zero is taken as 0.
    """

    v: int
    t_ns: int
    source: str
    seq: int
    outcome: str
    arrives_ms: float | None
    why: tuple[str, ...]
    is_raised: bool = False


class Mark(msgspec.Struct, frozen=True, kw_only=True):
    t_ns: int
    text: str


class Telemetry(msgspec.Struct, frozen=True, kw_only=True):
    """What the daemon is doing, 50 times a second. `t_ns` is CLOCK_REALTIME."""

    v: int
    t_ns: int
    seq: int
    operating_state: str
    is_homed: bool
    is_busy: bool
    setpoint_cf: float | None
    governed_cf: float | None
    measured_cf: float | None
    predicted_cf: float | None
    field_mT: float | None
    gap_mm: float | None
    gap_setpoint_mm: float | None
    measured_jp: tuple[float, float] | None
    skew_mm: float | None
    duty: tuple[float, float]
    limits: tuple[str, ...]
    faults: tuple[str, ...]
    setpoint_age_ms: float | None
    confidence: float | None
    tick: Tick
    belief: dict[str, BeliefReport] = {}
    search_age_ms: float = 0.0
    handle_mm: float | None = None
    handle_mm_s: float | None = None
    verdict: Verdict | None = None
    mark: Mark | None = None


class Explained(msgspec.Struct, frozen=True):
    """A fault or a limit with its cause, in figures where they are known, and its remedy."""

    code: str
    cause: str
    remedy: str


class RoundTripReport(msgspec.Struct, frozen=True):
    """Percentiles of the time from handing a Drive to the wire until its State was read, us."""

    least: float
    p50: float
    p99: float


class ClockReport(msgspec.Struct, frozen=True):
    """Line through the device's clock: host minus device, and by how much the device's clock runs fast."""

    offset_s: float
    drift_ppm: float
    residual_us: float
    windows: int
    outliers: int


class LinkReport(msgspec.Struct, frozen=True, kw_only=True):
    """The device at the other end of the wire, and how well the wire carries."""

    state: str
    cause: str
    remedy: str
    backend: str
    port: str
    losses: int
    last_loss: str
    firmware: str | None
    serial_number: int | None
    firmware_schema: str | None
    daemon_schema: str
    protocol_version: int
    frames: int | None
    bytes: int | None
    corrupt: int | None
    lost: int | None
    repeated: int | None
    resynchronisations: int | None
    round_trip_us: RoundTripReport | None
    clock: ClockReport | None
    unsent: int | None = None
    refused: dict[str, str] = {}
    unanswered_share: float | None = None
    damaged_share: float | None = None


class ExecReport(msgspec.Struct, frozen=True, kw_only=True):
    """Percentiles of a duration over the last seconds, and the longest of them, us."""

    p50: float
    p99: float
    p999: float
    max: float


class SourceReport(msgspec.Struct, frozen=True, kw_only=True):
    """One publisher: whether it holds the brake, how its messages come, and its clock against this machine's; `raised`
    counts its setpoints around zero that were taken as 0.
    """

    state: str
    silent_ms: float
    session: int | None
    seq: int
    accepted: int
    refused: int
    lost: int
    restarts: int
    delay_us: ExecReport
    jitter_us: float
    clock_behind_ms: float | None
    clock_steps: int
    clock: ClockReport | None
    cause: str
    remedy: str
    raised: int = 0


class PlayoutReport(msgspec.Struct, frozen=True, kw_only=True):
    """The effect of holding setpoints back until `playout_ms` after their stamps."""

    playout_ms: float
    held_us: ExecReport
    jitter_us: float
    setpoints: int
    late: int


class SetpointReport(msgspec.Struct, frozen=True, kw_only=True):
    """Counts of setpoints since the daemon's start; `sources` has each publisher's newest `seq`."""

    accepted: int
    refused: int
    dropped: int
    last_refusal: str | None
    newest_source: str
    sources: dict[str, int]
    by_source: dict[str, SourceReport] = msgspec.field(default_factory=dict)
    playout: PlayoutReport | None = None


class WayReport(msgspec.Struct, frozen=True, kw_only=True):
    """Time of a setpoint from its stamp to the force, against a budget. Null is not known yet."""

    to_duty_us: ExecReport
    device_us: float | None
    carriages_ms: float | None
    total_ms: float | None
    budget_ms: float


class LatenessReport(ExecReport, frozen=True, kw_only=True):
    """Percentiles of how late runs began in the last seconds, us; `worst` is the longest since the start."""

    worst: float


class RateReport(msgspec.Struct, frozen=True, kw_only=True):
    """How well a rate group keeps its time: counts since the start, percentiles over the last five to ten seconds."""

    grade: str
    hz: float
    runs: int
    merged: int
    overruns: int
    stalls: int
    lateness_us: LatenessReport
    exec_us: ExecReport


class DeviceReport(msgspec.Struct, frozen=True, kw_only=True):
    """Learned correction of the device: its force is `scale` times the model's plus `offset_N`."""

    scale: float
    scale_sd: float
    offset_N: float
    offset_sd_N: float
    sensor_zero_N: float
    sensor_zero_sd_N: float
    lag_ms: float | None = None


class ProfileReport(msgspec.Struct, frozen=True, kw_only=True):
    """The device's stored profile: whether it is used, its age on the disk (null: none), and why there is none."""

    is_used: bool
    age_s: float | None
    refusal: str
    folder: str = ""


class CalibrationReport(msgspec.Struct, frozen=True, kw_only=True):
    """The device's calibration: the file in force, why none is, and the folder; empty where there is none."""

    file: str = ""
    refusal: str = ""
    folder: str = ""


class BlackBoxReport(msgspec.Struct, frozen=True, kw_only=True):
    """Folder of the black boxes, the newest of this run, why there is none, and how many parts were lost."""

    folder: str = ""
    newest: str = ""
    refusal: str = ""
    dropped: int = 0


class StallReport(msgspec.Struct, frozen=True):
    ms: float
    culprit: str


class PeerReport(msgspec.Struct, frozen=True):
    """A peer that was refused, or whose messages were dropped: where, who, why, and how often in a row."""

    endpoint: str
    address: str
    key: str
    reason: str
    count: int


class PeersReport(msgspec.Struct, frozen=True, kw_only=True):
    """Connections by endpoint, and since the start the peers refused and the messages dropped unread."""

    connections: dict[str, int] = msgspec.field(default_factory=dict)
    refused: int = 0
    dropped: int = 0
    refusals: tuple[PeerReport, ...] = ()
    drops: tuple[PeerReport, ...] = ()


class OutputReport(msgspec.Struct, frozen=True, kw_only=True):
    """Control ticks in which each output stage has acted, in the order of the stages."""

    rate: int = 0
    slew: int = 0
    not_finite: int = 0
    range: int = 0


class FollowingReport(msgspec.Struct, frozen=True, kw_only=True):
    """How well the force was followed in the last seconds in which it could be: the RMS of measured less asked, as it
    is, and with `delay_ms` taken out, the delay that explains most of it.
    """

    rms_N: float
    aligned_rms_N: float
    delay_ms: float


class ArmReport(msgspec.Struct, frozen=True, kw_only=True):
    given: tuple[str, ...]
    is_over: bool
    error: Explained | None = None


class SceneReport(msgspec.Struct, frozen=True, kw_only=True):
    scene: str
    is_over: bool
    error: Explained | None = None


class Status(Telemetry, frozen=True, kw_only=True):
    """Answer to the command `status`: the newest telemetry, and what is told only on demand."""

    version: str
    build: str = ""
    scene: str
    scene_fingerprint: str = ""
    terms_out: tuple[str, ...] = ()
    solver: str = ""
    roller_radius_mm: float | None = None
    uptime_s: float
    least_N: float
    most_N: float
    trim: float
    device: DeviceReport
    profile: ProfileReport
    least_gap_mm: float
    link: LinkReport
    setpoints: SetpointReport
    peers: PeersReport = PeersReport()
    rates: dict[str, RateReport]
    phases_us: dict[str, ExecReport] = {}
    late_ticks_by: dict[str, int]
    fault_details: tuple[Explained, ...]
    limit_details: tuple[Explained, ...]
    newest_stall: StallReport | None
    not_granted: tuple[str, ...]
    way: WayReport | None = None
    black_box: BlackBoxReport = BlackBoxReport()
    output: OutputReport = OutputReport()
    next_commands: tuple[str, ...] = ()
    is_open: bool | None = None
    following: FollowingReport | None = None
    arm: ArmReport | None = None
    scene_change: SceneReport | None = None
    calibration: CalibrationReport = CalibrationReport()
    process_id: int | None = None


class PortraitReport(msgspec.Struct, frozen=True, kw_only=True):
    """Learned phase portrait of the device: rising forces, and the fastest change of each, either way, by the gap's
    speed.
    """

    force_N: tuple[float, ...]
    rate_N_s: tuple[float, ...]


class Description(msgspec.Struct, frozen=True, kw_only=True):
    """Answer to the command `describe`: what a recording is of. Null is not known."""

    version: str
    build: str
    configuration: dict[str, Any]
    scene: dict[str, Any]
    model: str
    profile: ProfileReport
    firmware: str | None
    serial_number: int | None
    portrait: PortraitReport | None = None
    configuration_file: str | None = None
    core: dict[str, str] = {}


class Numbered(msgspec.Struct, frozen=True, kw_only=True):
    """A request, even a wrong one."""

    id: int | str


class Request(Numbered, frozen=True, kw_only=True):
    """A command to the daemon's control endpoint. Raises ValueError for another version, or too long a command."""

    v: int
    command: str
    args: dict[str, Any] = msgspec.field(default_factory=dict)

    def __post_init__(self) -> None:
        require(self.v == VERSION, "v", self.v, f"{VERSION}")
        require(0 < len(self.command) <= 64, "command", self.command, "1..64 characters")


class ErrorReply(msgspec.Struct, frozen=True):
    code: str
    message: str
    hint: str


class Reply(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The answer to a `Request`: `result` where `ok`, `error` otherwise."""

    v: int
    id: int | str | None
    ok: bool
    result: dict[str, Any] | None = None
    error: ErrorReply | None = None


M = TypeVar("M", Setpoint, Telemetry, Motion, Verdict, Numbered, Request, Reply)

_MISSING = re.compile(r"Object missing required field `(.+?)`(?: - at `\$(\.?)(.*)`)?")
_TOO_LONG = re.compile(r".* (\d+) exceeds max_(\w+)_len\((\d+)\)")
_EXPECTED = re.compile(r"Expected `(.+?)`, got `(.+?)`(?: - at `\$\.?(.*)`)?")
_REMEDIES = {
    ("int", "float"): "; pack a whole number (JavaScript: BigInt)",
    ("int", "Timestamp"): "; pack ns since 1970",
    ("object", "array"): "; pack the names with the values (rmp-serde: to_vec_named)",
    ("str", "bin"): "; pack text as str",
}
_KINDS = {"object": "map", "bytes": "bin"}
_RAW = msgspec.msgpack.Decoder(msgspec.Raw)


def decode(data: bytes, message_type: type[M]) -> M:
    """Return the message in `data`. Raises MessageError for anything but a valid map of this type."""
    if len(data) > MAX_MESSAGE_BYTES:
        raise MessageError(f"message of {len(data)} bytes: allowed is {MAX_MESSAGE_BYTES}")
    if not data:
        raise MessageError("message is empty, or has several parts: allowed is one part, the map, without a topic")
    _require_whole(data)
    try:
        unpacked = msgpack.unpackb(
            data,
            object_pairs_hook=_map,
            max_str_len=4096,
            max_bin_len=4096,
            max_array_len=1024,
            max_map_len=256,
            max_ext_len=256,
        )
    except msgpack.ExtraData as error:
        where = "after" if isinstance(error.unpacked, dict) else "before"
        kind = "is JSON" if data[:1] in b"[{" else f"has bytes {where} the map"
        raise MessageError(f"message {kind}: allowed is one msgpack map and nothing else") from error
    except MessageError:
        raise
    except (ValueError, msgpack.UnpackException, RecursionError) as error:
        said = f"not a msgpack map: {type(error).__name__} {error}".strip()
        raise MessageError(_TOO_LONG.sub(r"message has a long \2, of \1: allowed is \3", said)) from error
    try:
        return msgspec.convert(unpacked, message_type)
    except msgspec.ValidationError as error:
        raise MessageError(_in_words(str(error))) from error


def _require_whole(data: bytes) -> None:
    """Require all that lengths announce: msgpack takes memory for it first."""
    try:
        _RAW.decode(data)
    except (msgspec.DecodeError, RecursionError) as error:
        if "trailing" not in str(error):
            raise MessageError(f"not a msgpack map: {error}") from error


def _map(pairs: list[tuple[Any, Any]]) -> dict[Any, Any]:
    for name, _ in pairs:
        if type(name) is not str:
            raise MessageError(f"key {in_short(name)} is bin: allowed is str; pack names as str, numbers as numbers")
    if len(unpacked := dict(pairs)) < len(pairs):
        twice = next(name for name, _ in pairs if [each for each, _ in pairs].count(name) > 1)
        raise MessageError(f"{in_short(twice)} stands twice: allowed is once")
    return unpacked


def _in_words(text: str) -> str:
    """Return what msgspec found wrong as `field is a type: allowed is another`."""
    match = _EXPECTED.fullmatch(text)
    if match is None:
        return _MISSING.sub(r"\3\2\1 is missing", text)
    expected, got = (_KINDS.get(kind, kind) for kind in match.groups()[:2])
    remedy = _REMEDIES.get((match[1], got), "")
    return f"{match[3] or 'message'} is {got}: allowed is {expected.replace(' | null', '')}{remedy}"


def encode(message: Setpoint | Telemetry | Motion | Verdict | Request | Reply | dict[str, Any]) -> bytes:
    """Return the message as bytes; numbers and arrays of NumPy go as numbers and lists. Raises MessageError."""
    try:
        return _ENCODER.encode(message)
    except (TypeError, OverflowError) as error:
        raise MessageError(f"message: allowed are numbers, texts, lists and maps: {error}") from error


def _plain(value: Any) -> Any:
    if hasattr(value, "tolist"):
        return value.tolist()
    raise TypeError(f"{in_short(value)} is none of them")


_ENCODER = msgspec.msgpack.Encoder(enc_hook=_plain)
