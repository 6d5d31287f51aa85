"""Checks that frames which are damaged, cut off, too long or for another device are neither obeyed nor answered.

The damaged message is a Drive OFF or a Clear, so that a device that obeys it does no harm.
"""

import struct
from collections.abc import Callable, Iterable
from typing import Final

from firmware_protocol.codec import FUNCTION, Clear, Drive, DriveMode, Hello, Identity, State, crc8, encode
from firmware_protocol.conformance.check import Check, check
from firmware_protocol.conformance.host import ANSWER_S, PERIOD_S, SEEN_S, Beat, Host, Unmet

DRIVE: Final = FUNCTION[Drive]
SILENT = "no State, drive_counter unchanged; the good Drive after it is answered"


def _raw_drive(duty_steps: int, mode: int, counter: int) -> bytes:
    """Return the payload of a Drive that the codec would refuse, with the right CRC-8."""
    body = struct.pack("<hhBB", duty_steps, 0, mode, counter)
    return body + bytes((crc8(bytes((DRIVE,)) + body),))


def _drive(counter: int) -> bytes:
    return encode(Drive(0.0, 0.0, DriveMode.OFF, counter))


def _ignores(host: Host, put: Iterable[Callable[[int], None]]) -> str:
    """Send bad Drives, each by a function of `put` that takes the counter, and a good Drive after each.

    Raises Unmet where a bad Drive is answered or shows in Status, and where the good Drive after it is not answered.
    """
    tried = 0
    for send in put:
        host.pass_time(3 * PERIOD_S, Beat.OFF)
        host.pass_time(ANSWER_S)
        before = host.next_status(Beat.NOTHING).drive_counter
        host.forget()
        send((host.counter + 1) % 256)
        host.pass_time(ANSWER_S)
        tried += 1
        if states := len(host.all_of(State)):
            raise Unmet(f"form {tried}: {states} State")
        host.next_status(Beat.NOTHING)
        shown = host.next_status(Beat.NOTHING).drive_counter
        if shown != before:
            raise Unmet(f"form {tried}: drive_counter {shown} in Status, {before} before it")
        host.counter = (host.counter + 1) % 256
        host.beat(Beat.OFF)
        host.pass_time(ANSWER_S)
        if not host.all_of(State):
            raise Unmet(f"form {tried}: ignored, and so was the good Drive after it")
    return f"{tried} {'form' if tried == 1 else 'forms'} ignored"


@check("Carriers", "a Drive with a wrong CRC-8 in a whole frame", SILENT)
def drive_crc_8(host: Host) -> str:
    """Check that a Drive with a wrong bit, in the CRC-8 or in a duty, is ignored."""
    return _ignores(
        host,
        [
            lambda counter: host.line.send(DRIVE, _drive(counter)[:-1] + bytes((_drive(counter)[-1] ^ 1,))),
            lambda counter: host.line.send(DRIVE, bytes((_drive(counter)[0] ^ 4,)) + _drive(counter)[1:]),
        ],
    )


@check("Who says what when, 2", "a Drive with a duty of 1.0001 or -3.2768, its CRC-8 right", SILENT)
def drive_range(host: Host) -> str:
    """Check that a Drive with a duty out of range is ignored."""
    return _ignores(
        host,
        [
            lambda counter: host.line.send(DRIVE, _raw_drive(10_001, 0, counter)),
            lambda counter: host.line.send(DRIVE, _raw_drive(-32_768, 0, counter)),
        ],
    )


@check("Who says what when, 2", "a Drive of mode 2 or 255, its CRC-8 right", SILENT)
def drive_mode(host: Host) -> str:
    """Check that a Drive with an undefined mode is ignored."""
    return _ignores(
        host,
        [
            lambda counter: host.line.send(DRIVE, _raw_drive(0, 2, counter)),
            lambda counter: host.line.send(DRIVE, _raw_drive(0, 255, counter)),
        ],
    )


@check("Carriers", "a Drive of 6 and of 8 bytes, and of none", SILENT)
def drive_length(host: Host) -> str:
    """Check that a Drive of a wrong length is ignored, though its frame is whole."""
    return _ignores(
        host,
        [
            lambda counter: host.line.send(DRIVE, _drive(counter)[:-1]),
            lambda counter: host.line.send(DRIVE, _drive(counter) + b"\x00"),
            lambda _: host.line.send(DRIVE, b""),
        ],
    )


@check("Carriers", "functions 10 and 127, and a device's own State and Identity", SILENT)
def other_functions(host: Host) -> str:
    """Check that messages of unknown functions and a device's own are ignored."""

    def send(function: int) -> Callable[[int], None]:
        return lambda counter: host.line.send(function, _drive(counter) + b"\x00")

    return _ignores(host, [send(function) for function in (10, 127, FUNCTION[State], FUNCTION[Identity])])


@check("Carriers", "a Clear of 2 bytes and of none, a Hello of 5 and of 7", "not acknowledged, not answered")
def command_length(host: Host) -> str:
    """Check that commands of a wrong length are ignored: without a CRC-8, the length is all there is to check."""
    host.idle()
    nonce = host.new_nonce()
    hello = encode(Hello(0, 0, nonce))  # of no schema: a device that takes it does no more than latch
    host.forget()
    for function, payload in (
        (FUNCTION[Clear], bytes((nonce, nonce))),
        (FUNCTION[Clear], b""),
        (FUNCTION[Hello], hello[:-1]),
        (FUNCTION[Hello], hello + bytes((nonce,))),
    ):
        host.line.send(function, payload)
        host.pass_time(SEEN_S)
        shown = host.status.command_nonce
        if shown == nonce or host.all_of(Identity):
            what = f"nonce {shown} in Status, {len(host.all_of(Identity))} Identity"
            raise Unmet(f"function {function} with {len(payload)} bytes: {what}")
    return "4 forms ignored"


SENT: Final = {
    "frame_crc_16": "a Drive with a wrong CRC-16, one without its final XOR, one with another sequence under it",
    "frame_cut_off": "a Drive cut off after its first byte, in the middle, before its last",
    "frame_too_long": "a Drive with a byte more, with 300 more, three with no delimiter between them",
    "frame_zero_inside": "a Drive with a delimiter in its middle",
    "noise": "30, 11 and 1200 bytes of noise, then a delimiter",
    "other_node": "a Drive to another node, from which nothing was heard",
}


def _of_carrier(name: str) -> Check:
    """Return the check that a Drive with one kind of damage of the carrier is ignored; `name` is a key of SENT."""

    def perform(host: Host) -> str:
        def send(at: int) -> Callable[[int], None]:
            return lambda counter: host.line.send_damaged(host.line.damages(DRIVE, _drive(counter))[name][at])

        return _ignores(host, [send(at) for at in range(len(host.line.damages(DRIVE, _drive(0))[name]))])

    return Check(name, "Carriers", SENT[name], SILENT, perform, moves=False, is_gate=False)


CHECKS: Final = (
    drive_crc_8,
    drive_range,
    drive_mode,
    drive_length,
    other_functions,
    command_length,
)
ON_A_CARRIER: Final = tuple(_of_carrier(name) for name in SENT)
"""The checks of damages by the carrier. A line has those that its `damages` names."""
