"""What comes next in a force that repeats itself, as a pulse does, where the setpoints bring no preview.

No period is assumed, for heart beats vary: the newest stretch of force is compared with those remembered, and what
followed them tells what will follow it (analogue forecasting, Lorenz, J. Atmos. Sci. 26, 1969; locally weighted linear
regression, Cleveland and Devlin, J. Am. Stat. Assoc. 83, 1988). How far that is believed has to be earned: forecasts
are judged by what came, beside the slope that is extrapolated otherwise.
"""

import math
from array import array
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

GRID_S = 0.01
"Forces are remembered on a grid of time, whose points everything below counts."
HISTORY = 1_000
LEAST_HISTORY = 100
"With less nothing is forecast."
LAGS = (1, 2, 4, 7, 11)
"A stretch is compared at these points before its end, as changes from there."
STRIDE = 3
"Every third stretch is looked at: the regression makes up for most of what lies between them."
AHEAD = 8
"Points that are forecast; a plan looks 30 ms ahead, from as far ahead as the carriages are late."
JUDGED = 4
"The point ahead that forecasts are judged at."
LONGEST_STEP_S = 0.1
"Setpoints further apart than this are no stream: nothing that was learned outlives the gap."
SAME_N = 1e-4
"Stretches that differ by no more are the same."
RIDGE = 0.01
"Share by which the regression's variances are raised: from stretches that hardly differ no dependence is learned."
STRANGEST = 100.0
"""Nothing is forecast from a stretch further than this from those most like it, as after a jump: 1 and its squared
distance from their mean, in their standard deviations."""
LONG_S, SHORT_S = 2.0, 0.2
"Forecasts earn trust over the long time, and lose it over the short."
DOUBT_N = 0.02
"Before the first is judged they count as this far from the slope and no better."
FORGIVEN_N = 0.003
"Differences as small as this neither earn trust nor lose it."

TAPS = len(LAGS)
_LEAST_BYTES = LEAST_HISTORY * array("d").itemsize
_SHORTEST = LAGS[-1] + 1 + AHEAD
_ROWS = np.array([0, *(-lag for lag in LAGS), *range(1, AHEAD + 1)])[:, None]
_ENDS = np.arange(-1 - AHEAD, _SHORTEST - AHEAD - HISTORY - 2, -STRIDE)
_AROUND = np.concatenate([np.minimum(_ROWS - 1, -1), _ROWS + _ENDS], axis=1)
"""Places from the end of a full history, a column for each stretch: its end, what is compared of it, what followed. The
first column is the newest stretch, which nothing has followed yet."""
_AHEAD_S = GRID_S * np.arange(AHEAD + 1.0)
_CONSTANT = np.eye(TAPS + 1)[0]
_RIDGE = np.diag(1.0 - _CONSTANT)


class Score(NamedTuple):
    """Means of squares, N², with the newest counting most: what forecasts gained on the slope, and how far they were
    from it."""

    gained: float
    apart: float

    def after(self, forecast_error_N: float, slope_error_N: float, time_s: float) -> "Score":
        """With the errors of one forecast more; `time_s` is the time constant of forgetting."""
        share = GRID_S / (time_s + GRID_S)
        gained = slope_error_N**2 - forecast_error_N**2
        apart = (slope_error_N - forecast_error_N) ** 2
        return Score(self.gained + share * (gained - self.gained), self.apart + share * (apart - self.apart))


class Periodicity(NamedTuple):
    """What is remembered of a stream of setpoints. Compares by value; nothing changes it."""

    stamp_s: float = -math.inf
    force_N: float = 0.0
    time_s: float = -math.inf
    "Of the newest point of the grid, not after the newest setpoint."
    history: bytes = b""
    "The forces on the grid, float64: bytes are immutable, and numpy reads them where they are."
    from_s: float = -math.inf
    "The point of the grid that `changes_N` are from."
    changes_N: tuple[float, ...] = ()
    "From there to itself and the points ahead; empty while nothing is forecast."
    awaited_N: tuple[tuple[float, float] | None, ...] = (None,) * JUDGED
    "What forecast and slope said that the next points of the grid would be."
    long: Score = Score(0.0, DOUBT_N**2)
    short: Score = Score(0.0, 0.0)

    @property
    def trust(self) -> float:
        """0..1: how far the forecast takes the place of the slope.

        Of all mixtures, what was judged would have been met best by one with the share (1 + gained / apart) / 2 of the
        forecast. `gained / apart` is less, and nothing where nothing was gained.
        """
        if not self.changes_N:
            return 0.0
        earned = self.long.gained / (self.long.apart + FORGIVEN_N**2)
        lost = -self.short.gained / (self.short.apart + FORGIVEN_N**2)
        return min(max(earned, 0.0), 1.0) * min(max(1.0 - lost, 0.0), 1.0)


NOTHING_LEARNED = Periodicity()


def observe(state: Periodicity, stamp_s: float, force_N: float, slope_N_s: float) -> Periodicity:
    """The state with one setpoint more, in bounded time; `slope_N_s` is what is extrapolated otherwise.

    Another force with the same stamp, or one from up to GRID_S before, takes the place of the first; a stamp from
    longer before, or after LONGEST_STEP_S, begins anew.
    """
    if state.from_s < state.time_s and len(state.history) >= _LEAST_BYTES:
        # a plan later than the point of the grid came: the plan that a setpoint waits for has enough to do
        state = _searched(state, slope_N_s)
    if -GRID_S < stamp_s - state.stamp_s < 0.0:
        stamp_s = state.stamp_s  # the clocks of publisher and daemon are read at slightly different times
    spacing_s = stamp_s - state.stamp_s
    if not 0.0 <= spacing_s <= LONGEST_STEP_S:
        return Periodicity(stamp_s, force_N, stamp_s, array("d", [force_N]).tobytes())
    count = int((stamp_s - state.time_s) / GRID_S)
    if count == 0 or spacing_s == 0.0:
        is_known = spacing_s == 0.0 and force_N == state.force_N
        return state if is_known else state._replace(stamp_s=stamp_s, force_N=force_N)
    times_s = [state.time_s + GRID_S * step for step in range(1, count + 1)]
    shares = [(time_s - state.stamp_s) / spacing_s for time_s in times_s]
    came_N = array("d", [state.force_N + share * (force_N - state.force_N) for share in shares])
    history = (state.history + came_N.tobytes())[-came_N.itemsize * HISTORY :]
    long, short = state.long, state.short
    for force, guesses in zip(came_N, state.awaited_N, strict=False):
        if guesses is not None:
            errors = guesses[0] - force, guesses[1] - force
            long, short = long.after(*errors, LONG_S), short.after(*errors, SHORT_S)
    awaited = (*state.awaited_N, *[None] * count)[-JUDGED:]
    # until the next forecast the last one serves, as far as it reaches
    changes = state.changes_N if stamp_s - state.from_s < (AHEAD - 1) * GRID_S else ()
    return Periodicity(stamp_s, force_N, times_s[-1], history, state.from_s, changes, awaited, long, short)


def _searched(state: Periodicity, slope_N_s: float) -> Periodicity:
    """The state with a forecast from its newest point of the grid, and what it and the slope say, to be judged by. The
    slope may know of one setpoint more, which is on the safe side.
    """
    changes = _search(np.frombuffer(state.history))
    said = None
    if changes:
        since_s = state.stamp_s - state.time_s
        forecast = state.force_N + changes[JUDGED] - changes[1] * since_s / GRID_S
        said = forecast, state.force_N + slope_N_s * (JUDGED * GRID_S - since_s)
    return state._replace(from_s=state.time_s, changes_N=changes, awaited_N=(*state.awaited_N[:-1], said))


def forecast_N(state: Periodicity, ahead_s: Array) -> Array:
    """The forces at these times, 0 or more, after the newest setpoint; they stay where the forecast ends. Only where
    `trust` is above 0."""
    changes = state.changes_N
    since_s = state.stamp_s - state.from_s
    points, part = divmod(since_s / GRID_S, 1.0)
    start = int(points)
    # the forecast starts at the newest setpoint, which may have come some steps after the point it is from
    base_N = state.force_N - changes[start] - part * (changes[start + 1] - changes[start])
    forces: Array = np.interp(ahead_s + since_s, _AHEAD_S, changes)
    forces += base_N
    return forces


def _search(history: Array) -> tuple[float, ...]:
    """The changes from the newest point of the grid to itself and the next AHEAD; empty where nothing is like it.

    What followed a stretch is regressed on 1 and on how the stretch differs from the newest. The newest does not differ
    from itself, so that the regression's constant is its forecast.
    """
    changes = history[_AROUND[:, : (len(history) - _SHORTEST) // STRIDE + 2]]
    changes[1:] -= changes[0]
    before = changes[1 : TAPS + 1]
    before -= before[:, :1]
    squared = np.einsum("ij,ij->j", before, before)
    weight = (squared + TAPS * SAME_N**2) ** -2
    weight[0] = 0.0
    changes[0] = 1.0
    regressors = changes[: TAPS + 1]
    weighted = regressors * weight
    normal = weighted @ regressors.T
    total = normal[0, 0]
    normal += (RIDGE / TAPS * (weight @ squared) + SAME_N**2 * total) * _RIDGE
    solution = np.linalg.solve(normal, _CONSTANT)
    if solution[0] * total > STRANGEST:
        return ()
    return (0.0, *(changes[TAPS + 1 :] @ (solution @ weighted)).tolist())
