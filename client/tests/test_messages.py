"""The ZeroMQ messages: whatever arrives becomes a valid message or a MessageError, and nothing else."""

import math
import re
import tracemalloc
from pathlib import Path
from typing import Any

import msgpack
import msgspec
import pytest
from hypothesis import given, strategies as st

from tormagd_client.messages import (
    MAX_DISPLACEMENT_MM,
    MAX_MESSAGE_BYTES,
    MAX_PREVIEW_SAMPLES,
    MAX_RATE_MM_S,
    ErrorReply,
    MessageError,
    Reply,
    Request,
    Setpoint,
    Telemetry,
    Tick,
    decode,
    encode,
)
from tormagd_client.printable import LONGEST_SHOWN

PAGE = (Path(__file__).parents[2] / "docs/messages.md").read_text(encoding="utf-8")
WALL = {"handle_mm": 1.0, "stiffness_N_mm": 0.5}
SETPOINT: dict[str, Any] = {"v": 1, "source": "a", "seq": 7, "stamp_ns": 10**18, "servo_cf": 1.5, "valid_for_ms": 50.0}
REQUEST: dict[str, Any] = {"v": 1, "id": 3, "command": "status"}
TYPES = (Setpoint, Telemetry, Request, Reply)

forces = st.floats(0.0, 1_000.0)
displacements = st.none() | st.floats(0.0, MAX_DISPLACEMENT_MM)
rates = st.none() | st.floats(-MAX_RATE_MM_S, MAX_RATE_MM_S)
setpoints = st.builds(
    Setpoint,
    v=st.just(1),
    source=st.text(min_size=1, max_size=64).filter(lambda text: text.isprintable()),
    seq=st.integers(0, 2**63 - 1),
    stamp_ns=st.integers(0, 2**63 - 1),
    servo_cf=forces,
    valid_for_ms=st.floats(0.0, 60_000.0, exclude_min=True),
    displacement_mm=displacements,
    rate_mm_s=rates,
    preview_N=st.lists(forces, max_size=256).map(tuple),
    preview_dt_ms=st.floats(0.1, 1_000.0),
)
values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.text(max_size=8)
    | st.binary(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=8,
)


def changed(base: dict[str, Any], **fields: Any) -> bytes:
    packed: bytes = msgpack.packb(base | fields)
    return packed


def refusal(data: bytes, kind: type[Any] = Setpoint) -> str:
    with pytest.raises(MessageError) as caught:
        decode(data, kind)
    return str(caught.value)


requests = st.builds(
    Request,
    v=st.just(1),
    id=st.integers(-(2**63), 2**63 - 1) | st.text(max_size=20),
    command=st.text(min_size=1, max_size=64),
    args=st.dictionaries(st.text(max_size=8), st.none() | st.booleans() | st.text(max_size=8), max_size=4),
)
REFUSED = Reply(v=1, id=None, ok=False, error=ErrorReply("busy", "homing", "wait"))
DONE = Reply(v=1, id="x", ok=True, result={"operating_state": "ENABLED", "faults": []})
TELEMETRY = Telemetry(
    v=1,
    t_ns=1,
    seq=2,
    operating_state="DISABLED",
    is_homed=False,
    is_busy=False,
    setpoint_cf=None,
    governed_cf=0.4,
    measured_cf=None,
    predicted_cf=None,
    field_mT=51.0,
    gap_mm=None,
    gap_setpoint_mm=None,
    measured_jp=(47.5, 47.4),
    skew_mm=None,
    duty=(0.0, -1.0),
    limits=("STALE",),
    faults=(),
    setpoint_age_ms=None,
    confidence=1.0,
    tick=Tick(12.0, 100.0),
)


@given(setpoints, requests)
def test_messages_come_back_as_they_went(setpoint: Setpoint, request_: Request) -> None:
    sent: list[Any] = [setpoint, request_, REFUSED, DONE, TELEMETRY]
    assert [decode(encode(message), type(message)) for message in sent] == sent


def test_a_message_is_a_plain_msgpack_map() -> None:
    assert msgpack.unpackb(encode(decode(changed(SETPOINT), Setpoint))) == SETPOINT


def test_the_longest_preview_fits_the_size_limit() -> None:
    preview = tuple(1.0 + 1.0 / (k + 3.0) for k in range(MAX_PREVIEW_SAMPLES))
    full = msgspec.structs.replace(decode(changed(SETPOINT), Setpoint), preview_N=preview, preview_dt_ms=2.0)
    assert len(encode(full)) < MAX_MESSAGE_BYTES / 4
    assert decode(encode(full), Setpoint) == full


@pytest.mark.parametrize("kind", [Setpoint, Request])
def test_unknown_fields_are_ignored(kind: type[Any]) -> None:
    base = SETPOINT if kind is Setpoint else REQUEST
    assert decode(changed(base, colour="blue", nested={"v": 2, "list": [1, None]}), kind) == decode(changed(base), kind)


@pytest.mark.parametrize("name", SETPOINT)
def test_a_missing_field_is_named(name: str) -> None:
    assert (
        refusal(msgpack.packb({key: value for key, value in SETPOINT.items() if key != name})) == f"{name} is missing"
    )


@pytest.mark.parametrize("name", ["v", "seq", "stamp_ns", "servo_cf", "valid_for_ms", "displacement_mm", "rate_mm_s"])
@pytest.mark.parametrize("value", ["1.5", True, [1.5], {"N": 1.5}, b"1.5", "nan"])
def test_a_number_is_a_number(name: str, value: object) -> None:
    # msgpack refuses binary before names are known
    assert name in refusal(changed(SETPOINT, **{name: value})) or isinstance(value, bytes)


@pytest.mark.parametrize("name", ["servo_cf", "valid_for_ms", "displacement_mm", "rate_mm_s"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_numbers_that_are_not_finite_are_refused(name: str, value: float) -> None:
    text = refusal(changed(SETPOINT, **{name: value}))
    assert [said for said in (f"{name} = {value}", "allowed is") if said not in text] == []


@pytest.mark.parametrize(
    ("fields", "name"),
    [
        ({"v": 2}, "v = 2"),
        ({"v": 0}, "v = 0"),
        ({"source": ""}, "source = ''"),
        ({"source": "x" * 65}, "source"),
        ({"seq": -1}, "seq = -1"),
        ({"seq": 2**63}, "seq"),
        ({"seq": 1.5}, "seq"),
        ({"stamp_ns": -1}, "stamp_ns = -1"),
        ({"stamp_ns": 2**64 - 1}, "stamp_ns"),
        ({"servo_cf": -0.00501}, "servo_cf = -0.00501: allowed is 0..1000 N; a brake cannot push"),
        ({"servo_cf": 1_000.1}, "servo_cf = 1000.1"),
        ({"valid_for_ms": 0.0}, "valid_for_ms = 0.0"),
        ({"valid_for_ms": 60_001.0}, "valid_for_ms = 60001.0"),
        ({"displacement_mm": 1e10}, "displacement_mm = 10000000000.0"),
        ({"displacement_mm": -0.1}, "displacement_mm = -0.1: allowed is 0..2"),
        ({"rate_mm_s": -1e308}, "rate_mm_s = -1e+308"),
        ({"rate_mm_s": 301}, "rate_mm_s = 301.0: allowed is -300..300"),
        ({"preview_N": [1.0] * 257, "preview_dt_ms": 2.0}, "preview_N = '257 values'"),
        ({"preview_N": [1.0] * 1_300, "preview_dt_ms": 2.0}, "message has a long array, of 1300: allowed is 1024"),
        ({"source": "x" * 4_097}, "message has a long str, of 4097: allowed is 4096"),
        ({"preview_N": [1.0, math.nan], "preview_dt_ms": 2.0}, "preview_N[1] = nan"),
        ({"preview_N": [1.0, -1.0], "preview_dt_ms": 2.0}, "preview_N"),
        ({"preview_N": [1.0, "2"], "preview_dt_ms": 2.0}, "preview_N"),
        ({"preview_N": [1.0]}, "preview_dt_ms = None"),
        ({"preview_N": [1.0], "preview_dt_ms": 0.0}, "preview_dt_ms = 0.0"),
        ({"preview_N": [1.0], "preview_dt_ms": 5e-324}, "preview_dt_ms = 5e-324: allowed is 0.1..1000 ms"),
        ({"preview_N": [1.0], "preview_dt_ms": math.inf}, "preview_dt_ms = inf"),
        ({"contact": {"stiffness_N_mm": 1.0}}, "contact.handle_mm is missing"),
        ({"contact": WALL | {"handle_mm": 10_001.0}}, "contact.handle_mm = 10001.0: allowed is -10000..10000"),
        ({"contact": WALL | {"handle_mm": math.nan}}, "contact.handle_mm = nan: allowed is -10000..10000"),
        ({"contact": WALL | {"stiffness_N_mm": -0.1}}, "contact.stiffness_N_mm = -0.1: allowed is 0..100"),
        ({"contact": WALL | {"stiffness_N_mm": 101.0}}, "contact.stiffness_N_mm = 101.0: allowed is 0..100"),
        ({"contact": WALL | {"friction_N": -0.1}}, "contact.friction_N = -0.1: allowed is 0..1000"),
        ({"contact": WALL | {"friction_N": math.inf}}, "contact.friction_N = inf: allowed is 0..1000"),
        ({"contact": WALL | {"place_sd_mm": -0.1}}, "contact.place_sd_mm = -0.1: allowed is 0..10000"),
        ({"contact": WALL | {"place_sd_mm": math.nan}}, "contact.place_sd_mm = nan: allowed is 0..10000"),
        ({"contact": WALL | {"stiffness_share": 1.1}}, "contact.stiffness_share = 1.1: allowed is 0..1"),
    ],
)
def test_values_out_of_range_are_named(fields: dict[str, Any], name: str) -> None:
    assert name in refusal(changed(SETPOINT, **fields))


@pytest.mark.parametrize(
    ("fields", "kind"),
    [
        ({"preview_N": [-1.2345678901234567e100] * MAX_PREVIEW_SAMPLES, "preview_dt_ms": 1.0}, Setpoint),
        ({"source": "\x1b" * 4_000}, Setpoint),
        ({"command": "\x1b" * 4_000}, Request),
    ],
)
def test_a_refusal_is_short_whatever_was_sent(fields: dict[str, Any], kind: type[Any]) -> None:
    assert len(refusal(changed(SETPOINT if kind is Setpoint else REQUEST, **fields), kind)) < LONGEST_SHOWN + 60


@pytest.mark.parametrize(
    ("fields", "name"),
    [
        ({"v": 3}, "v = 3"),
        ({"command": ""}, "command"),
        ({"command": "c" * 65}, "command"),
        ({"id": None}, "id"),
        ({"id": 1.0}, "id"),
        ({"args": []}, "args"),
    ],
)
def test_requests_out_of_range_are_named(fields: dict[str, Any], name: str) -> None:
    assert name in refusal(changed(REQUEST, **fields), Request)


@pytest.mark.parametrize("size", [MAX_MESSAGE_BYTES + 1, 10_000_000])
def test_oversize_is_refused_before_it_is_read(size: int) -> None:
    assert f"{size} bytes" in refusal(b"\xc1" * size)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\x80",
        b"\xc1",
        b"\xdf\xff\xff\xff\xff",  # claims 2^32 - 1 entries
        b"\xdd\xff\xff\xff\xff",
        b"\xc6\xff\xff\xff\xff",
        b"\x91" * MAX_MESSAGE_BYTES,  # nested arrays
        b"\xdc\x04\x00" * (MAX_MESSAGE_BYTES // 3),  # each claims 1,024 entries
        b"\x81\xa1a" * (MAX_MESSAGE_BYTES // 3),
        b"\x81\x01\x01",  # a key that is no text
        b"\x81\x90\x01",  # a key that cannot be hashed
        b"\xd6\xff\x00\x00\x00\x00",  # a timestamp
        b"\xc7\x00\x05",
        b"\x81\xa2\xff\xfe\x01",  # a key that is not UTF-8
        msgpack.packb([1, 2, 3]),
        msgpack.packb(SETPOINT) + b"\x00",
        msgpack.packb(SETPOINT)[:-1],
    ],
    ids=range(17),
)
@pytest.mark.parametrize("kind", TYPES)
def test_broken_msgpack_is_a_message_error_and_costs_no_memory(data: bytes, kind: type[Any]) -> None:
    tracemalloc.start()
    refusal(data, kind)
    assert tracemalloc.get_traced_memory()[1] < 20 * MAX_MESSAGE_BYTES
    tracemalloc.stop()


@pytest.mark.parametrize("depth", [100, 300, 400, 511, 600, 900, 1000, 1023, 1100])
@pytest.mark.parametrize("one", [b"\x91", b"\x81\xa1a"])
def test_deep_nesting_is_decoded_or_refused(depth: int, one: bytes) -> None:
    nested = b"\x84\xa1v\x01\xa2id\x01\xa7command\xa1x\xa4args\x81\xa1k" + one * depth + b"\xc0"
    try:
        request = decode(nested, Request)
    except MessageError:
        return
    assert request.command == "x"


@given(data=st.binary(max_size=200), kind=st.sampled_from(TYPES))
def test_random_bytes_are_a_message_error(data: bytes, kind: type[Any]) -> None:
    refusal(data, kind)


@given(
    base=st.sampled_from([SETPOINT, REQUEST]),
    changes=st.dictionaries(
        st.sampled_from([*SETPOINT, *REQUEST, "args", "preview_N", "preview_dt_ms", "rate_mm_s"]), values
    ),
    dropped=st.sets(st.sampled_from([*SETPOINT, *REQUEST])),
    kind=st.sampled_from(TYPES),
)
def test_any_map_is_a_valid_message_or_a_message_error(
    base: dict[str, Any], changes: dict[str, Any], dropped: set[str], kind: type[Any]
) -> None:
    fields = {key: value for key, value in (base | changes).items() if key not in dropped}
    try:
        message = decode(msgpack.packb(fields), kind)
    except MessageError:
        return
    if isinstance(message, Setpoint):
        assert 0.0 <= message.servo_cf <= 1_000.0
        assert 0.0 < message.valid_for_ms <= 60_000.0
        assert all(value is None or math.isfinite(value) for value in (message.displacement_mm, message.rate_mm_s))


@given(cut=st.integers(0, 200), flipped=st.integers(0, 200), bit=st.integers(0, 7))
def test_damaged_setpoints_never_break_the_decoder(cut: int, flipped: int, bit: int) -> None:
    data = bytearray(changed(SETPOINT, rate_mm_s=3.0, preview_N=[1.0, 2.0], preview_dt_ms=2.0))
    data[flipped % len(data)] ^= 1 << bit
    try:
        decode(bytes(data[: cut or None]), Setpoint)
    except MessageError as error:
        refused = str(error)
    else:
        return
    assert refused


PACKED: dict[str, bytes] = {
    "whole numbers as int": changed(SETPOINT, servo_cf=2, valid_for_ms=500),
    "float32": msgpack.packb(SETPOINT, use_single_float=True),
    **{f"`servo_cf` of {force}": changed(SETPOINT, servo_cf=float(force)) for force in ("-0.0", "-1e-17", "-0.003")},
    **{f"`servo_cf` of {force}": changed(SETPOINT, servo_cf=float(force)) for force in ("-0.3", "NaN")},
    "`servo_cf` by msgpack_numpy": changed(SETPOINT, servo_cf={b"nd": False, b"type": b"<f8", b"data": bytes(8)}),
    "`stamp_ns` as float": changed(SETPOINT, stamp_ns=1e18),
    "`stamp_ns` as timestamp": changed(SETPOINT, stamp_ns=msgpack.Timestamp(10**9)),
    "`seq` as float": changed(SETPOINT, seq=7.0),
    "`v` of true": changed(SETPOINT, v=True),
    "`valid_for_ms` of 0": changed(SETPOINT, valid_for_ms=0),
    "`source` with zeros of C": changed(SETPOINT, source="robot\0\0"),
    "`source` as bin": changed(SETPOINT, source=b"robot"),
    "names as bin": msgpack.packb({name.encode(): value for name, value in SETPOINT.items()}),
    "a name twice": b"\x87" + changed(SETPOINT)[1:] + msgpack.packb("servo_cf") + msgpack.packb(0.5),
    "array": msgpack.packb(list(SETPOINT.values())),
    "two parts": b"",
    "a topic in front": b"setpoint " + changed(SETPOINT),
    "a newline behind": changed(SETPOINT) + b"\n",
    "JSON": b'{"v":1,"source":"robot"}',
}
"""Setpoints as other packers write them. The daemon reads the first of two parts as empty."""
TABLE = PAGE.partition("## What packers send")[2].partition("\n## ")[0]
TOLD = dict(re.findall(r"^\| (.+) \| `?(.+?)`? \|$", TABLE, re.MULTILINE))


def test_the_page_tells_of_each_packer() -> None:
    assert [*PACKED] == [*TOLD][2:]


@pytest.mark.parametrize("name", PACKED)
def test_what_packers_send_is_taken_or_refused_as_the_page_says(name: str) -> None:
    if TOLD[name].startswith("taken"):
        assert decode(PACKED[name], Setpoint).servo_cf in (2.0, 1.5, 0.0, -1e-17, -0.003)
    else:
        assert refusal(PACKED[name]) == TOLD[name]
