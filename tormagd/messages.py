"""The ZeroMQ messages: one msgpack map per frame, `v: 1`.

`decode` is the border: msgpack unpacks with size limits, msgspec checks names and types, each message checks its own
values. Unknown fields are ignored, so that a newer client can talk to an older daemon.
"""

from typing import Any, TypeVar

import msgpack
import msgspec

VERSION = 1
MAX_MESSAGE_BYTES = 16_384  # a setpoint with the longest preview is under 3 kB; libzmq drops what is larger
MAX_SOURCE_CHARACTERS = 64
MAX_PREVIEW_SAMPLES = 256
MAX_FORCE_N = 1_000.0  # a value no brake of this size can mean; the scene's own range is enforced by the governor
MAX_VALIDITY_MS = 60_000.0
MAX_DISPLACEMENT_MM = 2.0  # since the handle last turned: friction is mobilised there, and more means nothing
MAX_RATE_MM_S = 300.0  # no hand moves a handle faster
LONGEST_SHOWN = 80  # characters of a refused value: an answer with the refusal in it has to stay readable itself


class MessageError(ValueError):
    """A message that was refused: the text says which field, its value and what is allowed."""


def _require(condition: bool, name: str, value: object, allowed: str) -> None:
    if not condition:
        shown = repr(value)
        if len(shown) > LONGEST_SHOWN:
            shown = f"{shown[: LONGEST_SHOWN - 3]}..."
        raise ValueError(f"{name} = {shown}: allowed is {allowed}")


class Setpoint(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A force to render, from one publisher. `stamp_ns` is CLOCK_REALTIME at the publisher.

    `displacement_mm` (since the handle turned) and `rate_mm_s` say at which handle motion the force is meant; without
    them the daemon uses the motion it measures. `preview_N` holds the forces that follow this one, `preview_dt_ms`
    apart.
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

    def __post_init__(self) -> None:
        _require(self.v == VERSION, "v", self.v, f"{VERSION}")
        _require(0 < len(self.source) <= MAX_SOURCE_CHARACTERS, "source", self.source, "1..64 characters")
        _require(0 <= self.seq < 2**63, "seq", self.seq, "0..2^63-1")
        _require(0 <= self.stamp_ns < 2**63, "stamp_ns", self.stamp_ns, "0..2^63-1 ns since 1970")
        _require(0.0 <= self.servo_cf <= MAX_FORCE_N, "servo_cf", self.servo_cf, f"0..{MAX_FORCE_N:g} N")
        _require(0.0 < self.valid_for_ms <= MAX_VALIDITY_MS, "valid_for_ms", self.valid_for_ms, "above 0, to 60000 ms")
        for name, least, most in (
            ("displacement_mm", 0.0, MAX_DISPLACEMENT_MM),
            ("rate_mm_s", -MAX_RATE_MM_S, MAX_RATE_MM_S),
        ):
            value = getattr(self, name)
            _require(value is None or least <= value <= most, name, value, f"{least:g}..{most:g}")
        if self.preview_N is not None:
            allowed = f"at most {MAX_PREVIEW_SAMPLES} forces of 0..{MAX_FORCE_N:g} N"
            _require(len(self.preview_N) <= MAX_PREVIEW_SAMPLES, "preview_N", f"{len(self.preview_N)} values", allowed)
            for index, force_N in enumerate(self.preview_N):
                if not 0.0 <= force_N <= MAX_FORCE_N:
                    raise ValueError(f"preview_N[{index}] = {force_N!r}: allowed is 0..{MAX_FORCE_N:g} N")
            spacing = self.preview_dt_ms
            _require(spacing is not None and 0.0 < spacing <= 1_000.0, "preview_dt_ms", spacing, "above 0, to 1000 ms")


class Tick(msgspec.Struct, frozen=True):
    """Timing of the newest control tick."""

    lateness_us: float
    exec_us: float


class Telemetry(msgspec.Struct, frozen=True, kw_only=True):
    """What the daemon is doing, 50 times a second. Forces in N, lengths in mm, `t_ns` CLOCK_REALTIME.

    `measured_cf` is the force sensor's, `predicted_cf` the model's at the measured gap and motion. A value that is not
    known (no device, no setpoint) is null.
    """

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


class Request(msgspec.Struct, frozen=True, kw_only=True):
    """A command to the daemon's control endpoint."""

    v: int
    id: int | str
    command: str
    args: dict[str, Any] = msgspec.field(default_factory=dict)

    def __post_init__(self) -> None:
        _require(self.v == VERSION, "v", self.v, f"{VERSION}")
        _require(0 < len(self.command) <= 64, "command", self.command, "1..64 characters")


class ErrorReply(msgspec.Struct, frozen=True):
    """Why a command was refused, and what to do about it."""

    code: str
    message: str
    hint: str


class Reply(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The answer to a `Request`: `result` where ok, `error` otherwise."""

    v: int
    id: int | str | None
    ok: bool
    result: dict[str, Any] | None = None
    error: ErrorReply | None = None


M = TypeVar("M", Setpoint, Telemetry, Request, Reply)


def decode(data: bytes, message_type: type[M]) -> M:
    """The message in `data`. Raises MessageError for anything but a valid map of this type."""
    if len(data) > MAX_MESSAGE_BYTES:
        raise MessageError(f"message of {len(data)} bytes: allowed is {MAX_MESSAGE_BYTES}")
    try:
        unpacked = msgpack.unpackb(
            data, max_str_len=4096, max_bin_len=0, max_array_len=1024, max_map_len=256, max_ext_len=0
        )
    except (ValueError, msgpack.UnpackException, RecursionError) as error:
        raise MessageError(f"not a msgpack map: {type(error).__name__} {error}".strip()) from error
    try:
        return msgspec.convert(unpacked, message_type)
    except msgspec.ValidationError as error:
        raise MessageError(str(error)) from error


def encode(message: Setpoint | Telemetry | Request | Reply) -> bytes:
    """The msgpack map of `message`."""
    return _ENCODER.encode(message)


_ENCODER = msgspec.msgpack.Encoder()
