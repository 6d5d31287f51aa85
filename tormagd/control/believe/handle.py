"""Whether the handle's encoder is believed: a force that grows with the gap's is that of a shaft that moves.

Friction at rest holds what the hand gives it, through elastomer that bends. It may fall where the gap opens, and comes
back only with a motion, of the force over the stiffness. So where the measured force rises as the gap's does and the
encoder stands, the encoder is lost, or the sensor reads what nobody feels.
"""

import math
from typing import Final, final

from tormagd.control.filter import low_pass

STANDS_MM: Final = 0.01
"Just over a count of the encoder: a handle within it stands."
SETTLES_S: Final = 0.3
"What the rate's filter leaves of a motion, and what the force sensor still has to tell of it, has gone by then."
RISES_N: Final = 0.15
"More than STANDS_MM bends of the stiffest elastomer, 12 N/mm, and noise."
MODEL_RISES_N: Final = 0.1
"By so much the gap has to have moved, in the model's force: the strongest believable device makes 1.53 times as much."
FILTER_S: Final = 0.01
UNHEARD_S: Final = 0.1
"After so long without a reading it is watched anew."
FORGETS_S: Final = 5.0
"A sensor's zero drifts, and an elastomer recovers: the least force of so long ago is none any more."


@final
class HandleWatch:
    """Compares the force of a handle that stands with the one that the gap gives."""

    at_mm: float = math.inf
    "Where the handle stands."
    heard_s: float = 0.0
    still_s: float = 0.0
    "For how long it stands."
    force_N: float = 0.0
    "Mean size of the force over FILTER_S."
    min_N: float = 0.0
    "The least of it since the handle stands."
    min_model_N: float = 0.0
    "What the model gave then."
    rested_N: float = 0.0
    "What the model gave when the handle came to stand."
    is_lost: bool = False
    "The encoder is not believed until it moves."

    def moved_gap_at_rest(self, model_N: float) -> bool:
        """Whether the handle stands since before the gap went to where the model gives `model_N`: friction at rest does
        not follow, though the handle's filtered rate may still say that it moves."""
        return abs(model_N - self.rested_N) > MODEL_RISES_N

    def update(self, sensed_s: float, handle_mm: float, reading_N: float, model_N: float) -> None:
        """Takes a reading of handle and force, where the model gives `model_N` at the measured gap."""
        dt_s = sensed_s - self.heard_s
        if not dt_s > 0.0:
            return
        self.heard_s = sensed_s
        size_N = abs(reading_N)
        if dt_s > UNHEARD_S or abs(handle_mm - self.at_mm) > STANDS_MM:
            self.at_mm, self.still_s, self.force_N, self.is_lost = handle_mm, 0.0, size_N, False
            self.min_N, self.min_model_N, self.rested_N = size_N, model_N, model_N
            return
        self.still_s += dt_s
        self.force_N = low_pass(self.force_N, size_N, dt_s, FILTER_S)
        if self.still_s < SETTLES_S or self.force_N <= self.min_N:
            self.min_N, self.min_model_N = self.force_N, model_N
            return
        self.min_N = low_pass(self.min_N, self.force_N, dt_s, FORGETS_S)
        self.min_model_N = low_pass(self.min_model_N, model_N, dt_s, FORGETS_S)
        if self.force_N - self.min_N > RISES_N and model_N - self.min_model_N > MODEL_RISES_N:
            self.is_lost = True
