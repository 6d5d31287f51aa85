"""What comes next in a force that repeats itself, as a pulse does, where the setpoints bring no preview.

No period is assumed, for heart beats vary: the newest stretch of force, as a delay embedding, is compared with those
remembered, and what followed them tells what will follow it (analogue forecasting, Lorenz, J. Atmos. Sci. 26, 1969;
locally weighted linear regression, Cleveland and Devlin, J. Am. Stat. Assoc. 83, 1988). How far that is believed has to
be earned: by its skill over the slope that is extrapolated otherwise, judged by what came.
"""

import math
from array import array
from typing import Final, final

import numpy as np
import numpy.typing as npt

from firmware_protocol.value import Value
from tormagd.control.interpolation import at_step

Array = npt.NDArray[np.float64]

GRID_S: Final = 0.01
"Forces are remembered on a grid of time, whose points everything below counts; a pulse rises in ten of them."
HISTORY: Final = 1_000
"Ten seconds: a dozen heart beats at rest, and twice a breath, which modulates them."
LEAST_HISTORY: Final = 100
"With less, which is less than a heart beat, nothing is forecast."
DELAYS: Final = (1, 2, 4, 7, 11)
"""Of the embedding: a stretch is compared at these points before its end, as changes from there. Close together where
the slope and its change show, and back to the rise of a pulse, which takes a tenth of a second."""
STRIDE: Final = 3
"Every third stretch is looked at: the regression makes up for most of what lies between them."
HORIZON: Final = 8
"Points that are forecast; a plan looks 30 ms ahead, from as far ahead as the carriages are late."
JUDGED: Final = 4
"The point ahead that forecasts are judged at: as far as the middle of what a plan looks at, with usual carriages."
LONGEST_STEP_S: Final = 0.1
"Setpoints further apart than this are no stream: nothing that was learned outlives the gap."
SAME_N: Final = 1e-4
"Stretches that differ by no more are the same: a tenth of what the force sensor resolves."
RIDGE: Final = 0.01
"Share by which the regression's variances are raised: from stretches that hardly differ no dependence is learned."
MOST_LEVERAGE: Final = 100.0
"""Nothing is forecast from a stretch of more leverage, as after a jump: 1 and its squared distance from the mean of
those most like it, in their standard deviations."""
LONG_S: Final = 2.0
SHORT_S: Final = 0.2
"Skill is earned over the long time, a few beats, and lost over the short: a rhythm that breaks breaks at once."
DOUBT_N: Final = 0.02
"Before the first is judged, forecasts count as this far from the slope and no better."
FORGIVEN_N: Final = 0.003
"Differences as small as this neither earn trust nor lose it."

TAPS: Final = 5
"Of the embedding: as many as DELAYS."
_LEAST_BYTES: Final = LEAST_HISTORY * array("d").itemsize
_MOST_BYTES: Final = HISTORY * array("d").itemsize
_SHORTEST: Final = DELAYS[-1] + 1 + HORIZON
_ROWS: Final = np.array([*[-delay for delay in DELAYS], *range(HORIZON + 1)])[:, None]
_ENDS: Final = np.arange(-1 - HORIZON, _SHORTEST - HORIZON - HISTORY - 2, -STRIDE)
_AROUND: Final = np.concatenate([np.minimum(_ROWS - 1, -1), _ROWS + _ENDS], axis=1)
"""Places from the end of a full history, a column for each stretch: what is compared of it, its end, what followed. The
first column is the newest stretch, which nothing has followed yet."""


@final
class Skill(Value):
    """Means of squares, N², with the newest counting most: what forecasts gained on the slope, and how far they were
    from it."""

    __match_args__ = ("gained", "apart")
    __slots__ = __match_args__

    def __init__(self, gained: float, apart: float) -> None:
        self.gained: Final = gained
        self.apart: Final = apart

    def after(self, forecast_error_N: float, slope_error_N: float, time_s: float) -> "Skill":
        """With the errors of one forecast more; `time_s` is the time constant of forgetting."""
        share = GRID_S / (time_s + GRID_S)
        gained = slope_error_N * slope_error_N - forecast_error_N * forecast_error_N
        difference_N = slope_error_N - forecast_error_N
        apart = difference_N * difference_N
        return Skill(self.gained + share * (gained - self.gained), self.apart + share * (apart - self.apart))

    @property
    def score(self) -> float:
        """Gained over apart. Of all mixtures, what was judged would have been met best by one with the share
        (1 + score) / 2 of the forecast."""
        return self.gained / (self.apart + FORGIVEN_N * FORGIVEN_N)


@final
class Guess(Value):
    """What forecast and slope said that a point of the grid would be, N."""

    __match_args__ = ("forecast_N", "slope_N")
    __slots__ = __match_args__

    def __init__(self, forecast_N: float, slope_N: float) -> None:
        self.forecast_N: Final = forecast_N
        self.slope_N: Final = slope_N


NOTHING_SAID: Final[tuple[Guess | None, ...]] = (None,) * JUDGED
UNJUDGED_LONG: Final = Skill(0.0, DOUBT_N * DOUBT_N)
UNJUDGED_SHORT: Final = Skill(0.0, 0.0)


@final
class Periodicity(Value):
    """What is remembered of a stream of setpoints.

    stamp_s, force_N  of the newest setpoint
    time_s            of the newest point of the grid, not after the newest setpoint
    history           the forces on the grid, float64: bytes do not change, and NumPy reads them where they are
    from_s            the point of the grid that `changes_N` are from
    changes_N         from there to itself and the points ahead; empty while nothing is forecast
    awaited           what was said of the next points of the grid, to be judged by what comes
    long, short       the skill so far
    """

    __match_args__ = (
        "stamp_s",
        "force_N",
        "time_s",
        "history",
        "from_s",
        "changes_N",
        "awaited",
        "long",
        "short",
    )
    __slots__ = __match_args__

    def __init__(
        self,
        stamp_s: float = -math.inf,
        force_N: float = 0.0,
        time_s: float = -math.inf,
        history: bytes = b"",
        from_s: float = -math.inf,
        changes_N: list[float] | None = None,
        awaited: tuple[Guess | None, ...] = NOTHING_SAID,
        long: Skill = UNJUDGED_LONG,
        short: Skill = UNJUDGED_SHORT,
    ) -> None:
        self.stamp_s: Final = stamp_s
        self.force_N: Final = force_N
        self.time_s: Final = time_s
        self.history: Final = history
        self.from_s: Final = from_s
        self.changes_N: Final[list[float]] = [] if changes_N is None else changes_N
        self.awaited: Final = awaited
        self.long: Final = long
        self.short: Final = short

    @property
    def trust(self) -> float:
        """0..1: how far the forecast takes the place of the slope; half of what would have been best, and nothing where
        nothing was gained."""
        if not self.changes_N:
            return 0.0
        earned, lost = self.long.score, -self.short.score
        return min(max(earned, 0.0), 1.0) * min(max(1.0 - lost, 0.0), 1.0)


NOTHING_LEARNED: Final = Periodicity()


def observe(state: Periodicity, stamp_s: float, force_N: float) -> Periodicity:
    """The state with one setpoint more. What comes next is not looked for here, as something waits for this setpoint:
    `foreseen` does that afterwards.

    Another force with the same stamp, or one from up to GRID_S before, takes the place of the first; a stamp from
    longer before, or after LONGEST_STEP_S, begins anew.
    """
    if -GRID_S < stamp_s - state.stamp_s < 0.0:
        stamp_s = state.stamp_s  # the clocks of publisher and daemon are read at slightly different times
    spacing_s = stamp_s - state.stamp_s
    if not 0.0 <= spacing_s <= LONGEST_STEP_S:
        return Periodicity(stamp_s, force_N, stamp_s, array("d", [force_N]).tobytes())
    count = int((stamp_s - state.time_s) / GRID_S)
    if count == 0 or spacing_s == 0.0:
        if spacing_s == 0.0 and force_N == state.force_N:
            return state
        return Periodicity(
            stamp_s,
            force_N,
            state.time_s,
            state.history,
            state.from_s,
            state.changes_N,
            state.awaited,
            state.long,
            state.short,
        )
    return _advanced(state, stamp_s, force_N, count)


def _advanced(state: Periodicity, stamp_s: float, force_N: float, count: int) -> Periodicity:
    """The state after a setpoint that passes `count` points of the grid: what was said of them is judged."""
    spacing_s = stamp_s - state.stamp_s
    times_s = [state.time_s + GRID_S * step for step in range(1, count + 1)]
    shares = [(time_s - state.stamp_s) / spacing_s for time_s in times_s]
    came_N = [state.force_N + share * (force_N - state.force_N) for share in shares]
    history = (state.history + array("d", came_N).tobytes())[-_MOST_BYTES:]
    long, short = state.long, state.short
    for came, guess in zip(came_N, state.awaited):  # noqa: B905 as below
        if guess is not None:
            forecast_error_N, slope_error_N = guess.forecast_N - came, guess.slope_N - came
            long = long.after(forecast_error_N, slope_error_N, LONG_S)
            short = short.after(forecast_error_N, slope_error_N, SHORT_S)
    awaited = (*state.awaited, *NOTHING_SAID)[min(count, JUDGED) :][:JUDGED]
    # until the next forecast the last one serves, as far as it reaches
    changes = state.changes_N if stamp_s - state.from_s < (HORIZON - 1) * GRID_S else None
    return Periodicity(stamp_s, force_N, times_s[-1], history, state.from_s, changes, awaited, long, short)


def foreseen(state: Periodicity, slope_N_s: float) -> Periodicity:
    """The state with a forecast from its newest point of the grid, once for each, and what forecast and `slope_N_s`,
    which is extrapolated otherwise, say, to be judged by. Takes several times as long as a plan."""
    if state.from_s >= state.time_s or len(state.history) < _LEAST_BYTES:
        return state
    changes = _search(np.frombuffer(state.history))
    said: Guess | None = None
    if changes:
        since_s = state.stamp_s - state.time_s
        forecast = state.force_N + changes[JUDGED] - changes[1] * since_s / GRID_S
        said = Guess(forecast, state.force_N + slope_N_s * (JUDGED * GRID_S - since_s))
    return Periodicity(
        state.stamp_s,
        state.force_N,
        state.time_s,
        state.history,
        state.time_s,
        changes,
        (*state.awaited[:-1], said),
        state.long,
        state.short,
    )


def forecast_N(state: Periodicity, begins_s: float, after_s: list[float]) -> list[float]:
    """The forces at these times (n) after `begins_s`, 0 or more, from the newest setpoint on; they stay where the
    forecast ends. Only where `trust` is above 0."""
    changes = state.changes_N
    # the forecast starts at the newest setpoint, which may have come some steps after the point it is from
    since_s = state.stamp_s - state.from_s
    base_N = state.force_N - at_step(since_s / GRID_S, changes)
    return [base_N + at_step((since_s + begins_s + later_s) / GRID_S, changes) for later_s in after_s]


def _search(history: Array) -> list[float]:
    """The changes from the newest point of the grid to itself and the next HORIZON; empty where nothing is like it.

    What followed a stretch is regressed on 1 and on how the stretch differs from the newest. The newest does not differ
    from itself, so that the regression's constant is its forecast.
    """
    changes = history[_AROUND[:, : (len(history) - _SHORTEST) // STRIDE + 2]]
    changes -= changes[TAPS]
    before = changes[:TAPS]
    before -= before[:, :1].copy()
    weight = (np.add.reduce(before * before) + TAPS * SAME_N**2) ** -2
    weight[0] = 0.0
    changes[TAPS] = 1.0
    return _constants((changes[: TAPS + 1] * weight @ changes.T).tolist())


def _constants(rows: list[list[float]]) -> list[float]:
    """The regression's constants, the first 0, by elimination of all else from its normal equations: weighted sums of
    products, a row for each regressor, that of 1 the last; a column for each, and behind them for what followed."""
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
    if total > MOST_LEVERAGE * constant[0]:
        return []
    return [0.0, *[each / constant[0] for each in constant[1:]]]
