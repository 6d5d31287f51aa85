"""Bench records freed of memory: what relaxation and the field's hysteresis did to each row is found and taken out.

A force model of displacement, rate and field has no memory, the elastomer and the magnets' circuit have. Fitted to the
records as they are, a model learns the memory of the bench's own program; so the memory is identified with them:

    F = D(B - h) m S(v)       m = 1 - sum g_i q_i / D(B)       q_i: D(B) behind a low-pass of time constant tau_i

D is the force of the field at rest, a smooth curve; S = 1 + s exp(-(v / v_s)^2) + c v, friction over its kinetic level;
h follows the field's changes towards +-h_max. A record begins after a long rest at its first row's field.
"""

import numpy as np
from scipy.optimize import least_squares

from tormagd.lab.arrays import Array
from tormagd.lab.training.dataset import Dataset
from tormagd.lab.training.memory import records, times_of
from tormagd.model.features import FEATURES, FIELD
from tormagd.model.memory import Memory

RATE = FEATURES.index("rate_mm_s")
START_TIMES_S = (10.0, 100.0, 1000.0)
"Those of field-step tests."
TIME_SPREADS = (3.0, 3.0, 1.01)
"""A fitted time stays within this factor of its start, so that they cannot change places; the last is hardly fitted,
for records of ten minutes do not tell a term that is slow from one that is slower and greater."""
START_FRACTION = 0.03
DEGREE = 4
"Of the logarithm of D over the logarithm of the field."
FITTED_ROWS = 6000
ROBUST_N = 0.05
"Errors beyond this count less: rows near a reversal of the field."


def identify(data: Dataset) -> tuple[Memory, Dataset]:
    """The memory in the records of `data`, and the same rows with the forces that they would have had without it.

    Every record begins after a long rest. Deterministic. Raises `DomainError` without `time_s`.
    """
    every = max(1, len(data) // FITTED_ROWS)
    kept = data.subset(np.arange(0, len(data), every))
    terms = len(START_TIMES_S)
    greatest_mT = float(data.features[:, FIELD].max())
    middle = float(np.log(data.features[:, FIELD]).mean())

    def split(parameters: Array) -> tuple[Array, Array, Memory]:
        shape, friction = parameters[: DEGREE + 1], parameters[DEGREE + 1 : DEGREE + 4]
        fractions, times, lag = parameters[-2 * terms - 2 : -terms - 2], parameters[-terms - 2 : -2], parameters[-2:]
        lag_mT, turn_mT = (greatest_mT * lag).tolist()
        memory = Memory(
            fractions=tuple(fractions.tolist()), times_s=tuple(np.exp(times).tolist()), lag_mT=lag_mT, turn_mT=turn_mT
        )
        return shape, friction, memory

    def level_N(shape: Array, field_mT: Array) -> Array:
        level: Array = np.exp(np.polynomial.polynomial.polyval(np.log(field_mT) - middle, shape))
        return level

    def remembered(shape: Array, memory: Memory, rows: Dataset) -> tuple[Array, Array]:
        """Force at rest without memory, and with it."""
        field_mT = rows.features[:, FIELD]
        lagging_mT = field_mT - _lag_mT(memory, field_mT, rows)
        free_N = level_N(shape, field_mT)
        lagging_N = level_N(shape, lagging_mT)
        return free_N, lagging_N - _relaxed_away_N(memory, lagging_N, rows)

    def residual(parameters: Array) -> Array:
        shape, (static, speed_mm_s, viscous), memory = split(parameters)
        rate = kept.features[:, RATE]
        over = 1.0 + static * np.exp(-np.square(rate / speed_mm_s)) + viscous * rate
        error: Array = remembered(shape, memory, kept)[1] * over - kept.force_N
        return error

    times = np.log(START_TIMES_S)
    spread = np.log(TIME_SPREADS)
    start = np.concatenate(([0.5, 2.0], np.zeros(DEGREE - 1), [0.1, 5.0, 3e-4], np.full(terms, START_FRACTION), times))
    start = np.concatenate((start, [0.01, 0.1]))
    low = np.concatenate((np.full(DEGREE + 1, -20.0), [0.0, 0.5, -0.01], np.zeros(terms), times - spread, [0.0, 0.01]))
    high = np.concatenate(
        (np.full(DEGREE + 1, 20.0), [1.0, 50.0, 0.01], np.full(terms, 0.3), times + spread, [0.1, 0.5])
    )
    scale = np.concatenate((np.full(DEGREE + 1, 0.1), [0.1, 1.0, 1e-3], np.full(terms, 0.03), np.full(terms, 0.5)))
    scale = np.concatenate((scale, [0.01, 0.1]))
    found = least_squares(residual, start, bounds=(low, high), x_scale=scale, loss="soft_l1", f_scale=ROBUST_N)
    shape, _, memory = split(found.x)
    free_N, with_memory_N = remembered(shape, memory, data)
    return memory, Dataset(data.features, data.force_N * free_N / with_memory_N, data.cycle, data.time_s)


def _lag_mT(memory: Memory, field_mT: Array, rows: Dataset) -> Array:
    """How far the field lies behind: rate-independent, it moves along |dB| towards the side that dB leads to."""
    lag_mT = np.zeros_like(field_mT)
    for record in records(rows):
        now, found = 0.0, []
        for change in np.diff(field_mT[record], prepend=field_mT[record.start]).tolist():
            if change != 0.0:
                side = memory.lag_mT if change > 0.0 else -memory.lag_mT
                now += (now - side) * float(np.expm1(-abs(change) / memory.turn_mT))
            found.append(now)
        lag_mT[record] = found
    return lag_mT


def _relaxed_away_N(memory: Memory, driving_N: Array, rows: Dataset) -> Array:
    """What the elastomer has relaxed of `driving_N` (n) since the rest before each record."""
    times, away_N = times_of(rows), np.zeros_like(driving_N)
    fractions = np.array(memory.fractions)
    for record in records(rows):
        steps_s = np.diff(times[record], prepend=times[record.start])
        decays = np.exp(-steps_s[:, np.newaxis] / np.array(memory.times_s))
        driving = driving_N[record]
        mean_N = (driving + np.concatenate((driving[:1], driving[:-1]))) / 2.0
        slow_N, found = np.full(len(fractions), driving[0]), np.empty_like(driving)
        for row, (decay, drive) in enumerate(zip(decays, mean_N.tolist(), strict=True)):
            slow_N = drive + (slow_N - drive) * decay
            found[row] = fractions @ slow_N
        away_N[record] = found
    return away_N
