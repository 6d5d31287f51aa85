"""Checks that need more than the line: a reset, and what only a bench can bring about."""

from typing import Final

from firmware_protocol.codec import DeviceMode, Home, Retract, State
from firmware_protocol.conformance.check import Check, Hazard, check
from firmware_protocol.conformance.host import (
    NO_FAULT,
    OPENED_S,
    SEEN_S,
    Beat,
    Host,
    Untested,
    is_open,
    positions,
    shown,
    unless,
)
from firmware_protocol.conformance.moving import keeps_still
from firmware_protocol.conformance.taking import MIN_SHARE

FAR_INSIDE_MM, BOOT_S, UNHOMED_SHARE, TO_TURN_S = 10.0, 10.0, 0.5, 0.5


def _is_new(host: Host, how: str) -> str:
    """Reset a device in RUN, FAR_INSIDE_MM in, and compare it with a new one."""
    if host.reset is None:
        raise Untested(f"nobody can reset the device: --reset COMMAND, which is called with {how}")
    host.running(FAR_INSIDE_MM)
    host.reset(how)
    host.begin()
    is_reset = host.until(lambda: host.status.command_nonce == 0, BOOT_S, Beat.NOTHING)
    unless(not is_reset, f"no reset, or one that keeps the nonce: {shown(host.status)}")
    host.counter = 255
    seen = [keeps_still(host, "after the reset")]
    host.send(Home(0))
    host.shows(DeviceMode.IDLE, homed=False, fault=NO_FAULT, besides="after a Home with nonce 0")
    start_s, start = host.now_s, host.last(State)
    host.obeyed(Retract)
    host.until(lambda: host.is_resting() and is_open(host.status), OPENED_S)
    seen.append(f"opens in {host.now_s - start_s:.1f} s from {positions(start)}")
    limit_s = FAR_INSIDE_MM / (MIN_SHARE * UNHOMED_SHARE * host.opening_mm_s) + TO_TURN_S
    is_late = host.now_s - start_s > limit_s
    host.shows(DeviceMode.IDLE, homed=False, opened=True, fault=NO_FAULT, besides=seen[-1], wrong=is_late)
    host.home(Beat.NOTHING)
    seen.append(keeps_still(host, "homed without a Hello,"))
    host.hello()
    host.pass_time(SEEN_S, Beat.RUN)
    return host.shows(DeviceMode.RUN, Beat.RUN, homed=True, besides=f"{'; '.join(seen)}; after it")


LIKE_NEW: Final = (
    f"nonce 0, IDLE, not HOMED, no fault, drives off; opens {FAR_INSIDE_MM:g} mm at over "
    f"{MIN_SHARE * UNHOMED_SHARE:g} of the device's speed and {TO_TURN_S:g} s; runs after Home and Hello, not before"
)


@check(Hazard.CLOSES, "Reset", f"in RUN, {FAR_INSIDE_MM:g} mm in, a reset that keeps the memory", LIKE_NEW, moves=True)
def warm_reset(host: Host) -> str:
    """A zero that was kept over a reset by watchdog or pin may be off."""
    return _is_new(host, "warm")


@check(Hazard.CLOSES, "Reset", f"in RUN, {FAR_INSIDE_MM:g} mm in, the supply off and on", LIKE_NEW, moves=True)
def cold_reset(host: Host) -> str:
    return _is_new(host, "cold")


def _by_hand(name: str, hazard: Hazard, sent: str, expected: str) -> Check:
    """Return a rule that only a person with tools can test; it is listed as untested."""

    def perform(host: Host) -> str:
        raise Untested("for the bench, by hand")

    return Check(name, hazard, "Faults", sent, expected, perform, moves=False, is_gate=False)


BY_HAND: Final = (
    _by_hand("overcurrent", Hazard.WORN, "in RUN a carriage held", "OVERCURRENT after 0.15 s; LATCHED"),
    _by_hand("retract_failed", Hazard.SHUT, "a carriage held while RETRACTING", "RETRACT_FAILED"),
    _by_hand("uncommanded_motion", Hazard.CLOSES, "IDLE, a screw turned by 0.3 mm", "UNCOMMANDED_MOTION, opens"),
    _by_hand("supply", Hazard.SHUT, "a supply of 8.5 V, and of 15.5 V", "SUPPLY until Clear, refused meanwhile"),
    _by_hand("temperature", Hazard.WORN, "the sensor warmed to over 60 degC", "TEMPERATURE; as SUPPLY"),
    _by_hand("watchdog", Hazard.CLOSES, "a firmware that hangs in RUN", "a reset within 50 ms, drives off"),
)


@check(
    Hazard.SHUT,
    "Who says what when, 7",
    "Drive OFF; where that does not open, Clear and Retract",
    "both open switches, drives off",
)
def left_open(host: Host) -> str:
    hindrance = host.leave_open()
    return unless(hindrance, f"THE GAP MAY BE SHUT: {hindrance}" if hindrance else shown(host.status))


CHECKS: Final = (warm_reset, cold_reset, *BY_HAND)
