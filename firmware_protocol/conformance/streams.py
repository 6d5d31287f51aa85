"""Checks of State, Sense and Status: how often, in which order, how soon, by which clock. Nothing moves."""

from itertools import pairwise
from typing import Final

from firmware_protocol.codec import DriveMode, Sense, State, Status, period
from firmware_protocol.conformance.check import check
from firmware_protocol.conformance.host import (
    ANSWER_S,
    PERIOD_S,
    STATUS_S,
    Beat,
    Host,
    Unmet,
    shown,
    unless,
    usual,
)

DRIVE, ANSWERS, STATUS = (f"Who says what when, {number}" for number in (2, 3, 4))
LISTENED_S = 1.0
CLOCKED_S = 3.0
PAIRS = 200
WINDOW = 300
"""States of one comparison of the clocks; the median of all comparisons counts, because a step is no rate."""
ENDS = 50
"""States at either end of a window; the least delayed of them counts."""
MOST_LOST = 0.01
STATUS_TOLERANCE = 0.03
MOST_DRIFT = 0.01
MOST_ANSWER_S = 5e-3
"""Above this the daemon reports LINK_DEGRADED."""
TIME_SPAN_S = period(State, "device_time_s")


@check(STATUS, f"nothing for {LISTENED_S:g} s", "50 Status a second, 3 % more or less, on the device's own clock")
def status_without_host(host: Host) -> str:
    """Check that Status comes at its rate without a host."""
    return _status_rate(host, Beat.NOTHING)


@check(STATUS, f"Drive OFF every 1 ms for {LISTENED_S:g} s", "50 Status a second, 3 % more or less")
def status_with_host(host: Host) -> str:
    """Check that Status comes at its rate while Drives come."""
    return _status_rate(host, Beat.OFF)


def _status_rate(host: Host, beat: Beat) -> str:
    """Listen for LISTENED_S. Raises Unmet for a wrong rate of Status, or a gap of over two and a half periods."""
    start_s = host.now_s
    host.pass_time(LISTENED_S, beat)
    times = [time_s for time_s, _ in host.all_of(Status)]
    if len(times) < 2:
        raise Unmet(f"{len(times)} Status in {LISTENED_S:g} s")
    period_s = (times[-1] - times[0]) / (len(times) - 1)
    widest_s = max(after - before for before, after in pairwise([start_s, *times, host.now_s]))
    seen = f"one every {period_s * 1e3:.1f} ms, {widest_s * 1e3:.0f} ms apart at most"
    # a lost Status, or a late turn of this process, makes one gap of two; a sender that lags makes more
    return unless(abs(period_s / STATUS_S - 1.0) > STATUS_TOLERANCE or widest_s > 2.5 * STATUS_S, seen)


@check(ANSWERS, f"{LISTENED_S * 1e3:.0f} Drive OFF, one every 1 ms", "a State for each, 99 % at least")
def state_answers_drive(host: Host) -> str:
    """Check that each Drive is answered by a State: the control loop needs positions at its own rate."""
    return _answered(host, State)


@check(ANSWERS, f"{LISTENED_S * 1e3:.0f} Drive OFF, one every 1 ms", "a Sense for each, 99 % at least")
def sense_answers_drive(host: Host) -> str:
    """Check that each Drive is answered by a Sense: force, handle and currents."""
    return _answered(host, Sense)


def _answered(host: Host, kind: type[State] | type[Sense]) -> str:
    """Send Drive OFF for LISTENED_S. Raises Unmet unless as many answers of a type come, to within MOST_LOST."""
    host.pass_time(LISTENED_S, Beat.OFF)
    host.pass_time(ANSWER_S)
    sent, came = round(LISTENED_S / PERIOD_S), len(host.all_of(kind))
    seen = f"{came} {kind.__name__} for {sent} Drives"
    refused = {what: count for what, count in host.refused.items() if what.startswith(kind.__name__)}
    if refused:
        seen += f"; refused since the start: {refused}"
    return unless(abs(came - sent) > MOST_LOST * sent, seen)


@check(ANSWERS, f"{PAIRS} Drive OFF, each after the answer to the one before", "State, then Sense")
def state_before_sense(host: Host) -> str:
    """Check that State comes before Sense: the control loop waits for positions."""
    wrong: list[str] = []
    for _ in range(PAIRS):
        host.forget()
        host.beat(Beat.OFF)
        host.until(lambda: bool(host.all_of(State) and host.all_of(Sense)), ANSWER_S, Beat.NOTHING)
        order = " ".join(type(one.message).__name__ for one in host.heard if isinstance(one.message, State | Sense))
        if order != "State Sense":
            wrong.append(order or "nothing")
    last = f", the last one by {wrong[-1]}" if wrong else ""
    return unless(len(wrong) > MOST_LOST * PAIRS, f"{len(wrong)} of {PAIRS} Drives were answered otherwise{last}")


@check(ANSWERS, "no Drive for 0.2 s", "no State and no Sense")
def no_answer_without_drive(host: Host) -> str:
    """Check that State and Sense come only as answers to a Drive."""
    host.pass_time(ANSWER_S)
    host.forget()
    host.pass_time(0.2)
    states, senses = len(host.all_of(State)), len(host.all_of(Sense))
    seen = f"{states} State, {senses} Sense"
    return unless(states or senses, seen)


@check(ANSWERS, "Drive OFF every 1 ms", f"State within {MOST_ANSWER_S * 1e3:g} ms as a rule, at once on the device")
def answer_time(host: Host) -> str:
    """Check that State comes as soon as the position loop needs it, the adapter's delay included."""
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
    return unless(usual(delays_s) > MOST_ANSWER_S, seen)


@check("State", "Drive OFF every 1 ms for 0.6 s", "State's counter is one more each time, modulo 256")
def state_counter(host: Host) -> str:
    """Check that State's counter rises by one: by it the host counts lost States, and knows repeated ones."""
    host.pass_time(0.6, Beat.OFF)
    counters = [state.counter for _, state in host.all_of(State)]
    if len(counters) < 2:
        raise Unmet(f"{len(counters)} State")
    steps = [(after - before) % 256 for before, after in pairwise(counters)]
    wrong = [step for step in steps if step != 1]
    seen = f"{len(wrong)} of {len(steps)} steps are not 1: {sorted(set(wrong))[:5]}, first {counters[:5]}"
    return unless(len(wrong) > MOST_LOST * len(steps), seen)


@check(
    "State",
    f"Drive OFF every 1 ms for {CLOCKED_S:g} s",
    "device_time_s runs by 1 s in a second, 1 % more or less",
)
def device_clock(host: Host) -> str:
    """Check that the device's clock runs true: speeds are computed from it."""
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
    seen = f"{1.0 + drift:.4f} s in a second, {drift:+.2%}"
    return unless(abs(drift) > MOST_DRIFT, seen)


@check(STATUS, "Drive OFF, its counter going up, then none", "Status shows the counter of the last Drive")
def drive_counter_shown(host: Host) -> str:
    """Check that Status shows the counter of the last Drive: by it the host sees what arrived."""
    seen = ""
    for _ in range(3):
        host.pass_time(7 * PERIOD_S, Beat.OFF)
        host.pass_time(ANSWER_S)
        counter = host.next_status(Beat.NOTHING).drive_counter
        seen = unless(counter != host.counter, f"drive_counter {counter} after a Drive with {host.counter}")
    return seen


@check(DRIVE, "a Drive OFF, then five more with the same counter", "one State")
def repeated_drive(host: Host) -> str:
    """Check that a repeated Drive is not answered: it is not accepted."""
    host.pass_time(2 * PERIOD_S, Beat.OFF)
    host.pass_time(ANSWER_S)
    host.forget()
    host.beat(Beat.OFF)
    for _ in range(5):
        host.counter = (host.counter - 1) % 256
        host.drive(DriveMode.OFF)
        host.pass_time(3 * PERIOD_S)
    host.pass_time(ANSWER_S)
    count = len(host.all_of(State))
    return unless(count != 1, f"{count} State")


@check("Status", "Drive OFF", "a supply of 9 to 15 V, an element of -20 to 60 degC, no SUPPLY or TEMPERATURE")
def status_plausible(host: Host) -> str:
    """Check that supply and temperature are plausible: a wrong unit or a loose wire shows here."""
    status = host.next_status(Beat.OFF)
    seen = f"{status.supply_V:.1f} V, {status.temperature_C:.0f} degC, {shown(status)}"
    causes = [fault.name for fault in status.faults if fault.name in ("SUPPLY", "TEMPERATURE")]
    return unless(not (9.0 <= status.supply_V <= 15.0 and -20.0 <= status.temperature_C <= 60.0) or causes, seen)


@check("Sense", "Drive OFF, nothing moving", "currents under 0.2 A, a force under 5 N")
def sense_plausible(host: Host) -> str:
    """Check that currents and force are near 0 at rest."""
    host.idle()
    host.pass_time(0.1, Beat.OFF)
    sense = host.last(Sense)
    currents, force_N = (sense.left_current_A, sense.right_current_A), sense.force_N
    seen = f"{currents[0]:+.3f} A, {currents[1]:+.3f} A, {force_N:+.3f} N"
    return unless(max(map(abs, currents)) > 0.2 or abs(force_N) > 5.0, seen)


CHECKS: Final = (
    status_without_host,
    status_with_host,
    state_answers_drive,
    sense_answers_drive,
    state_before_sense,
    no_answer_without_drive,
    answer_time,
    state_counter,
    device_clock,
    drive_counter_shown,
    repeated_drive,
    status_plausible,
    sense_plausible,
)
