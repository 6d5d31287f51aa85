"""Whether the handle's encoder is believed: a force that grows with the gap is that of a shaft that moves.

Friction at rest holds what the hand gives it, through elastomer that bends: it may fall where the gap opens, and comes
back only with a motion, of the force over the stiffness. So where the measured force rises as the gap's does, and the
encoder stands, the encoder is lost (or the sensor reads what nobody feels). A force that does not change shows nothing.
"""

import math
from typing import Final, final

from firmware_protocol.value import Value

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
class HandleWatch(Value):
    """A handle that has stood at `at_mm` for `still_s`, as heard at `heard_s`; the mean of the force's size over
    FILTER_S, the least of it since, and what the model gave then. `rested_N` is what the model gave when it came to
    stand. `is_lost`: it is not believed until it moves."""

    def __init__(
        self,
        at_mm: float = math.inf,
        heard_s: float = 0.0,
        still_s: float = 0.0,
        force_N: float = 0.0,
        least_N: float = 0.0,
        least_model_N: float = 0.0,
        rested_N: float = 0.0,
        is_lost: bool = False,
    ) -> None:
        self.at_mm: Final = at_mm
        self.heard_s: Final = heard_s
        self.still_s: Final = still_s
        self.force_N: Final = force_N
        self.least_N: Final = least_N
        self.least_model_N: Final = least_model_N
        self.rested_N: Final = rested_N
        self.is_lost: Final = is_lost

    def outlasts(self, model_N: float) -> bool:
        """Whether it has stood since before the gap moved to where the model gives `model_N`, though its filtered rate
        says more: friction at rest does not follow."""
        return abs(model_N - self.rested_N) > MODEL_RISES_N

    def heard(self, sensed_s: float, handle_mm: float, reading_N: float, model_N: float) -> "HandleWatch":
        """The same after one more reading of handle and force, where the model gives `model_N` at the measured gap."""
        elapsed_s = sensed_s - self.heard_s
        if not elapsed_s > 0.0:
            return self
        size_N = abs(reading_N)
        if elapsed_s > UNHEARD_S or abs(handle_mm - self.at_mm) > STANDS_MM:
            return HandleWatch(handle_mm, sensed_s, 0.0, size_N, size_N, model_N, model_N)
        still_s = self.still_s + elapsed_s
        force_N = self.force_N + elapsed_s / (FILTER_S + elapsed_s) * (size_N - self.force_N)
        if still_s < SETTLES_S or force_N <= self.least_N:
            return HandleWatch(self.at_mm, sensed_s, still_s, force_N, force_N, model_N, self.rested_N, self.is_lost)
        share = elapsed_s / (FORGETS_S + elapsed_s)
        least_N = self.least_N + share * (force_N - self.least_N)
        least_model_N = self.least_model_N + share * (model_N - self.least_model_N)
        has_risen = force_N - least_N > RISES_N and model_N - least_model_N > MODEL_RISES_N
        is_lost = self.is_lost or has_risen
        return HandleWatch(self.at_mm, sensed_s, still_s, force_N, least_N, least_model_N, self.rested_N, is_lost)


UNHEARD: Final = HandleWatch()
