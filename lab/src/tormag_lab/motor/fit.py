"""What a motor log says of motor and screw: three linear models in units of the carriage (m, N), with 95% intervals.

    volts      gain V(t - delay) = mass a + viscous v + coulomb sign(v) + offset        (Gautier and Khalil)
    windings   V(t - delay) = R i + L di/dt + K v
    gearbox    K i = mass a + viscous v + p(x) + sign(v) (q(x) + (1 - efficiency) |K i|)

`volts` needs only voltage and position; a current gives the others, and the gain K / R. Polynomials p and q of the
position are the magnets' pull and the friction that it loads. Both sides are filtered alike without lag, and rows at
rest left out. Covariances are sandwiches over blocks of a second (Liang and Zeger 1986), for correlated noise. To cover
a wrong model, each is fitted again in ways that should not matter. These are more terms, other rows, a wider band, and
shifted or thinned currents. Intervals grow by how far these move the values.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.signal import butter, decimate, sosfiltfilt
from scipy.stats import t as student

from tormag_lab.arrays import Array
from tormag_lab.errors import LabError
from tormag_lab.motor.log import Log
from tormagd.commission.finding import solved

CUTOFF_HZ = 100.0
THINNED_HZ = 40.0
SLOW_M_S = 1e-3
"At a lower speed its sign is noise, and friction may be static."
MOSTLY, THROUGHOUT = 0.5, 0.98
"Least share of a row in motion. Without a current, turns tell friction from drag; with one they only blur it."
BLOCK_S = 1.0
MIN_BLOCKS = 8
EDGE = 4
"Rows at both ends that carry the filters' guesses."
SPREAD = 2.0
"Standard deviations of the position within which a parameter varies over the log."
LONGEST_DELAY_S = 0.02
DELAY_TURNS = 4
WIDER_HZ = 100.0
SETTLING_TURNS = 60


class Estimate(NamedTuple):
    """A value and the half width of its 95% interval."""

    value: float
    ci95: float

    def scaled(self, factor: float) -> "Estimate":
        return Estimate(self.value * factor, self.ci95 * abs(factor))


class Motion(NamedTuple):
    """Motion of a log: position from its mean, m, speed, acceleration, and the sign of the speed, 0 at rest. `factor`
    rows make one thinned row."""

    x: Array
    v: Array
    a: Array
    sign: Array
    factor: int

    def thin(self, column: Array) -> Array:
        """Return a column low-passed, thinned by `factor`, and without EDGE rows at both ends."""
        thinned = decimate(column, self.factor, ftype="fir", zero_phase=True) if self.factor > 1 else column
        return np.asarray(thinned[EDGE:-EDGE])


class Fit(NamedTuple):
    """A least-squares fit, and how many standard deviations make 95%."""

    values: Array
    covariance: Array
    deviations: float
    relative_residual: float

    @property
    def half_widths(self) -> Array:
        return np.asarray(self.deviations * np.sqrt(np.diag(self.covariance)))

    def half_widths_of(self, function: Callable[[Array], Array]) -> Array:
        """Return the half widths of the 95% intervals of m functions of the values, linearised about these."""
        steps = np.maximum(1e-3 * np.sqrt(np.diag(self.covariance)), np.finfo(np.float64).tiny)
        rises = [function(self.values + shift) - function(self.values - shift) for shift in np.diag(steps)]
        slopes = np.array(rises) / (2.0 * steps[:, None])
        return np.asarray(self.deviations * np.sqrt(np.diag(slopes.T @ self.covariance @ slopes)))


def motion(log: Log, thinned_Hz: float = THINNED_HZ) -> Motion:
    smooth = _low_pass(log)
    position = smooth(log.position_m)
    speed = np.gradient(position, log.period_s)
    sign = np.sign(speed) * (np.abs(speed) > SLOW_M_S)
    factor = max(1, round(1.0 / log.period_s / thinned_Hz))
    found = Motion(position - position.mean(), speed, np.gradient(speed, log.period_s), sign, factor)
    if len(found.thin(speed)) < MIN_BLOCKS * BLOCK_S * thinned_Hz or not (sign > 0).any() or not (sign < 0).any():
        raise LabError("the log moves too little: mass, friction and offset cannot be told apart")
    return found


def moving(seen: Motion, share: float) -> Array:
    return np.asarray(seen.thin(np.abs(seen.sign)) > share)


def _low_pass(log: Log) -> Callable[[Array], Array]:
    sections = butter(4, CUTOFF_HZ, fs=1.0 / log.period_s, output="sos")
    return lambda column: np.asarray(sosfiltfilt(sections, column))


def block_numbers(seen: Motion, period_s: float) -> Array:
    rows = len(seen.thin(seen.v))
    return (np.arange(rows) * seen.factor * period_s / BLOCK_S).astype(np.int64)


def linear(rows: Array, target: Array, blocks: Array) -> Fit:
    values, covariance = solved(rows, target, blocks)
    count = len(np.unique(blocks))
    if count < MIN_BLOCKS or not np.isfinite(values).all():
        raise LabError("the log moves too little: mass, friction and offset cannot be told apart")
    deviations = float(student.ppf(0.975, max(count - len(values), 1)))
    left = np.linalg.norm(target - rows @ values) / np.linalg.norm(target)
    return Fit(values, covariance, deviations, float(left))


class Volts(NamedTuple):
    """The fitted model `volts`: coefficients in V for m/s2, for m/s and for 1, and a delay in s."""

    mass: Estimate
    viscous: Estimate
    coulomb: Estimate
    offset: Estimate
    delay: Estimate
    relative_residual: float

    def voltage(self, log: Log) -> tuple[Array, Array]:
        """Return applied and predicted voltage, V (n each), of the thinned rows in motion."""
        seen = motion(log)
        values = np.array([self.mass.value, self.viscous.value, self.coulomb.value, self.offset.value])
        measured, _ = _voltage(log, seen, self.delay.value)
        moves = moving(seen, MOSTLY)
        return measured[moves], (_volts_rows(seen) @ values)[moves]


def _volts_rows(seen: Motion) -> Array:
    return np.column_stack([seen.thin(column) for column in (seen.a, seen.v, seen.sign, np.ones_like(seen.v))])


def _voltage(log: Log, seen: Motion, delay_s: float) -> tuple[Array, Array]:
    volts = _low_pass(log)(np.interp(log.t_s - delay_s, log.t_s, log.input_V))
    return seen.thin(volts), seen.thin(np.gradient(volts, log.period_s))


def fit_volts(log: Log) -> Volts:
    seen = motion(log)
    kept = moving(seen, MOSTLY)
    blocks = block_numbers(seen, log.period_s)[kept]
    rows = _volts_rows(seen)[kept]
    # gears pass on less than they take in, so mass differs between speeding up and braking; friction and offset vary
    # along the stroke
    left_out = (seen.a * np.sign(seen.a * seen.v), seen.sign * seen.x, seen.x)
    largest = (1.0, SPREAD * float(seen.x.std()), SPREAD * float(seen.x.std()))
    more = np.column_stack([rows, *(seen.thin(column)[kept] for column in left_out)])
    plain, delay_s = _with_delay(log, seen, rows, kept, blocks)
    full, full_delay_s = _with_delay(log, seen, more, kept, blocks)
    varied = [size * abs(float(value)) for size, value in zip(largest, full.values[4:7], strict=True)]
    spreads = (varied[0], 0.0, varied[1], varied[2])
    widths = plain.half_widths
    mass, viscous, coulomb, offset = (
        Estimate(float(value), float(width + abs(value - other) + spread))
        for value, width, other, spread in zip(plain.values, widths, full.values, spreads, strict=False)
    )
    delay = Estimate(delay_s, float(widths[4]) + abs(full_delay_s - delay_s))
    return Volts(mass, viscous, coulomb, offset, delay, plain.relative_residual)


def _with_delay(log: Log, seen: Motion, rows: Array, kept: Array, blocks: Array) -> tuple[Fit, float]:
    delay_s = 0.0
    for _ in range(DELAY_TURNS):
        target, slope = _voltage(log, seen, delay_s)
        fitted = linear(np.column_stack([rows, slope[kept]]), target[kept], blocks)
        delay_s += float(fitted.values[-1])
        if not abs(delay_s) <= LONGEST_DELAY_S:
            raise LabError(f"the voltage fits the motion best {delay_s:g} s later: allowed are {LONGEST_DELAY_S:g} s")
    return fitted, delay_s


class Variant(NamedTuple):
    """One way to fit a model: with more terms, other rows, other currents, or in a wider band."""

    is_full: bool = False
    moving_share: float = THROUGHOUT
    current_shift: float = 0.0
    currents: slice = slice(None)
    thinned_Hz: float = THINNED_HZ


OTHER_WAYS = (
    (Variant(is_full=True), Variant(is_full=True, moving_share=MOSTLY)),
    (Variant(current_shift=-0.5), Variant(current_shift=0.5)),
    # a sample a millisecond is not the current's mean; every second sample shows how much that matters
    (Variant(currents=slice(0, None, 2)), Variant(currents=slice(1, None, 2))),
    (Variant(thinned_Hz=WIDER_HZ),),
)
"Groups of ways, of which the one that differs most counts."


def _estimates(fit_in: Callable[[Variant], tuple[Array, Array]]) -> list[Estimate]:
    """Return the plain fit's values, with intervals that cover what OTHER_WAYS make of them."""
    values, widths = fit_in(Variant())
    apart = [np.max([np.abs(fit_in(variant)[0] - values) for variant in group], axis=0) for group in OTHER_WAYS]
    widths = np.sum([widths, *apart], axis=0)
    return [Estimate(float(value), float(width)) for value, width in zip(values, widths, strict=True)]


class Windings(NamedTuple):
    """The fitted model `windings`: ohm, henry, V s/m, s."""

    resistance: Estimate
    inductance: Estimate
    back_emf: Estimate
    delay: Estimate


def fit_windings(log: Log) -> Windings:

    def fit_in(variant: Variant) -> tuple[Array, Array]:
        seen = motion(log, variant.thinned_Hz)
        kept = moving(seen, variant.moving_share)
        current = _low_pass(log)(_current(log, variant))
        terms = [current, np.gradient(current, log.period_s), seen.v]
        if variant.is_full:  # brushes drop a voltage of their own, and a meter has an offset
            terms += [seen.sign, np.ones_like(seen.v)]
        rows = np.column_stack([seen.thin(term)[kept] for term in terms])
        fitted, delay_s = _with_delay(log, seen, rows, kept, block_numbers(seen, log.period_s)[kept])
        return np.append(fitted.values[:3], delay_s), fitted.half_widths[[0, 1, 2, -1]]

    return Windings(*_estimates(fit_in))


class Gearbox(NamedTuple):
    """The fitted model `gearbox`: kg, N s/m, the gears' efficiency, and N. `coulomb` is half the difference and
    `offset` half the sum of the forces for slow opening and closing, as means over the stroke."""

    mass: Estimate
    viscous: Estimate
    efficiency: Estimate
    coulomb: Estimate
    offset: Estimate


def fit_gearbox(log: Log, force_N_A: float) -> Gearbox:

    def fit_in(variant: Variant) -> tuple[Array, Array]:
        seen = motion(log, variant.thinned_Hz)
        kept = moving(seen, variant.moving_share)
        blocks = block_numbers(seen, log.period_s)[kept]
        force = force_N_A * _current(log, variant)
        x = seen.x / seen.x.std()
        terms = [seen.a, seen.v, seen.sign * np.abs(force), np.ones_like(x), x, x**2, seen.sign, seen.sign * x]
        target = seen.thin(force)[kept]
        fitted = linear(np.column_stack([seen.thin(term)[kept] for term in terms]), target, blocks)
        idle_N = 0.0
        if variant.is_full:
            # the force that turns the idle gears is not transmitted, so no share of it is lost
            idle_N = abs(float(fitted.values[6]))
            terms += [seen.sign * np.minimum(np.abs(force), idle_N), seen.a * np.sign(seen.a * seen.v)]
            fitted = linear(np.column_stack([seen.thin(term)[kept] for term in terms]), target, blocks)
        at = x[seen.sign != 0][:: seen.factor]

        def means(values: Array) -> Array:
            opening, closing = (_slow(values, at, direction, idle_N) for direction in (1.0, -1.0))
            return np.array([(opening - closing).mean() / 2.0, (opening + closing).mean() / 2.0])

        values = np.array([fitted.values[0], fitted.values[1], 1.0 - fitted.values[2], *means(fitted.values)])
        return values, np.array([*fitted.half_widths[:3], *fitted.half_widths_of(means)])

    return Gearbox(*_estimates(fit_in))


def _current(log: Log, variant: Variant) -> Array:
    if log.current_A is None:
        raise LabError("current_A: needed to tell the motor's windings from its load")
    times = log.t_s + variant.current_shift * log.period_s
    return np.asarray(np.interp(times, log.t_s[variant.currents], log.current_A[variant.currents]))


def _slow(values: Array, x: Array, direction: float, idle_N: float) -> Array:
    """Return the motor's force (n) that moves the carriage slowly at positions `x` (n)."""
    lost = float(values[2])
    idling = float(values[8]) if len(values) > 8 else 0.0
    load: Array = values[3] + values[4] * x + values[5] * x**2 + direction * (values[6] + values[7] * x)
    force = load
    # the loss depends on the force itself; each turn leaves less than the lost share of the error
    for _ in range(SETTLING_TURNS):
        force = load + direction * (lost * np.abs(force) + idling * np.minimum(np.abs(force), idle_N))
    return force
