"""Checks of all messages that came, and of how the device is left."""

from typing import Final

from firmware_protocol.conformance.check import Hazard, check
from firmware_protocol.conformance.host import SWITCH_MM, Host, Unmet, shown, unless

ALL = "everything, from the start on"


@check(Hazard.MISLED, "Messages", ALL, "only messages that pass: length, CRC-8, ranges; those of a device")
def own_messages(host: Host) -> str:
    return unless(host.refused, listed(host.refused) or "all passed")


@check(
    Hazard.MISLED, "Carriers", ALL, "whole frames, their sequence one more each time (on CAN the controllers see to it)"
)
def own_frames(host: Host) -> str:
    errors = host.line.frame_errors
    return unless(errors, listed(errors) or "all whole")


@check(Hazard.SHUT, "Who says what when, 5", ALL, "no reset: the nonce in Status never falls back to 0")
def no_reset(host: Host) -> str:
    return unless(host.resets, f"the nonce fell back to 0 {host.resets} times")


@check(Hazard.MISLED, "Modes", ALL, "Status does not contradict itself")
def status_consistent(host: Host) -> str:
    return unless(host.contradictions, listed(host.contradictions) or f"at last {shown(host.status)}")


@check(Hazard.SHUT, "Homing", ALL, f"each switch closed at its end of the way, to {SWITCH_MM:g} mm, and only there")
def switches_match_positions(host: Host) -> str:
    """Finds a switch that is stuck or the other carriage's, and a wrong scale."""
    return unless(host.misplaced, listed(host.misplaced) or "all where they should be")


@check(
    Hazard.SHUT,
    "Who says what when, 7",
    "Drive OFF; where that does not open, Clear and Retract",
    "both open switches, drives off",
)
def left_open(host: Host) -> str:
    if hindrance := host.leave_open():
        raise Unmet(f"THE GAP MAY BE SHUT: {hindrance}")
    return shown(host.status)


def listed(counts: dict[str, int]) -> str:
    return ", ".join(f"{what}, {count} times" for what, count in counts.items())


CHECKS: Final = (
    own_messages,
    own_frames,
    no_reset,
    status_consistent,
    switches_match_positions,
)
