"""Whether the handle's encoder is believed: a force that grows with the gap's force needs a shaft that moves.

At rest, friction holds what the hand gives, and more force only comes with a motion of the shaft. So a force that rises
with the gap's, while the encoder stands, shows a lost encoder, or a sensor that reads what nobody feels.
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
"Least change of the model's force that shows a moved gap."
FILTER_S: Final = 0.01
UNHEARD_S: Final = 0.1
"After so long without a reading it is watched anew."
FORGETS_S: Final = 5.0
"A sensor's zero drifts, and an elastomer recovers: the least force of so long ago is none any more."


@final
class HandleWatch:
    """Watch on the encoder: compares the force of a resting handle with the model's force at the gap."""

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
        """Tell whether the model's force has changed to `model_N` by more than MODEL_RISES_N since the handle came to
        stand.

        Friction at rest does not follow a changing gap.
        """
        return abs(model_N - self.rested_N) > MODEL_RISES_N

    def update(self, sensed_s: float, handle_mm: float, reading_N: float, model_N: float) -> None:
        """Take one reading of handle and force, with the model's force `model_N` at the measured gap.

        May set `is_lost`; a motion, or a pause of more than UNHEARD_S, clears it. A `sensed_s` (host time) that is not
        newer changes nothing.
        """
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
