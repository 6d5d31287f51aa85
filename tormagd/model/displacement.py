"""What a force model calls displacement: the handle's travel at the roller since it last turned."""

from typing import Final, final

from firmware_protocol.value import Value

TURN_MM: Final = 0.05
"A handle motion against the last direction counts as a reversal from here on: 6 counts of its encoder."
MOBILISED_MM: Final = 2.0
"Displacement saturates here: friction is fully mobilised, whatever the insert."
MOVING_MM_S: Final = 5.0
"Slower handles teach no model and no trim, and no force is planned for them: their friction may be static."


@final
class Turn(Value):
    """The way the handle goes, 1 or -1, where it last turned, mm, and the furthest it has been since, mm."""

    def __init__(self, direction: float, turned_mm: float, furthest_mm: float) -> None:
        self.direction: Final = direction
        self.turned_mm: Final = turned_mm
        self.furthest_mm: Final = furthest_mm

    def moved_to(self, position_mm: float) -> "Turn":
        """The same after the handle moved there. It turned where it was furthest, not where we became sure of it."""
        beyond_mm = position_mm - self.furthest_mm
        if beyond_mm * self.direction >= 0.0:
            return self if beyond_mm == 0.0 else Turn(self.direction, self.turned_mm, position_mm)
        if abs(beyond_mm) > TURN_MM:
            return Turn(-self.direction, self.furthest_mm, position_mm)
        return self

    def displacement_mm(self, position_mm: float) -> float:
        """Travel from the turn to there, saturating at MOBILISED_MM."""
        return min(abs(position_mm - self.turned_mm), MOBILISED_MM)
