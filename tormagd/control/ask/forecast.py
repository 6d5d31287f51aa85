"""Forecast of a force that repeats itself, as a pulse does, where the setpoints bring no preview.

The newest stretch of force, as a delay embedding, is compared with those remembered. What followed those tells what
will follow the newest (analogue forecasting, Lorenz, J. Atmos. Sci. 26, 1969; locally weighted linear regression,
Cleveland and Devlin, J. Am. Stat. Assoc. 83, 1988).

One embedding is as long as the rise of a pulse, another as half its beat; the one with less recent error counts more.
The forecast has to earn trust by its skill over the slope, which is extrapolated otherwise.
"""

import math
from array import array
from typing import Final, final

import numpy as np
import numpy.typing as npt

from firmware_protocol.value import Value
from tormagd.control.interpolation import at_step
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

    def after(self, error_N: float, other_error_N: float, share: float) -> "Skill":
        """Return the skill after both guesses' newest errors, weighted by `share`."""
        apart_N = other_error_N - error_N
        gained = apart_N * (other_error_N + error_N)
        return Skill(
            self.gained + share * (gained - self.gained), self.apart + share * (apart_N * apart_N - self.apart)
        )

    @property
    def score(self) -> float:
        return self.gained / (self.apart + FORGIVEN_N * FORGIVEN_N)


Array = npt.NDArray[np.float64]

GRID_S: Final = 0.01
"Step of the time grid of remembered forces. The counts below are in its points."
HISTORY: Final = 1_000
"Ten seconds: a dozen heart beats, or two breaths."
MIN_HISTORY: Final = 100
"Nothing is forecast from fewer points."
RISE_DELAYS: Final = (1, 2, 4, 7, 11)
BEAT_DELAYS: Final = (1, 3, 8, 18, 38)
"A stretch is compared at these points before its end, as changes from the end."
TAPS: Final = 5
STRIDE: Final = 3
"Every third stretch of the history is compared."
HORIZON: Final = 8
"A plan looks 30 ms ahead, and further by the carriages' lag."
HORIZON_S: Final = HORIZON * GRID_S
EVERY: Final = 2
"A forecast takes several times as long as a plan, so each embedding has a beat of its own."
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
MAX_LEVERAGE: Final = 100.0
"Nothing is forecast from a stretch of more leverage, as after a jump."
LONG_S: Final = 2.0
SHORT_S: Final = 0.2
"Skill is earned over the long time, a few beats, and lost over the short one."
_LONG_SHARE: Final = EVERY * GRID_S / (LONG_S + EVERY * GRID_S)
_SHORT_SHARE: Final = EVERY * GRID_S / (SHORT_S + EVERY * GRID_S)
_BYTES: Final = 8
"Of each point of the history."


def embedding(delays: tuple[int, ...]) -> npt.NDArray[np.intp]:
    """Return the places of all stretches in a full history, as indices from its end."""
    rows = np.array([*[-delay for delay in delays], *range(HORIZON + 1)])[:, None]
    ends = np.arange(-1 - HORIZON, BEAT_DELAYS[-1] - HISTORY - 1, -STRIDE)
    return np.concatenate([np.minimum(rows - 1, -1), rows + ends], axis=1)


EMBEDDINGS: Final = np.stack([embedding(RISE_DELAYS), embedding(BEAT_DELAYS)])
"Shape (2, TAPS + 1 + HORIZON, n)."


@final
class Guess(Value):
    """The force that was forecast for one point of the grid."""

    def __init__(self, rise_N: float, beat_N: float, forecast_N: float, slope_N: float) -> None:
        self.rise_N: Final = rise_N
        self.beat_N: Final = beat_N
        self.forecast_N: Final = forecast_N
        self.slope_N: Final = slope_N


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
    sought: bytes
    "The history that is searched with one embedding after the other; empty between two forecasts."
    sought_s: float
    "Its newest point."
    rise_N: list[float]
    rise_unlike: float
    "What RISE_DELAYS found in it: changes of force, N, and their distance, N²."
    awaited: tuple[Guess | None, ...]
    "Guesses for the next points of the grid; None where none was made."
    long: Skill
    short: Skill
    rise_missed: float
    "Mean squared error, N², of the embedding RISE_DELAYS."
    beat_missed: float

    def __init__(self) -> None:
        self.forget()

    @property
    def trust(self) -> float:
        """Return how far the forecast takes the place of the slope, 0..1."""
        unit = 0.0, 1.0
        return within(self.long.score, unit) * within(1.0 + self.short.score, unit) if self.changes_N else 0.0

    def forget(self, stamp_s: float = -math.inf, force_N: float = 0.0, history: bytes = b"") -> None:
        """Begin with one setpoint, or with none."""
        self.stamp_s, self.force_N, self.time_s, self.history = stamp_s, force_N, stamp_s, history
        self.from_s, self.changes_N, self.awaited = -math.inf, [], NOTHING_SAID
        self.sought, self.sought_s, self.rise_N, self.rise_unlike = b"", -math.inf, [], math.inf
        self.long, self.short = Skill(0.0, DOUBT_N * DOUBT_N), Skill(0.0, 0.0)
        self.rise_missed = self.beat_missed = DOUBT_N * DOUBT_N

    def update(self, stamp_s: float, force_N: float) -> None:
        """Take one setpoint: judge what was forecast for its time, and remember it."""
        if -GRID_S < stamp_s - self.stamp_s < 0.0:
            stamp_s = self.stamp_s  # the clocks of publisher and daemon are read at slightly different times
        spacing_s = stamp_s - self.stamp_s
        if not 0.0 <= spacing_s <= MAX_STEP_S:
            self.forget(stamp_s, force_N, array("d", [force_N]).tobytes())
            return
        count = int((stamp_s - self.time_s) / GRID_S)
        if count > 0 and spacing_s > 0.0:
            self._advance(stamp_s, force_N, count)
        self.stamp_s, self.force_N = stamp_s, force_N

    def foresee(self, slope_N_s: float, *, is_whole: bool = True) -> bool:
        """Make a forecast from the newest point of the grid, or in the next call if not `is_whole`; return whether one
        was due."""
        if not self.sought:
            if self.time_s - self.from_s < (EVERY - 0.5) * GRID_S or len(self.history) < MIN_HISTORY * _BYTES:
                return False
            self.sought, self.sought_s = self.history, self.time_s
            self.rise_N, self.rise_unlike = _search(np.frombuffer(self.sought), 0)
            if not is_whole:
                return True
        beat, beat_unlike = _search(np.frombuffer(self.sought), 1)
        self.sought, self.from_s = b"", self.sought_s
        # the grid may have gone on since the search began
        place = JUDGED - 1 - round((self.time_s - self.from_s) / GRID_S)
        said = self._mix(self.rise_N, beat, beat_unlike, slope_N_s)
        if place >= 0:
            self.awaited = (*self.awaited[:place], said, *self.awaited[place + 1 :])
        return True

    def _mix(self, rise: list[float], beat: list[float], beat_unlike: float, slope_N_s: float) -> Guess | None:
        """Weigh what the embeddings found, and return what is forecast; None where neither found anything alike."""
        if not (rise or beat):
            self.short, self.changes_N = LOST, []
            return None
        # where one embedding finds nothing alike, the other's forecast is taken
        rise, beat = rise or beat, beat or rise
        rise_weight = (self.rise_missed + self.rise_unlike) ** -2
        share = rise_weight / (rise_weight + (self.beat_missed + beat_unlike) ** -2)
        changes = self.changes_N = [beat[place] + share * (rise[place] - beat[place]) for place in range(len(rise))]
        since = (self.stamp_s - self.from_s) / GRID_S
        ahead_N = [self.force_N + each[JUDGED] - at_step(since, each) for each in (rise, beat, changes)]
        return Guess(ahead_N[0], ahead_N[1], ahead_N[2], self.force_N + slope_N_s * GRID_S * (JUDGED - since))

    def forces_N(self, begins_after_s: float, after_s: list[float]) -> list[float]:
        """Return the forecast forces at `begins_after_s` + `after_s` after the newest setpoint's stamp."""
        changes = self.changes_N
        # shifted through the newest setpoint, which may have come after the point the forecast was made from
        since_s = self.stamp_s - self.from_s
        base_N = self.force_N - at_step(since_s / GRID_S, changes)
        return [base_N + at_step((since_s + begins_after_s + later_s) / GRID_S, changes) for later_s in after_s]

    def _advance(self, stamp_s: float, force_N: float, count: int) -> None:
        """Add `count` points to the grid, and judge the guesses for them."""
        spacing_s = stamp_s - self.stamp_s
        times_s = [self.time_s + GRID_S * step for step in range(1, count + 1)]
        per_s = (force_N - self.force_N) / spacing_s
        came_N = [self.force_N + per_s * (time_s - self.stamp_s) for time_s in times_s]
        self.history = (self.history + array("d", came_N).tobytes())[-HISTORY * _BYTES :]
        self.time_s = times_s[-1]
        for came, guess in zip(came_N, self.awaited):  # noqa: B905 as below
            if guess is not None:
                self._judge(guess, came)
        self.awaited = (*self.awaited, *NOTHING_SAID)[min(count, JUDGED) :][:JUDGED]
        # until the next forecast the last one serves, as far as it reaches
        if stamp_s - self.from_s >= (HORIZON - 1) * GRID_S:
            self.changes_N = []

    def _judge(self, guess: Guess, came_N: float) -> None:
        error_N, slope_error_N = guess.forecast_N - came_N, guess.slope_N - came_N
        self.long = self.long.after(error_N, slope_error_N, _LONG_SHARE)
        self.short = self.short.after(error_N, slope_error_N, _SHORT_SHARE)
        rise_error_N, beat_error_N = guess.rise_N - came_N, guess.beat_N - came_N
        self.rise_missed += _LONG_SHARE * (rise_error_N * rise_error_N - self.rise_missed)
        self.beat_missed += _LONG_SHARE * (beat_error_N * beat_error_N - self.beat_missed)


def _search(history: Array, number: int) -> tuple[list[float], float]:
    """Forecast with one of EMBEDDINGS: return the changes of force, N, and their distance, N²."""
    places = EMBEDDINGS[number, :, : (len(history) - BEAT_DELAYS[-1] - 1 - HORIZON) // STRIDE + 2]
    changes = history.take(places, mode="wrap")
    changes -= changes[TAPS]
    before = changes[:TAPS]
    before -= before[:, :1].copy()
    apart = (before * before).sum(axis=0) + TAPS * SAME_N**2
    apart[0] = math.inf
    unlike = float(apart.min()) / TAPS
    if unlike > UNLIKE_N * UNLIKE_N:
        return [], unlike
    changes[TAPS] = 1.0
    weight = 1.0 / (apart * apart)
    return _constants(((changes[: TAPS + 1] * weight) @ changes.T).tolist()), unlike


def _constants(rows: list[list[float]]) -> list[float]:
    """Return the regressions' constants, by elimination."""
    total = rows[TAPS][TAPS]
    variance = 0.0
    for place in range(TAPS):
        variance += rows[place][place]
    ridge = RIDGE / TAPS * variance + SAME_N**2 * total
    for _ in range(TAPS):
        pivot = rows[0]
        left: list[list[float]] = []
        for row in rows[1:]:
            share = row[0] / (pivot[0] + ridge)
            # rows are equally long, and only an unchecked zip is compiled to a plain loop
            left.append([value - share * above for value, above in zip(row[1:], pivot[1:])])  # noqa: B905
        rows = left
    constant = rows[0]
    if total > MAX_LEVERAGE * constant[0]:
        return []
    return [0.0, *[each / constant[0] for each in constant[1:]]]
