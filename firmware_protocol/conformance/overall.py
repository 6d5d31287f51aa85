"""Checks of all messages that came; and the last one, of how the device is left."""

from typing import Final

from firmware_protocol.conformance.check import Hazard, check
from firmware_protocol.conformance.host import SWITCH_MM, Host, Unmet, shown, unless

ALL = "everything, from the start on"


@check(Hazard.MISLED, "Messages", ALL, "only messages that pass: length, CRC-8, ranges; those of a device")
def own_messages(host: Host) -> str:
    """Check that no message of the device was refused."""
    return unless(host.refused, listed(host.refused) or "all passed")


@check(
    Hazard.MISLED, "Carriers", ALL, "whole frames, their sequence one more each time (on CAN the controllers see to it)"
)
def own_frames(host: Host) -> str:
    """Check COBS, CRC-16 and sequence of the device's frames."""
    errors = host.line.frame_errors
    return unless(errors, listed(errors) or "all whole")


@check(Hazard.SHUT, "Who says what when, 5", ALL, "no reset: the nonce in Status never falls back to 0")
def no_reset(host: Host) -> str:
    """Check that nothing that the host sent has reset the device."""
    return unless(host.resets, f"the nonce fell back to 0 {host.resets} times")


@check(Hazard.MISLED, "Modes", ALL, "Status does not contradict itself")
def status_consistent(host: Host) -> str:
    """Check that no Status contradicts itself."""
    return unless(host.contradictions, listed(host.contradictions) or f"at last {shown(host.status)}")


@check(Hazard.SHUT, "Homing", ALL, f"each switch closed at its end of the way, to {SWITCH_MM:g} mm, and only there")
def switches_match_positions(host: Host) -> str:
    """Check that end switches fit the positions: a switch is neither stuck nor another one's, a way to scale."""
    return unless(host.misplaced, listed(host.misplaced) or "all where they should be")


@check(
    Hazard.SHUT,
    "Who says what when, 7",
    "Drive OFF; where that does not open, Clear and Retract",
    "both open switches, drives off",
)
def left_open(host: Host) -> str:
    """Open the gap, and check that it is open: however it went, the device is left in its safe state."""
    if hindrance := host.leave_open():
        raise Unmet(f"THE GAP MAY BE SHUT: {hindrance}")
    return shown(host.status)


def listed(counts: dict[str, int]) -> str:
    """Return things and how often each came, in words."""
    return ", ".join(f"{what}, {count} times" for what, count in counts.items())


CHECKS: Final = (
    own_messages,
    own_frames,
    no_reset,
    status_consistent,
    switches_match_positions,
)
