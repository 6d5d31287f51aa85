"""Bench records freed of memory: what relaxation and the field's hysteresis did to each row is found and taken out.

A force model of displacement, rate and field has no memory; fitted to raw records, it would learn that of the bench's
own program. So the memory of the elastomer and of the magnets' circuit is identified with them:

    G = D(B - h) m S(v)       m = 1 - sum g_i q_i / D(B)       q_i: D(B) behind a low-pass of time constant tau_i
    F = G (1 - exp(-k x / G)) before mobilisation, then G

D is the force of the field at rest, a smooth curve of each insert. S = 1 + s exp(-(v / v_s)^2) + c v is friction over
its kinetic level. h follows the field's changes towards +-h_max. A record begins after a long rest at its first row's
field. Inserts of one matrix relax and lag alike, the lag scaled to the field.
"""

import numpy as np
from scipy.optimize import least_squares

from tormag_lab.arrays import Array
from tormag_lab.ideal_carriage import Lag
from tormag_lab.training.dataset import Dataset, records, times_of
from tormag_lab.training.law import mobilised_N
from tormagd.element.model.features import CIP, FIELD
from tormagd.element.model.memory import Memory

START_TIMES_S = (10.0, 100.0, 1000.0)
"Time constants of field-step tests."
TIME_SPREADS = (3.0, 3.0, 1.01)
"""Factors that keep times from changing places. Ten minutes do not tell a slow term from a slower and greater one, so
the last hardly moves."""
START_FRACTION = 0.03
DEGREE = 4
"Of the polynomial for the logarithm of D over that of the field."
FITTED_ROWS = 3000
MIN_N = 1e-6
ROBUST_N = 0.05
"Larger errors count less: they are rows near a reversal of the field."


def identify(data: Dataset) -> tuple[Memory, Dataset]:
    """Identify the memory in `data`, and return it and the rows with forces freed of it."""
    every = max(1, len(data) // FITTED_ROWS)
    kept = data.subset(np.arange(0, len(data), every))
    terms = len(START_TIMES_S)
    irons, insert = np.unique(data.features[:, CIP], return_inverse=True)
    greatest_mT = np.array([data.features[insert == place, FIELD].max() for place in range(len(irons))])
    middle = float(np.log(data.features[:, FIELD] / greatest_mT[insert] * greatest_mT.max()).mean())
    levels = len(irons) * (DEGREE + 1)

    def split(parameters: Array) -> tuple[Array, Array, Memory]:
        shapes, friction = parameters[:levels].reshape(-1, DEGREE + 1), parameters[levels : levels + 4]
        fractions, times, lag = parameters[-2 * terms - 2 : -terms - 2], parameters[-terms - 2 : -2], parameters[-2:]
        turn_mT = float(greatest_mT.max() * lag[1])
        memory = Memory(
            fractions=tuple(fractions.tolist()),
            times_s=tuple(np.exp(times).tolist()),
            lag_mT=float(lag[0]) * turn_mT,
            turn_mT=turn_mT,
        )
        return shapes, friction, memory

    def forces(parameters: Array, rows: Dataset) -> tuple[Array, Array]:
        """Return the forces without and with memory."""
        shapes, (static, speed_mm_s, viscous, stiffness_N_mm), memory = split(parameters)
        displacement_mm, rate, field_mT, iron = rows.features.T
        of_insert = np.searchsorted(irons, iron)
        # at one gap the fields of all inserts are the same share of their greatest
        common_mT = field_mT / greatest_mT[of_insert] * greatest_mT.max()

        def level_N(field_mT: Array) -> Array:
            powers = np.vander(np.log(field_mT) - middle, DEGREE + 1, increasing=True)
            level: Array = np.exp((powers * shapes[of_insert]).sum(axis=1))
            return level

        def given_N(kinetic_N: Array) -> Array:
            over = 1.0 + static * np.exp(-np.square(rate / speed_mm_s)) + viscous * rate
            return mobilised_N(np.maximum(kinetic_N * over, MIN_N), displacement_mm, stiffness_N_mm)

        lagging_N = level_N(common_mT - _lag_mT(memory, common_mT, rows))
        return given_N(level_N(common_mT)), given_N(lagging_N - _relaxed_away_N(memory, lagging_N, rows))

    def residual(parameters: Array) -> Array:
        return forces(parameters, kept)[1] - kept.force_N

    times = np.log(START_TIMES_S)
    spread = np.log(TIME_SPREADS)
    shape = np.concatenate(([0.5, 2.0], np.zeros(DEGREE - 1)))
    parts = (  # start, least, most, scale
        (np.tile(shape, len(irons)), np.full(levels, -20.0), np.full(levels, 20.0), np.full(levels, 0.1)),
        ([0.1, 5.0, 3e-4, 5.0], [0.0, 0.5, -0.01, 1.0], [1.0, 50.0, 0.01, 50.0], [0.1, 1.0, 1e-3, 1.0]),
        (np.full(terms, START_FRACTION), np.zeros(terms), np.full(terms, 0.3), np.full(terms, 0.03)),
        (times, times - spread, times + spread, np.full(terms, 0.5)),
        # the lag over the field change that turns it, which `Memory` bounds; that change over the greatest field
        ([0.1, 0.1], [0.0, 0.01], [0.25, 0.5], [0.1, 0.1]),
    )
    start, low, high, scale = (np.concatenate(column) for column in zip(*parts, strict=True))
    found = least_squares(residual, start, bounds=(low, high), x_scale=scale, loss="soft_l1", f_scale=ROBUST_N)
    free_N, with_memory_N = forces(found.x, data)
    # at no displacement there is no force to lose
    kept_share = np.divide(with_memory_N, free_N, out=np.ones_like(free_N), where=free_N > 0.0)
    return split(found.x)[2], Dataset(data.features, data.force_N / kept_share, data.cycle, data.time_s)


def _lag_mT(memory: Memory, field_mT: Array, rows: Dataset) -> Array:
    """Return the lag of the element's field behind `field_mT` (n) at each row."""
    law = Lag(memory.lag_mT, memory.turn_mT)
    fields_mT = [field_mT[record] for record in records(times_of(rows))]
    return -np.concatenate([law.along_Tm(each_mT, 0.0, float(each_mT[0])) for each_mT in fields_mT])


def _relaxed_away_N(memory: Memory, driving_N: Array, rows: Dataset) -> Array:
    """Return how much of `driving_N` (n) has relaxed away at each row."""
    times, away_N = times_of(rows), np.zeros_like(driving_N)
    fractions = np.array(memory.fractions)
    for record in records(times):
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
