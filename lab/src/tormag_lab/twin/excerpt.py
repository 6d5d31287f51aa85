"""What a twin takes from a recording, in one pass: the force a hundred times a second, and how the carriages move.

Only that stays in memory, about 5 kB for a second of recording.
"""

import math
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from tormag_lab.arrays import Array
from tormag_lab.errors import LabError
from tormagd.commission.carriage_findings import SIDES, smooth, smoothed
from tormagd.record.reader import RecordingError, Shown, read_recording

GRID_HZ = 100.0
"Each row is a mean over its time."
CHUNK_S = 30.0
LONGEST_S = 4.0 * 3600.0
MIN_S, MIN_HZ = 20.0, 200.0
"A shorter recording shows no memory; a thinned one no motor."
EVERY_TICK = 0.9
"With more changes of the reading for each tick, the sensor is at least as fast as the ticks."
MIN_TICKS = 1000
"A shorter end of a recording is not smoothed for its carriages."
MOVING_EVERY_S = 0.02
MIDDLE, MIDDLE_SD = np.linspace(0.3, 0.7, 41), 0.6868
"Middle quantiles, whose mean the sensor's steps hardly move, and that mean of a normal value."
IDLE_A = 0.2
"About the current of an idling gearbox, about which the laws are linear."


NUMBERS = (
    *("monotonic_s", "measurement", "left_mm", "right_mm", "device_handle_mm", "device_force_N"),
    *("device_temperature_C", "left_current_A", "right_current_A", "supply_V", "left_duty", "right_duty"),
    "device_clock_drift",
)
Tick = msgspec.defstruct(
    "Tick", [*((name, float, math.nan) for name in NUMBERS), ("device_mode", str, "")], frozen=True, gc=False
)
"What is read of a control tick; NaN is unknown."


class Moves(NamedTuple):
    """Rows (n) of one carriage in motion; opening is positive. `block` numbers half a second each."""

    block: Array
    volts: Array
    volts_s: Array
    current_A: Array
    current_A_s: Array
    speed_m_s: Array
    acceleration_m_s2: Array
    gap_mm: Array
    over_A: Array
    "Mean of the current above IDLE_A: it ripples, and the mesh loses a share of each peak."
    over_share: Array
    "Share of the time above IDLE_A."


class Excerpt(NamedTuple):
    """What one recording says: rows (n) at GRID_HZ without a gap in time, and the moving carriages. `force_N` is NaN
    where the sensor had no new reading; `noise_N` is its noise by chunk."""

    name: str
    gap_mm: Array
    handle_mm: Array
    force_N: Array
    temperature_C: Array
    readings: Array
    ticks: Array
    noise_N: Array
    supply_V: float
    clock_ppm: float
    moves: dict[str, Moves]

    def first(self, lasts_s: float) -> "Excerpt":
        rows = {name: getattr(self, name)[: round(lasts_s * GRID_HZ)] for name in ROWS}
        return self._replace(**rows, moves={})

    @property
    def time_s(self) -> Array:
        return np.arange(len(self.gap_mm)) / GRID_HZ

    @property
    def minute(self) -> Array:
        return np.asarray((self.time_s - self.time_s[-1] / 2.0) / 60.0)


ROWS = ("gap_mm", "handle_mm", "force_N", "temperature_C", "readings", "ticks")


def excerpt_of(path: Path) -> Excerpt:
    taking = Taking(str(path))
    try:
        read_recording(path, Tick, taking.see)
    except RecordingError as error:
        raise LabError(str(error)) from error
    return taking.done()


class Taking:
    """Makes an `Excerpt` of control ticks, taken in the order of time."""

    def __init__(self, name: str) -> None:
        self._name, self._refusal = name, ""
        self._rows: list[tuple[float, ...]] = []
        self._first_s = math.nan
        self._reading_N = math.nan
        self._grids: list[Array] = []
        self._noise_N: list[float] = []
        self._others: list[tuple[float, float]] = []
        self._moves: dict[str, list[Array]] = {side: [] for side in SIDES}

    def see(self, seen: Shown) -> None:
        """Take a message, if it is a control tick with a time."""
        if not seen.is_tick or self._refusal or math.isnan(now_s := seen.message.monotonic_s):
            return
        if not self._rows:
            self._first_s = now_s
        before_s = self._rows[-1][0] if self._rows else now_s
        if now_s < before_s:
            self._refusal = f"monotonic_s = {now_s} after {before_s}: allowed is time that rises"
        elif now_s - self._first_s > LONGEST_S:
            self._refusal = f"{now_s - self._first_s:.0f} s of recording: allowed are {LONGEST_S:g} s"
        elif (now_s - self._first_s) // CHUNK_S > (before_s - self._first_s) // CHUNK_S:
            self._end_chunk()
        *numbers, mode = msgspec.structs.astuple(seen.message)
        self._rows.append((*numbers, float(mode == "RUN")))

    def done(self) -> Excerpt:
        if self._rows:
            self._end_chunk()
        grid = np.concatenate(self._grids, axis=1) if self._grids else np.zeros((6, 1))
        gap_mm, handle_mm, force_N, temperature_C, readings, ticks = grid
        others = np.array(self._others or [(math.nan, math.nan)])
        lasts_s, rate_Hz = len(ticks) / GRID_HZ, float(np.median(ticks)) * GRID_HZ
        refusals = (
            (bool(self._refusal), self._refusal),
            (lasts_s < MIN_S, f"{lasts_s:.1f} s of control ticks: allowed are at least {MIN_S:g} s"),
            (rate_Hz < MIN_HZ, f"{rate_Hz:.0f} control ticks a second: allowed are at least {MIN_HZ:g}, all of them"),
            (
                not (np.isfinite(grid[:4]).all(axis=0).any() and np.isfinite(others).any(axis=0).all()),
                "never all of gap, handle, force, temperature, supply and clock in it: allowed is a homed device",
            ),
        )
        for is_so, reason in refusals:
            if is_so:
                raise LabError(f"{self._name}: {reason}")
        supply_V, clock = np.nanmedian(others, axis=0)
        return Excerpt(
            self._name,
            _held(gap_mm),
            _held(handle_mm),
            np.where(np.isfinite(gap_mm + handle_mm), force_N, np.nan),
            _held(temperature_C),
            readings,
            ticks,
            np.array(self._noise_N),
            float(supply_V),
            1e6 * float(clock),
            {side: Moves(*np.concatenate(rows, axis=1)) for side, rows in self._moves.items()},
        )

    def _end_chunk(self) -> None:
        """Reduce the waiting ticks to rows, noise, supply, clock and moves of a chunk."""
        columns = dict(zip((*NUMBERS, "runs"), np.array(self._rows).T, strict=True))
        columns["gap_mm"] = columns["left_mm"] + columns["right_mm"]
        self._rows = []
        times_s = columns["monotonic_s"] - self._first_s
        begin = sum(each.shape[1] for each in self._grids)
        place = np.floor(times_s * GRID_HZ + 1e-6).astype(np.int64) - begin
        rows = int(place[-1]) + 1
        ticks = np.bincount(place, minlength=rows).astype(np.float64)

        def mean(values: Array) -> Array:
            known = np.isfinite(values)
            counts = np.bincount(place[known], minlength=rows)
            sums = np.bincount(place[known], values[known], minlength=rows)
            return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)

        force_N = columns["device_force_N"]
        changes = np.diff(force_N, prepend=self._reading_N) != 0.0
        self._reading_N = float(force_N[-1])
        means = [
            mean(columns[name]) for name in ("gap_mm", "device_handle_mm", "device_force_N", "device_temperature_C")
        ]
        self._grids.append(np.array([*means, np.bincount(place, changes, minlength=rows), ticks]))
        # a sensor that reads in every tick sometimes reads the same twice
        told = changes | (changes.mean() > EVERY_TICK)
        fresh_N = force_N[told & np.isfinite(force_N)]
        # a reversal is no noise, and the middle quantiles pass it over
        bends_N = np.abs(fresh_N[2:] - 2.0 * fresh_N[1:-1] + fresh_N[:-2])
        middle_N = float(np.quantile(bends_N, MIDDLE).mean()) if bends_N.size else 0.0
        self._noise_N.append(middle_N / MIDDLE_SD / math.sqrt(6.0))
        self._others.append((float(np.median(columns["supply_V"])), float(columns["device_clock_drift"][-1])))
        if len(times_s) < MIN_TICKS:
            return
        period_s = float(np.median(np.diff(times_s)))
        for side in SIDES:
            self._moves[side].append(_moving(columns, side, times_s, period_s))


def _moving(columns: dict[str, Array], side: str, times_s: Array, period_s: float) -> Array:
    """Return the rows of `Moves` (10 x n) while the duties drive the carriage `side`."""
    seen = smoothed(period_s, columns, side)
    margin = 2 * seen.window
    even = np.ones(len(times_s))
    # across a gap in time or another mode, smoothed motion is not of these duties
    even[1:] = np.abs(np.diff(times_s) - period_s) < 0.5 * period_s
    steady = np.convolve(1.0 - even * columns["runs"], np.ones(2 * margin + 1), "same") < 0.5
    steady[:margin] = steady[-margin:] = False
    kept = np.flatnonzero(seen.moves & steady)
    kept = kept[:: max(round(MOVING_EVERY_S / period_s), 1)]
    volts_s = np.gradient(seen.volts) / period_s
    told_A = columns[f"{side}_current_A"]
    # the current rises to its reading within a tick, so its mean is about half way
    over_A = np.abs(0.5 * (told_A + np.roll(told_A, 1))) - IDLE_A
    return np.array(
        [
            np.floor(2.0 * times_s[kept]),
            *(
                values[kept]
                for values in (
                    seen.volts,
                    volts_s,
                    seen.current_A,
                    seen.slope_A_s,
                    seen.speed_m_s,
                    seen.acceleration_m_s2,
                    columns["gap_mm"],
                    smooth(np.maximum(over_A, 0.0), seen.window),
                    smooth(np.where(over_A > 0.0, 1.0, 0.0), seen.window),
                )
            ),
        ]
    )


def _held(values: Array) -> Array:
    known = np.flatnonzero(np.isfinite(values))
    return values[known[np.maximum(np.searchsorted(known, np.arange(len(values)), side="right") - 1, 0)]]
