"""Checks that frames which are damaged, cut off, too long or for another device are neither obeyed nor answered.

Every message of a host gets every damage. The damaged Drive is an OFF, so that a device that obeys it does no harm.
"""

import struct
from collections.abc import Callable, Iterable
from typing import Final

from firmware_protocol.codec import (
    FUNCTION,
    Clear,
    DeviceMode,
    Drive,
    DriveMode,
    Hello,
    Home,
    Identity,
    Message,
    Retract,
    State,
    crc8,
    encode,
)
from firmware_protocol.conformance.check import Check, Hazard, check
from firmware_protocol.conformance.host import ANSWER_S, PERIOD_S, Beat, Host, Unmet, shown, unless

DRIVE: Final = FUNCTION[Drive]
SILENT = "no State, drive_counter unchanged; the good Drive after it is answered"
UNDONE = "no Identity, nonce not shown, mode as before; the good Clear after it is acknowledged"
COMMANDS: Final = (Home, Clear, Retract, Hello)
Send = Callable[[int], None]
"""Sends a bad message with this counter or nonce."""


def _raw_drive(duty_steps: int, mode: int, counter: int) -> bytes:
    body = struct.pack("<hhBB", duty_steps, 0, mode, counter)
    return body + bytes((crc8(bytes((DRIVE,)) + body),))


def _drive(counter: int) -> bytes:
    return encode(Drive(0.0, 0.0, DriveMode.OFF, counter))


def _command(kind: type[Message], nonce: int) -> bytes:
    return encode(Hello(0, 0, nonce)) if kind is Hello else bytes((nonce,))


def _ignores(host: Host, put: Iterable[Send]) -> str:
    """Send bad Drives, and a good one after each."""
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
        after = host.next_status(Beat.NOTHING).drive_counter
        unless(after != before, f"form {tried}: drive_counter {after} in Status, {before} before it")
        host.counter = (host.counter + 1) % 256
        host.beat(Beat.OFF)
        host.pass_time(ANSWER_S)
        if not host.all_of(State):
            raise Unmet(f"form {tried}: ignored, and so was the good Drive after it")
    return f"{tried} {'form' if tried == 1 else 'forms'} ignored"


def _refuses(host: Host, put: Iterable[tuple[str, Send]]) -> str:
    """Send bad commands to an idle device, and a good Clear after each."""
    tried = 0
    host.idle()
    for what, send in put:
        nonce = host.new_nonce()
        host.forget()
        send(nonce)
        host.next_status(Beat.NOTHING)
        status = host.next_status(Beat.NOTHING)
        if status.command_nonce == nonce or status.mode is not DeviceMode.IDLE or host.all_of(Identity):
            raise Unmet(f"{what} with nonce {nonce}: {len(host.all_of(Identity))} Identity, {shown(status)}")
        if not host.command(Clear, Beat.NOTHING):
            raise Unmet(f"{what}: ignored, and so was the good Clear after it")
        tried += 1
    return f"{tried} forms of commands ignored"


@check(Hazard.CLOSES, "Carriers", "a Drive with a wrong CRC-8 in a whole frame", SILENT)
def drive_crc_8(host: Host) -> str:
    return _ignores(
        host,
        [
            lambda counter: host.line.send(DRIVE, _drive(counter)[:-1] + bytes((_drive(counter)[-1] ^ 1,))),
            lambda counter: host.line.send(DRIVE, bytes((_drive(counter)[0] ^ 4,)) + _drive(counter)[1:]),
        ],
    )


@check(
    Hazard.CLOSES,
    "Who says what when, 2",
    "a Drive OFF or RUN with a duty of 1.0001 or -3.2768, its CRC-8 right",
    SILENT,
)
def drive_range(host: Host) -> str:
    return _ignores(
        host,
        [
            lambda counter: host.line.send(DRIVE, _raw_drive(10_001, 0, counter)),
            lambda counter: host.line.send(DRIVE, _raw_drive(-32_768, 0, counter)),
            lambda counter: host.line.send(DRIVE, _raw_drive(10_001, 1, counter)),
            lambda counter: host.line.send(DRIVE, _raw_drive(-32_768, 1, counter)),
        ],
    )


@check(Hazard.SHUT, "Who says what when, 2", "a Drive of mode 2 or 255, its CRC-8 right", SILENT)
def drive_mode(host: Host) -> str:
    return _ignores(
        host,
        [
            lambda counter: host.line.send(DRIVE, _raw_drive(0, 2, counter)),
            lambda counter: host.line.send(DRIVE, _raw_drive(0, 255, counter)),
        ],
    )


@check(Hazard.CLOSES, "Carriers", "a Drive of 6 and of 8 bytes, and of none", SILENT)
def drive_length(host: Host) -> str:
    """The carrier's frame is whole; only the message is too short or too long."""
    return _ignores(
        host,
        [
            lambda counter: host.line.send(DRIVE, _drive(counter)[:-1]),
            lambda counter: host.line.send(DRIVE, _drive(counter) + b"\x00"),
            lambda _: host.line.send(DRIVE, b""),
        ],
    )


@check(Hazard.MISLED, "Carriers", "functions 10 and 127, and a device's own State and Identity", SILENT)
def other_functions(host: Host) -> str:

    def send(function: int) -> Send:
        return lambda counter: host.line.send(function, _drive(counter) + b"\x00")

    return _ignores(host, [send(function) for function in (10, 127, FUNCTION[State], FUNCTION[Identity])])


@check(Hazard.OPENS, "Carriers", "each command with a byte more, a byte less, and without any", UNDONE)
def command_length(host: Host) -> str:
    """A command has no CRC-8: the length is all there is to check."""

    def send(kind: type[Message], cut: Callable[[bytes], bytes]) -> tuple[str, Send]:
        return kind.__name__, lambda nonce: host.line.send(FUNCTION[kind], cut(_command(kind, nonce)))

    cuts: tuple[Callable[[bytes], bytes], ...] = (lambda body: body + body[-1:], lambda body: body[:-1], lambda _: b"")
    return _refuses(host, [send(kind, cut) for kind in COMMANDS for cut in cuts])


SENT: Final = {
    "frame_crc_16": "a wrong CRC-16, one without its final XOR, one with another sequence under it",
    "frame_cut_off": "cut off after its first byte, in the middle, before its last",
    "frame_too_long": "a byte more, 300 more, three with no delimiter between them",
    "frame_zero_inside": "a delimiter in its middle",
    "noise": "30, 11 and 1200 bytes of noise, then a delimiter",
    "other_node": "to another node, from which nothing was heard",
}


def _of_carrier(name: str) -> Check:
    """Return the check that messages with the carrier's damage `name`, a key of SENT, are ignored."""

    def perform(host: Host) -> str:
        def forms(kind: type[Message], body: Callable[[int], bytes]) -> list[Send]:
            function = FUNCTION[kind]

            def send(at: int) -> Send:
                return lambda number: host.line.send_damaged(host.line.damages(function, body(number))[name][at])

            return [send(at) for at in range(len(host.line.damages(function, body(0))[name]))]

        def commands(kind: type[Message]) -> list[tuple[str, Send]]:
            return [(kind.__name__, send) for send in forms(kind, lambda nonce: _command(kind, nonce))]

        seen = _ignores(host, forms(Drive, _drive))
        return f"{seen}; {_refuses(host, [one for kind in COMMANDS for one in commands(kind)])}"

    sent = f"a Drive, Home, Clear, Retract, Hello: {SENT[name]}"
    return Check(name, Hazard.CLOSES, "Carriers", sent, f"{SILENT}; {UNDONE}", perform, moves=False, is_gate=False)


CHECKS: Final = (
    drive_crc_8,
    drive_range,
    drive_mode,
    drive_length,
    other_functions,
    command_length,
)
ON_A_CARRIER: Final = tuple(_of_carrier(name) for name in SENT)
