"""Whether the handle's encoder is believed.

At rest, friction holds what the hand gives, and more force only comes with a motion of the shaft. So a force that rises
with the gap's force while the encoder stands shows a fault. Either the encoder is lost, or the sensor reads what nobody
feels.
"""

import math
from typing import Final, final

from tormagd.control.interpolation import low_pass

STANDS_MM: Final = 0.01
"A handle that keeps within this stands: just over a count of the encoder."
SETTLES_S: Final = 0.3
"By then what the filters of rate and force keep of a motion has gone."
RISES_N: Final = 0.15
"More than STANDS_MM bends of the stiffest elastomer, 12 N/mm, and noise."
MODEL_RISES_N: Final = 0.1
"Least change of the model's force that shows a moved gap."
FILTER_S: Final = 0.01
UNHEARD_S: Final = 0.1
"After so long without a reading the watch begins anew."
FORGETS_S: Final = 5.0
"Time constant in which the least force is forgotten: a sensor's zero drifts, and an elastomer recovers."


@final
class HandleWatch:
    """Watch on the handle's encoder: compares the force of a resting handle with the model's force at the gap."""

    at_mm: float = math.inf
    "The encoder's place at which the handle stands."
    heard_s: float = 0.0
    "When the newest reading was sensed, on the host's clock."
    still_s: float = 0.0
    "How long the handle has stood."
    force_N: float = 0.0
    "Mean magnitude of the force over FILTER_S."
    min_N: float = 0.0
    "The least of these means since the handle stands."
    min_model_N: float = 0.0
    "The model's force at that time."
    rested_N: float = 0.0
    "The model's force when the handle came to stand."
    is_lost: bool = False
    "Whether the encoder is lost: it is not believed until it moves."

    def moved_gap_at_rest(self, model_N: float) -> bool:
        """Tell whether the gap's force has changed by more than MODEL_RISES_N since the handle came to stand."""
        return abs(model_N - self.rested_N) > MODEL_RISES_N

    def update(self, sensed_s: float, handle_mm: float, reading_N: float, model_N: float) -> None:
        """Take one reading of handle and force, and update `is_lost`."""
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
