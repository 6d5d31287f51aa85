"""What the handle's motion says of friction, and whether its encoder is believed.

creep     the rate that counts: a rise at once, a fall over SLOWS_S
followed  the model's force m as far as friction has it: a fall at once, of a rise 1 - exp(-k x / m) after x mm
lost      at rest, friction holds what the hand gives, and more force only comes with a motion of the shaft. So a
          force that rises with the gap's force while the encoder stands shows a fault: the encoder is lost, or the
          sensor reads what nobody feels
"""

import math
from typing import Final, final

from tormagd.control.believe.slow_friction import STRIBECK_MM_S
from tormagd.control.interpolation import low_pass
from tormagd.control.records import Measured

FASTEST_MM_S: Final = 2.0 * STRIBECK_MM_S
"A faster handle does not creep."
SLOWS_S: Final = 0.1
"A handle that sticks for a moment does not creep."
BRISTLES_N_MM: Final = 8.0
"Stiffness k of the contact's bristles, sample 1's (plant card)."
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
    """Watch on one handle: how slowly it slides, how far friction has followed, and whether its encoder is lost."""

    creep_mm_s: float = FASTEST_MM_S
    "The rate that counts as the handle's, as far as it creeps."
    followed_N: float = 0.0
    "The model's force as far as friction has followed it."
    handle_mm: float = 0.0
    "Where the handle was when it last followed."
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

    def update(self, measured: Measured, model_N: float) -> float:
        """Take what is `measured` at a gap that gives the model's force `model_N`, and return `followed_N`."""
        rise_N = model_N - self.followed_N
        if rise_N > 0.0 and model_N > 0.0:
            rise_N *= 1.0 - math.exp(-BRISTLES_N_MM * abs(measured.handle_mm - self.handle_mm) / model_N)
        self.followed_N += rise_N
        self.handle_mm = measured.handle_mm
        dt_s = measured.sensed_s - self.heard_s
        if dt_s > 0.0:
            self.heard_s = measured.sensed_s
            from_mm_s, level_mm_s = min(self.creep_mm_s, FASTEST_MM_S), measured.handle.sliding_mm_s
            self.creep_mm_s = level_mm_s + max(from_mm_s - level_mm_s, 0.0) * SLOWS_S / (SLOWS_S + dt_s)
            self._watch(measured.handle_mm, abs(measured.force_N), model_N, dt_s)
        return self.followed_N

    def _watch(self, handle_mm: float, size_N: float, model_N: float, dt_s: float) -> None:
        """Update `is_lost` with the size of the force, `size_N`, `dt_s` after the reading before."""
        if dt_s > UNHEARD_S or abs(handle_mm - self.at_mm) > STANDS_MM:
            self.at_mm, self.still_s, self.force_N, self.is_lost = handle_mm, 0.0, size_N, False
            self.min_N, self.min_model_N, self.rested_N = size_N, model_N, model_N
            return
        self.still_s += dt_s
        self.force_N = low_pass(self.force_N, size_N, dt_s, FILTER_S)
        forgets_s = 0.0 if self.still_s < SETTLES_S or self.force_N <= self.min_N else FORGETS_S
        self.min_N = low_pass(self.min_N, self.force_N, dt_s, forgets_s)
        self.min_model_N = low_pass(self.min_model_N, model_N, dt_s, forgets_s)
        self.is_lost = self.is_lost or (
            self.force_N - self.min_N > RISES_N and model_N - self.min_model_N > MODEL_RISES_N
        )
