"""All checks in their order, first those that move nothing; and those that need a reset, or a bench."""

from functools import partial
from typing import Final

from firmware_protocol.codec import Clear, DeviceMode, DriveMode, Home, Retract, State
from firmware_protocol.conformance import moving, taking, telling
from firmware_protocol.conformance.check import Check, Hazard, check
from firmware_protocol.conformance.host import (
    NO_FAULT,
    OPENED_S,
    SEEN_S,
    Host,
    Unmet,
    Untested,
    is_open,
    places,
    positions,
    shown,
    unless,
)

FAR_INSIDE_MM, ASKEW_MM, BOOT_S = 10.0, 1.5, 10.0


def _is_new(host: Host, how: str) -> str:
    """Reset a device in RUN, FAR_INSIDE_MM in and askew, and compare it with a new one."""
    if host.reset is None:
        raise Untested(f"nobody can reset the device: --reset COMMAND, which is called with {how}")
    host.running(FAR_INSIDE_MM, ASKEW_MM)
    host.reset(how)
    host.begin()
    unless(
        not host.until(lambda: host.status.command_nonce == 0, BOOT_S, None),
        f"no reset, or one that keeps the nonce: {shown(host.status)}",
    )
    host.counter = (host.counter - 1) % 256 if how == "warm" else 255
    seen = [moving.keeps_still(host, "after the reset")]
    host.send(Home(0))
    host.shows(DeviceMode.IDLE, None, homed=False, fault=NO_FAULT, besides="after a Home with nonce 0")
    if how == "warm":
        host.obeyed(Retract)
        seen.append(taking.opens_fully(host, NO_FAULT, len(host.rows), has_zero=False))
    host.home(None)
    seen.append(moving.keeps_still(host, "homed without a Hello,"))
    host.hello()
    host.pass_time(SEEN_S, DriveMode.RUN)
    return host.shows(
        DeviceMode.RUN,
        DriveMode.RUN,
        homed=True,
        besides=f"{'; '.join(seen)}; after it {positions(host.last(State))}",
        wrong=max(map(abs, places(host.last(State)))) > moving.ZERO_MM / 2.0,
    )


RESETS: Final = [
    Check(
        f"{how}_reset",
        Hazard.CLOSES,
        "Reset",
        f"in RUN, {FAR_INSIDE_MM:g} mm in, one carriage {ASKEW_MM:g} mm less, {what}",
        "nonce 0, IDLE, not HOMED, no fault, drives off; after a warm one opens at over "
        f"{taking.MIN_SHARE * taking.UNHOMED_SHARE:g} of the device's speed, after a cold one homes from there; "
        "each zero at its own switch; runs after Home and Hello, not before",
        partial(_is_new, how=how),
        moves=True,
        is_gate=False,
    )
    for how, what in (("warm", "a reset that keeps the memory"), ("cold", "the supply off and on"))
]


def _by_hand(host: Host) -> str:
    raise Untested("for the bench, by hand")


BY_HAND: Final = [
    Check(name, hazard, "Faults", sent, expected, _by_hand, moves=False, is_gate=False)
    for name, hazard, sent, expected in (
        ("overcurrent", Hazard.WORN, "in RUN, and in HOMING, each carriage held", "OVERCURRENT after 0.15 s; LATCHED"),
        (
            "retract_failed",
            Hazard.SHUT,
            "each carriage held while RETRACTING, for 9 s",
            "RETRACT_FAILED; off after 8 s",
        ),
        (
            "uncommanded_motion",
            Hazard.CLOSES,
            "IDLE, and LATCHED, each screw turned by 0.3 mm; turned in while RETRACTING",
            "UNCOMMANDED_MOTION, opens",
        ),
        ("supply", Hazard.SHUT, "a supply of 8.5 V, and of 15.5 V", "SUPPLY until Clear, refused meanwhile"),
        ("temperature", Hazard.WORN, "the sensor warmed to over 60 degC", "TEMPERATURE; as SUPPLY"),
        ("watchdog", Hazard.CLOSES, "a firmware that hangs in RUN", "a reset within 50 ms, drives off"),
    )
]


@check(
    Hazard.SHUT,
    "Who says what when, 7",
    "Drive OFF; where that does not open, Clear and Retract",
    "both open switches, drives off",
)
def left_open(host: Host) -> str:
    host.hello()
    for kind in (Clear, Retract, Clear, Retract, Clear):
        host.until(host.is_resting, OPENED_S)
        if host.is_resting() and is_open(host.next_status(DriveMode.OFF)):
            return shown(host.status)
        host.command(kind)
    raise Unmet(f"THE GAP MAY BE SHUT: {shown(host.status)}")


CHECKS: Final = (
    *telling.STREAMS,
    *moving.GATES,
    *taking.CHECKS,
    *moving.CHECKS,
    *telling.OVERALL,
    *RESETS,
    *BY_HAND,
    left_open,
)
