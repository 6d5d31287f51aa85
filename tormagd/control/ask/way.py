"""Whether the handle pushes on or withdraws.

withdrawing   it has turned back, and either the hand pulls: the force that holds it has changed its sign; or it has
              come back by SLID_MM. Or the force has turned by UNSEEN_N, and the encoder shows nothing

A held handle that trembles turns back by what bristles give, but its hand goes on pushing: its way stays.
"""

from typing import Final, final

from tormagd.control.records import AT_REST, Measured, Travel

PULLS_N: Final = 0.1
"More than noise and drift of a force sensor."
UNSEEN_N: Final = 0.5
"Bristles give more than the encoder's reversal before a hand pulls so hard: the encoder stands still."
SLID_MM: Final = 0.5
"More than the bristles of the softest elastomer give, 5 N/mm at 1.5 N either way."


def place_and_rate(measured: Measured, push_sign: float) -> tuple[float, float]:
    """Return where the handle is, mm, and how it moves, mm/s, positive pushing on."""
    handle = measured.handle
    return push_sign * measured.handle_mm, push_sign * handle.turn.direction * handle.quick_mm_s


@final
class Way:
    """The stage that follows the handle of a brake along the way of the task."""

    travel: Travel = AT_REST
    "At the newest measurement; at rest while there is none."
    changed_mm: float = 0.0
    "The encoder's place where the way last changed."

    def __init__(self, push_sign: int) -> None:
        """`push_sign` is 1 where a handle that pushes on moves to greater places of its encoder, else -1."""
        self._push_sign: Final = float(push_sign)

    def update(self, measured: Measured | None, is_sensor_believed: bool) -> Travel:
        """Return where the handle is and goes. A force sensor that is not believed does not show which way."""
        before = self.travel
        if measured is None:
            self.travel = Travel(before.place_mm, 0.0, before.is_pushing)
            return self.travel
        turn, place_mm = measured.handle.turn, measured.handle_mm
        # how far it is against the way that it is known to go, and which force resists that
        onward = self._push_sign * turn.direction
        is_pushing = before.is_pushing
        has_turned = (onward > 0.0) != is_pushing
        if is_sensor_believed and measured.force_N > PULLS_N:
            is_pushing = onward > 0.0
        elif is_sensor_believed and measured.force_N < -UNSEEN_N:
            is_pushing = onward < 0.0
        elif has_turned and min(turn.displacement_mm(place_mm), abs(place_mm - self.changed_mm)) > SLID_MM:
            is_pushing = not is_pushing
        if is_pushing != before.is_pushing:
            self.changed_mm = place_mm
        self.travel = Travel(*place_and_rate(measured, self._push_sign), is_pushing)
        return self.travel
