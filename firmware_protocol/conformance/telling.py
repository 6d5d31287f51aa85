"""Checks of what the device reports: how often, in which order, how soon, by which clock, and against physics.

Those of all reports read every State and Sense since the start, by mode.
"""

import math
from collections.abc import Sequence
from functools import partial
from itertools import chain, pairwise
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
    encode,
    period,
)
from firmware_protocol.conformance.check import ALL, WHO, Hazard, check
from firmware_protocol.conformance.host import (
    ANSWER_S,
    COLUMNS,
    HELLO_NONCE,
    PERIOD_S,
    STATUS_S,
    SWITCH_MM,
    Host,
    Untested,
    shown,
    unless,
)
from firmware_protocol.conformance.line import SerialLine

Array = npt.NDArray[np.float64]
LISTENED_S, DRIVES = 2.0, 1000
STATUS_TOLERANCE, STATUS_OFF_S, MAX_DRIFT, MAX_LEAP_S, BLOCK, TOLD = 0.03, 2.5e-3, 0.01, 1e-3, 250, 8
"""States time a Status; one may overtake it on a bus. BLOCK Drives and arrivals bound the device's clock, unless one is
late: that must be so in one of TOLD."""
MAX_ANSWER_S, PAUSE_S = 3e-3, 0.1
"The device's own millisecond, and the way there and back by any adapter."
TIME_SPAN_S, HANDLE_SPAN_MM = period(State, "device_time_s"), period(Sense, "handle_position_mm")
STEP_MM, HANDLE_STEP_MM = period(State, "left_position_mm") / 2**16, HANDLE_SPAN_MM / 2**16
TURN_MM, TURNED_S, LEAP_MM = 40.0 * math.pi, 20.0, 0.25
"Swapped bytes leap by 2 mm a step."
SUCCESSIVE_S, TICK_S, FORCE_S, AT_REST_A, USUAL_N = 3e-3, 1e-5, 0.03, 0.02, 5.0
STEPS, ENDS, BESIDE_S, FRESH_S, FORCE_STEPS, LONE, NOISY, UNMOVED = 3.0, -1.0, 5e-3, 2e-3, 50, 0.2, 12.0, 999
"A place that is old lies STEPS off its way; LONE is a share of a range. Noise changes by NOISY times its usual least."
SIDES, MOVES_MM_S, STANDS_MM_S, MOVING = (
    ("left", "right"),
    0.5,
    0.1,
    (DeviceMode.RUN, DeviceMode.HOMING, DeviceMode.RETRACTING),
)
HALF, ALIKE, SAME, LEAST, MANY = 20, 0.15, 0.99, 0.05, 2000
NONCES: Final = (1, 129, 1, 65, 1, 33, 1, 17, 1, 9, 1, 5, 1, 3, 2, 254, 253, 128, 127, 126, 6)
"""Each bit changes alone, up and down by any distance."""
SLIDES_MM_S, NEAR_MM, GROWS, AS_MUCH, DEPTHS_MM = 10.0, 0.7, 1.15, 1.25, (0.0, 12.0, 16.0, 20.0, 24.0)
"From one of the depths to the next a force grows GROWS times, at least."


def columns(host: Host, first: int = 0) -> dict[str, Array]:
    """Return what came from a value of `host.rows` on, unwrapped, and speeds."""
    rows = np.array(host.rows[first:]).reshape(-1, len(COLUMNS))
    unless(len(rows) < 2, "no Sense")
    table = dict(zip(COLUMNS, rows.T, strict=True))
    # whoever stood still, a State was latched between its Drive and its arrival
    middle_s = 0.5 * (table["asked_s"] + table["arrived_s"])
    table["device_s"] = middle_s - np.unwrap(middle_s - table["device_time_s"], period=TIME_SPAN_S)
    table["handle_mm"] = np.unwrap(table["handle_mm"], period=HANDLE_SPAN_MM)
    for name in ("left_mm", "right_mm", "handle_mm"):
        ways_mm = [
            way * np.interp(table["device_s"] + way * BESIDE_S, table["device_s"], table[name]) for way in (1.0, -1.0)
        ]
        table[f"{name}_s"] = sum(ways_mm) / (2.0 * BESIDE_S)
    return table


def all_columns(host: Host) -> dict[str, Array]:
    """Return all that came, with the mode of both Status around, else ENDS less the first."""
    unless(len(host.marks) < 4, "no Status")
    table, (at, modes) = columns(host), np.array(host.marks).reshape(-1, 2).T
    table["mode"] = np.full(len(table["counter"]), math.nan)
    table["mode"][int(at[0]) : int(at[-1])] = np.repeat(
        np.where(modes[1:] == modes[:-1], modes[1:], ENDS - modes[:-1]), np.diff(at).astype(int)
    )
    return table


def successive(rows: dict[str, Array]) -> npt.NDArray[np.bool_]:
    """Return whether a State follows at once, but where a homing moves the origin."""
    is_old = rows["mode"] == ENDS - DeviceMode.HOMING
    return np.asarray((np.diff(rows["device_s"]) < SUCCESSIVE_S) & ~is_old[1:] & ~is_old[:-1])


def least_step(rows: dict[str, Array], name: str, step: float) -> int:
    """Return a value's least step, in the mode where that is greatest."""
    ways = np.rint(np.abs(np.diff(rows[name])) / step).astype(np.int_) * successive(rows)
    parts = [ways[(ways > 0) & (rows["mode"][1:] == mode)] for mode in DeviceMode]
    return max((int(part.min()) for part in parts if part.size > BLOCK), default=UNMOVED)


def off_way(rows: dict[str, Array], name: str) -> Array:
    """Return how far each place but the ends lies beside the way between its neighbours."""
    steps_s, ways, near = np.diff(rows["device_s"]), np.diff(rows[name]), successive(rows)
    beside_s = np.maximum(steps_s[:-2] + steps_s[2:], TICK_S)
    off = ways[1:-1] - steps_s[1:-1] * (ways[:-2] + ways[2:]) / beside_s
    # neighbours that are shorter would count the encoder's steps several times
    return np.abs(off) * (near[:-2] & near[1:-1] & near[2:] & (beside_s >= steps_s[1:-1]))


def oldest_s(rows: dict[str, Array], name: str, moves: npt.NDArray[np.bool_]) -> float:
    """Return a value's usual age while it `moves`, at most."""
    is_new = np.diff(rows[name], prepend=math.nan) != 0.0
    ages_s = rows["device_s"] - np.maximum.accumulate(np.where(is_new, rows["device_s"], -math.inf))
    parts = [moves & (rows["mode"] == mode) for mode in DeviceMode]
    return max((float(np.median(ages_s[part])) for part in parts if np.sum(part) > BLOCK), default=0.0)


@check(Hazard.MISLED, WHO + "1", "3 Hellos", f"one Identity each, at once, with schema {SCHEMA_HASH:08X}", is_gate=True)
def identity_answers_hello(host: Host) -> str:
    host.counter = host.next_status(None).drive_counter  # so that the first Drive counts
    for _ in range(3):
        host.hello()
    theirs = [f"{identity.schema_hash:08X}" for _, identity in host.all_of(Identity)]
    return unless(theirs != 3 * [f"{SCHEMA_HASH:08X}"], f"for 3 Hellos {theirs} {[*host.refused]}")


@check(
    Hazard.SHUT,
    WHO + "5",
    f"Clear with the nonces {NONCES}, then 1 to 254",
    "each acknowledged",
)
def every_nonce(host: Host) -> str:
    host.idle()
    for nonce in (*NONCES, *range(1, 255)):
        host.beat(None, besides=partial(host.send, Clear(nonce)))
        unless(host.next_status(None).command_nonce != nonce, f"nonce {nonce} not acknowledged: {shown(host.status)}")
    return f"{len(NONCES) + 254} acknowledged"


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
    "a State for each",
)
def every_counter(host: Host) -> str:
    for change in range(1, 256):
        host.counter = (host.counter + change - 1) % 256
        host.answered(DriveMode.OFF, -1.0, 1.0)
    return "255 changes accepted"


def drawn_A(rows: dict[str, Array], side: str) -> dict[str, float]:
    """Return by mode the current for an acceleration, both with the weights of a second difference."""
    clock_s = np.arange(rows["device_s"][0], rows["device_s"][-1], PERIOD_S)
    row = np.searchsorted(rows["device_s"], clock_s, side="right") - 1
    at_mm, at_A = (np.interp(clock_s, rows["device_s"], rows[f"{side}_{unit}"]) for unit in ("mm", "A"))
    before, middle, after = slice(-2 * HALF), slice(HALF, -HALF), slice(2 * HALF, None)
    mm_s2 = (at_mm[before] - 2.0 * at_mm[middle] + at_mm[after]) / (HALF * PERIOD_S) ** 2
    mm_s = (at_mm[after] - at_mm[before]) / (2.0 * HALF * PERIOD_S)
    mean_A = np.convolve(at_A, np.bartlett(2 * HALF + 1) / HALF, "valid")
    makes = np.column_stack([mm_s2, mm_s, np.sign(mm_s), np.ones(len(mm_s))])
    is_dense = (row[after] - row[before] > HALF) & (np.abs(mm_s) > MOVES_MM_S)
    modes = rows["mode"][row]
    parts = {
        mode.name: is_dense & (modes[before] == mode) & (modes[middle] == mode) & (modes[after] == mode)
        for mode in MOVING
    }
    return {
        name: float(np.linalg.lstsq(makes[part], mean_A[part], rcond=None)[0][0])
        for name, part in parts.items()
        if np.sum(part) > MANY
    }


def _standing_A(rows: dict[str, Array]) -> float:
    """Return what a standing motor usually draws in a motion."""
    found_A = [0.0]
    for side, other in (SIDES, SIDES[::-1]):
        stands = (np.abs(rows[f"{side}_mm_s"]) < STANDS_MM_S) & np.isin(rows["mode"], MOVING[1:])
        beside = stands & (np.abs(rows[f"{other}_mm_s"]) > MOVES_MM_S)
        found_A += [float(np.median(np.abs(rows[f"{side}_A"][part]))) for part in (stands, beside) if part.any()]
    return max(found_A)


def _alike(rows: dict[str, Array]) -> list[str]:
    """Return the modes in which both sides always report one value alike, but not the other."""
    is_both, found = np.minimum(*(np.abs(rows[f"{side}_mm_s"]) for side in SIDES)) > MOVES_MM_S, []
    for mode in MOVING:
        part = is_both & (rows["mode"] == mode)
        sames = [rows[f"left_{of}"][part] == rows[f"right_{of}"][part] for of in ("mm", "A")]
        is_one = np.sum(part) > MANY and any(map(np.all, sames)) and min(map(np.mean, sames)) < SAME
        found += [mode.name] if is_one else []
    return found


@check(
    Hazard.MISLED,
    WHO + "3",
    ALL,
    f"a motor at rest under {AT_REST_A:g} A, also where it is braked; in each mode the same current for an "
    f"acceleration, to {ALIKE:.0%}; nowhere both sides always alike; a force under {USUAL_N:g} N, as a rule; no value "
    "far beside both its neighbours",
)
def plausible_in_each_mode(host: Host) -> str:
    rows = all_columns(host)
    is_off = np.isin(rows["mode"], (DeviceMode.IDLE, DeviceMode.LATCHED))
    most_A = max([_standing_A(rows), *(float(np.abs(rows[f"{side}_A"][is_off]).max(initial=0.0)) for side in SIDES)])
    force_N, alike = float(np.median(np.abs(rows["force_N"]))), _alike(rows)
    lone = sum(alone(rows, name) for name in ("force_N", "left_A", "right_A"))
    seen = f"{most_A:.3f} A at rest, alike in {alike}, {force_N:.2f} N as a rule, {lone} values alone"
    is_wrong = most_A > AT_REST_A or alike or force_N > USUAL_N or lone > 0
    for side in SIDES:
        drawn = drawn_A(rows, side)
        seen += "".join(f"; {side} {mode} {1e3 * value:+.2f} mA s2/mm" for mode, value in drawn.items())
        is_wrong = is_wrong or not all(
            abs(value / np.mean([*drawn.values()]) - 1.0) < ALIKE for value in drawn.values()
        )
    return unless(is_wrong, seen)


@check(
    Hazard.MISLED,
    WHO + "3",
    f"{ALL}; then for {LISTENED_S:g} s nothing",
    f"in each mode {STATUS_S * 1e3:g} ms from Status to Status, to {STATUS_OFF_S * 1e3:g} ms, on the device's clock; "
    f"without Drives 50 a second, to {STATUS_TOLERANCE:.0%}; a State within {MAX_ANSWER_S * 1e3:g} ms of its Drive, "
    "as a rule",
)
def reports_in_time(host: Host) -> str:
    start_s, before = host.now_s, len(host.marks)
    host.pass_time(LISTENED_S)
    share = (len(host.marks) - before) / 2 * STATUS_S / (host.now_s - start_s)
    rows, at = all_columns(host), np.array(host.marks[::2]).astype(int)
    at = at[(at > 0) & (at < len(rows["mode"]))]
    before_s, after_s = rows["device_s"][at - 1], rows["device_s"][at]
    least_s, most_s = before_s[1:] - after_s[:-1], after_s[1:] - before_s[:-1]
    off = int(np.sum((least_s > STATUS_S + STATUS_OFF_S) | (most_s < STATUS_S - STATUS_OFF_S)))
    usual_s = {
        mode.name: np.nanmedian((rows["arrived_s"] - rows["asked_s"])[rows["mode"] == mode])
        for mode in DeviceMode
        if mode in rows["mode"]
    }
    seen = ", ".join(
        [
            f"{share:.3f} of all Status alone, {off} not in time",
            *(f"{name} {s * 1e3:.2f} ms" for name, s in usual_s.items()),
        ]
    )
    return unless(abs(share - 1.0) > STATUS_TOLERANCE or off or max(usual_s.values(), default=0.0) > MAX_ANSWER_S, seen)


@check(
    Hazard.MISLED,
    "Carriers",
    f"a Hello byte for byte again; empty frames; a Hello in two parts, {PAUSE_S:g} s apart; one with the sequence of "
    "another message before, then of another Hello, then the first again; sequences that leap",
    "1 Identity, then 1 for each Hello",
)
def frames_as_they_come(host: Host) -> str:
    if not isinstance(host.line, SerialLine):
        raise Untested("of a serial line")
    counts = []
    for many, parts in host.line.unusual(FUNCTION[Hello], encode(Hello(SCHEMA_HASH, PROTOCOL_VERSION, HELLO_NONCE))):
        host.heard.clear()
        host.nonces += [HELLO_NONCE ^ 1, HELLO_NONCE]
        for part in parts:
            host.beat(None, period_s=PAUSE_S, besides=partial(host.line.port.write, part))
        host.pass_time(ANSWER_S)
        counts.append((len(host.all_of(Identity)), many))
    return unless(any(came != many for came, many in counts), f"(Identity, Hellos) {counts}")


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
    rows = all_columns(host)
    starts = np.arange(0, max(len(rows["device_s"]) - BLOCK, 1), BLOCK)
    rate = float(np.median(np.diff(rows["device_s"][starts]) / np.diff(rows["asked_s"][starts])))
    least_s = np.maximum.reduceat(rows["device_s"] - rate * rows["arrived_s"], starts)
    most_s = np.minimum.reduceat(rows["device_s"] - rate * rows["asked_s"], starts)
    # what is answered late may have been stamped by a computer that stood still
    waits_s = np.maximum(rows["arrived_s"] - rows["asked_s"], np.diff(rows["asked_s"], prepend=rows["asked_s"][0]))
    is_told = np.maximum.reduceat(waits_s, starts) <= MAX_ANSWER_S
    leaps_s = np.maximum(least_s[1:] - most_s[:-1], least_s[:-1] - most_s[1:])[is_told[1:] & is_told[:-1]]
    unless(
        len(leaps_s) < len(starts) / TOLD,
        f"{len(leaps_s)} of {len(starts)} times {BLOCK} answers in time, one after the other",
    )
    drift, leap_s = rate - 1.0, leaps_s.max(initial=0.0)
    ticks = np.round(rows["device_time_s"] * 1e5) % 100
    times = min(len(set(part)) for mode in DeviceMode if len(part := ticks[rows["mode"] == mode]) > BLOCK)
    seen = f"{drift:+.2%}, {leap_s * 1e3:.2f} ms of leap at most, {times} different times of 100 within a millisecond"
    return unless(abs(drift) > MAX_DRIFT or leap_s > MAX_LEAP_S or times < 20, seen)


@check(
    Hazard.MISLED,
    "State",
    ALL,
    f"in each mode a position, to {STEPS * STEP_MM * 1e3:.0f} um on the way between those before and after it; in "
    "steps of 1",
)
def positions_run_on(host: Host) -> str:
    rows, seen = all_columns(host), []
    for side in SIDES:
        off, least = off_way(rows, f"{side}_mm"), least_step(rows, f"{side}_mm", STEP_MM)
        if least == UNMOVED:
            raise Untested("nothing moved; run all checks")
        is_wrong = off.max() > STEPS * STEP_MM or least > 1
        seen.append(unless(is_wrong, f"{side}: {off.max() * 1e3:.1f} um off the way, in steps of {least}"))
    return "; ".join(seen)


@check(
    Hazard.MISLED,
    "Sense",
    f"{ALL}; somebody turns the handle by over a turn, and back, within {TURNED_S:g} s",
    "no leap, steps of 1, in each mode a new place with each Sense",
)
def handle_runs_on(host: Host) -> str:
    host.ask("turn the handle by over a whole turn, at a steady pace, and back")
    host.pass_time(TURNED_S, DriveMode.OFF)
    rows = all_columns(host)
    way_mm = float(np.ptp(rows["handle_mm"]))
    has_turned = way_mm > 1.05 * TURN_MM and len(_along_N(rows)) == 2
    least, most_mm = least_step(rows, "handle_mm", HANDLE_STEP_MM), off_way(rows, "handle_mm").max()
    old_s = oldest_s(rows, "handle_mm", np.abs(rows["handle_mm_s"]) > SLIDES_MM_S)
    seen = f"turned by {way_mm:.0f} mm, in steps of {least}, {most_mm:.3f} mm off its way, {old_s * 1e3:.1f} ms old"
    unless((has_turned and 1 < least < UNMOVED) or most_mm > LEAP_MM or old_s > FRESH_S, seen)
    if not has_turned:
        raise Untested(f"{seen}; turn the handle by over a turn and back meanwhile, --only handle_runs_on")
    return seen


def _along_N(rows: dict[str, Array], mode: DeviceMode | None = None) -> list[float]:
    is_there = (rows["mode"] == mode) | (mode is None)
    ways_N = (way * rows["force_N"][is_there & (way * rows["handle_mm_s"] > SLIDES_MM_S)] for way in (1.0, -1.0))
    return [round(float(np.median(way_N)), 2) for way_N in ways_N if way_N.size > BLOCK]


def _usual_N(rows: dict[str, Array], part: npt.NDArray[np.bool_]) -> float:
    return float(np.median(np.abs(rows["force_N"][part]))) if np.sum(part) > BLOCK / 4 else math.nan


def _times(rows: dict[str, Array], depths: Sequence[npt.NDArray[np.bool_]]) -> float:
    """Return the greatest quotient of the forces of two modes."""
    modes_N = [[_usual_N(rows, depth & (rows["mode"] == mode)) for mode in DeviceMode] for depth in depths]
    return max((np.nanmax(by_N) / np.nanmin(by_N) for by_N in modes_N if not np.isnan(by_N).all()), default=1.0)


def alone(rows: dict[str, Array], name: str) -> int:
    """Return how many values lie far beside both neighbours."""
    ways, near = np.diff(rows[name]), successive(rows)
    least = np.minimum(ways[:-1] * -np.sign(ways[1:]), np.abs(ways[1:]))  # over 0 if it turns back
    noise = min(NOISY * np.quantile(np.abs(ways[ways != 0.0]), 0.25), LONE * np.ptp(rows[name])) if ways.any() else 0.0
    near = near[:-1] & near[1:]
    parts = [part for mode in DeviceMode if (part := rows["mode"] == mode).any()]
    return sum(
        int(np.sum(near & part[1:-1] & (least > max(LONE * np.ptp(rows[name][part]), LEAST, noise)))) for part in parts
    )


@check(
    Hazard.MISLED,
    "Sense",
    f"{ALL}; the handle turned meanwhile",
    f"in each mode a force against the motion, at most {FORCE_S * 1e3:g} ms old, in steps of at most "
    f"{FORCE_STEPS * 1e-3:g} N; {GROWS:g} times more from each depth of {DEPTHS_MM} mm "
    "to the next",
)
def force_follows_gap(host: Host) -> str:
    rows = all_columns(host)
    inside_mm, slides = -0.5 * (rows["left_mm"] + rows["right_mm"]), np.abs(rows["handle_mm_s"]) > SLIDES_MM_S
    against_N = [*chain.from_iterable(_along_N(rows, mode) for mode in DeviceMode)]
    least, old_s = least_step(rows, "force_N", 1e-3), oldest_s(rows, "force_N", slides)
    depths = [slides & (np.abs(inside_mm - mm) < NEAR_MM) for mm in DEPTHS_MM]
    forces_N = [_usual_N(rows, depth) for depth in depths]
    most = _times(rows, depths)
    seen = (
        f"{against_N} N against it, {old_s * 1e3:.0f} ms old, in steps of {least}; "
        f"{', '.join(f'{force_N:.2f}' for force_N in forces_N)} N, {most:.2f} times as much in one mode as in another"
    )
    unless(
        min(against_N, default=1.0) <= 0.0 or FORCE_STEPS < least < UNMOVED or old_s > FORCE_S / 2.0 or most > AS_MUCH,
        seen,
    )
    if np.isnan(forces_N).any():
        raise Untested(f"{seen} at {DEPTHS_MM} mm: run all checks, and turn the handle meanwhile")
    return unless(any(after < GROWS * before for before, after in pairwise(forces_N[1:])), seen)


STREAMS: Final = (
    identity_answers_hello,
    every_nonce,
    every_counter,
    frames_as_they_come,
)
OVERALL: Final = (
    every_drive_answered,
    clock_runs_on,
    reports_in_time,
    plausible_in_each_mode,
    positions_run_on,
    handle_runs_on,
    force_follows_gap,
    own_messages,
    status_consistent,
)
