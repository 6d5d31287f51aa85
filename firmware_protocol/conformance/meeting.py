"""Checks of Hello and Identity, schema and version, and of what a mismatch leads to. Nothing moves."""

from typing import Final

from firmware_protocol.codec import PROTOCOL_VERSION, SCHEMA_HASH, Clear, DeviceFault, DeviceMode, Identity
from firmware_protocol.conformance.check import Hazard, check
from firmware_protocol.conformance.host import ANSWER_S, NO_FAULT, SEEN_S, Beat, Host, Unmet, is_homed, shown, unless

PAGE = "Who says what when, 1"
CLEARING = "What each mode takes"
HELLOS = 3
NONCES: Final = (1, 129, 1, 65, 1, 33, 1, 17, 1, 9, 1, 5, 1, 3, 2, 254, 253, 128, 127, 126, 6)
"""Each bit changes alone, up and down by any distance."""


@check(Hazard.MISLED, PAGE, f"{HELLOS} Hellos", "one Identity each, at once", is_gate=True)
def identity_answers_hello(host: Host) -> str:
    for _ in range(HELLOS):
        host.hello()
    count = len(host.all_of(Identity))
    refused = f"; refused: {', '.join(host.refused)}" if host.refused else ""
    return unless(count != HELLOS, f"{count} Identity for {HELLOS} Hellos{refused}")


@check(
    Hazard.MISLED,
    PAGE,
    "Hello",
    f"Identity with schema {SCHEMA_HASH:08X}, bytes {SCHEMA_HASH.to_bytes(4, 'little').hex(' ')}",
    is_gate=True,
)
def schema_hash(host: Host) -> str:
    """Tells a reversed byte order apart from another tormag.dbc."""
    host.hello()
    theirs = host.last(Identity).schema_hash
    seen = f"schema {theirs:08X}, bytes {theirs.to_bytes(4, 'little').hex(' ')}"
    if theirs == int.from_bytes(SCHEMA_HASH.to_bytes(4, "little"), "big"):
        raise Unmet(f"{seen}: its bytes are the wrong way round")
    different = ": firmware and this program are built from different tormag.dbc" if theirs != SCHEMA_HASH else ""
    return unless(different, seen + different)


@check(Hazard.MISLED, "Who says what when, 5", "Hello with nonce 255, 77, 77, 255", "the next Status shows each")
def hello_nonce(host: Host) -> str:
    seen = []
    for nonce in (255, 77, 77, 255):
        host.hello(nonce=nonce)
        seen.append(host.next_status(Beat.NOTHING).command_nonce)
        unless(seen[-1] != nonce, f"nonce {seen[-1]} in Status after a Hello with {nonce}")
    return f"nonces {seen}"


def _mismatch(host: Host, schema: int, version: int) -> str:
    host.idle()
    host.forget()
    host.hello(schema, version)
    answers = len(host.all_of(Identity))
    return host.shows(
        DeviceMode.LATCHED,
        homed=False,
        fault=DeviceFault.SCHEMA_MISMATCH,
        besides=f"{answers} Identity",
        wrong=answers != 1,
    )


@check(
    Hazard.CLOSES, PAGE, "Hello with another schema hash", "Identity; Status LATCHED with SCHEMA_MISMATCH, not HOMED"
)
def schema_mismatch(host: Host) -> str:
    return _mismatch(host, SCHEMA_HASH ^ 1, PROTOCOL_VERSION)


@check(
    Hazard.CLOSES,
    PAGE,
    "Hello with another protocol version",
    "Identity; Status LATCHED with SCHEMA_MISMATCH, not HOMED",
)
def version_mismatch(host: Host) -> str:
    return _mismatch(host, SCHEMA_HASH, (PROTOCOL_VERSION + 1) % 256)


@check(Hazard.CLOSES, CLEARING, "Hello with another schema hash, then Clear", "Clear not acknowledged, still LATCHED")
def mismatch_holds(host: Host) -> str:
    """A mismatch holds as long as its cause."""
    schema_mismatch.perform(host)
    host.refuses(Clear, DeviceMode.LATCHED)
    return host.shows(DeviceMode.LATCHED, fault=DeviceFault.SCHEMA_MISMATCH)


@check(
    Hazard.OPENS,
    CLEARING,
    "Hello with another schema hash, the right Hello, then Clear",
    "Clear acknowledged; IDLE, no fault, not HOMED",
)
def clear_clears(host: Host) -> str:
    """Clear ends a fault whose cause is gone, and brings back no zero."""
    schema_mismatch.perform(host)
    host.hello()
    host.shows(DeviceMode.LATCHED, fault=DeviceFault.SCHEMA_MISMATCH, besides="after the right Hello, before Clear")
    host.obeyed(Clear)
    return host.shows(DeviceMode.IDLE, homed=False, fault=NO_FAULT)


@check(Hazard.CLOSES, "Modes", "not homed, Drive OFF, then Drive RUN with a duty of 0", "stays IDLE")
def run_needs_homing(host: Host) -> str:
    host.without_zero()
    unless(is_homed(host.status), f"HOMED even after a mismatch and a Clear: {shown(host.status)}")
    host.pass_time(SEEN_S, Beat.RUN)
    return host.shows(DeviceMode.IDLE, Beat.RUN)


@check(
    Hazard.SHUT,
    "Who says what when, 5",
    f"Clear with the nonces {NONCES}, then 1 to 254",
    "each acknowledged, the last one of the row",
)
def every_nonce(host: Host) -> str:
    """A command is new whenever its nonce differs; otherwise a Retract could be lost."""
    host.idle()
    for nonce in NONCES:
        host.send(Clear(nonce))
        host.pass_time(ANSWER_S)
        host.next_status(Beat.NOTHING)
        if host.status.command_nonce != nonce:
            raise Unmet(f"nonce {nonce} not acknowledged, {host.status.command_nonce} in Status")
    for nonce in range(1, 255):
        host.send(Clear(nonce))
        host.beat(Beat.NOTHING)
    host.next_status(Beat.NOTHING)
    nonce = host.next_status(Beat.NOTHING).command_nonce
    return unless(nonce != 254, f"{len(NONCES)} acknowledged, then, of 254 more in a row, the one with {nonce}")


CHECKS: Final = (
    identity_answers_hello,
    schema_hash,
    hello_nonce,
    schema_mismatch,
    version_mismatch,
    mismatch_holds,
    clear_clears,
    run_needs_homing,
    every_nonce,
)
