"""Checks of silence in RUN: when the device notices, what it does, and what it takes until it runs again."""

from typing import Final

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
    Retract,
    Sense,
    encode,
)
from firmware_protocol.conformance.check import Check, Hazard, check
from firmware_protocol.conformance.host import (
    HELLO_NONCE,
    INSIDE_MM,
    NO_FAULT,
    OPENED_S,
    PERIOD_S,
    SEEN_S,
    Beat,
    Host,
    Unmet,
    Untested,
    is_homed,
    shown,
    unless,
)
from firmware_protocol.conformance.running import has_to_let_go, refuses_run

PAGE: Final = "Who says what when, 6"
LATCHES: Final = "What each mode takes"
SHORT_S: Final = 0.047
LONG_S: Final = 0.053
BORNE_S: Final = 0.0495
NOTICED_S: Final = 0.0515
"""By the device's clock: shorter silences are borne, longer ones noticed, with a tick for tolerance."""
SHORTS, LONGS = 12, 5
LATCHED_S: Final = 10.0
RESTING_A: Final = 0.05
HELD_S: Final = 37.0
HOLDS: Final = 3
"""The holds together meet every time modulo 2^16 ms in RUN, and a silence in every 2^15 ms."""
SPARSE_S: Final = 0.02
"""Drives this seldom still hold RUN."""
OVER_S: Final = 16.0
UPTIMES: Final = {31: 2.0**31 * 1e-6, 32: 2.0**32 * 1e-6}
SILENT: Final = f"in RUN, {INSIDE_MM:g} mm in, no Drive any more"
LATCHED: Final = "LATCHED by silence, "
TIMED_OUT: Final = DeviceFault.COMMAND_TIMEOUT


def _ends(host: Host, silent_s: float) -> bool:
    silence_s = host.fall_silent(silent_s)
    status = host.next_status(Beat.RUN)
    has_ended = status.mode is not DeviceMode.RUN
    seen = f"after {silence_s * 1e3:.2f} ms on the device's clock: {shown(status)}"
    unless(silence_s < BORNE_S if has_ended else silence_s > NOTICED_S, seen)
    unless(status.faults != (TIMED_OUT if has_ended else NO_FAULT), seen)
    return has_ended


@check(
    Hazard.OPENS,
    PAGE,
    f"in RUN, {SHORT_S * 1e3:g} ms without a Drive, {SHORTS} times, at random times after a Status",
    "stays RUN, no fault",
    moves=True,
)
def short_silence_is_borne(host: Host) -> str:
    host.running()
    for _ in range(SHORTS):
        _ends(host, SHORT_S)
    return host.shows(DeviceMode.RUN, Beat.RUN, fault=NO_FAULT)


@check(
    Hazard.SHUT,
    PAGE,
    f"in RUN, at the open end and {INSIDE_MM:g} mm in, {LONG_S * 1e3:g} ms without a Drive, then Drive RUN; {LONGS} "
    "times, at random times after a Status",
    "by then no RUN, COMMAND_TIMEOUT alone; opens, LATCHED",
    moves=True,
)
def silence_is_noticed(host: Host) -> str:
    noticed = 0
    for at in range(LONGS):
        host.running(INSIDE_MM if at else 0.0)
        noticed += _ends(host, LONG_S)
        host.until(host.is_resting, OPENED_S)
        host.shows(DeviceMode.LATCHED, homed=False, opened=True, fault=TIMED_OUT)
    return unless(noticed < LONGS - 1, f"{noticed} of {LONGS} noticed, the others too short by the device's clock")


@check(
    Hazard.SHUT,
    PAGE,
    f"{SILENT}, but every 1 ms a repeated Drive, one with a wrong CRC-8, a Clear and Hellos",
    "noticed as before",
    moves=True,
)
def only_good_drives_extend(host: Host) -> str:
    host.running(2.0 * INSIDE_MM)
    bad_counter = 0

    def chatter() -> None:
        nonlocal bad_counter
        bad_counter = (bad_counter + 1) % 256
        repeated = encode(Drive(0.0, 0.0, DriveMode.RUN, host.counter))
        bad = encode(Drive(0.0, 0.0, DriveMode.RUN, (host.counter + 1 + bad_counter) % 256))
        host.line.send(FUNCTION[Drive], repeated)
        host.line.send(FUNCTION[Drive], bad[:-1] + bytes((bad[-1] ^ 0x55,)))
        if bad_counter % 10 == 0:
            host.send(Hello(SCHEMA_HASH, PROTOCOL_VERSION, HELLO_NONCE))
        elif bad_counter % 10 == 5:
            host.send(Clear(host.new_nonce()))

    silence_s = host.fall_silent(LONG_S, chatter)
    seen = f"after {silence_s * 1e3:.1f} ms"
    return host.shows(DeviceMode.RETRACTING, Beat.RUN, fault=TIMED_OUT, besides=seen, wrong=silence_s < NOTICED_S)


@check(
    Hazard.CLOSES,
    PAGE,
    f"{SILENT}; then for {LATCHED_S:g} s nothing, Drive OFF, and Drive RUN by turns",
    "stays LATCHED, open, with COMMAND_TIMEOUT alone, not HOMED; no motion, no current",
    moves=True,
)
def silence_latches(host: Host) -> str:
    host.latched()
    host.pass_time(LATCHED_S / 2.0, Beat.NOTHING, SPARSE_S)
    host.pass_time(LATCHED_S / 4.0, Beat.OFF, SPARSE_S)
    host.pass_time(LATCHED_S / 4.0, Beat.RUN, SPARSE_S)
    sense = host.last(Sense)
    most_A = max(abs(sense.left_current_A), abs(sense.right_current_A))
    refuses_run(host, DeviceMode.LATCHED)
    besides = f"{most_A:.3f} A"
    return host.shows(
        DeviceMode.LATCHED, homed=False, opened=True, fault=TIMED_OUT, besides=besides, wrong=most_A > RESTING_A
    )


@check(Hazard.OPENS, LATCHES, f"{LATCHED}Home, then Retract", "neither acknowledged, stays LATCHED", moves=True)
def latched_refuses_home_and_retract(host: Host) -> str:
    """A latched device is open, or cannot open."""
    host.latched()
    return "; ".join(host.refuses(kind, DeviceMode.LATCHED, homed=False) for kind in (Home, Retract))


@check(
    Hazard.CLOSES,
    LATCHES,
    f"{LATCHED}Clear without any Drive, then Drive RUN",
    "acknowledged: the cause is gone; no fault, not HOMED, stays IDLE",
    moves=True,
)
def cleared_is_not_homed(host: Host) -> str:
    """After a fault the device has to home again."""
    host.latched()
    host.obeyed(Clear, Beat.NOTHING)
    host.shows(DeviceMode.IDLE, Beat.NOTHING, homed=False, fault=NO_FAULT)
    return refuses_run(host, DeviceMode.IDLE)


@check(
    Hazard.CLOSES,
    "Modes",
    f"{LATCHED}Clear and Home, Drive RUN going on all the time; then one Drive OFF",
    "IDLE until the Drive OFF, RUN after it",
    moves=True,
)
def let_go_after_fault(host: Host) -> str:
    """For a host that did not see the fault."""
    host.running(INSIDE_MM)
    host.pass_time(0.1)
    host.until(host.is_resting, OPENED_S, Beat.RUN)
    host.obeyed(Clear, Beat.RUN)
    homing = host.home(Beat.RUN)
    if not is_homed(homing.status):
        raise Unmet(f"not homed: {shown(homing.status)}")
    return has_to_let_go(host)


def _holds(host: Host, end_s: float) -> str:
    """Hold RUN with sparse Drives until then, and fall silent."""
    host.running()
    while host.now_s < end_s:
        host.beat(Beat.RUN, period_s=SPARSE_S)
        if host.status.mode is not DeviceMode.RUN:
            raise Unmet(f"RUN with a Drive every {SPARSE_S * 1e3:g} ms ends: {shown(host.status)}")
    host.pass_time(SEEN_S, Beat.RUN)
    _ends(host, LONG_S + PERIOD_S)
    host.until(host.is_resting, OPENED_S)
    return host.shows(DeviceMode.LATCHED, fault=TIMED_OUT)


@check(
    Hazard.SHUT,
    PAGE,
    f"{HOLDS} times in RUN a Drive every {SPARSE_S * 1e3:g} ms, {HOLDS * HELD_S:g} s in all, then none",
    "stays RUN; then COMMAND_TIMEOUT alone, whenever",
    moves=True,
)
def any_uptime(host: Host) -> str:
    """Finds a timeout's counter that overflows at 2^16 ms or changes its sign."""
    began_s = host.now_s
    seen = [_holds(host, began_s + at * HELD_S) for at in range(1, HOLDS + 1)]
    return f"{len(seen)} times: {seen[-1]}"


def _clock_runs_over(bits: int) -> Check:
    """Return the check that a counter of microseconds may overflow at 2 to this power."""
    over_s = UPTIMES[bits]

    def perform(host: Host) -> str:
        host.running()
        up_s = host.uptime_s
        if up_s is None or not up_s < over_s < up_s + OVER_S:
            raise Untested(f"build a firmware whose clock starts {OVER_S / 2.0:g} s before {over_s:.0f} s; --uptime")
        return _holds(host, host.now_s + OVER_S)

    return Check(
        f"uptime_of_2_{bits}_us",
        Hazard.SHUT,
        PAGE,
        f"in RUN while the uptime becomes {over_s:.0f} s, then no Drive any more",
        "stays RUN; then COMMAND_TIMEOUT alone",
        perform,
        moves=True,
        is_gate=False,
    )


CHECKS: Final = (
    short_silence_is_borne,
    silence_is_noticed,
    only_good_drives_extend,
    silence_latches,
    latched_refuses_home_and_retract,
    cleared_is_not_homed,
    let_go_after_fault,
    any_uptime,
    *(_clock_runs_over(bits) for bits in UPTIMES),
)
