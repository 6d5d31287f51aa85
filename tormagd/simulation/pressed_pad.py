"""The tactile element: from the magnets' gap and the finger's depth in the pad to the force that the finger feels.

The same magnets, screws and field as the brake's, with a `TactilePad` between them, which is richer than any model the
controller uses.
"""

from typing import Final, final

from tormagd.element.physics.field import PAD_RADIUS_M
from tormagd.simulation.element import Warmth
from tormagd.simulation.gap_field import GapField
from tormagd.simulation.parameters import PlantParameters
from tormagd.simulation.tactile_pad import DEEPEST_MM, FASTEST_MM_S, TactilePad, worked_pad

MT_PER_TM: Final = 1e3 / PAD_RADIUS_M


@final
class PressedPad:
    """The worked, rested pad between the magnets, with its state."""

    def __init__(self, plant: PlantParameters, gap_mm: float, dt_s: float) -> None:
        assert plant.pad is not None, "this is the plant of a pad"
        self._dt_s = dt_s
        self._field = GapField(plant, gap_mm)
        self._pad: TactilePad = worked_pad(plant.pad)
        self.warmth = Warmth(plant)
        self.force_N = 0.0

    @property
    def kinetic_N(self) -> float:
        return self.force_N

    def advance(self, time_s: float, gap_mm: float, depth_mm: float, speed_mm_s: float) -> None:
        """Advance by one step that ends at `time_s` and `gap_mm`."""
        field_mT = MT_PER_TM * self._field.advance(gap_mm)
        depth_mm = min(max(depth_mm, 0.0), DEEPEST_MM)
        speed_mm_s = min(max(speed_mm_s, -FASTEST_MM_S), FASTEST_MM_S)
        self.force_N = self.warmth.advance(time_s) * self._pad.advance(self._dt_s, depth_mm, speed_mm_s, field_mT)
