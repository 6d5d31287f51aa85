"""All checks in their order: first those that move nothing."""

from collections.abc import Sequence

from firmware_protocol.codec import FUNCTION, Drive
from firmware_protocol.conformance import (
    bench,
    damage,
    homing,
    meeting,
    opening,
    overall,
    running,
    silence,
    streams,
    stroke,
)
from firmware_protocol.conformance.check import Check
from firmware_protocol.conformance.line import Line


def checks_on(line: Line) -> Sequence[Check]:
    """Return all checks but those of damages that the line's carrier cannot do."""
    damages = line.damages(FUNCTION[Drive], b"")
    return [one for one in CHECKS if one not in damage.ON_A_CARRIER or one.name in damages]


CHECKS = (
    *meeting.CHECKS,
    *streams.CHECKS,
    *damage.CHECKS,
    *damage.ON_A_CARRIER,
    *homing.CHECKS,
    *running.CHECKS,
    *stroke.CHECKS,
    *opening.CHECKS,
    *silence.CHECKS,
    *overall.CHECKS,
    *bench.CHECKS,
    overall.left_open,
)
