"""Whether a force sensor still shows new values, told from its own noise and resolution.

run      readings of one value, one after the other
stale    the same value although the force has changed by STALE_N and two of the sensor's steps: it teaches nothing
frozen   the same although it has changed by FROZEN_N and two steps. Where the sensor's noise is resolved, also for
         longer than FROZEN_RUNS of its mean runs
"""

import math
from typing import Final, final

STALE_N: Final = 0.03
"Three times the noise of a sensor."
FROZEN_N: Final = 0.15
"A sensor that shows nothing of such a change is broken."
FROZEN_S: Final = 0.1
"No sensor is frozen sooner: it shows ten readings a second at least."
FROZEN_RUNS: Final = 12.0
"White noise as large as a step shows one value so often once in five million times."
RESOLVED: Final = 1.5
ALTERNATES: Final = 0.4
"""A sensor's noise is resolved under two conditions."""
HEARD: Final = 100
"Number of runs that tell a sensor's noise."


@final
class Freshness:
    """Judge of whether one force sensor still shows new values."""

    reading_N: float = math.inf
    "The newest reading; inf before the first."
    still_s: float = 0.0
    "How long the reading has been the same."
    stood_N: float = 0.0
    "The model's force when the reading last changed."
    runs: int = 0
    "Number of runs there were, HEARD at most."
    run_s: float = 0.0
    "Mean length of a run."
    min_run_s: float = math.inf
    "Length of the shortest run."
    change_N: float = 0.0
    "The newest change of the reading, with its sign."
    step_N: float = 0.0
    "The least change of the reading: the sensor's step."
    alternates: float = 0.0
    "Share of the changes that go back on the change before."

    def update(self, scale: float, model_N: float, reading_N: float, dt_s: float, *, learns: bool) -> tuple[bool, bool]:
        """Take one reading, which stands for `dt_s` > 0, and return whether it is stale, and the sensor frozen."""
        if reading_N == self.reading_N:
            self.still_s += dt_s
        else:
            if learns and self.reading_N != math.inf:
                self._take_run(reading_N - self.reading_N, self.still_s + dt_s)
            self.reading_N, self.still_s, self.stood_N = reading_N, 0.0, model_N
        changed_N, steps_N = scale * abs(model_N - self.stood_N), 2.0 * min(self.step_N, FROZEN_N)
        is_long = (
            self.runs == HEARD
            and self.alternates > ALTERNATES
            and self.run_s < RESOLVED * self.min_run_s
            and self.still_s > FROZEN_RUNS * self.run_s
        )
        is_frozen = self.still_s > FROZEN_S and (is_long or changed_N > FROZEN_N + steps_N)
        return changed_N > STALE_N + steps_N, is_frozen

    def _take_run(self, change_N: float, run_s: float) -> None:
        """Learn noise and resolution from a run that lasted `run_s` and ended with a change of `change_N`."""
        self.runs = min(self.runs + 1, HEARD)
        share = 1.0 / self.runs
        self.run_s += share * (run_s - self.run_s)
        self.alternates += share * ((1.0 if change_N * self.change_N < 0.0 else 0.0) - self.alternates)
        self.min_run_s = min(self.min_run_s, run_s)
        self.step_N = abs(change_N) if self.step_N == 0.0 else min(self.step_N, abs(change_N))
        self.change_N = change_N
