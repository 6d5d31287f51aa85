"""Whether the handle pushes on or withdraws.

withdrawing   it has turned back, and either the hand pulls: the force that holds it has changed its sign; or it has
              come back by SLID_MM

A held handle that trembles turns back by what bristles give, but its hand goes on pushing: its way stays.
"""

from typing import Final, final

from tormagd.control.records import AT_REST, Measured, Travel

PULLS_N: Final = 0.1
"More than noise and drift of a force sensor."
SLID_MM: Final = 0.5
"More than the bristles of the softest elastomer give, 5 N/mm at 1.5 N either way."


@final
class Way:
    """The stage that follows the handle of a brake along the way of the task."""

    travel: Travel = AT_REST
    "At the newest measurement; at rest while there is none."

    def __init__(self, push_sign: int) -> None:
        """`push_sign` is 1 where a handle that pushes on moves to greater places of its encoder, else -1."""
        self._push_sign: Final = float(push_sign)

    def update(self, measured: Measured | None, is_sensor_believed: bool) -> Travel:
        """Return where the handle is and goes. A force sensor that is not believed does not show which way."""
        before = self.travel
        if measured is None:
            self.travel = Travel(before.place_mm, 0.0, before.is_pushing)
            return self.travel
        turn = measured.handle.turn
        # how far it is against the way that it is known to go, and which force resists that
        onward = self._push_sign * turn.direction
        is_pushing = before.is_pushing
        if (onward > 0.0) != is_pushing:
            is_pulled = is_sensor_believed and measured.force_N > PULLS_N
            if is_pulled or turn.displacement_mm(measured.handle_mm) > SLID_MM:
                is_pushing = not is_pushing
        self.travel = Travel(self._push_sign * measured.handle_mm, onward * measured.handle.quick_mm_s, is_pushing)
        return self.travel
