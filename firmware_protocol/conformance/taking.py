"""Checks made from the table of rules: a message is sent to a device in a mode, and what it changed is compared.

What must change nothing is sent among Drives of two rates, one message after the other: neither mode, faults, zero,
nonce, positions, currents nor the number of answers may differ after it. What a mode acts on is sent once a rate.
"""

import struct
from collections.abc import Callable, Iterator
from functools import partial
from itertools import chain, cycle
from typing import Final, NamedTuple

import numpy as np

from firmware_protocol.codec import (
    FUNCTION,
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
    State,
    Status,
    crc8,
    encode,
)
from firmware_protocol.conformance.check import Check, Hazard
from firmware_protocol.conformance.host import (
    FRESH_S,
    HELLO_NONCE,
    HOMED_S,
    HOMES_S,
    INSIDE_MM,
    NO_FAULT,
    OPENED_S,
    PERIOD_S,
    SEEN_S,
    STATUS_S,
    Beat,
    Host,
    is_homed,
    places,
    shown,
    unless,
    ways_mm,
)
from firmware_protocol.conformance.rules import MODES, REFUSED_COMMANDS, REFUSED_DRIVES, TAKES
from firmware_protocol.conformance.telling import SIDES, Array, columns

PAGE: Final = "What each mode takes"
SPARSE_S: Final = 0.025
"Drives this seldom still hold RUN, and show what goes on after a message."
DUTY: Final = -0.4
STEPS: Final = round(DUTY * 10_000)
MOVED_MM, RESTING_A, DEEP_MM, FAR_MM, HOMING_MM = 0.1, 0.2, 20.0, 4.0, 3.0
"A homing that goes in further than it backs off obeys another message."
BEGUN_MM, BEGUN_S, OPEN_S, SILENCE_S = 0.1, 0.2, 0.8, 0.05
"A carriage INSIDE_MM in has begun to open after BEGUN_S, and is open after OPEN_S."
COASTED_MM: Final = {
    (DeviceMode.RUN, PERIOD_S): 0.6,
    (DeviceMode.HOMING, PERIOD_S): 0.6,
    (DeviceMode.HOMING, SPARSE_S): 0.6,
}
WITHIN_S: Final = {DeviceMode.HOMING: HOMES_S, DeviceMode.RETRACTING: 0.6}
TWO_STATUS_S: Final = 2.2 * STATUS_S
RESTING: Final = (DeviceMode.IDLE, DeviceMode.RUN, DeviceMode.LATCHED)
ENDS_IN: Final = {False: DeviceMode.IDLE, True: DeviceMode.LATCHED}
COMMANDS: Final[dict[str, type[Retract | Home | Clear]]] = {"Retract": Retract, "Home": Home, "Clear": Clear}
FITS, MISFITS, OFF, SILENT = "Hello that fits", "Hello that does not", "Drive OFF", "silence"
ACTS: Final = TAKES | {SILENT: ("", "RETRACTING, LATCHED with COMMAND_TIMEOUT", "", "", "")}
CAUSES: Final = {MISFITS: DeviceFault.SCHEMA_MISMATCH, SILENT: DeviceFault.COMMAND_TIMEOUT}
MIN_SHARE, UNHOMED_SHARE, MAX_SHARE, ENDS_MM, WINDOW_S = 0.6, 0.5, 1.15, 3.0, 0.02
"""Bounds of a carriage's speed as shares of the device's opening speed: its least without the ends, and without a zero,
and its most, over WINDOW_S."""
MISFITTING: Final = (
    *(Hello(SCHEMA_HASH ^ 1 << bit, PROTOCOL_VERSION, HELLO_NONCE) for bit in (0, 7, 8, 15, 16, 23, 24, 31)),
    *(Hello(SCHEMA_HASH, version, HELLO_NONCE) for version in (0, 2, 129, 255)),
)
STAYS: Final = ("", "answered", "refused", "accepted, nothing to do", "accepted, goes on", "Identity")


class Sent(NamedTuple):
    """A message that changes nothing but the nonce, if it is accepted, and that a Hello is answered."""

    name: str
    send: Callable[[], None]
    nonce: int | None = None
    identities: int = 0


class Place(NamedTuple):
    """Where messages are sent: the mode, how it is reached, and the Drives meanwhile."""

    name: str
    mode: DeviceMode
    enter: Callable[[Host], object]
    beat: Beat
    duty: float


def _drive(
    host: Host,
    mode: int,
    left: int = STEPS,
    right: int = STEPS,
    ahead: int = 1,
    crc: int = 0,
    length: int = 7,
    body: int = 6,
) -> bytes:
    """Return the payload of a Drive that differs from the next good one as REFUSED_DRIVES says."""
    data = struct.pack("<hhBBx", left, right, mode, (host.counter + ahead) % 256)[:body]
    whole = data + bytes((crc8(bytes((FUNCTION[Drive],)) + data) ^ crc,))
    return whole if body != 6 else whole[:length].ljust(length, b"\0")


def _command(kind: type[Message], nonce: int) -> bytes:
    return encode(MISFITTING[0].replaced(nonce=nonce)) if kind is Hello else bytes((nonce,))


def _send_drive(host: Host, function: int = FUNCTION[Drive], **differs: int) -> None:
    host.line.send(function, _drive(host, **differs))


def _send_damaged(host: Host, kind: type[Message], mode: int, nonce: int, what: str) -> None:
    body = _drive(host, mode) if kind is Drive else _command(kind, nonce)
    host.send(Hello(SCHEMA_HASH, PROTOCOL_VERSION, host.status.command_nonce))  # what is damaged must not repeat it
    for form in host.line.damages(FUNCTION[kind], body)[what]:
        host.line.send_damaged(form)


def refused(host: Host, ahead: int = 1) -> Iterator[Sent]:
    """Yield the messages that no mode takes."""
    for mode in (0, 1):
        for name, differs in REFUSED_DRIVES.items():
            yield Sent(f"a Drive with {name}", partial(_send_drive, host, **{"mode": mode, "ahead": ahead, **differs}))
    for kind in (Home, Clear, Retract, Hello):
        for name, change in REFUSED_COMMANDS.items():
            if change or kind is not Hello:
                body = _command(kind, host.new_nonce() if change else host.status.command_nonce)
                sent = change(body) if change else body
                yield Sent(f"{kind.__name__} with {name}", partial(host.line.send, FUNCTION[kind], sent))


def damaged(host: Host) -> Iterator[Sent]:
    """Yield each message of a host with each damage of the carrier."""
    for kind, mode in ((Drive, 0), (Drive, 1), (Home, 0), (Clear, 0), (Retract, 0), (Hello, 0)):
        for what in host.line.damages(FUNCTION[kind], _command(kind, 1)):
            yield Sent(
                f"{kind.__name__}: {what}", partial(_send_damaged, host, kind, mode, host.new_nonce(), what), None, 1
            )


def taken(host: Host, place: Place) -> Iterator[Sent]:
    """Yield the messages of TAKES that change nothing here."""
    for name, kind in COMMANDS.items():
        cell = TAKES[name][place.mode]
        if cell in STAYS or (kind is Clear and place.name == MISMATCHED):
            nonce = host.new_nonce()
            yield Sent(name, partial(host.send_beside, kind(nonce)), nonce if cell.startswith("accepted") else None)
    if place.beat is DriveMode.OFF and TAKES["Drive RUN"][place.mode] == "answered":
        yield Sent("Drive RUN", partial(host.drive, DriveMode.RUN, DUTY, DUTY))
    if place.name != MISMATCHED:
        for nonce in (host.status.command_nonce, 77, HELLO_NONCE):
            yield Sent(FITS, partial(host.send_beside, Hello(SCHEMA_HASH, PROTOCOL_VERSION, nonce)), nonce, 1)


def stays(place: Place, host: Host) -> str:
    """Send all that changes nothing in this place, at both rates of Drives."""
    return f"{_stays(host, place, PERIOD_S)} and {_stays(host, place, SPARSE_S)} messages changed nothing"


def _stays(host: Host, place: Place, period_s: float) -> int:
    place.enter(host)
    before, start, sent = host.next_status(place.beat), places(host.last(State)), 0
    unless(before.mode is not place.mode, f"where it begins: {shown(before)}")
    first = len(host.rows)
    sources = [taken(host, place), refused(host, 1 if period_s == PERIOD_S else 7)]
    if (place.mode in RESTING) is (period_s == PERIOD_S):
        sources.insert(1, damaged(host))
    for one in chain(*sources):
        before = _changes_nothing(host, place, period_s, one, before, start)
        if host.status.mode is not place.mode:
            break
        sent += 1
    if place.mode not in RESTING:
        _ends(host, place, first, before.faults)
    return sent


def _changes_nothing(
    host: Host, place: Place, period_s: float, one: Sent, before: Status, start: tuple[float, float]
) -> Status:
    """Send a message, compare Status with the one before, unless a motion has ended, and return what it must be."""
    host.heard.clear()
    is_still, since_s = place.mode in RESTING, host.now_s + FRESH_S
    host.beat(place.beat, place.duty, place.duty, period_s, one.send)
    seen_s = TWO_STATUS_S if is_still or one.nonce is not None else 0.5 * STATUS_S
    host.pass_time(seen_s, place.beat, period_s, place.duty)
    after = before.replaced(command_nonce=before.command_nonce if one.nonce is None else one.nonce)
    moved_mm = max(map(abs, ways_mm(host.last(State), start)))
    found = _changes(host, one, after, since_s) | {f"moved by {moved_mm:.2f} mm": is_still and moved_mm > MOVED_MM}
    wrong = ", ".join(what for what, is_so in found.items() if is_so)
    unless(
        wrong and (is_still or not host.is_resting()),
        f"{one.name}, a Drive every {period_s * 1e3:g} ms: {wrong}, {shown(host.status)}",
    )
    return after


def _changes(host: Host, one: Sent, before: Status, since_s: float) -> dict[str, bool]:
    """Return what may not change in Status, and whether it did."""
    after = [each for time_s, each in host.all_of(Status) if time_s > since_s] or [host.status]
    identities = len(host.all_of(Identity))
    return {
        "another mode": any(each.mode is not before.mode for each in after),
        "other faults": any(each.faults != before.faults for each in after),
        "another HOMED": any(is_homed(each) is not is_homed(before) for each in after),
        f"nonce not {before.command_nonce}": any(each.command_nonce != before.command_nonce for each in after),
        f"{identities} Identity": identities != one.identities,
        "drive_counter of no Drive": any(each.drive_counter not in host.counters for each in after),
    }


def _ends(host: Host, place: Place, first: int, faults: DeviceFault) -> None:
    """Let a motion end, which the messages must not have changed."""
    if place.mode is DeviceMode.RETRACTING:
        opens_fully(host, faults, first, place.beat)
        return
    host.until(host.is_resting, HOMED_S, place.beat)
    deepest_mm = min(columns(host, first)[f"{side}_mm"].min() for side in SIDES)
    host.shows(
        DeviceMode.IDLE,
        place.beat,
        homed=True,
        opened=True,
        fault=NO_FAULT,
        besides=f"{deepest_mm:+.2f} mm at the innermost",
        wrong=deepest_mm < -HOMING_MM,
    )


def acts(place: Place, name: str, host: Host) -> str:
    """Send a message that this mode acts on, at both rates of Drives, and compare what it leads to."""
    return "; ".join(_acts(host, place, name, period_s) for period_s in (PERIOD_S, SPARSE_S))


def _acts(host: Host, place: Place, name: str, period_s: float) -> str:
    is_far, beat = place.mode is DeviceMode.RUN and period_s == PERIOD_S, place.beat
    if is_far:  # far inside, at full duty
        host.running(host.stroke_mm - FAR_MM)
        host.pass_time(BEGUN_S / 4.0, DriveMode.RUN, duty=-1.0)
        beat, first = DriveMode.OFF if name == OFF else DriveMode.RUN, len(host.rows)
    else:
        place.enter(host)
        first = len(host.rows)
        host.pass_time(WITHIN_S.get(place.mode, 0.0) * (host.random.random() + (period_s > PERIOD_S)) / 2.0, beat)
    faults = (NO_FAULT if name == "Clear" else host.status.faults) | CAUSES.get(name, NO_FAULT)
    seen = _begun(host, place, name, beat, period_s)
    if is_far or place.mode is DeviceMode.RETRACTING:
        return opens_fully(host, faults, first, beat)
    host.until(host.is_resting, OPEN_S - BEGUN_S if place.mode is DeviceMode.RUN else HOMED_S, beat)
    return host.shows(
        # one Drive OFF lets go
        DeviceMode.RUN if name == OFF else ENDS_IN[bool(faults)],
        beat,
        homed=not any((faults, "not homed" in ACTS[name][place.mode], place.mode is DeviceMode.LATCHED)),
        opened=True,
        fault=faults,
        besides=seen,
        wrong=name == MISFITS and host.command(Clear, beat, SEEN_S),
    )


def _fall_silent(host: Host, place: Place) -> None:
    """Send no Drive, but all else that changes nothing."""
    bad = cycle([*list(taken(host, place))[:-2], *refused(host)])
    damages = list(chain(*host.line.damages(FUNCTION[Drive], _drive(host, 1)).values()))
    for _ in range(round(2.0 * SILENCE_S / PERIOD_S)):
        next(bad).send()
        next(bad).send()
        host.beat(None, besides=partial(host.line.send_damaged, host.random.choice(damages)))


def _say(host: Host, place: Place, name: str, beat: Beat) -> None:
    if name in COMMANDS:
        nonce = host.new_nonce()
        for other, kind in COMMANDS.items():
            if TAKES[other][place.mode] == "refused":
                host.send(kind(nonce))
        host.obeyed(COMMANDS[name], beat, nonce, -1.0)
    said = DriveMode.OFF if name == OFF else beat
    duty = -1.0 if said is DriveMode.OFF else 0.0
    besides = {
        MISFITS: partial(host.send_beside, host.random.choice(MISFITTING)),
        OFF: partial(host.drive, DriveMode.RUN, -1.0, -1.0),
    }
    host.beat(said, duty, duty, besides=besides.get(name, lambda: None))
    if name == SILENT:
        _fall_silent(host, place)


def _begun(host: Host, place: Place, name: str, beat: Beat, period_s: float) -> str:
    """Send a message, and compare what follows at once with what must be."""
    start, to = places(host.last(State)), ACTS[name][place.mode].partition(",")[0]
    host.heard.clear()
    _say(host, place, name, beat)
    host.pass_time(BEGUN_S, beat, period_s, -1.0 if name != OFF or beat is DriveMode.OFF else 0.0)
    way_mm = [way for _, state in host.all_of(State) for way in ways_mm(state, start)]
    modes = [status.mode.name for _, status in host.all_of(Status) if status.mode is not place.mode]
    seen = f"{min(way_mm):+.2f} mm at the innermost, {min(way_mm[-2:]):+.2f} mm after {BEGUN_S:g} s, {modes[:1]}"
    return unless(
        any(
            (
                to != DeviceMode.HOMING.name and min(way_mm) < -COASTED_MM.get((place.mode, period_s), MOVED_MM),
                place.mode is DeviceMode.RUN and min(way_mm[-2:]) < BEGUN_MM,
                name != SILENT and len(host.all_of(Identity)) != (name == MISFITS),
                modes[:1] != [to] * (to in MODES),
            )
        ),
        seen,
    )


def opens_fully(
    host: Host, fault: DeviceFault, first: int, beat: Beat = DriveMode.OFF, *, has_zero: bool = True
) -> str:
    """Watch a device open, and judge each carriage's speed from this value of `host.rows` on."""
    host.until(host.is_resting, OPENED_S, beat)
    rows = columns(host, first)
    leasts, mosts = zip(*(_opened(rows, side) for side in SIDES), strict=True)
    seen = f"{min(leasts):.1f} mm/s on the way, {max(mosts):.1f} at most"
    return host.shows(
        ENDS_IN[bool(fault)],
        beat,
        homed=has_zero and not fault,
        opened=True,
        fault=fault,
        besides=seen,
        wrong=min(leasts) < MIN_SHARE * (1.0 if has_zero else UNHOMED_SHARE) * host.opening_mm_s
        or max(mosts) > MAX_SHARE * host.opening_mm_s,
    )


def _opened(rows: dict[str, Array], side: str) -> tuple[float, float]:
    """Return a carriage's least speed without ENDS_MM, and its most."""
    times_s, at_mm = rows["device_s"], rows[f"{side}_mm"]
    later = np.searchsorted(times_s, times_s + WINDOW_S)
    earlier, later = np.flatnonzero(later < len(times_s)), later[later < len(times_s)]
    mm_s = (at_mm[later] - at_mm[earlier]) / (times_s[later] - times_s[earlier])
    is_way = (at_mm[earlier] > at_mm[0] + ENDS_MM) & (at_mm[later] < at_mm[-1] - ENDS_MM)
    return float(np.min(mm_s[is_way])) if is_way.any() else 0.0, float(np.max(mm_s, initial=0.0))


def misfits(host: Host) -> str:
    """Send an idle device each Hello that does not fit, and mend it."""
    for hello in MISFITTING:
        host.idle()
        host.heard.clear()
        host.hello(hello.schema_hash, hello.protocol_version)
        count, seen = len(host.all_of(Identity)), f"schema {hello.schema_hash:08X}, version {hello.protocol_version}"
        host.shows(DeviceMode.LATCHED, homed=False, fault=CAUSES[MISFITS], besides=seen, wrong=count != 1)
        unless(
            host.status.command_nonce != HELLO_NONCE or host.command(Clear, DriveMode.OFF, SEEN_S),
            f"{seen}: its nonce is not shown, or Clear's is, {shown(host.status)}",
        )
    return f"{len(MISFITTING)} latched, and were mended"


def put_off(host: Host) -> None:
    """Bring the device to IDLE without letting go."""
    _retracting(host, DriveMode.RUN, 0.0)
    host.until(host.is_resting, OPENED_S, DriveMode.RUN)


def _retracting(host: Host, beat: Beat, inside_mm: float = DEEP_MM) -> None:
    host.running(inside_mm)
    host.obeyed(Retract, beat)


def _homing(host: Host, beat: Beat) -> None:
    """Begin to home; a host that has not let go may send Drive RUN until the end."""
    (put_off if beat is DriveMode.RUN else Host.homed)(host)
    host.obeyed(Home, beat)


MISMATCHED: Final = "LATCHED by a mismatch"
PLACES: Final = (
    Place("IDLE without zero", DeviceMode.IDLE, Host.without_zero, DriveMode.RUN, DUTY),
    Place(MISMATCHED, DeviceMode.LATCHED, partial(Host.hello, schema_hash=SCHEMA_HASH ^ 1), DriveMode.OFF, -1.0),
    Place("IDLE", DeviceMode.IDLE, Host.homed, DriveMode.OFF, -1.0),
    Place("IDLE, not let go", DeviceMode.IDLE, put_off, DriveMode.RUN, DUTY),
    Place("RUN", DeviceMode.RUN, lambda host: host.running(INSIDE_MM), DriveMode.RUN, 0.0),
    Place("HOMING", DeviceMode.HOMING, partial(_homing, beat=DriveMode.OFF), DriveMode.OFF, -1.0),
    Place("HOMING beside RUN", DeviceMode.HOMING, partial(_homing, beat=DriveMode.RUN), DriveMode.RUN, DUTY),
    Place("RETRACTING", DeviceMode.RETRACTING, partial(_retracting, beat=DriveMode.OFF), DriveMode.OFF, -1.0),
    Place(
        "RETRACTING after silence",
        DeviceMode.RETRACTING,
        partial(Host.timed_out, inside_mm=DEEP_MM),
        DriveMode.RUN,
        -1.0,
    ),
    Place("LATCHED", DeviceMode.LATCHED, Host.latched, DriveMode.RUN, DUTY),
)
HAZARDS: Final = {"Home": Hazard.OPENS, "Clear": Hazard.CLOSES, MISFITS: Hazard.CLOSES}


def _named(*words: str) -> str:
    return "_".join(words).lower().replace(",", "").replace(" ", "_")


CHECKS: Final = (
    Check(
        "misfitting_hello",
        Hazard.CLOSES,
        "Who says what when, 1",
        f"{len(MISFITTING)} Hellos with another schema or version, each time Clear, a Hello that fits, Clear",
        "LATCHED with SCHEMA_MISMATCH until the second Clear",
        misfits,
        moves=False,
        is_gate=False,
    ),
    *(
        Check(
            _named(place.name, "stays"),
            Hazard.CLOSES,
            PAGE,
            f"{place.name}: all that this mode refuses or only answers, among Drives every 1 and {SPARSE_S * 1e3:g} ms",
            "mode, faults, HOMED, nonce, positions, currents as before; one State for each good Drive",
            partial(stays, place),
            moves=place.name not in ("IDLE without zero", MISMATCHED),
            is_gate=False,
        )
        for place in PLACES
    ),
    *(
        Check(
            _named(place.name, message.replace(" that does not", " misfit")),
            HAZARDS.get(message, Hazard.SHUT),
            PAGE,
            f"{place.name}: {message}, among Drives every 1 and {SPARSE_S * 1e3:g} ms",
            cells[place.mode],
            partial(acts, place, message),
            moves=True,
            is_gate=False,
        )
        for place in PLACES
        for message, cells in ACTS.items()
        if place.name in MODES and cells[place.mode] not in (*STAYS, "obeyed", "RUN, or answered")
    ),
)
