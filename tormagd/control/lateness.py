"""How late a device's carriages are behind the gap that is planned: weaker motors than were believed come late.

Expected is the planned gap behind a lag of first order, and the lag is the one with which the carriages are found
nearest to that: least squares, in which what is known fades. So the plan may set out sooner by it without the lag
growing for that; and as an error counts with the speed, slow stretches, on which nobody is late, do not hide that
a steep one is.
"""

from typing import Final, final

from firmware_protocol.value import Value

MOST_LAG_S: Final = 0.06
"Carriages that are later are not followed: the latest of the plant card's, sample 2's in palpation, are by 50 ms."
FADES_S: Final = 3.0
"What is known of a lag fades in this time, while it is known what comes."
DOUBTED_MM2_S: Final = 50.0
"""A first motion that took so much speed squared times its time, 35 ms at full speed, is believed by half. Chosen with
FADES_S on sample 1 with its inertia, 1.7 and 2.5 times of it (a finger's and an artery's pulse, that of `make run`); 25
to 150, and 2 to 5 s, miss those by the same, to half a millinewton."""
CAUGHT_UP_MM: Final = 0.1
"After a jump, which leaves any carriages behind, they are on their way until they have come so near."
LONGEST_S: Final = 0.02
"A longer pause between plans counts as this."
MEASURED_S: Final = 0.0015
"So long before a plan its carriages were measured."


@final
class Lateness(Value):
    """`lag_s`, 0 to MOST_LAG_S; `motion_mm2_s`, how much motion taught it; `expected_mm`, where the gap is expected,
    None where it was not known what comes; `is_on_its_way` after a jump."""

    def __init__(
        self,
        lag_s: float = 0.0,
        motion_mm2_s: float = 0.0,
        expected_mm: float | None = None,
        is_on_its_way: bool = False,
    ) -> None:
        self.lag_s: Final = lag_s
        self.motion_mm2_s: Final = motion_mm2_s
        self.expected_mm: Final = expected_mm
        self.is_on_its_way: Final = is_on_its_way


ON_TIME: Final = Lateness()


def surprised(before: Lateness) -> Lateness:
    """What is known after a plan that did not know what comes: the same lag. Where the gap is expected begins anew, and
    so does whether it is on its way."""
    return before if before.expected_mm is None else Lateness(before.lag_s, before.motion_mm2_s)


def found(
    before: Lateness, elapsed_s: float, planned_mm: float, gap_mm: float, speed_mm_s: float, fastest_mm_s: float
) -> Lateness:
    """What is known once a gap was planned, `elapsed_s` after the one before, where it was known what comes; and the
    carriages were measured at `gap_mm` with `speed_mm_s` just before. None are faster than `fastest_mm_s`."""
    elapsed_s = min(max(elapsed_s, 0.0), LONGEST_S)
    # an estimate that has just begun may show any speed
    speed_mm_s = min(max(speed_mm_s, -fastest_mm_s), fastest_mm_s)
    expected_mm, lag_s, motion_mm2_s = before.expected_mm, before.lag_s, before.motion_mm2_s
    if expected_mm is None:
        expected_mm = planned_mm
    elif elapsed_s > 0.0:
        expected_mm += elapsed_s / (lag_s + elapsed_s) * (planned_mm - expected_mm)
    behind_mm = expected_mm - gap_mm - speed_mm_s * MEASURED_S
    if abs(behind_mm) > (CAUGHT_UP_MM if before.is_on_its_way else MOST_LAG_S * fastest_mm_s):
        return Lateness(lag_s, motion_mm2_s, expected_mm, True)
    motion_mm2_s += elapsed_s * (speed_mm_s * speed_mm_s - motion_mm2_s / FADES_S)
    lag_s += elapsed_s * behind_mm * speed_mm_s / (DOUBTED_MM2_S + motion_mm2_s)
    return Lateness(min(max(lag_s, 0.0), MOST_LAG_S), motion_mm2_s, expected_mm)
