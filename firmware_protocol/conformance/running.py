"""Checks of RUN: how it is entered, what the duties do, what ends it, and which modes refuse it."""

from typing import Final

from firmware_protocol.codec import (
    SCHEMA_HASH,
    Clear,
    DeviceFault,
    DeviceMode,
    Home,
    Identity,
    Retract,
    Sense,
    State,
)
from firmware_protocol.conformance.check import Hazard, check
from firmware_protocol.conformance.host import (
    ANSWER_S,
    HOMED_S,
    INSIDE_MM,
    NO_FAULT,
    OPENED_S,
    PERIOD_S,
    SEEN_S,
    Beat,
    Host,
    Unmet,
    is_open,
    positions,
    shown,
    told,
    unless,
)

PAGE: Final = "Modes"
TAKES: Final = "What each mode takes"
OPENING: Final = "Opening"
RAMP_PER_S: Final = 1.0
MAX_DUTY: Final = 0.5
REFUSED_DUTY: Final = -0.4
"A motor in RUN would go in by over REFUSED_MM with it, in SEEN_S."
REFUSED_MM: Final = 0.1
HOMING_S: Final = 0.5
HOMING_MM: Final = 3.0
"A homing that goes in further than it backs off obeys another command."
MOVED_MM: Final = 0.3
AT_STOP_DUTY: Final = 0.3
AT_STOP_MM: Final = 0.1
AT_STOP_A: Final = 0.3
"""A motor that pushes into the stop at AT_STOP_DUTY draws several times this."""
BEGUN_MM: Final = 0.1
BEGUN_S: Final = 0.2
OPEN_S: Final = 0.8
"""A carriage INSIDE_MM in has begun to open after BEGUN_S, and is open after OPEN_S."""
GIVEN_UP_S: Final = 7.0
"""By then a device that cannot open has said so."""
IN_TIME: Final = (
    f"RETRACTING, both out by {BEGUN_MM:g} mm in {BEGUN_S:g} s; in {OPEN_S:g} s IDLE, open, HOMED, no fault"
)
RUNNING: Final = f"in RUN, {INSIDE_MM:g} mm in, "


@check(Hazard.OPENS, PAGE, "homed, Drive OFF, then Drive RUN with a duty of 0", "RUN", moves=True)
def run_is_entered(host: Host) -> str:
    host.running()
    return shown(host.status)


@check(
    Hazard.CLOSES,
    "Drive",
    f"in RUN, a left duty that falls from 0 to -{MAX_DUTY:g} at most, right 0",
    f"the left carriage goes in by {MOVED_MM:g} mm, the right one stays; the left motor draws more",
    moves=True,
    is_gate=True,
)
def left_duty(host: Host) -> str:
    """With a wrong side or sign every safe state closes the gap."""
    return _duty_moves(host, is_left=True)


@check(
    Hazard.CLOSES,
    "Drive",
    f"in RUN, a right duty that falls from 0 to -{MAX_DUTY:g} at most, left 0",
    f"the right carriage goes in by {MOVED_MM:g} mm, the left one stays; the right motor draws more",
    moves=True,
    is_gate=True,
)
def right_duty(host: Host) -> str:
    return _duty_moves(host, is_left=False)


def _duty_moves(host: Host, *, is_left: bool) -> str:
    host.running()
    start = host.last(State)
    for step in range(round(MAX_DUTY / RAMP_PER_S / PERIOD_S)):
        duty = -RAMP_PER_S * PERIOD_S * step
        host.beat(Beat.RUN, duty if is_left else 0.0, 0.0 if is_left else duty)
        left_mm, right_mm = _moved_mm(host, start)
        moved_mm, other_mm = (left_mm, right_mm) if is_left else (right_mm, left_mm)
        sense = host.last(Sense)
        currents_A = abs(sense.left_current_A), abs(sense.right_current_A)
        seen = (
            f"left by {left_mm:+.2f} mm, right by {right_mm:+.2f} mm at a duty of {duty:.2f}, "
            f"{currents_A[0]:.2f} A and {currents_A[1]:.2f} A"
        )
        if moved_mm <= -MOVED_MM and abs(other_mm) < MOVED_MM / 2:
            return unless((currents_A[0] > currents_A[1]) is not is_left, seen)
        unless(max(abs(moved_mm), abs(other_mm)) >= MOVED_MM, seen)
    raise Unmet(f"{seen}, {shown(host.status)}")


@check(
    Hazard.WORN,
    PAGE,
    f"in RUN at both open switches, duties of +{AT_STOP_DUTY:g} for 0.2 s",
    f"no motion over {AT_STOP_MM:g} mm, no current over {AT_STOP_A:g} A",
    moves=True,
)
def open_switch_stops(host: Host) -> str:
    host.running()
    if not is_open(host.status):
        raise Unmet(f"not at the open switches: {shown(host.status)}")
    start = host.last(State)
    host.forget()
    host.pass_time(0.2, Beat.RUN, duty=AT_STOP_DUTY)
    currents_A = [abs(A) for _, sense in host.all_of(Sense) for A in (sense.left_current_A, sense.right_current_A)]
    most_A = max(currents_A, default=0.0)
    left_mm, right_mm = _moved_mm(host, start)
    return host.shows(
        DeviceMode.RUN,
        Beat.RUN,
        besides=f"left by {left_mm:+.2f} mm, right by {right_mm:+.2f} mm, {most_A:.2f} A at most",
        wrong=most_A > AT_STOP_A or max(abs(left_mm), abs(right_mm)) > AT_STOP_MM,
    )


def _moved_mm(host: Host, start: State) -> tuple[float, float]:
    state = host.last(State)
    return state.left_position_mm - start.left_position_mm, state.right_position_mm - start.right_position_mm


@check(
    Hazard.SHUT,
    OPENING,
    f"{RUNNING}Drive OFF",
    IN_TIME,
    moves=True,
)
def off_opens(host: Host) -> str:
    host.running(INSIDE_MM)
    return _opens(host, Beat.OFF)


@check(
    Hazard.SHUT,
    OPENING,
    f"{RUNNING}Retract, while Drive RUN goes on",
    f"acknowledged; {IN_TIME}",
    moves=True,
)
def retract_opens(host: Host) -> str:
    host.running(INSIDE_MM)
    host.obeyed(Retract, Beat.RUN)
    return _opens(host, Beat.RUN)


def _opens(host: Host, beat: Beat) -> str:
    start = host.last(State)
    host.shows(DeviceMode.RETRACTING, beat, besides=f"from {positions(start)}")
    seen = f"from {positions(start)} to "
    if not host.until(lambda: min(_moved_mm(host, start)) >= BEGUN_MM, BEGUN_S, beat):
        what = "went the wrong way" if min(_moved_mm(host, start)) <= -BEGUN_MM else "did not begin"
        raise Unmet(f"{what}: {seen}{positions(host.last(State))} in {BEGUN_S:g} s, {_given_up(host, beat)}")
    if not host.until(host.is_resting, OPEN_S - BEGUN_S, beat):
        late = host.last(State)
        host.pass_time(SEEN_S, beat)
        what = "too slow" if max(_moved_mm(host, late)) > 0.0 else "stands"
        raise Unmet(f"{what}: {seen}{positions(late)} in {OPEN_S:g} s, {_given_up(host, beat)}")
    besides = f"{seen}{positions(host.last(State))}: RETRACTING, then"
    return host.shows(DeviceMode.IDLE, beat, homed=True, opened=True, fault=NO_FAULT, besides=besides)


def _given_up(host: Host, beat: Beat) -> str:
    said = host.until(lambda: host.is_resting() or DeviceFault.RETRACT_FAILED in host.status.faults, GIVEN_UP_S, beat)
    return f"then {shown(host.status)}" if said else f"and says nothing of it in {GIVEN_UP_S:g} s"


@check(
    Hazard.CLOSES,
    PAGE,
    "Retract in RUN while Drive RUN goes on; then one Drive OFF",
    "IDLE until the Drive OFF, RUN after it",
    moves=True,
)
def let_go_after_retract(host: Host) -> str:
    host.running()
    host.obeyed(Retract, Beat.RUN)
    host.until(lambda: host.status.mode is not DeviceMode.RETRACTING, OPENED_S, Beat.RUN)
    return has_to_let_go(host)


def has_to_let_go(host: Host) -> str:
    """Send Drive RUN to an idle device, one Drive OFF, then Drive RUN again."""
    host.hello(beat=Beat.RUN)  # as a host does every second
    start = host.last(State)
    host.pass_time(SEEN_S, Beat.RUN, duty=REFUSED_DUTY)
    moved_mm = min(_moved_mm(host, start))
    besides = f"before a Drive OFF, moved by {moved_mm:+.2f} mm"
    host.shows(DeviceMode.IDLE, Beat.RUN, besides=besides, wrong=abs(moved_mm) > REFUSED_MM)
    host.beat(Beat.OFF)
    host.pass_time(SEEN_S, Beat.RUN)
    return host.shows(DeviceMode.RUN, Beat.RUN, besides="IDLE, and after a Drive OFF and Drive RUN again")


@check(Hazard.OPENS, TAKES, "in RUN a Home, then a Clear", "neither acknowledged, stays RUN and HOMED", moves=True)
def run_refuses_home_and_clear(host: Host) -> str:
    """Home and Clear would take the brake out of the host's hands."""
    host.running()
    seen = [host.refuses(kind, DeviceMode.RUN, Beat.RUN, homed=True) for kind in (Home, Clear)]
    return "; ".join(seen)


@check(Hazard.OPENS, "Who says what when, 1", "the right Hello in RUN", "Identity; stays RUN and HOMED", moves=True)
def hello_in_run(host: Host) -> str:
    """The host sends a Hello every second."""
    host.running()
    host.forget()
    for nonce in (host.status.command_nonce, 77):
        host.hello(nonce=nonce, beat=Beat.RUN)
    count = len(host.all_of(Identity))
    besides = f"{count} Identity for 2 Hellos"
    return host.shows(DeviceMode.RUN, Beat.RUN, homed=True, besides=besides, wrong=count != 2)


@check(Hazard.CLOSES, TAKES, f"Home; while HOMING, Drive RUN with {REFUSED_DUTY:g}", "homes as without", moves=True)
def homing_refuses_run(host: Host) -> str:
    host.homed()
    host.obeyed(Home)
    start = host.last(State)
    end_s = host.now_s + HOMING_S
    while host.now_s < end_s and min(_moved_mm(host, start)) > -HOMING_MM:
        host.beat(Beat.RUN, REFUSED_DUTY, REFUSED_DUTY)
    besides = f"moved by {min(_moved_mm(host, start)):+.2f} mm after {HOMING_S:g} s, then"
    host.until(lambda: host.status.mode is not DeviceMode.HOMING, HOMED_S)
    return host.shows(DeviceMode.IDLE, homed=True, opened=True, fault=NO_FAULT, besides=besides)


def refuses_run(host: Host, mode: DeviceMode) -> str:
    """Send closing Drive RUN to a device that must not run."""
    host.beat(Beat.OFF)
    host.pass_time(ANSWER_S)
    start = host.last(State)
    host.forget()
    host.pass_time(SEEN_S, Beat.RUN, duty=REFUSED_DUTY)
    host.pass_time(ANSWER_S)
    states = len(host.all_of(State))
    moved_mm = min(_moved_mm(host, start))
    is_wrong = abs(moved_mm) > REFUSED_MM or states != round(SEEN_S / PERIOD_S)
    return host.shows(mode, besides=f"{states} State, moved by {moved_mm:+.2f} mm", wrong=is_wrong)


def _mismatched(host: Host, beat: Beat, faults: DeviceFault = DeviceFault.SCHEMA_MISMATCH) -> str:
    host.hello(SCHEMA_HASH ^ 1, beat=beat)
    if (status := host.next_status(beat)).mode not in (DeviceMode.RETRACTING, DeviceMode.LATCHED):
        raise Unmet(shown(status))
    host.until(host.is_resting, OPENED_S, beat)
    return host.shows(DeviceMode.LATCHED, beat, homed=False, opened=True, fault=faults)


@check(
    Hazard.CLOSES,
    TAKES,
    "a Hello with another schema hash in RUN, in HOMING, while RETRACTING, when LATCHED by silence",
    "each time opens; LATCHED with SCHEMA_MISMATCH, and the fault that was there before",
    moves=True,
)
def mismatch_in_every_mode(host: Host) -> str:
    """A host of another schema does not know the rules."""
    host.running(INSIDE_MM)
    seen = [f"in RUN: {_mismatched(host, Beat.RUN)}"]
    host.homed()
    host.obeyed(Home)
    seen.append(f"in HOMING: {_mismatched(host, Beat.OFF)}")
    host.running(INSIDE_MM)
    host.shows(DeviceMode.RETRACTING)
    seen.append(f"while RETRACTING: {_mismatched(host, Beat.OFF)}")
    host.latched()
    both = DeviceFault.COMMAND_TIMEOUT | DeviceFault.SCHEMA_MISMATCH
    seen.append(f"when LATCHED: {_mismatched(host, Beat.OFF, both)}")
    return "; ".join(seen)


@check(
    Hazard.SHUT,
    TAKES,
    f"{RUNNING}Drive OFF; while RETRACTING Home, Clear, then Retract",
    "only Retract acknowledged; IDLE, open, HOMED",
    moves=True,
)
def retracting_takes_only_retract(host: Host) -> str:
    host.running(2.0 * INSIDE_MM)
    host.shows(DeviceMode.RETRACTING, besides="after Drive OFF")
    taken = [kind.__name__ for kind in (Home, Clear) if not host.is_refused(kind)]
    was_acknowledged = host.command(Retract)
    host.until(lambda: host.status.mode is DeviceMode.IDLE, OPENED_S)
    besides = f"{', '.join(taken) or 'nothing'} acknowledged, Retract {told(was_acknowledged)}"
    is_wrong = taken or not was_acknowledged
    return host.shows(DeviceMode.IDLE, homed=True, opened=True, besides=besides, wrong=is_wrong)


CHECKS: Final = (
    run_is_entered,
    left_duty,
    right_duty,
    open_switch_stops,
    off_opens,
    retract_opens,
    retracting_takes_only_retract,
    let_go_after_retract,
    run_refuses_home_and_clear,
    hello_in_run,
    homing_refuses_run,
    mismatch_in_every_mode,
)
