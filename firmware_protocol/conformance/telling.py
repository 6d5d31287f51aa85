"""Checks of what the device reports: how often, in which order, how soon, by which clock, and against physics.

Those of all reports read every State and Sense since the start: clocks, positions and handle run on, the currents are
those of the duties and speeds, the force grows as the gap closes.
"""

import math
from functools import partial
from itertools import accumulate, pairwise
from typing import Final

import numpy as np
import numpy.typing as npt

from firmware_protocol.codec import (
    FUNCTION,
    PROTOCOL_VERSION,
    SCHEMA_HASH,
    Clear,
    DeviceFault,
    DriveMode,
    Hello,
    Identity,
    Sense,
    State,
    Status,
    encode,
    period,
)
from firmware_protocol.conformance.check import Hazard, check
from firmware_protocol.conformance.host import (
    ANSWER_S,
    COLUMNS,
    HELLO_NONCE,
    STATUS_S,
    SWITCH_MM,
    TIME_SPAN_S,
    Host,
    Untested,
    shown,
    unless,
)
from firmware_protocol.conformance.line import SerialLine

Array = npt.NDArray[np.float64]
WHO, ALL = "Who says what when, ", "everything, from the start on"
LISTENED, BETWEEN_S, CLOCKED_S, FINE_S, DRIVES = 75, 0.013, 3.0, 1.13e-3, 1000
STATUS_TOLERANCE, MAX_DRIFT, MAX_LEAP_S, BLOCK = 0.03, 0.01, 2e-3, 100
"Of BLOCK States the least delayed tells the device's clock from the host's."
MAX_ANSWER_S: Final = 3e-3
"The device's own millisecond, and the way there and back by any adapter."
HANDLE_SPAN_MM: Final = period(Sense, "handle_position_mm")
STEP_MM, HANDLE_STEP_MM = period(State, "left_position_mm") / 2**16, HANDLE_SPAN_MM / 2**16
TURN_MM, TURNED_S, LEAP_MM = 40.0 * math.pi, 20.0, 1.0
"A handle at 0.3 m/s moves a third of LEAP_MM in 1 ms; one of swapped bytes leaps by 2 mm a step."
SUCCESSIVE_S, APART_S, FORCE_S = 3e-3, 0.1, 0.03
STEPS: Final = 4.5
"From so many steps in one period on a place that is not between its neighbours is wrong."
NONCES: Final = (1, 129, 1, 65, 1, 33, 1, 17, 1, 9, 1, 5, 1, 3, 2, 254, 253, 128, 127, 126, 6)
"""Each bit changes alone, up and down by any distance."""
LATCHES_AND_CLEARS: Final[tuple[Hello | Clear, ...]] = (
    *(Hello(SCHEMA_HASH ^ bit, PROTOCOL_VERSION, HELLO_NONCE) for bit in (1, 0)),
    Clear(1),
)
SLIDES_MM_S, NEAR_MM, GROWS, DEPTHS_MM = 10.0, 0.7, 1.15, (12.0, 16.0, 20.0, 24.0)
"From one of the depths to the next a force grows GROWS times, at least."


def columns(host: Host, first: int = 0) -> dict[str, Array]:
    """Return what came from this value of `host.rows` on, unwrapped, and the handle's speed."""
    rows = np.array(host.rows[first:]).reshape(-1, len(COLUMNS))
    unless(len(rows) < 2, "no Sense")
    table = dict(zip(COLUMNS, rows.T, strict=True))
    table["device_s"] = np.unwrap(table["device_time_s"], period=TIME_SPAN_S) + np.cumsum(
        np.diff(table["arrived_s"], prepend=table["arrived_s"][:1]) > APART_S
    )
    table["handle_mm"] = np.unwrap(table["handle_mm"], period=HANDLE_SPAN_MM)
    table["handle_mm_s"] = np.gradient(table["handle_mm"], table["device_s"] + 1e-9 * np.arange(len(rows)))
    return table


@check(Hazard.MISLED, WHO + "1", "3 Hellos", f"one Identity each, at once, with schema {SCHEMA_HASH:08X}", is_gate=True)
def identity_answers_hello(host: Host) -> str:
    for _ in range(3):
        host.hello()
    theirs = {identity.schema_hash for _, identity in host.all_of(Identity)}
    count, seen = len(host.all_of(Identity)), ", ".join([*(f"{schema:08X}" for schema in theirs), *host.refused])
    return unless(count != 3 or theirs != {SCHEMA_HASH}, f"{count} Identity for 3 Hellos, schema {seen}")


@check(
    Hazard.SHUT,
    WHO + "5",
    f"Clear with the nonces {NONCES}, then 1 to 254",
    "each acknowledged",
)
def every_nonce(host: Host) -> str:
    """A command is new whenever its nonce differs; otherwise a Retract could be lost."""
    host.idle()
    for nonce in (*NONCES, *range(1, 255)):
        host.beat(None, besides=partial(host.send, Clear(nonce)))
        shown_nonce = host.next_status(None).command_nonce
        unless(shown_nonce != nonce, f"nonce {nonce} not acknowledged, {shown_nonce} in Status")
    return f"{len(NONCES) + 254} acknowledged"


@check(
    Hazard.MISLED,
    WHO + "4",
    f"for {LISTENED * BETWEEN_S:g} s nothing; Drive OFF every 1 ms; among it Hellos that do not fit and do, and Clear",
    "50 Status a second, to 3 %",
)
def status_rate(host: Host) -> str:
    host.idle()
    shares = []
    for beat, besides in ((None, ()), (DriveMode.OFF, ()), (DriveMode.OFF, LATCHES_AND_CLEARS)):
        host.forget()
        start_s = host.now_s
        for at in range(LISTENED):
            if besides:
                host.send(besides[at % len(besides)])
            host.pass_time(BETWEEN_S, beat)
        shares.append(round(len(host.all_of(Status)) * STATUS_S / (host.now_s - start_s), 3))
    return unless(any(abs(share - 1.0) > STATUS_TOLERANCE for share in shares), f"{shares} of all")


@check(
    Hazard.MISLED,
    WHO + "3",
    f"{DRIVES} Drive OFF, one every 1 ms; then none",
    "for each one State, then one Sense, at once",
)
def every_drive_answered(host: Host) -> str:
    delays_s = []
    for _ in range(DRIVES):
        before = host.states
        host.beat(DriveMode.OFF)
        host.until(partial(_more_than, host, before), ANSWER_S, None)
        delays_s.append(host.newest[State].time_s - host.drive_s if host.states > before else ANSWER_S)
    host.pass_time(10 * ANSWER_S)
    kinds = [type(one.message) for one in host.heard if isinstance(one.message, State | Sense)]
    states, senses = kinds.count(State), kinds.count(Sense)
    # on a bus the State of a later Drive may overtake a Sense, as its identifier is lower
    early = sum(count < 0 for count in accumulate(1 if kind is State else -1 for kind in kinds))
    usual_s = float(np.median(delays_s))
    seen = f"{states} State, {senses} Sense, {early} times a Sense before its State, {usual_s * 1e3:.2f} ms as a rule"
    return unless((states, senses) != (DRIVES, DRIVES) or early or usual_s > MAX_ANSWER_S, seen)


@check(
    Hazard.MISLED,
    WHO + "2",
    "Drive OFF with whole duties, its counter changed by 1 .. 255",
    "a State for each, the counter in Status",
)
def every_counter(host: Host) -> str:
    for change in range(1, 256):
        before, duty = host.states, (-1.0, 1.0)[change % 2]
        host.counter = (host.counter + change - 1) % 256
        host.beat(DriveMode.OFF, duty, -duty)
        host.until(partial(_more_than, host, before), ANSWER_S, None)
        unless(host.states != before + 1, f"no State for a counter changed by {change}, to {host.counter}")
        if change % 50 == 0:
            host.next_status(None)
            shown_counter = host.next_status(None).drive_counter
            unless(shown_counter != host.counter, f"drive_counter {shown_counter} after a Drive with {host.counter}")
    return "255 changes accepted"


@check(
    Hazard.MISLED,
    "Status",
    "Drive OFF, nothing moving",
    "9 to 15 V, -20 to 60 degC and no fault of them; currents under 0.02 A, a force under 5 N",
)
def plausible_at_rest(host: Host) -> str:
    status = host.next_status(DriveMode.OFF)
    sense = host.last(Sense)
    most_A = max(abs(sense.left_current_A), abs(sense.right_current_A))
    seen = f"{status.supply_V:.1f} V, {status.temperature_C:.0f} degC, {most_A:.3f} A, {sense.force_N:+.3f} N"
    is_fine = 9.0 <= status.supply_V <= 15.0 and -20.0 <= status.temperature_C <= 60.0 and most_A < 0.02
    return unless(
        not is_fine or abs(sense.force_N) > 5.0 or status.faults & (DeviceFault.SUPPLY | DeviceFault.TEMPERATURE), seen
    )


@check(
    Hazard.MISLED,
    "Carriers",
    "a Hello byte for byte again; empty frames; a Hello in two parts; one with the sequence of the frame before",
    "1 Identity, then 1 for each Hello",
)
def frames_as_they_come(host: Host) -> str:
    assert isinstance(host.line, SerialLine)
    counts = []
    for parts in host.line.unusual(FUNCTION[Hello], encode(Hello(SCHEMA_HASH, PROTOCOL_VERSION, HELLO_NONCE))):
        host.forget()
        for part in parts:
            host.line.port.write(part)
            host.beat(None)
        host.pass_time(ANSWER_S)
        counts.append(len(host.all_of(Identity)))
    return unless(any(count != 1 for count in counts), f"{counts} Identity")


@check(
    Hazard.MISLED, "Carriers", ALL, "only whole messages of a device: CRC-8, ranges, the sequence one more each time"
)
def own_messages(host: Host) -> str:
    return none_of(host.refused | host.line.frame_errors, "all passed")


@check(
    Hazard.SHUT,
    "Modes",
    ALL,
    "Status in time, no contradiction, no nonce 0 after another; States counted by one; "
    f"each switch closed to {SWITCH_MM:g} mm at its end",
)
def status_consistent(host: Host) -> str:
    """Finds a reset, and a switch that is stuck, late or the other carriage's, and a wrong scale."""
    return none_of(+host.contradictions, f"at last {shown(host.status)}")


def none_of(counts: dict[str, int], seen: str) -> str:
    return unless(counts, ", ".join(f"{what}, {count} times" for what, count in counts.items()) or seen)


def _more_than(host: Host, states: int) -> bool:
    return host.states > states


@check(
    Hazard.MISLED,
    "State",
    f"{CLOCKED_S:g} s of Drive OFF, one every {FINE_S * 1e3:g} ms",
    "device_time_s in steps of 10 us, 1 s in a second to 1 %, without leaps",
)
def clock_runs_on(host: Host) -> str:
    """Speeds are computed from this clock, and lost States found by this counter."""
    first = len(host.rows)
    host.pass_time(CLOCKED_S, DriveMode.OFF, FINE_S)
    rows = columns(host, first)
    blocks = [
        part.min() for part in np.array_split(rows["arrived_s"] - rows["device_s"], len(rows["counter"]) // BLOCK)
    ]
    drift = (blocks[0] - blocks[-1]) / np.ptp(rows["arrived_s"]) * len(blocks) / (len(blocks) - 1)
    # a host is late only, so that the least delayed State of a block shows the device's clock
    leap_s = float(np.max(np.abs(np.diff(blocks) + drift * BLOCK * FINE_S)))
    times = len(set(np.round(rows["device_time_s"] * 1e5) % 100))
    seen = f"{drift:+.2%}, {leap_s * 1e3:.2f} ms of leap at most, {times} different times of 100 within a millisecond"
    return unless(abs(drift) > MAX_DRIFT or leap_s > MAX_LEAP_S or times < 20, seen)


def astray(device_s: Array, at_mm: Array, step_mm: float) -> int:
    """Return how many places lie off the way of a motion: old, or of another time."""
    steps_s, ways_mm = np.diff(device_s), np.diff(at_mm)
    near = np.logical_and.reduce([steps_s[at : len(steps_s) - 3 + at] < SUCCESSIVE_S for at in range(4)])
    before, after = ways_mm[:-3], ways_mm[3:]
    off_mm = ways_mm[1:-2] - steps_s[1:-2] * (ways_mm[1:-2] + ways_mm[2:-1]) / (steps_s[1:-2] + steps_s[2:-1])
    least_mm = np.minimum(np.abs(before), np.abs(after))
    moves = near & (before * after > 0.0) & (least_mm > STEPS * step_mm)
    return int(np.sum(moves & (np.abs(off_mm) > 0.6 * least_mm)))


@check(Hazard.MISLED, "State", ALL, "in each motion a position is between those before and after it")
def positions_run_on(host: Host) -> str:
    rows = columns(host)
    off = {name: astray(rows["device_s"], rows[name], STEP_MM) for name in ("left_mm", "right_mm")}
    if np.sum(np.abs(np.diff(rows["left_mm"])) > STEPS * STEP_MM) < BLOCK:
        raise Untested("nothing moved; run all checks")
    return unless(any(off.values()), f"{off} of {len(rows['counter'])} astray")


@check(
    Hazard.MISLED,
    "Sense",
    f"{ALL}; somebody turns the handle by over a turn, and back, within {TURNED_S:g} s",
    "no leap, a force against the motion",
)
def handle_runs_on(host: Host) -> str:
    """Finds leaps, as of swapped bytes or too few bits, and a force that is not against the motion."""
    host.ask("turn the handle by over a whole turn, at a steady pace, and back")
    end_s, has_turned = host.now_s + TURNED_S, False
    while not has_turned and host.now_s < end_s:
        host.pass_time(0.5, DriveMode.OFF)
        rows = columns(host)
        way_mm, along_N = float(np.ptp(rows["handle_mm"])), _along_N(rows)
        has_turned = way_mm > 1.05 * TURN_MM and len(along_N) == 2
    steps_mm = np.diff(rows["handle_mm"])[np.diff(rows["device_s"]) < SUCCESSIVE_S]
    most_mm, coarse = np.abs(steps_mm).max(initial=0.0), np.gcd.reduce(np.rint(steps_mm / HANDLE_STEP_MM).astype(int))
    is_new = (np.diff(rows["force_N"]) != 0.0) & (np.abs(rows["handle_mm_s"][1:]) > SLIDES_MM_S)
    apart_s = np.quantile(np.diff(rows["device_s"][1:][is_new]), 0.25) if np.sum(is_new) > 1 else 0.0
    seen = (
        f"turned by {way_mm:.0f} mm, {most_mm:.3f} mm a time at most, in steps of {coarse}, {along_N} N against it, "
        f"anew every {apart_s * 1e3:.0f} ms"
    )
    unless(most_mm > LEAP_MM or coarse > 1 or min(along_N, default=0.0) < 0.0 or apart_s > FORCE_S, seen)
    if not has_turned:
        raise Untested(f"{seen}; turn the handle by over a turn and back meanwhile, --only handle_runs_on")
    return seen


def _along_N(rows: dict[str, Array]) -> list[float]:
    along_N = (way * rows["force_N"][way * rows["handle_mm_s"] > SLIDES_MM_S] for way in (1.0, -1.0))
    return [round(float(np.median(part_N)), 2) for part_N in along_N if part_N.size]


@check(
    Hazard.MISLED,
    "Sense",
    f"{ALL}; the handle turned meanwhile",
    f"a force that grows {GROWS:g} times from each depth of {DEPTHS_MM} mm to the next",
)
def force_follows_gap(host: Host) -> str:
    """Finds a force that is clipped or stands, where gap and handle show more."""
    rows = columns(host)
    inside_mm, slides = -0.5 * (rows["left_mm"] + rows["right_mm"]), np.abs(rows["handle_mm_s"]) > SLIDES_MM_S
    forces_N = [
        np.median(part_N) if part_N.size else math.nan
        for part_N in (np.abs(rows["force_N"][slides & (np.abs(inside_mm - mm) < NEAR_MM)]) for mm in DEPTHS_MM)
    ]
    seen = ", ".join(f"{force_N:.2f} N" for force_N in forces_N)
    if np.isnan(forces_N).any():
        raise Untested(f"{seen} at {DEPTHS_MM} mm: run all checks, and turn the handle meanwhile")
    return unless(any(after < GROWS * before for before, after in pairwise(forces_N)), seen)


STREAMS: Final = (
    identity_answers_hello,
    every_nonce,
    status_rate,
    every_drive_answered,
    every_counter,
    plausible_at_rest,
    frames_as_they_come,
    clock_runs_on,
)
OVERALL: Final = (
    positions_run_on,
    handle_runs_on,
    force_follows_gap,
    own_messages,
    status_consistent,
)
