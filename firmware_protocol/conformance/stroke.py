"""Checks along the whole stroke: where the switches are, what a duty does, what stops carriages that go too far."""

from functools import partial
from itertools import pairwise
from typing import Final

from firmware_protocol.codec import DeviceFault, DeviceMode, Sense, State, Status, Switches
from firmware_protocol.conformance.check import Hazard, check
from firmware_protocol.conformance.host import (
    SEEN_S,
    STATUS_S,
    Beat,
    Host,
    Unmet,
    places,
    shown,
    unless,
)
from firmware_protocol.conformance.opening import opens_fully

PAGE: Final = "Homing"
STOPS: Final = "Faults"
SLOW_MM_S: Final = 2.0
BESIDE_MM: Final = 1.5
ZERO_MM: Final = 0.3
SCALE: Final = 0.02
SKEW_MM: Final = 2.0
BOUND_MM: Final = 0.3
"Two Status at SLOW_MM_S, and the sway of a carriage."
AHEAD_MM: Final = 0.7
NEAR: Final = 0.85
"""Share of the stroke that is travelled at a brisk speed."""
PAST: Final = 1.15
"""Share of the stroke: no scale is off by this much, so a device that gets here does not watch."""
DUTIES: Final = (0.4, 0.6, 0.8, 1.0)
MIDDLE_MM: Final = 10.0
PULSE_S: Final = 0.3
SETTLED_S: Final = 0.15
MIN_GAIN: Final = 0.6
STARTED_S: Final = 0.02
STARTED_MM: Final = 0.05
STARTING_A: Final = (0.5, 10.0)
"""What a motor draws that starts at the whole duty; outside, the unit is wrong."""


@check(
    Hazard.MISLED,
    PAGE,
    f"in RUN one carriage alone {BESIDE_MM:g} mm in and out again at {SLOW_MM_S:g} mm/s, then the other",
    f"its open switch changes within {ZERO_MM:g} mm of 0, the other one's does not",
    moves=True,
)
def zero_is_at_switch(host: Host) -> str:
    """Each encoder's zero is where its own open switch closes."""
    host.running()
    seen = []
    for side, name in enumerate(("LEFT", "RIGHT")):
        rests_mm = places(host.last(State))
        goals = [-BESIDE_MM if at == side else rests_mm[at] for at in (0, 1)]
        host.forget()
        host.bring(goals[0], goals[1], SLOW_MM_S)
        host.pass_time(SEEN_S, Beat.RUN)
        goals[side] = BESIDE_MM
        own = Switches[f"{name}_OPEN"]
        host.bring(goals[0], goals[1], SLOW_MM_S, partial(_has_closed, host, own))
        host.pass_time(SEEN_S, Beat.RUN)
        edges_mm = _edges_mm(host, side, own)
        other = Switches.LEFT_OPEN if side else Switches.RIGHT_OPEN
        kept = all(other in status.switches for _, status in host.all_of(Status))
        seen.append(f"{name} changes at {', '.join(f'{mm:+.2f} mm' for mm in edges_mm) or 'no place'}")
        if len(edges_mm) != 2 or max(map(abs, edges_mm)) > ZERO_MM or not kept:
            raise Unmet("; ".join(seen) + ("" if kept else ", and so does the other"))
    return "; ".join(seen)


def _has_closed(host: Host, switch: Switches) -> bool:
    return switch in host.status.switches


def _edges_mm(host: Host, side: int, switch: Switches) -> list[float]:
    """Return where the carriage was each time its switch changed, mm."""
    edges_mm, at_mm, was = [], 0.0, True
    for one in host.heard:
        if isinstance(one.message, State):
            at_mm = places(one.message)[side]
        elif isinstance(one.message, Status) and was is not (switch in one.message.switches):
            was = not was
            edges_mm.append(at_mm)
    return edges_mm


@check(
    Hazard.MISLED,
    "Drive",
    f"in RUN, {MIDDLE_MM:g} mm in, duties of -{DUTIES[0]:g}, +{DUTIES[0]:g} .. -1, +1 for {PULSE_S:g} s each",
    f"each step of {DUTIES[1] - DUTIES[0]:.1f} adds {MIN_GAIN:g} of its share of the speed; Status goes on",
    moves=True,
)
def duty_makes_speed(host: Host) -> str:
    """Speed rises with the duty up to the whole, both ways, and nothing gives way."""
    host.running(MIDDLE_MM)
    seen = []
    for sign in (-1.0, 1.0):
        speeds = []
        for duty in DUTIES:
            host.bring(-MIDDLE_MM, -MIDDLE_MM)
            host.pass_time(SEEN_S, Beat.RUN)
            speeds.append(_speed_mm_s(host, sign * duty))
        gains = [after - before for before, after in pairwise(speeds)]
        seen.append(f"{'out' if sign > 0.0 else 'in'} " + ", ".join(f"{speed:.1f}" for speed in speeds) + " mm/s")
        if host.status.mode is not DeviceMode.RUN or min(gains) < MIN_GAIN * speeds[-1] * (DUTIES[1] - DUTIES[0]):
            raise Unmet(f"{'; '.join(seen)}; {shown(host.status)}")
    return "; ".join(seen)


@check(
    Hazard.MISLED,
    "Sense",
    f"in RUN, {MIDDLE_MM:g} mm in, from rest a duty of +1, and again {STARTED_S * 1e3:g} ms later",
    f"{STARTING_A[0]:g} to {STARTING_A[1]:g} A, positive, in the second Sense, and {STARTED_MM:g} mm of way in State",
    moves=True,
)
def answers_are_of_now(host: Host) -> str:
    host.running(MIDDLE_MM)
    start_mm = places(host.last(State))
    # the second Drive measures what the first began; an answer that lags shows a motor at rest
    host.pass_time(2 * STARTED_S, Beat.RUN, STARTED_S, duty=1.0)
    sense = host.last(Sense)
    currents_A = sense.left_current_A, sense.right_current_A
    way_mm = min(after - before for before, after in zip(start_mm, places(host.last(State)), strict=True))
    seen = f"{', '.join(f'{current_A:+.2f} A' for current_A in currents_A)}, {way_mm:+.2f} mm"
    is_right = all(STARTING_A[0] < current_A < STARTING_A[1] for current_A in currents_A)
    return unless(not is_right or way_mm < STARTED_MM, seen)


def _speed_mm_s(host: Host, duty: float) -> float:
    """Give both motors a duty for PULSE_S and return the slower carriage's settled speed."""
    host.pass_time(SETTLED_S, Beat.RUN, duty=duty)
    start = places(host.last(State))
    host.pass_time(PULSE_S - SETTLED_S, Beat.RUN, duty=duty)
    end = places(host.last(State))
    unless(host.now_s - host.newest[Status].time_s > 2.5 * STATUS_S, f"no Status at a duty of {duty:g}")
    ways_mm = [(after - before) * (1.0 if duty > 0.0 else -1.0) for before, after in zip(start, end, strict=True)]
    return min(ways_mm) / (PULSE_S - SETTLED_S)


@check(
    Hazard.WORN,
    STOPS,
    f"in RUN, {MIDDLE_MM:g} mm in, one carriage on at {SLOW_MM_S:g} mm/s; then the other one",
    f"SKEW alone from {SKEW_MM:g} mm on, {BOUND_MM:g} more or less; opens and latches",
    moves=True,
)
def skew_opens(host: Host) -> str:
    seen = []
    for side in (0, 1):
        host.running(MIDDLE_MM)
        goals = [-MIDDLE_MM - (2.0 * SKEW_MM if at == side else 0.0) for at in (0, 1)]
        host.bring(goals[0], goals[1], SLOW_MM_S, lambda: _skew_mm(host) > SKEW_MM + BOUND_MM or _has_left(host))
        apart_mm = _skew_mm(host)
        seen.append(f"{apart_mm:.2f} mm apart: {shown(host.next_status(Beat.RUN))}")
        unless(host.status.faults != DeviceFault.SKEW or apart_mm < SKEW_MM - BOUND_MM, "; ".join(seen))
        seen.append(opens_fully(host, DeviceFault.SKEW))
    return "; ".join(seen)


def _skew_mm(host: Host) -> float:
    left_mm, right_mm = places(host.last(State))
    return abs(left_mm - right_mm)


def _has_left(host: Host) -> bool:
    return host.status.mode is not DeviceMode.RUN


@check(
    Hazard.WORN,
    STOPS,
    f"in RUN at {SLOW_MM_S:g} mm/s to the closed switches, the left carriage {AHEAD_MM:g} mm ahead; then the right one",
    f"END_STOP alone, at the stroke's length to {SCALE:.0%}; opens and latches",
    moves=True,
)
def end_stop_opens(host: Host) -> str:
    """Each closed switch ends RUN, at the stated distance from the open one."""
    seen = []
    for ahead in ((AHEAD_MM, 0.0), (0.0, AHEAD_MM)):
        host.running(NEAR * host.stroke_mm)
        goals = [-PAST * host.stroke_mm - mm for mm in ahead]
        host.forget()
        host.bring(goals[0], goals[1], SLOW_MM_S, lambda: _has_left(host))
        innermost_mm = min(min(places(state)) for _, state in host.all_of(State))
        off = innermost_mm / -host.stroke_mm - 1.0
        seen.append(f"{innermost_mm:.2f} mm, {off:+.1%}: {shown(host.next_status(Beat.RUN))}")
        unless(host.status.faults != DeviceFault.END_STOP or abs(off) > SCALE, "; ".join(seen))
        seen.append(opens_fully(host, DeviceFault.END_STOP))
    return "; ".join(seen)


CHECKS: Final = (zero_is_at_switch, duty_makes_speed, answers_are_of_now, skew_opens, end_stop_opens)
