"""Checks of motion: homing, what a duty does, what ends RUN, how the gap opens, and what silence leads to."""

import math
from functools import partial
from itertools import product
from typing import Final

import numpy as np

from firmware_protocol.codec import Clear, DeviceFault, DeviceMode, DriveMode, Home, Sense, State, Status
from firmware_protocol.conformance.check import Check, Hazard, check
from firmware_protocol.conformance.host import (
    ANSWER_S,
    ENDS,
    INSIDE_MM,
    NO_FAULT,
    OPENED_S,
    PERIOD_S,
    SEEN_S,
    STROKE_MM,
    SWITCH_MM,
    Host,
    Unmet,
    clamped,
    is_homed,
    places,
    positions,
    shown,
    unless,
    ways_mm,
)
from firmware_protocol.conformance.taking import DUTY, PLACES, RESTING, RESTING_A, SPARSE_S, opens_fully, refused, taken
from firmware_protocol.conformance.telling import TIME_SPAN_S, Array, all_columns, columns

RUNNING: Final = next(place for place in PLACES if place.name == "RUN")

SILENCE, DRIVE = "Who says what when, 6", "Drive"
ZERO_MM, JUMP_MM, LAST_S = 1.0, 0.2, 8.0
"""A carriage rests ZERO_MM from its zero at most: behind its switch, where it was braked from a creep. It is braked
when HOMED shows, so that a State further off than JUMP_MM has the old origin."""
RAMP_PER_S, MAX_DUTY, MOVED_MM, SLOW_S, REVERSED_S = 1.0, 0.5, 0.3, 0.045, 0.12
AT_STOP_DUTY, AT_STOP_MM, AT_STOP_A, PHASES = 0.3, 0.1, 0.3, (1.0, 0.9, 0.8, 0.7)
"A motor that pushes into the stop at AT_STOP_DUTY draws several times AT_STOP_A."
SLOW_MM_S, BESIDE_MM, SCALE_MM = 2.0, 1.5, 0.02 * STROKE_MM
SKEW_MM, BOUND_MM, AHEAD_MM, ASIDE_MM = 2.0, 0.3, 4.0, 0.5
"BOUND_MM is two Status at SLOW_MM_S, and the sway of a carriage."
MIDDLE, NEAR = 0.4, 0.97
"Shares of the stroke; from NEAR a switch comes before SKEW."
MIDDLE_MM, FREE_MM, ALIKE = 10.0, 2.5, 0.05
SETTLED_S, PULSE_S, PULSES, SMOOTHED_S, PART_S = 0.04, 0.03, 100, 0.0035, 0.015
"The start of a pulse shows a current that is smoothed."
MAX_OFF, MAX_LAG_S, STALL_A = 0.01, 1.5e-3, (0.7, 30.0)
"""MAX_OFF of duty may lie between a current and what duty, speed and rise make. L / R is under MAX_LAG_S; a whole duty
makes STALL_A."""
SHORT_S, LONG_S, BORNE_S, NOTICED_S = 0.047, 0.053, 0.0495, 0.0515
"By the device's clock shorter silences are borne, longer ones noticed, with a tick for tolerance."
SHORTS, LONGS, HELD_S, HOLDS = 12, 5, 38.0, 3
"The holds together meet every time modulo 2^16 ms in RUN, and a silence in every 2^15 ms."
TIMED_OUT: Final = DeviceFault.COMMAND_TIMEOUT


@check(
    Hazard.OPENS,
    "Homing",
    "Home to a device without a zero, beside Drive OFF; then again, without any Drive",
    f"in {LAST_S:g} s IDLE, HOMED, open, no fault; from the first State after HOMED both within {ZERO_MM:g} mm of 0",
    moves=True,
    is_gate=True,
)
def home_homes(host: Host) -> str:
    host.without_zero()
    seen = []
    for beat in (DriveMode.OFF, None):
        host.heard.clear()
        seconds, state = host.home(beat), host.last(State)
        homed_s = next((time_s for time_s, status in host.all_of(Status) if is_homed(status)), math.inf)
        first = next((each for time_s, each in host.all_of(State) if time_s > homed_s), state)
        seen.append(f"{seconds:.1f} s, first {positions(first)}, then {positions(state)}")
        jump_mm = max(map(abs, ways_mm(first, places(state))))
        is_off = beat is DriveMode.OFF and (max(map(abs, places(state))) > ZERO_MM or jump_mm > JUMP_MM)
        host.shows(
            DeviceMode.IDLE,
            homed=True,
            opened=True,
            fault=NO_FAULT,
            besides=seen[-1],
            wrong=is_off or seconds > LAST_S,
        )
    return "; ".join(seen)


def _duty_moves(side: int, host: Host) -> str:
    """Let one duty fall until its carriage moves: with a wrong side or sign every safe state closes the gap."""
    host.running()
    start, duty, seen = places(host.last(State)), 0.0, ""
    while duty > -MAX_DUTY:
        duty -= RAMP_PER_S * PERIOD_S
        host.beat(DriveMode.RUN, 0.0 if side else duty, duty if side else 0.0)
        moved_mm = ways_mm(host.last(State), start)
        seen = f"by {moved_mm[0]:+.2f} and {moved_mm[1]:+.2f} mm at {duty:.2f}"
        if moved_mm[side] <= -MOVED_MM and abs(moved_mm[1 - side]) < MOVED_MM / 2:
            return seen
        unless(max(map(abs, moved_mm)) >= MOVED_MM, seen)
    raise Unmet(f"{seen}, {shown(host.status)}")


@check(
    Hazard.WORN,
    "Modes",
    f"in RUN, duties of +{AT_STOP_DUTY:g} at both open switches; then each carriage alone {BESIDE_MM:g} mm in at "
    f"{SLOW_MM_S:g} mm/s, Drives of {PHASES} every {SLOW_S * 1e3:g} ms; both at -1, 1, 3 times",
    f"at a switch, or behind it, no motion over {AT_STOP_MM:g} mm, none over {AT_STOP_A:g} A; the other opens; each "
    f"switch changes within {SWITCH_MM:g} mm of its carriage's 0, and Status shows it at once",
    moves=True,
)
def open_switch_stops(host: Host) -> str:
    host.running()
    seen = []
    for inside, duty in (((False, False), AT_STOP_DUTY), *product(((True, False), (False, True)), PHASES)):
        host.bring(*np.where(inside, -BESIDE_MM, places(host.last(State))), mm_s=SLOW_MM_S)
        host.pass_time(SEEN_S, DriveMode.RUN)
        first, is_shown = len(host.rows), [each not in host.status.switches for each in ENDS[:2]] == list(inside)
        host.pass_time(0.3, DriveMode.RUN, SLOW_S if any(inside) else PERIOD_S, duty)
        rows = columns(host, first)
        behind_A = [rows[f"{name}_A"][rows[f"{name}_mm"] > SWITCH_MM].max(initial=0.0) for name in ("left", "right")]
        moved_mm = np.array([rows[name][-1] - rows[name][0] for name in ("left_mm", "right_mm")])
        most_A = np.array([np.abs(rows[name]).max() for name in ("left_A", "right_A")])
        seen.append(f"by {moved_mm[0]:+.2f} and {moved_mm[1]:+.2f} mm, {most_A[0]:.2f} and {most_A[1]:.2f} A at most")
        host.shows(
            DeviceMode.RUN,
            DriveMode.RUN,
            besides=seen[-1],
            wrong=not is_shown
            or np.where(
                inside,
                (moved_mm < MOVED_MM) | (np.array(behind_A) > AT_STOP_A),
                (most_A > AT_STOP_A) | (np.abs(moved_mm) > AT_STOP_MM),
            ).any(),
        )
    for duty in 3 * (-1.0, 1.0):
        host.pass_time(REVERSED_S, DriveMode.RUN, duty=duty)
    host.shows(DeviceMode.RUN, DriveMode.RUN, besides="at a duty of 1")
    return "; ".join(seen)


def _pulse(host: Host, period_s: float = PERIOD_S) -> None:
    """Brake; then send drawn duties, alike or not, towards the middle, and beside them what RUN keeps."""
    host.pass_time(SETTLED_S, DriveMode.RUN, period_s)
    draw, beside = host.random, host.random.choice(list(host.random.choice((taken(host, RUNNING), refused(host)))))
    most = min(PULSE_S / (3.0 * period_s), 1.0)
    size = draw.choice((1.0, draw.random(), ALIKE * draw.random()))
    sizes = size, draw.choice((draw.random(), clamped(size + draw.uniform(-ALIKE, ALIKE), 1.0)))
    left, right = (
        math.copysign(most * each, -way_mm)
        for each, way_mm in zip(sizes, ways_mm(host.last(State), (-MIDDLE_MM, -MIDDLE_MM)), strict=True)
    )
    host.drive(DriveMode.RUN)  # of two within a millisecond the newer acts
    host.beat(DriveMode.RUN, left, right, period_s, beside.send)
    for _ in range(round(PULSE_S / most / period_s) - 1):
        host.beat(DriveMode.RUN, left, right, period_s)
    unless(
        host.status.mode is not DeviceMode.RUN,
        f"{beside.name} in RUN with a Drive every {period_s * 1e3:g} ms: {shown(host.status)}",
    )


def _driven(rows: dict[str, Array], side: str) -> Array:
    """Return of stretches of equal duties: duty, speed, the current's rise and mean, density of States."""
    is_free = (rows["mode"] == DeviceMode.RUN) & (np.maximum(rows["left_mm"], rows["right_mm"]) < -FREE_MM)
    keys = np.column_stack([rows["left_duty"], rows["right_duty"], is_free])
    edges = np.flatnonzero(np.any(np.diff(keys, axis=0) != 0.0, axis=1)) + 1
    stretches = np.column_stack([edges[:-1], edges[1:]])[is_free[edges[:-1]] & (np.diff(edges) > 1)]
    found = []
    for first, last in stretches:
        part = slice(np.searchsorted(rows["device_s"], rows["device_s"][first] + SMOOTHED_S), last)
        at_s, at_mm, at_A = (rows[name][part] for name in ("device_s", f"{side}_mm", f"{side}_A"))
        seconds = at_s[-1] - at_s[0] if len(at_s) else 0.0
        if seconds > PART_S:
            # means over time
            mean_A = np.sum((at_A[1:] + at_A[:-1]) * np.diff(at_s)) / 2.0 / seconds
            mm_s, rise_A_s = ((at[-1] - at[0]) / seconds for at in (at_mm, at_A))
            states = min(PERIOD_S * (len(at_s) - 1) / seconds, 1.0)
            found.append((rows[f"{side}_duty"][first], mm_s, rise_A_s, mean_A, states))
    return np.array(found).reshape(-1, 5).T


@check(
    Hazard.MISLED,
    DRIVE,
    f"{PULSES} times in RUN, {MIDDLE_MM:g} mm in, {PULSE_S * 1e3:g} ms of drawn duties; and those before",
    f"each current that of its duty and speed, to {MAX_OFF:g} of duty",
    moves=True,
)
def duties_make_currents(host: Host) -> str:
    """I R = d U - v K - L dI/dt: finds clipped, coarse, dead, swapped duties and unsigned currents."""
    host.running(MIDDLE_MM)
    for _ in range(PULSES):
        _pulse(host, host.random.choice((PERIOD_S, SPARSE_S)))
    host.pass_time(SEEN_S, DriveMode.RUN)
    rows, seen = all_columns(host), []
    for name in ("left", "right"):
        *made_by, current_A, dense = _driven(rows, name)
        shares, *_ = np.linalg.lstsq((dense * made_by).T, dense * current_A, rcond=None)
        per_duty, lag_s = shares[0], -shares[2]
        off = np.sqrt(dense) * np.abs(current_A - shares @ made_by) / max(abs(per_duty), 1e-3)
        text = f"{off.max():.3f} off at {made_by[0][off.argmax()]:+.2f}, {lag_s * 1e3:.2f} ms late"
        is_off = not STALL_A[0] < per_duty < STALL_A[1] or off.max() > MAX_OFF or lag_s > MAX_LAG_S
        seen.append(unless(is_off, f"{name} {per_duty:.2f} A a duty, {text}"))
    return "; ".join(seen)


def _ends_run(fault: DeviceFault, from_share: float, most_mm: float, host: Host) -> str:
    """Bring the carriages in, and one of them on until it is too far; then the other."""
    is_skew, begins_mm = fault is DeviceFault.SKEW, -from_share * host.stroke_mm
    seen = []
    for side in (0, 1):
        host.running(-begins_mm)
        host.heard.clear()
        host.bring(
            begins_mm + (ASIDE_MM if side else -AHEAD_MM),
            begins_mm + (-AHEAD_MM if side else ASIDE_MM),
            mm_s=SLOW_MM_S,
            ends=lambda: (
                bool(np.ptp(places(host.last(State))) > SKEW_MM + BOUND_MM) or host.status.mode is not DeviceMode.RUN
            ),
        )
        innermost_mm = min(places(state)[side] for _, state in host.all_of(State))
        off_mm = np.ptp(places(host.last(State))) - SKEW_MM if is_skew else innermost_mm + host.stroke_mm
        seen.append(f"{off_mm:+.2f} mm from where it ends: {shown(host.next_status(DriveMode.RUN))}")
        unless(host.status.faults != fault or abs(off_mm) > most_mm, "; ".join(seen))
        seen.append(opens_fully(host, fault, len(host.rows)))
    return "; ".join(seen)


@check(
    Hazard.CLOSES,
    "Modes",
    f"4 times silence in RUN, Drive RUN, Clear, Home, Drive RUN of {DUTY:g}; one Drive OFF, each time in another mode",
    "RUN, in whatever mode the Drive OFF came, and the first Drive's duties act; IDLE and still before it",
    moves=True,
)
def let_go_after_all(host: Host) -> str:
    seen = []
    for lets_go in (DeviceMode.RETRACTING, DeviceMode.LATCHED, DeviceMode.HOMING, DeviceMode.IDLE):
        host.timed_out()
        for mode, commands in (
            (DeviceMode.RETRACTING, ()),
            (DeviceMode.LATCHED, (Clear, Home)),
            (DeviceMode.HOMING, ()),
            (DeviceMode.IDLE, ()),
        ):
            if mode is DeviceMode.IDLE is lets_go:
                keeps_still(host, "before a Drive OFF")
            if mode is lets_go:
                host.beat(DriveMode.OFF)
            for command in commands:
                host.obeyed(command, DriveMode.RUN)
            host.until(lambda: host.status.mode in RESTING, OPENED_S, DriveMode.RUN)
        host.pass_time(2 * SPARSE_S, DriveMode.RUN, SPARSE_S, DUTY)
        most_A = max(host.last(Sense).left_current_A, host.last(Sense).right_current_A)
        seen.append(
            host.shows(
                DeviceMode.RUN,
                DriveMode.RUN,
                besides=f"{lets_go.name} {most_A:+.2f} A at once",
                wrong=most_A > -RESTING_A,
            )
        )
    return "; ".join(seen)


def keeps_still(host: Host, when: str) -> str:
    """Send Drive RUN to an idle device that must not run yet."""
    host.beat(DriveMode.RUN)
    host.pass_time(ANSWER_S)
    start = places(host.last(State))
    host.pass_time(SEEN_S, DriveMode.RUN, duty=DUTY)
    way_mm = max(map(abs, ways_mm(host.last(State), start)))
    return host.shows(
        DeviceMode.IDLE, DriveMode.RUN, besides=f"{when} moved by {way_mm:.2f} mm", wrong=way_mm > AT_STOP_MM
    )


def _is_noticed(host: Host, silent_s: float) -> bool:
    """Send no Drive in RUN for a time; return whether RUN has ended, which that time must tell."""
    host.next_status(DriveMode.RUN)
    host.pass_time(host.random.randrange(20) * PERIOD_S, DriveMode.RUN)
    before = host.answered(DriveMode.RUN)
    host.until(lambda: host.now_s >= host.drive_s + silent_s - 0.5 * PERIOD_S, silent_s, None)
    silence_s = (host.answered(DriveMode.RUN).device_time_s - before.device_time_s) % TIME_SPAN_S
    status = host.next_status(DriveMode.RUN)
    has_ended = status.mode is not DeviceMode.RUN
    unless(
        (silence_s < BORNE_S or status.faults != TIMED_OUT)
        if has_ended
        else (silence_s > NOTICED_S or status.faults != NO_FAULT),
        f"after {silence_s * 1e3:.2f} ms on the device's clock: {shown(status)}",
    )
    return has_ended


def _notices(host: Host, silent_s: float) -> str:
    """Repeat a silence until it ends RUN: the device may have stood still in it."""
    unless(not any(_is_noticed(host, silent_s) for _ in range(LONGS)), f"never ends: {shown(host.status)}")
    host.until(host.is_resting, OPENED_S)
    return host.shows(DeviceMode.LATCHED, homed=False, opened=True, fault=TIMED_OUT)


@check(
    Hazard.SHUT,
    SILENCE,
    f"in RUN, at random times, {SHORT_S * 1e3:g} ms without a Drive {SHORTS} times; {LONG_S * 1e3:g} ms, "
    f"then Drive RUN, {LONGS} times, first at the open end, then {INSIDE_MM:g} mm in; one Drive RUN alone",
    "the short ones are borne; after the long ones no RUN, COMMAND_TIMEOUT alone; opens, LATCHED",
    moves=True,
)
def silence_is_noticed(host: Host) -> str:
    host.running()
    unless(any(_is_noticed(host, SHORT_S) for _ in range(SHORTS)), f"ends early: {shown(host.status)}")
    for at in range(LONGS):
        host.running(INSIDE_MM if at else 0.0)
        _notices(host, LONG_S)
    host.homed()
    host.beat(DriveMode.RUN, period_s=4.0 * LONG_S)
    return host.shows(DeviceMode.LATCHED, None, fault=TIMED_OUT, besides=f"{LONGS} noticed; after one Drive RUN")


@check(
    Hazard.SHUT,
    SILENCE,
    f"{HOLDS} times in RUN drawn duties every 1 or {SPARSE_S * 1e3:g} ms, {HOLDS * HELD_S:g} s in all, then no Drive",
    "stays RUN; then COMMAND_TIMEOUT alone, whenever",
    moves=True,
)
def any_uptime(host: Host) -> str:
    """Finds a timeout's counter that overflows at 2^16 ms or changes its sign."""
    began_s, seen = host.now_s, ""
    for at in range(1, HOLDS + 1):
        host.running(MIDDLE_MM)
        while host.now_s < began_s + at * HELD_S:
            _pulse(host, host.random.choice((PERIOD_S, SPARSE_S)))
        host.pass_time(SEEN_S, DriveMode.RUN)
        seen = _notices(host, LONG_S + PERIOD_S)
    return f"{HOLDS} times: {seen}"


ENDS_RUN: Final = [
    Check(
        f"{name}_opens",
        Hazard.WORN,
        "Faults",
        sent,
        f"{fault.name} alone {where}; opens and latches",
        partial(_ends_run, fault, from_share, most_mm),
        moves=True,
        is_gate=False,
    )
    for name, fault, from_share, most_mm, sent, where in (
        (
            "skew",
            DeviceFault.SKEW,
            MIDDLE,
            BOUND_MM,
            f"in RUN, one carriage on at {SLOW_MM_S:g} mm/s; then the other one",
            f"from {SKEW_MM:g} mm on, {BOUND_MM:g} more or less",
        ),
        (
            "end_stop",
            DeviceFault.END_STOP,
            NEAR,
            SCALE_MM,
            f"in RUN to {NEAR:g} of the stroke, then one carriage on at {SLOW_MM_S:g} mm/s to its closed switch; the "
            "other one",
            f"{SCALE_MM:g} mm from the stroke's length at most",
        ),
    )
]
CHECKS: Final = (
    open_switch_stops,
    *ENDS_RUN,
    let_go_after_all,
    silence_is_noticed,
    any_uptime,
    duties_make_currents,
)
GATES: Final = (
    home_homes,
    *(
        Check(
            f"{name}_duty",
            Hazard.CLOSES,
            DRIVE,
            f"in RUN, a {name} duty that falls from 0 to -{MAX_DUTY:g} at most, {other} 0",
            f"the {name} carriage goes in by {MOVED_MM:g} mm, the {other} one stays",
            partial(_duty_moves, side),
            moves=True,
            is_gate=True,
        )
        for side, name, other in ((0, "left", "right"), (1, "right", "left"))
    ),
)
