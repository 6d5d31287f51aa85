"""What a force model calls displacement: the handle's travel at the roller since it last turned."""

from typing import Final, final

from firmware_protocol.value import Value

TURN_MM: Final = 0.05
"A handle that goes back by more (6 counts of its encoder) has turned."
MOBILISED_MM: Final = 2.0
"Friction is fully mobilised from here on, whatever the insert."
MOVING_MM_S: Final = 5.0
"A slower handle teaches nothing, and no force is planned for it: its friction may be static."


@final
class Turn(Value):
    """Where a handle last turned, which way it has gone since (1 or -1), and how far it has been."""

    def __init__(self, direction: float, turned_mm: float, furthest_mm: float) -> None:
        self.direction: Final = direction
        self.turned_mm: Final = turned_mm
        self.furthest_mm: Final = furthest_mm

    def moved_to(self, position_mm: float) -> "Turn":
        beyond_mm = position_mm - self.furthest_mm
        if beyond_mm * self.direction >= 0.0:
            return self if beyond_mm == 0.0 else Turn(self.direction, self.turned_mm, position_mm)
        if abs(beyond_mm) > TURN_MM:
            return Turn(-self.direction, self.furthest_mm, position_mm)
        return self

    def displacement_mm(self, position_mm: float) -> float:
        return min(abs(position_mm - self.turned_mm), MOBILISED_MM)
