"""Way of the handle: whether it pushes on or withdraws.

pulled   the force is over PULLS_N the other way, whether the encoder shows it yet or not
slid     the encoder shows the handle going the other way, and it came SLID_MM

Either changes the way. A held handle that trembles turns back by what its bristles give, while its hand goes on
pushing: the way stays.
"""

from typing import Final, final

from tormagd.control.records import AT_REST, Measured, Travel

PULLS_N: Final = 0.1
"More than the force sensor's noise and the uncertainty of its zero."
SLID_MM: Final = 0.5
"More than the bristles of the softest elastomer give, at 5 N/mm and 1.5 N either way."


@final
class Way:
    """Follows a brake's handle along the way of the task."""

    travel: Travel = AT_REST
    changed_mm: float = 0.0

    def __init__(self, push_sign: int) -> None:
        self._push_sign: Final = float(push_sign)

    def update(self, measured: Measured | None, zero_N: float, is_sensor_believed: bool) -> Travel:
        before = self.travel
        if measured is None:
            self.travel = Travel(before.place_mm, 0.0, before.is_pushing)
            return self.travel
        turn, place_mm = measured.handle.turn, measured.handle_mm
        # 1 where the encoder shows the handle pushing on, -1 where withdrawing; a positive force resists that motion
        onward = self._push_sign * turn.direction
        is_pushing = before.is_pushing
        has_turned = (onward > 0.0) != is_pushing
        force_N = measured.force_N - turn.direction * zero_N
        if is_sensor_believed and abs(force_N) > PULLS_N:
            is_pushing = (onward > 0.0) == (force_N > 0.0)
        elif has_turned and min(turn.displacement_mm(place_mm), abs(place_mm - self.changed_mm)) > SLID_MM:
            is_pushing = not is_pushing
        self.changed_mm = self.changed_mm if is_pushing == before.is_pushing else place_mm
        self.travel = Travel(*measured.along(self._push_sign), is_pushing)
        return self.travel
