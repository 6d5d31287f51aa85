"""Checks of State, Sense and Status: how often, in which order, how soon, by which clock. Nothing moves."""

from itertools import accumulate, pairwise
from typing import Final

from firmware_protocol.codec import DriveMode, Sense, State, Status, period
from firmware_protocol.conformance.check import Hazard, check
from firmware_protocol.conformance.host import (
    ANSWER_S,
    PERIOD_S,
    STATUS_S,
    TIME_SPAN_S,
    Beat,
    Host,
    Unmet,
    Untested,
    shown,
    unless,
    usual,
)

DRIVE, ANSWERS, STATUS = (f"Who says what when, {number}" for number in (2, 3, 4))
LISTENED_S = 1.0
CLOCKED_S = 3.0
DRIVES = 1000
PAIRS = 20
TIMES = 100
FINE_S = 1.13e-3
WINDOW = 300
"""States of one comparison of the clocks; the median of all counts, because a step is no rate."""
ENDS = 50
"""States at either end of a window; the least delayed of them counts."""
STATUS_TOLERANCE = 0.03
MAX_DRIFT = 0.01
MAX_ANSWER_S = 3e-3
"""The device's own millisecond, and the way there and back by any adapter."""
HANDLE_MM = 1.0
"""A handle at 0.3 m/s moves a third of this in 1 ms; one of swapped bytes leaps by 2 mm a step."""
HANDLE_SPAN_MM = period(Sense, "handle_position_mm")


@check(
    Hazard.MISLED,
    STATUS,
    f"nothing for {LISTENED_S:g} s",
    "50 Status a second, 3 % more or less, on the device's own clock",
)
def status_without_host(host: Host) -> str:
    return _status_rate(host, Beat.NOTHING)


@check(Hazard.MISLED, STATUS, f"Drive OFF every 1 ms for {LISTENED_S:g} s", "50 Status a second, 3 % more or less")
def status_with_host(host: Host) -> str:
    return _status_rate(host, Beat.OFF)


def _status_rate(host: Host, beat: Beat) -> str:
    start_s = host.now_s
    host.pass_time(LISTENED_S, beat)
    times = [time_s for time_s, _ in host.all_of(Status)]
    unless(len(times) < 2, f"{len(times)} Status in {LISTENED_S:g} s")
    period_s = (times[-1] - times[0]) / (len(times) - 1)
    widest_s = max(after - before for before, after in pairwise([start_s, *times, host.now_s]))
    seen = f"one every {period_s * 1e3:.1f} ms, {widest_s * 1e3:.0f} ms apart at most"
    # a lost Status or a late turn of this process makes one gap of two; a sender that lags makes more
    return unless(abs(period_s / STATUS_S - 1.0) > STATUS_TOLERANCE or widest_s > 2.5 * STATUS_S, seen)


@check(Hazard.MISLED, ANSWERS, f"{DRIVES} Drive OFF, one every 1 ms", "for each one State, then one Sense")
def every_drive_answered(host: Host) -> str:
    """The control loop needs positions at its own rate."""
    host.pass_time(DRIVES * PERIOD_S, Beat.OFF)
    host.pass_time(ANSWER_S)
    kinds = [type(one.message) for one in host.heard if isinstance(one.message, State | Sense)]
    states, senses = kinds.count(State), kinds.count(Sense)
    seen = f"{states} State, {senses} Sense for {DRIVES} Drives"
    if refused := {what: count for what, count in host.refused.items() if what.startswith("S")}:
        seen += f"; refused since the start: {refused}"
    unless((states, senses) != (DRIVES, DRIVES), seen)
    # on a bus the State of a later Drive may overtake a Sense, as its identifier is lower
    behind = list(accumulate(1 if kind is State else -1 for kind in kinds))
    early = sum(count < 0 for count in behind)
    return unless(early, f"{seen}, {early} times a Sense before its State")


@check(Hazard.MISLED, ANSWERS, f"{PAIRS} times two Drive OFF at once", "two State for each pair")
def drives_at_once(host: Host) -> str:
    """A late host sends two Drives at once."""
    host.pass_time(ANSWER_S)
    host.forget()
    for _ in range(PAIRS):
        host.drive(DriveMode.OFF)
        host.drive(DriveMode.OFF)
        host.pass_time(5 * PERIOD_S)
    host.pass_time(ANSWER_S)
    count = len(host.all_of(State))
    return unless(count != 2 * PAIRS, f"{count} State for {2 * PAIRS} Drives")


@check(Hazard.MISLED, DRIVE, "Drive OFF, its counter changed by 128, 64, .. 1, 255, 254", "a State for each")
def every_counter(host: Host) -> str:
    host.beat(Beat.OFF)
    host.pass_time(ANSWER_S)
    for change in (128, 64, 32, 16, 8, 4, 2, 1, 255, 254):
        host.forget()
        host.counter = (host.counter + change - 1) % 256
        host.beat(Beat.OFF)
        host.pass_time(ANSWER_S)
        if len(host.all_of(State)) != 1:
            raise Unmet(f"{len(host.all_of(State))} State for a counter changed by {change}, to {host.counter}")
    return "10 changes accepted"


@check(Hazard.MISLED, ANSWERS, "no Drive for 0.2 s", "no State and no Sense")
def no_answer_without_drive(host: Host) -> str:
    host.pass_time(ANSWER_S)
    host.forget()
    host.pass_time(0.2)
    states, senses = len(host.all_of(State)), len(host.all_of(Sense))
    return unless(states or senses, f"{states} State, {senses} Sense")


@check(
    Hazard.CLOSES,
    ANSWERS,
    "Drive OFF every 1 ms",
    f"State within {MAX_ANSWER_S * 1e3:g} ms as a rule, at once on the device",
)
def answer_time(host: Host) -> str:
    """The position loop needs State in time, including the adapter's delay."""
    delays_s = []
    for _ in range(200):
        host.beat(Beat.OFF)
        if not host.until(lambda: bool(host.all_of(State)), ANSWER_S, Beat.NOTHING):
            continue
        delays_s.append(host.all_of(State)[0][0] - host.drive_s)
        host.forget()
    if not delays_s:
        raise Unmet("no State ever came")
    seen = f"{usual(delays_s) * 1e3:.2f} ms as a rule, {max(delays_s) * 1e3:.1f} ms at most"
    return unless(usual(delays_s) > MAX_ANSWER_S, seen)


@check(Hazard.MISLED, "State", "Drive OFF every 1 ms for 0.6 s", "State's counter is one more each time, modulo 256")
def state_counter(host: Host) -> str:
    """By the counter the host finds lost and repeated States."""
    host.pass_time(0.6, Beat.OFF)
    counters = [state.counter for _, state in host.all_of(State)]
    unless(len(counters) < 2, f"{len(counters)} State")
    steps = [(after - before) % 256 for before, after in pairwise(counters)]
    wrong = [step for step in steps if step != 1]
    seen = f"{len(wrong)} of {len(steps)} steps are not 1: {sorted(set(wrong))[:5]}, first {counters[:5]}"
    return unless(wrong, seen)


@check(
    Hazard.MISLED,
    "State",
    f"Drive OFF every 1 ms for {CLOCKED_S:g} s",
    "device_time_s runs by 1 s in a second, 1 % more or less",
)
def device_clock(host: Host) -> str:
    """Speeds are computed from this clock."""
    host.pass_time(CLOCKED_S, Beat.OFF)
    states = host.all_of(State)
    device_s, clocks = 0.0, []
    for (_, before), (time_s, state) in pairwise(states):
        device_s += (state.device_time_s - before.device_time_s) % TIME_SPAN_S
        clocks.append((time_s - device_s, time_s))
    drifts = []
    for at in range(0, len(clocks) - WINDOW + 1, WINDOW):
        (first, first_s), (last, last_s) = min(clocks[at : at + ENDS]), min(clocks[at + WINDOW - ENDS : at + WINDOW])
        drifts.append((first - last) / (last_s - first_s))
    if not drifts:
        raise Unmet(f"{len(states)} State in {CLOCKED_S:g} s")
    drift = usual(drifts)
    return unless(abs(drift) > MAX_DRIFT, f"{1.0 + drift:.4f} s in a second, {drift:+.2%}")


@check(Hazard.MISLED, "State", f"{TIMES} Drive OFF, one every 1.13 ms", "device_time_s in steps of 10 us")
def device_time_is_fine(host: Host) -> str:
    """With times rounded to the tick a speed would be wrong by up to a half."""
    host.pass_time(TIMES * FINE_S, Beat.OFF, FINE_S)
    host.pass_time(ANSWER_S)
    steps = {round(state.device_time_s * 1e5) % 100 for _, state in host.all_of(State)}
    return unless(len(steps) < 20, f"{len(steps)} different times of 100 within a millisecond")


@check(
    Hazard.MISLED,
    "Sense",
    "Drive OFF every 1 ms for 1 s, somebody turning the handle",
    "no leap over 1 mm, a force against the motion",
)
def handle_runs_on(host: Host) -> str:
    """Finds leaps, as of swapped bytes, and a force that is not against the motion."""
    host.pass_time(LISTENED_S, Beat.OFF)
    places = [sense.handle_position_mm for _, sense in host.all_of(Sense)]
    half = HANDLE_SPAN_MM / 2.0
    steps = [(after - before + half) % HANDLE_SPAN_MM - half for before, after in pairwise(places)]
    most_mm, way_mm = max(map(abs, steps), default=0.0), sum(steps)
    force_N = usual([sense.force_N for _, sense in host.all_of(Sense)])
    seen = f"turned by {way_mm:+.2f} mm, {most_mm:.3f} mm a step at most, {force_N:+.2f} N"
    unless(most_mm > HANDLE_MM or (abs(way_mm) > HANDLE_MM and force_N * way_mm < 0.0), seen)
    if abs(way_mm) < HANDLE_MM:
        raise Untested(f"{seen}; turn the handle by hand meanwhile, --only handle_runs_on")
    return seen


@check(
    Hazard.MISLED, STATUS, "Drive OFF, its counter going up, then none", "Status shows the counter of the last Drive"
)
def drive_counter_shown(host: Host) -> str:
    """By this counter the host sees what arrived."""
    seen = ""
    for _ in range(3):
        host.pass_time(7 * PERIOD_S, Beat.OFF)
        host.pass_time(ANSWER_S)
        counter = host.next_status(Beat.NOTHING).drive_counter
        seen = unless(counter != host.counter, f"drive_counter {counter} after a Drive with {host.counter}")
    return seen


@check(Hazard.SHUT, DRIVE, "a Drive OFF, then five more with the same counter, of other duties too", "one State")
def repeated_drive(host: Host) -> str:
    host.pass_time(2 * PERIOD_S, Beat.OFF)
    host.pass_time(ANSWER_S)
    host.forget()
    host.beat(Beat.OFF)
    for more in range(5):
        host.counter = (host.counter - 1) % 256
        host.drive(DriveMode.OFF, 0.1 * more)
        host.pass_time(3 * PERIOD_S)
    host.pass_time(ANSWER_S)
    count = len(host.all_of(State))
    return unless(count != 1, f"{count} State")


@check(
    Hazard.MISLED,
    "Status",
    "Drive OFF",
    "a supply of 9 to 15 V, an element of -20 to 60 degC, no SUPPLY or TEMPERATURE",
)
def status_plausible(host: Host) -> str:
    """Finds a wrong unit or a loose wire."""
    status = host.next_status(Beat.OFF)
    seen = f"{status.supply_V:.1f} V, {status.temperature_C:.0f} degC, {shown(status)}"
    causes = [fault.name for fault in status.faults if fault.name in ("SUPPLY", "TEMPERATURE")]
    return unless(not (9.0 <= status.supply_V <= 15.0 and -20.0 <= status.temperature_C <= 60.0) or causes, seen)


@check(Hazard.MISLED, "Sense", "Drive OFF, nothing moving", "currents under 0.2 A, a force under 5 N")
def sense_plausible(host: Host) -> str:
    host.idle()
    host.pass_time(0.1, Beat.OFF)
    sense = host.last(Sense)
    currents, force_N = (sense.left_current_A, sense.right_current_A), sense.force_N
    seen = f"{currents[0]:+.3f} A, {currents[1]:+.3f} A, {force_N:+.3f} N"
    return unless(max(map(abs, currents)) > 0.2 or abs(force_N) > 5.0, seen)


CHECKS: Final = (
    status_without_host,
    status_with_host,
    every_drive_answered,
    drives_at_once,
    every_counter,
    no_answer_without_drive,
    answer_time,
    state_counter,
    device_clock,
    device_time_is_fine,
    handle_runs_on,
    drive_counter_shown,
    repeated_drive,
    status_plausible,
    sense_plausible,
)
