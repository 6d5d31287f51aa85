"""Checks of Home: what it does, where the zero is, and from which State on."""

from typing import Final

from firmware_protocol.codec import Clear, DeviceMode, Home, Retract, State
from firmware_protocol.conformance.check import Hazard, check
from firmware_protocol.conformance.host import (
    HOMED_S,
    OPENED_S,
    SEEN_S,
    Beat,
    Homing,
    Host,
    Unmet,
    is_homed,
    is_open,
    positions,
    shown,
    told,
    unless,
)

PAGE: Final = "Homing"
TAKES: Final = "What each mode takes"
ZERO_MM = 1.0
"""A carriage rests this near its zero: behind its switch, where it was braked from a creep."""
JUMP_MM = 0.2
"""Carriages are braked when HOMED shows: a State further off than this has the old origin."""


def _homings(host: Host) -> list[Homing]:
    """Return the homings so far; without any, home the device."""
    if not host.homings:
        host.without_zero()
        host.home()
    return host.homings


@check(
    Hazard.OPENS,
    PAGE,
    "Home to an idle device without a zero",
    "acknowledged; HOMING, then IDLE, HOMED, at both open switches, no fault",
    moves=True,
    is_gate=True,
)
def home_homes(host: Host) -> str:
    homing = _homings(host)[0]
    modes = " ".join(mode.name for mode in homing.modes)
    status = homing.status
    is_right = status.mode is DeviceMode.IDLE and is_homed(status) and is_open(status) and not status.faults
    went = homing.was_acknowledged and DeviceMode.HOMING in homing.modes and homing.seconds <= HOMED_S
    seen = f"{told(homing.was_acknowledged)}; {modes} in {homing.seconds:.1f} s, {shown(status)}"
    return unless(not is_right or not went, seen)


@check(
    Hazard.MISLED,
    PAGE,
    "Home, Drive OFF every 1 ms",
    f"both positions within {ZERO_MM:g} mm of 0 afterwards",
    moves=True,
)
def home_zeroes(host: Host) -> str:
    seen = ""
    for homing in _homings(host):
        state = homing.last
        if state is None or not is_homed(homing.status):
            raise Unmet("no State" if state is None else shown(homing.status))
        seen = unless(max(abs(state.left_position_mm), abs(state.right_position_mm)) > ZERO_MM, positions(state))
    return seen


@check(
    Hazard.MISLED,
    PAGE,
    "Home, Drive OFF every 1 ms",
    "the first State after a Status with HOMED is in the new origin",
    moves=True,
)
def homed_is_in_new_origin(host: Host) -> str:
    """The host takes the device for homed from this State on."""
    seen = ""
    for homing in _homings(host):
        first, last = homing.first, homing.last
        if first is None or last is None:
            raise Unmet(f"no State after HOMED: {shown(homing.status)}")
        left_mm = abs(first.left_position_mm - last.left_position_mm)
        jump_mm = max(left_mm, abs(first.right_position_mm - last.right_position_mm))
        seen = unless(jump_mm > JUMP_MM, f"first {positions(first)}, then {positions(last)}")
    return seen


@check(
    Hazard.OPENS, "Who says what when, 5", "Home, and when it is done the same Home again", "not done again", moves=True
)
def repeated_command(host: Host) -> str:
    host.homed()
    host.obeyed(Home)
    nonce = host.status.command_nonce
    seen = ""
    host.until(lambda: host.status.mode is not DeviceMode.HOMING, HOMED_S)
    for _ in range(3):
        host.send(Home(nonce))
        host.pass_time(SEEN_S, Beat.OFF)
        seen = host.shows(DeviceMode.IDLE, homed=True, besides="after the same nonce again")
    return seen


@check(
    Hazard.SHUT,
    TAKES,
    "Retract to an idle device",
    "acknowledged; IDLE at both open switches, HOMED as before",
    moves=True,
)
def retract_when_idle(host: Host) -> str:
    host.homed()
    was_acknowledged = host.command(Retract)
    host.until(lambda: host.status.mode is DeviceMode.IDLE, OPENED_S)
    besides = f"{told(was_acknowledged)}, {positions(host.last(State))}"
    return host.shows(DeviceMode.IDLE, homed=True, opened=True, besides=besides, wrong=not was_acknowledged)


@check(
    Hazard.SHUT,
    TAKES,
    "Home; while HOMING a Clear, another Home, then a Retract",
    "only Retract acknowledged; IDLE, open, not HOMED",
    moves=True,
)
def homing_takes_only_retract(host: Host) -> str:
    host.homed()
    host.obeyed(Home)
    for kind in (Clear, Home):
        host.refuses(kind, DeviceMode.HOMING)
    host.obeyed(Retract)
    host.until(lambda: host.status.mode is DeviceMode.IDLE, OPENED_S)
    return host.shows(DeviceMode.IDLE, homed=False, opened=True)


CHECKS: Final = (
    home_homes,
    home_zeroes,
    homed_is_in_new_origin,
    repeated_command,
    retract_when_idle,
    homing_takes_only_retract,
)
