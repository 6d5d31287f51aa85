"""All checks in their order: first those that move nothing."""

from collections.abc import Sequence

from firmware_protocol.conformance import bench, moving, taking, telling
from firmware_protocol.conformance.check import Check
from firmware_protocol.conformance.line import Line, SerialLine


def checks_on(line: Line) -> Sequence[Check]:
    """Return all checks but that of a serial line's frames on a bus."""
    return [one for one in CHECKS if isinstance(line, SerialLine) or one is not telling.frames_as_they_come]


CHECKS = (
    *telling.STREAMS,
    *moving.GATES,
    *taking.CHECKS,
    *moving.CHECKS,
    *telling.OVERALL,
    *bench.CHECKS,
    bench.left_open,
)
