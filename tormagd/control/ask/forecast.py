"""Forecast of a force that repeats itself, as a pulse does, past what the setpoints preview.

The newest stretch of force, as a delay embedding, is compared with those remembered. What followed those tells what
will follow the newest (analogue forecasting, Lorenz, J. Atmos. Sci. 26, 1969; locally weighted linear regression,
Cleveland and Devlin, J. Am. Stat. Assoc. 83, 1988).

The stretch is as long as the rise of a pulse. The forecast has to earn trust by its skill over the slope, which is
extrapolated otherwise.
"""

import math
from typing import Final, final

import numpy as np
import numpy.typing as npt

from firmware_protocol.value import Value
from tormagd.control.interpolation import at_step, low_pass
from tormagd.element.model.force_curve import within

DOUBT_N: Final = 0.02
"Before an error is judged, the two guesses count as this far apart and equally good."
FORGIVEN_N: Final = 0.003
"Differences as small as this neither earn trust nor lose it."


@final
class Skill(Value):
    """Skill of one guess over another, as running means of squares, N²."""

    def __init__(self, gained: float, apart: float) -> None:
        self.gained: Final = gained
        self.apart: Final = apart

    def after(self, error_N: float, other_error_N: float, time_s: float) -> "Skill":
        """Return the skill over `time_s` after both guesses' newest errors."""
        apart_N, dt_s = other_error_N - error_N, EVERY * GRID_S
        gained = low_pass(self.gained, apart_N * (other_error_N + error_N), dt_s, time_s)
        return Skill(gained, low_pass(self.apart, apart_N * apart_N, dt_s, time_s))

    @property
    def score(self) -> float:
        return self.gained / (self.apart + FORGIVEN_N * FORGIVEN_N)


GRID_S: Final = 0.01
"Step of the time grid of remembered forces. The counts below are in its points."
HISTORY: Final = 1_000
"Ten seconds: a dozen heart beats, or two breaths."
MIN_HISTORY: Final = 100
"Nothing is forecast from fewer points."
DELAYS: Final = (1, 2, 4, 7, 11)
"A stretch is compared at these points before its end, as changes from the end."
TAPS: Final = 5
STRIDE: Final = 3
"Every third stretch of the history is compared."
HORIZON: Final = 8
"A plan looks 30 ms ahead, and further by the carriages' lag."
EVERY: Final = 2
"A forecast takes several times as long as a plan."
JUDGED: Final = 4
"Forecasts are judged in the middle of what a plan looks at."
MAX_STEP_S: Final = 0.1
"Setpoints that are further apart are no stream."
SAME_N: Final = 1e-4
"Stretches that differ by no more are the same: a tenth of what the force sensor resolves."
UNLIKE_N: Final = 0.05
"Nothing is forecast where every stretch differs by more. On sample 1, 30 mN do as well, 80 a little worse."
RIDGE: Final = 0.01
"Raises the regression's variances, because stretches that hardly differ teach nothing."
LONG_S: Final = 2.0
SHORT_S: Final = 0.2
"Skill is earned over the long time, a few beats, and lost over the short one."
_BYTES: Final = 8
"Of each point of the history."


_PLACES: Final = np.array([*[-delay for delay in DELAYS], *range(HORIZON + 1)])[:, None]
EMBEDDING: Final = np.concatenate(
    [np.minimum(_PLACES - 1, -1), _PLACES + np.arange(-1 - HORIZON, DELAYS[-1] - HISTORY - 1, -STRIDE)], axis=1
)
"The places of all stretches in a full history, as indices from its end; shape (TAPS + 1 + HORIZON, n)."
CONSTANT: Final = np.eye(TAPS + 1)[TAPS]
VARIANCES: Final = np.diag([*[1.0] * TAPS, 0.0])
"Where a regression's sums have the constant, and the variances that a ridge raises."


Guess = tuple[float, float]
"What was said of the force at one point of the grid: by the forecast, and by the slope."
NOTHING_SAID: Final[tuple[Guess | None, ...]] = (None,) * JUDGED
LOST: Final = Skill(-DOUBT_N * DOUBT_N, DOUBT_N * DOUBT_N)
"Where no stretch is like the newest one, the next forecast has to earn trust again."


@final
class Forecast:
    """Learns one stream of setpoints, and forecasts how its force goes on."""

    stamp_s: float
    "-inf before the first setpoint."
    force_N: float
    time_s: float
    history: bytes
    "The forces on the grid, float64, newest last."
    from_s: float
    "The point of the grid from which the forecast was made; -inf without one."
    changes_N: list[float]
    "The forecast changes of force from that point to itself and to the points ahead."
    awaited: tuple[Guess | None, ...]
    "Guesses for the next points of the grid; None where none was made."
    long: Skill
    short: Skill

    def __init__(self) -> None:
        self.forget()

    @property
    def trust(self) -> float:
        """Return how far the forecast takes the place of the slope, 0..1."""
        earned, kept = self.long.score, 1.0 + self.short.score
        return within(earned, (0.0, 1.0)) * within(kept, (0.0, 1.0)) if self.changes_N else 0.0

    def forget(self, stamp_s: float = -math.inf, force_N: float = 0.0, history: bytes = b"") -> None:
        """Begin with one setpoint, or with none."""
        self.stamp_s, self.force_N, self.time_s, self.history = stamp_s, force_N, stamp_s, history
        self.from_s, self.changes_N, self.awaited = -math.inf, [], NOTHING_SAID
        self.long, self.short = Skill(0.0, DOUBT_N * DOUBT_N), Skill(0.0, 0.0)

    def update(self, stamp_s: float, force_N: float) -> None:
        """Take one setpoint: judge what was forecast for its time, and remember it."""
        if -GRID_S < stamp_s - self.stamp_s < 0.0:
            stamp_s = self.stamp_s  # the clocks of publisher and daemon are read at slightly different times
        spacing_s = stamp_s - self.stamp_s
        if not 0.0 <= spacing_s <= MAX_STEP_S:
            self.forget(stamp_s, force_N, np.float64(force_N).tobytes())
            return
        count = int((stamp_s - self.time_s) / GRID_S)
        if count > 0 and spacing_s > 0.0:
            self._advance(stamp_s, force_N, count)
        self.stamp_s, self.force_N = stamp_s, force_N

    def foresee(self, slope_N_s: float) -> bool:
        """Make a forecast from the newest point of the grid, and return whether one was due."""
        if self.time_s - self.from_s < (EVERY - 0.5) * GRID_S or len(self.history) < MIN_HISTORY * _BYTES:
            return False
        self.from_s, self.changes_N = self.time_s, _search(np.frombuffer(self.history))
        said: Guess | None = None
        if self.changes_N:
            since = (self.stamp_s - self.time_s) / GRID_S
            said = self.from_N() + self.changes_N[JUDGED], self.force_N + slope_N_s * GRID_S * (JUDGED - since)
        else:
            self.short = LOST
        self.awaited = (*self.awaited[:-1], said)
        return True

    def from_N(self) -> float:
        """Return the force that the forecast was made from, so that it meets the newest setpoint."""
        return self.force_N - at_step((self.stamp_s - self.from_s) / GRID_S, self.changes_N)

    def force_at_N(self, after_s: float, from_N: float) -> float:
        """Return the forecast force at `after_s` after the newest setpoint's stamp."""
        return from_N + at_step((self.stamp_s - self.from_s + after_s) / GRID_S, self.changes_N)

    def _advance(self, stamp_s: float, force_N: float, count: int) -> None:
        """Add `count` points to the grid, and judge the guesses for them."""
        spacing_s = stamp_s - self.stamp_s
        per_s, before_s = (force_N - self.force_N) / spacing_s, self.time_s - self.stamp_s
        came_N = [self.force_N + per_s * (before_s + GRID_S * step) for step in range(1, count + 1)]
        self.history = (self.history + np.array(came_N).tobytes())[-HISTORY * _BYTES :]
        self.time_s += GRID_S * count
        for came, guess in zip(came_N, self.awaited):  # noqa: B905 only such a zip is compiled to a plain loop
            if guess is not None:
                error_N, slope_error_N = guess[0] - came, guess[1] - came
                self.long = self.long.after(error_N, slope_error_N, LONG_S)
                self.short = self.short.after(error_N, slope_error_N, SHORT_S)
        self.awaited = (*self.awaited, *NOTHING_SAID)[min(count, JUDGED) :][:JUDGED]


def _search(history: npt.NDArray[np.float64]) -> list[float]:
    """Forecast: return the changes of force, N, from the newest point to itself and to the points ahead, if any."""
    places = EMBEDDING[:, : (len(history) - DELAYS[-1] - 1 - HORIZON) // STRIDE + 2]
    changes = history.take(places, mode="wrap")
    changes -= changes[TAPS]
    before = changes[:TAPS]
    before -= before[:, :1].copy()
    apart = (before * before).sum(axis=0) + TAPS * SAME_N**2
    apart[0] = math.inf
    changes[TAPS] = 1.0
    sums = (changes[: TAPS + 1] / (apart * apart)) @ changes.T
    total, variance = sums[TAPS, TAPS], (sums[:, : TAPS + 1] * VARIANCES).sum()
    ridge = RIDGE / TAPS * variance + SAME_N**2 * total
    # the regression's constants are the last row of the inverse times the sums
    last = np.linalg.solve(sums[:, : TAPS + 1] + ridge * VARIANCES, CONSTANT)
    if apart.min() > TAPS * UNLIKE_N * UNLIKE_N:
        return []
    return [0.0, *(last @ sums[:, TAPS + 1 :]).tolist()]
