"""Checks of silence in RUN: when the device notices, what it does then, and what it takes until it runs again."""

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
    State,
    encode,
)
from firmware_protocol.conformance.check import check
from firmware_protocol.conformance.host import (
    HELLO_NONCE,
    INSIDE_MM,
    NO_FAULT,
    SEEN_S,
    Beat,
    Host,
    Silence,
    Unmet,
    is_homed,
    is_open,
    positions,
    shown,
    unless,
)
from firmware_protocol.conformance.running import has_to_let_go

PAGE: Final = "Who says what when, 6"
LATCHES: Final = "What each mode takes"
SHORT_S: Final = 0.044
"""A silence that, with a period of the host and a tick of the device, is under 50 ms."""
NOTICED_S: Final = 0.054
"""50 ms, a tick of the device, and the time that a Status is on its way."""
SILENT: Final = f"in RUN, {INSIDE_MM:g} mm in, no Drive any more"
LATCHED: Final = "LATCHED by silence, "


@check(PAGE, f"in RUN, {SHORT_S * 1e3:g} ms without a Drive, three times", "stays RUN, no fault", moves=True)
def short_silence_is_borne(host: Host) -> str:
    """Check that silences of SHORT_S change nothing: up to 50 ms are allowed."""
    host.running()
    seen = ""
    for _ in range(3):
        host.pass_time(SHORT_S)
        host.pass_time(SEEN_S, Beat.RUN)
        seen = host.shows(DeviceMode.RUN, Beat.RUN, fault=NO_FAULT)
    return seen


def _judged(silence: Silence) -> str:
    """Return what the first Status after NOTICED_S shows. Raises Unmet unless it shows COMMAND_TIMEOUT and no RUN."""
    late = [(at_s, status) for at_s, status in silence.statuses if at_s > NOTICED_S]
    if not late:
        raise Unmet("no Status after the last Drive")
    at_s, status = late[0]
    seen = f"{at_s * 1e3:.0f} ms after the last Drive: {shown(status)}"
    return unless(status.mode is DeviceMode.RUN or DeviceFault.COMMAND_TIMEOUT not in status.faults, seen)


@check(
    PAGE,
    SILENT,
    f"the first Status later than {NOTICED_S * 1e3:.0f} ms shows COMMAND_TIMEOUT and no RUN",
    moves=True,
)
def silence_is_noticed(host: Host) -> str:
    """Check that the device notices silence after 50 ms on its clock, and a tick."""
    host.running(INSIDE_MM)
    return _judged(host.fall_silent())


@check(PAGE, SILENT, "both carriages go to their open switches, then the drives are off", moves=True)
def silence_opens(host: Host) -> str:
    """Check that the device opens the gap on silence, then switches the drives off."""
    host.running(INSIDE_MM)
    before = positions(host.last(State))
    silence = host.fall_silent()
    modes = {status.mode.name for _, status in silence.statuses}
    seen = f"from {before}: {shown(silence.status)} after {silence.seconds:.2f} s, by way of {', '.join(sorted(modes))}"
    return unless(not is_open(silence.status) or silence.status.mode is DeviceMode.RUN, seen)


@check(
    PAGE,
    f"{SILENT}, but every 1 ms a repeated Drive, one with a wrong CRC-8, a Clear and Hellos",
    "noticed as before",
    moves=True,
)
def only_good_drives_extend(host: Host) -> str:
    """Check that only a good Drive extends the 50 ms: not a repeated or damaged one, a Clear or a Hello."""
    host.running()
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

    return _judged(host.fall_silent(chatter))


@check(PAGE, f"{LATCHED}Drive OFF every 1 ms for 0.3 s", "stays LATCHED with COMMAND_TIMEOUT, not HOMED", moves=True)
def silence_latches(host: Host) -> str:
    """Check that the fault of silence stays until it is cleared, and takes the zero away."""
    host.running(INSIDE_MM)
    host.fall_silent()
    host.pass_time(0.3, Beat.OFF)
    return host.shows(DeviceMode.LATCHED, homed=False, fault=DeviceFault.COMMAND_TIMEOUT)


@check(LATCHES, f"{LATCHED}Drive RUN with a duty of 0", "stays LATCHED; each Drive is answered", moves=True)
def latched_refuses_run(host: Host) -> str:
    """Check that a latched device does not run, and answers each Drive all the same."""
    host.latched()
    host.forget()
    host.pass_time(SEEN_S, Beat.RUN)
    states = len(host.all_of(State))
    return host.shows(DeviceMode.LATCHED, Beat.RUN, besides=f"{states} State", wrong=states < SEEN_S * 900)


@check(LATCHES, f"{LATCHED}Home", "not acknowledged, stays LATCHED", moves=True)
def latched_refuses_home(host: Host) -> str:
    """Check that a latched device refuses Home: the fault is cleared first."""
    host.latched()
    return host.refuses(Home, DeviceMode.LATCHED)


@check(LATCHES, f"{LATCHED}Retract", "not acknowledged, stays LATCHED", moves=True)
def latched_refuses_retract(host: Host) -> str:
    """Check that a latched device refuses Retract: it has opened already, or cannot."""
    host.latched()
    return host.refuses(Retract, DeviceMode.LATCHED)


@check(LATCHES, f"{LATCHED}Clear, then Drive RUN", "acknowledged, no fault, not HOMED; stays IDLE", moves=True)
def cleared_is_not_homed(host: Host) -> str:
    """Check that a Clear brings back no zero: after a fault the device has to home again."""
    host.latched()
    host.obeyed(Clear)
    host.pass_time(SEEN_S, Beat.RUN)
    return host.shows(DeviceMode.IDLE, Beat.RUN, homed=False, fault=NO_FAULT)


@check(
    "Modes",
    f"{LATCHED}Clear and Home, Drive RUN going on all the time; then one Drive OFF",
    "IDLE until the Drive OFF, RUN after it",
    moves=True,
)
def let_go_after_fault(host: Host) -> str:
    """Check that RUN comes back after a fault only by a Drive OFF, for a host that did not see the fault."""
    host.running(INSIDE_MM)
    host.fall_silent()
    host.obeyed(Clear, Beat.RUN)
    homing = host.home(Beat.RUN)
    if not is_homed(homing.status):
        raise Unmet(f"not homed: {shown(homing.status)}")
    return has_to_let_go(host)


CHECKS: Final = (
    short_silence_is_borne,
    silence_is_noticed,
    silence_opens,
    only_good_drives_extend,
    silence_latches,
    latched_refuses_run,
    latched_refuses_home,
    latched_refuses_retract,
    cleared_is_not_homed,
    let_go_after_fault,
)
