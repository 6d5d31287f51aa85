"""Checks of what the device reports: how often, in which order, how soon, by which clock, and against physics.

Those of all reports read every State and Sense since the start, by mode.
"""

import math
from functools import partial
from itertools import pairwise
from typing import Final

import numpy as np
import numpy.typing as npt

from firmware_protocol.codec import (
    FUNCTION,
    PROTOCOL_VERSION,
    SCHEMA_HASH,
    Clear,
    DeviceMode,
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
    PERIOD_S,
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
LISTENED_S, DRIVES = 2.0, 1000
STATUS_TOLERANCE, STATUS_OFF_S, MAX_DRIFT, MAX_LEAP_S, BLOCK = 0.03, 2.5e-3, 0.01, 2e-3, 250
"States time a Status; one may overtake it on a bus. The least delayed of BLOCK States shows the device's clock."
MAX_ANSWER_S, PAUSE_S = 3e-3, 0.1
"The device's own millisecond, and the way there and back by any adapter."
HANDLE_SPAN_MM: Final = period(Sense, "handle_position_mm")
STEP_MM, HANDLE_STEP_MM = period(State, "left_position_mm") / 2**16, HANDLE_SPAN_MM / 2**16
TURN_MM, TURNED_S, LEAP_MM = 40.0 * math.pi, 20.0, 1.0
"A handle at 0.3 m/s moves a third of LEAP_MM in 1 ms; one of swapped bytes leaps by 2 mm a step."
SUCCESSIVE_S, FORCE_S, AT_REST_A, USUAL_N = 3e-3, 0.03, 0.02, 5.0
STEPS, FARTHEST_MM, ENDS = 4.5, 0.2, -1.0
"From so many steps in one period on a place that is not between its neighbours is wrong."
NONCES: Final = (1, 129, 1, 65, 1, 33, 1, 17, 1, 9, 1, 5, 1, 3, 2, 254, 253, 128, 127, 126, 6)
"""Each bit changes alone, up and down by any distance."""
SLIDES_MM_S, NEAR_MM, GROWS, DEPTHS_MM = 10.0, 0.7, 1.15, (12.0, 16.0, 20.0, 24.0)
"From one of the depths to the next a force grows GROWS times, at least."


def columns(host: Host, first: int = 0) -> dict[str, Array]:
    """Return what came from this value of `host.rows` on, unwrapped, and the handle's speed."""
    rows = np.array(host.rows[first:]).reshape(-1, len(COLUMNS))
    unless(len(rows) < 2, "no Sense")
    table = dict(zip(COLUMNS, rows.T, strict=True))
    table["device_s"] = table["arrived_s"] - np.unwrap(table["arrived_s"] - table["device_time_s"], period=TIME_SPAN_S)
    table["handle_mm"] = np.unwrap(table["handle_mm"], period=HANDLE_SPAN_MM)
    table["handle_mm_s"] = np.gradient(table["handle_mm"], table["device_s"] + 1e-9 * np.arange(len(rows)))
    return table


def all_columns(host: Host) -> dict[str, Array]:
    """Return all that came, with the mode that both Status around a row show, else ENDS less the first."""
    unless(len(host.marks) < 4, "no Status")
    table, (at, modes) = columns(host), np.array(host.marks).reshape(-1, 2).T
    table["mode"] = np.full(len(table["counter"]), math.nan)
    table["mode"][int(at[0]) : int(at[-1])] = np.repeat(
        np.where(modes[1:] == modes[:-1], modes[1:], ENDS - modes[:-1]), np.diff(at).astype(int)
    )
    return table


def steps(rows: dict[str, Array], name: str, step_mm: float) -> npt.NDArray[np.int_]:
    """Return a place's steps from State to State, but where a homing ends."""
    is_old = rows["mode"] == ENDS - DeviceMode.HOMING
    is_next = (np.diff(rows["device_s"]) < SUCCESSIVE_S) & ~is_old[1:] & ~is_old[:-1]
    return np.asarray(np.rint(np.diff(rows[name])[is_next] / step_mm), dtype=np.int_)


@check(Hazard.MISLED, WHO + "1", "3 Hellos", f"one Identity each, at once, with schema {SCHEMA_HASH:08X}", is_gate=True)
def identity_answers_hello(host: Host) -> str:
    host.counter = host.next_status(None).drive_counter  # so that the first Drive counts
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
        unless(host.next_status(None).command_nonce != nonce, f"nonce {nonce} not acknowledged: {shown(host.status)}")
    return f"{len(NONCES) + 254} acknowledged"


@check(Hazard.MISLED, WHO + "4", f"for {LISTENED_S:g} s nothing", "50 Status a second, to 3 %")
def status_rate(host: Host) -> str:
    host.idle()
    host.heard.clear()
    start_s = host.now_s
    host.pass_time(LISTENED_S)
    share = len(host.all_of(Status)) * STATUS_S / (host.now_s - start_s)
    return unless(abs(share - 1.0) > STATUS_TOLERANCE, f"{share:.3f} of all")


@check(
    Hazard.MISLED,
    WHO + "3",
    f"{ALL}; then {DRIVES} Drive OFF, one every 1 ms; then none",
    "for each one State, then one Sense",
)
def every_drive_answered(host: Host) -> str:
    host.pass_time(DRIVES * PERIOD_S, DriveMode.OFF)
    host.pass_time(10 * ANSWER_S)
    counts = host.drives, host.states, host.senses, len(host.rows) // len(COLUMNS)
    return unless(len(set(counts)) > 1, "{} Drive, {} State, {} Sense, {} Sense behind its State".format(*counts))


@check(
    Hazard.MISLED,
    WHO + "2",
    "Drive OFF with whole duties, its counter changed by 1 .. 255",
    "a State for each, the counter in Status",
)
def every_counter(host: Host) -> str:
    for change in range(1, 256):
        host.counter = (host.counter + change - 1) % 256
        host.answered(DriveMode.OFF, -1.0, 1.0)
        if change % 50 == 0:
            host.next_status(None)
            seen = f"drive_counter {host.next_status(None).drive_counter} after a Drive with {host.counter}"
            unless(host.status.drive_counter != host.counter, seen)
    return "255 changes accepted"


@check(
    Hazard.MISLED,
    WHO + "3",
    ALL,
    f"with the drives off currents under {AT_REST_A:g} A; a force under {USUAL_N:g} N, as a rule",
)
def plausible_at_rest(host: Host) -> str:
    rows = all_columns(host)
    is_off = np.isin(rows["mode"], (DeviceMode.IDLE, DeviceMode.LATCHED))
    left_A, right_A = (np.abs(rows[name][is_off]).max(initial=0.0) for name in ("left_A", "right_A"))
    force_N = np.median(np.abs(rows["force_N"]))
    seen = f"{left_A:.3f} A, {right_A:.3f} A at most, {force_N:.2f} N as a rule"
    return unless(max(left_A, right_A) > AT_REST_A or force_N > USUAL_N, seen)


@check(
    Hazard.MISLED,
    WHO + "3",
    ALL,
    f"in each mode {STATUS_S * 1e3:g} ms from Status to Status, to {STATUS_OFF_S * 1e3:g} ms, on the device's clock; "
    f"a State within {MAX_ANSWER_S * 1e3:g} ms of its Drive, as a rule",
)
def reports_in_time(host: Host) -> str:
    rows = all_columns(host)
    at = np.array(host.marks[::2]).astype(int)
    at = at[(at > 0) & (at < len(rows["mode"]))]
    before_s, after_s = rows["device_s"][at - 1], rows["device_s"][at]
    least_s, most_s = before_s[1:] - after_s[:-1], after_s[1:] - before_s[:-1]
    off = int(np.sum((least_s > STATUS_S + STATUS_OFF_S) | (most_s < STATUS_S - STATUS_OFF_S)))
    usual_s = {
        mode.name: np.nanmedian((rows["arrived_s"] - rows["asked_s"])[rows["mode"] == mode])
        for mode in DeviceMode
        if mode in rows["mode"]
    }
    seen = ", ".join([f"{off} Status not in time", *(f"{name} {s * 1e3:.2f} ms" for name, s in usual_s.items())])
    return unless(off or max(usual_s.values(), default=0.0) > MAX_ANSWER_S, seen)


@check(
    Hazard.MISLED,
    "Carriers",
    f"a Hello byte for byte again; empty frames; a Hello in two parts, {PAUSE_S:g} s apart; one with the sequence of "
    "another frame before; sequences that leap",
    "1 Identity, then 1 for each Hello",
)
def frames_as_they_come(host: Host) -> str:
    assert isinstance(host.line, SerialLine)
    counts = []
    for parts in host.line.unusual(FUNCTION[Hello], encode(Hello(SCHEMA_HASH, PROTOCOL_VERSION, HELLO_NONCE))):
        host.heard.clear()
        for part in parts:
            host.beat(None, period_s=PAUSE_S, besides=partial(host.line.port.write, part))
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


@check(
    Hazard.MISLED,
    "State",
    ALL,
    "device_time_s in steps of 10 us, 1 s in a second to 1 %, without leaps",
)
def clock_runs_on(host: Host) -> str:
    rows = columns(host)
    late_s = rows["arrived_s"] - rows["device_s"]
    slow, _ = np.polyfit(rows["arrived_s"], late_s, 1)
    starts = np.arange(0, max(len(late_s) - BLOCK, 1), BLOCK)
    blocks_s = np.minimum.reduceat(late_s - slow * rows["arrived_s"], starts)
    drift, leap_s = -float(slow), float(np.abs(np.diff(blocks_s)).max(initial=0.0))
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


@check(
    Hazard.MISLED,
    "State",
    ALL,
    f"in each motion a position is between those before and after it; in steps of 1, no leap over {FARTHEST_MM:g} mm",
)
def positions_run_on(host: Host) -> str:
    rows = all_columns(host)
    seen, is_wrong = [], False
    for name in ("left_mm", "right_mm"):
        off, ways = astray(rows["device_s"], rows[name], STEP_MM), steps(rows, name, STEP_MM)
        if np.sum(np.abs(ways) > STEPS) < BLOCK:
            raise Untested("nothing moved; run all checks")
        coarse, most_mm = np.gcd.reduce(ways), np.abs(ways).max() * STEP_MM
        seen.append(f"{name}: {off} of {len(ways)} astray, in steps of {coarse}, {most_mm:.3f} mm at most")
        is_wrong |= bool(off) or coarse > 1 or most_mm > FARTHEST_MM
    return unless(is_wrong, "; ".join(seen))


@check(
    Hazard.MISLED,
    "Sense",
    f"{ALL}; somebody turns the handle by over a turn, and back, within {TURNED_S:g} s",
    f"no leap, a force against the motion, in each mode at most {FORCE_S * 1e3:g} ms old",
)
def handle_runs_on(host: Host) -> str:
    """Finds leaps, as of swapped bytes or too few bits, and a force that is not against the motion."""
    host.ask("turn the handle by over a whole turn, at a steady pace, and back")
    end_s, has_turned = host.now_s + TURNED_S, False
    while not has_turned and host.now_s < end_s:
        host.pass_time(0.5, DriveMode.OFF)
        rows = all_columns(host)
        way_mm, along_N = float(np.ptp(rows["handle_mm"])), _along_N(rows)
        has_turned = way_mm > 1.05 * TURN_MM and len(along_N) == 2
    ways = steps(rows, "handle_mm", HANDLE_STEP_MM)
    most_mm, coarse = np.abs(ways).max(initial=0) * HANDLE_STEP_MM, np.gcd.reduce(ways)
    is_new = np.diff(rows["force_N"], prepend=math.nan) != 0.0
    ages_s = rows["device_s"] - np.maximum.accumulate(np.where(is_new, rows["device_s"], -math.inf))
    slides = [(np.abs(rows["handle_mm_s"]) > SLIDES_MM_S) & (rows["mode"] == mode) for mode in DeviceMode]
    oldest_s = max((np.median(ages_s[part]) for part in slides if part.any()), default=0.0)
    seen = (
        f"turned by {way_mm:.0f} mm, {most_mm:.3f} mm a time at most, in steps of {coarse}, {along_N} N against it, "
        f"{oldest_s * 1e3:.0f} ms old"
    )
    unless(most_mm > LEAP_MM or coarse > 1 or min(along_N, default=0.0) < 0.0 or oldest_s > FORCE_S / 2.0, seen)
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
    every_counter,
    frames_as_they_come,
)
OVERALL: Final = (
    every_drive_answered,
    clock_runs_on,
    reports_in_time,
    plausible_at_rest,
    positions_run_on,
    handle_runs_on,
    force_follows_gap,
    own_messages,
    status_consistent,
)
