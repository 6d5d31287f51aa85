"""What the force shows: the sensor, force over gap and rate, how steps are followed, and the element's memory."""

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from tormagd.commission.finding import Array, Finding, finding, fitted
from tormagd.commission.procedure import (
    MOVING_MM_S,
    PLACES,
    Asked,
    Columns,
    Course,
    Known,
    Row,
    StoppedError,
    columns_of,
    given,
    handle_moved,
    watch,
)

SLIDING_MM_S = 20.0
"A faster handle has friction at speed, whatever its Stribeck speed."
MIN_SLIDING = 0.3
"A handle that moves for a smaller share of the time has taught little."
HOLD_S = 10.0
PARTS = 5
RAMPS_S = (6.0, 4.0, 4.0)
STEP_SHARES = (1.0, 0.0, 0.5, 1.0, 0.25, 0.75)
"Shares of the range: none was held before."
STEP_S, ARRIVED_S = 2.0, 1.0
"A step is held for STEP_S, of which ARRIVED_S is left to the carriages and the daemon's learning."
ENABLE_S = 2.0
_STATE = PLACES["operating_state"]
RESTED_S, RISEN_S, HELD_S = 4.0, 0.5, 6.0
WORN = "compare the insert with the scene's; replace one that is worn or swollen"
STRENGTH = (0.6, 1.5)
"The lower bound is the default `[trim]` for the weakest device; of 60 healthy draws the weakest has 0.63."
GAINS = "let the daemon run by the calibration that this commissioning writes (device.calibrations)"
CHANGING_N_S: Final = 1.0
STILL_MM_S, STROKE_S, TURNED_MM, RISEN = 2.0, 0.3, 0.5, 0.8
"The rubber's own way is under TURNED_MM: a force that is not at RISEN by then waits for its sensor."
SLOW = "set the sensor's amplifier to 15 Hz or more, and to 50 readings a second, or replace it"
TURN_MM = 40.0 * math.pi
HARMONICS = (1, 2, 3)
CURVE = (-0.09, 0.3)
"""Of 31 healthy devices the field law makes -0.06 to 0.26 1/N at MIDDLE_N; one bent by 10 %/N 0.07 more, or
0.16 less: upwards weights tell."""
MIDDLE_N = 1.3
STICKS = "look for what rubs beside the sensor, and for play in its mount; replace it"
STUCK_MN = (-5.0, 45.0)
BENT = "hang up two weights alike (--weight-N): they tell the sensor's curve from the magnets'; replace a bent sensor"
APART = "sensor's readings apart"
WAY = "friction one way over its mean"
SHAFT = "look whether shaft and insert run true, and at the sensor's mount"
SENSOR = "tare the sensor, look at its cable, shielding and supply"
ELEMENT = (
    "hang up a weight (--weight-N): it tells the sensor's gain from magnets and insert. Compare both with the scene"
)


def enabled(force_N: float) -> Course[None]:
    rows: Sequence[Row] = ()
    while not rows:
        _, rows = yield Asked(force_N)
    if rows[-1][_STATE] != "ENABLED":
        yield from given("enable", lambda row: bool(row[_STATE] == "ENABLED"), ENABLE_S, force_N)


def ready(force_N: float) -> Course[None]:
    yield from enabled(force_N)
    yield from handle_moved(force_N)


def sensor(known: Known) -> Course[list[Finding]]:
    """Hold one force on a handle that is moved both ways."""
    held_N = known.force_N(0.4)
    yield from ready(held_N)
    ticks = yield from watch(HOLD_S, lambda t_s: held_N)
    later = {name: values[len(values) // 5 :] for name, values in ticks.items()}
    require_sliding(later)
    raw_N, speed = later["device_force_N"], np.abs(later["handle_rate_mm_s"])
    way = np.where(speed > SLIDING_MM_S, _way(known, later), 0.0)
    both_ways = (
        (force_N[goes > 0], force_N[goes < 0])
        for force_N, goes in zip(np.array_split(raw_N, PARTS), np.array_split(way, PARTS), strict=True)
    )
    halves = [(np.mean(up_N) + np.mean(down_N)) / 2.0 for up_N, down_N in both_ways if up_N.size and down_N.size]
    over_model = later["measured_cf"] / later["predicted_cf"]
    slow, fast = (over_model[(speed > low) & (speed <= high)] for low, high in ((MOVING_MM_S, 25.0), (40.0, np.inf)))
    return [
        finding("sensor's zero", np.array(halves), "mN", (-60.0, 60.0), SENSOR, 1e3),
        *_jumps(raw_N, speed > SLIDING_MM_S),
        finding("sensor's rise after the handle's turn", _rises_s(known, later), "ms", (-300.0, 10.0), SLOW, 1e3),
        finding(
            "force when slow over force at speed, to the model's",
            float(np.nanmean(slow) / np.nanmean(fast)) if slow.size and fast.size else np.nan,
            "",
            (0.85, 1.15),
            "clean shaft and insert; train the insert with these motions",
        ),
    ]


def sensor_at_rest(ticks: Columns) -> list[Finding]:
    """Judge of a sensor what needs no motion."""
    whole = np.ones(ticks["device_force_N"].size, dtype=bool)
    apart_s = _readings_apart_s(ticks, whole)
    return [*_jumps(ticks["device_force_N"], whole), finding(APART, apart_s, "ms", (0.0, 30.0), SLOW, 1e3)]


def _jumps(force_N: Array, counts: npt.NDArray[np.bool_]) -> list[Finding]:
    """Return noise and resolution from the steps between readings; the noise where it `counts`."""
    jumps_N = np.abs(np.diff(force_N))
    known = jumps_N[counts[1:] & (jumps_N > 1e-6)]
    noise_N, least_N = np.sqrt(np.mean(known**2) / 2.0) if known.size else np.nan, jumps_N[jumps_N > 1e-6]
    return [
        finding("sensor's noise", noise_N, "mN", (0.0, 40.0), SENSOR, 1e3),
        finding("sensor's resolution", least_N.min(initial=np.inf), "mN", (0.0, 25.0), SENSOR, 1e3),
    ]


def force_over_gap(known: Known) -> Course[list[Finding]]:
    """Go slowly over the range and back while the handle is moved."""
    low_N, high_N = known.force_N(0.0), known.force_N(1.0)
    yield from ready(low_N)
    times_s = np.cumsum([0.0, *(lasts_s for lasts_s in RAMPS_S for _ in range(2))])
    forces_N = [low_N, *(len(RAMPS_S) * [high_N, low_N])]
    try:
        ticks = yield from watch(float(times_s[-1]), lambda t_s: float(np.interp(t_s, times_s, forces_N)))
    except StoppedError as error:
        # the daemon stops a device that it cannot believe: the row says how far off it is
        error.found = [_strength(columns_of(error.rows))]
        raise
    require_sliding(ticks)
    slides = np.abs(ticks["handle_rate_mm_s"]) > SLIDING_MM_S
    errors_N = (ticks["measured_cf"] - ticks["predicted_cf"])[slides]
    means_N = np.array([np.nanmean(part) for part in np.array_split(errors_N, max(len(errors_N) // 50, 1))])
    off_N = np.sqrt(np.mean(means_N**2))
    return [
        _strength(ticks),
        *_bent(ticks),
        finding("force over gap, off the learned curve by", off_N, "mN", (0.0, 45.0), ELEMENT, 1e3),
    ]


def _strength(ticks: Columns) -> Finding:
    """Return the device's force over the model's: what magnets, insert and the sensor's gain share."""
    slides = (np.abs(ticks["handle_rate_mm_s"]) > SLIDING_MM_S) & (ticks["predicted_cf"] > 0.0)
    over_model = (ticks["trim"] * ticks["measured_cf"] / ticks["predicted_cf"])[slides]
    return finding("force over the model's: magnets, insert, or sensor's gain", over_model, "", STRENGTH, ELEMENT)


def steps(known: Known) -> Course[list[Finding]]:
    """Step over the range while the handle is moved."""
    levels_N = [known.force_N(share) for share in STEP_SHARES]
    yield from ready(levels_N[1])
    yield from watch(ARRIVED_S, lambda t_s: levels_N[1])
    ticks = yield from watch(STEP_S * len(levels_N), lambda t_s: levels_N[min(int(t_s / STEP_S), len(levels_N) - 1)])
    require_sliding(ticks)
    errors_N, overshoots = [], []
    since_s = ticks["monotonic_s"] - ticks["monotonic_s"][0]
    slides = np.abs(ticks["handle_rate_mm_s"]) > SLIDING_MM_S
    gap_mm, reference_mm = ticks["left_mm"] + ticks["right_mm"], ticks["reference_gap_mm"]
    for number, level_N in enumerate(levels_N):
        is_in = (since_s >= number * STEP_S) & (since_s < (number + 1) * STEP_S)
        settled = is_in & slides & (since_s >= number * STEP_S + ARRIVED_S)
        errors_N.append(np.nanmean(ticks["measured_cf"][settled]) - level_N if settled.any() else np.nan)
        gap, reference = gap_mm[is_in], reference_mm[is_in]
        way_mm = reference[-1] - reference[0]
        beyond_mm = np.max(np.sign(way_mm) * gap) - np.max(np.sign(way_mm) * reference)
        overshoots.append(beyond_mm / abs(way_mm) if abs(way_mm) > 2.0 else 0.0)
    slope_N_s = np.abs(np.gradient(ticks["predicted_cf"] / ticks["trim"], ticks["monotonic_s"]))
    apart_mm = np.abs(ticks["left_mm"] - ticks["right_mm"])
    limit_mm = known.config.limits.skew_warning_mm
    return [
        finding("steps, off the asked force in the mean", np.array(errors_N).mean(), "mN", (-60.0, 60.0), SENSOR, 1e3),
        finding("steps, at worst", np.abs(errors_N).max(), "mN", (0.0, 100.0), SENSOR, 1e3),
        finding(APART, _readings_apart_s(ticks, slope_N_s > CHANGING_N_S), "ms", (0.0, 30.0), SLOW, 1e3),
        finding("carriages overshoot", max(0.0, *overshoots), "%", (0.0, 5.0), GAINS, 100.0),
        finding("carriages apart, of 99 % of the time", np.percentile(apart_mm, 99), "mm", (0.0, limit_mm), GAINS),
    ]


def _readings_apart_s(ticks: Columns, counts: npt.NDArray[np.bool_]) -> float:
    """Return the time between two readings where it `counts`."""
    changes = np.flatnonzero(np.diff(ticks["device_force_N"]))
    between_s = np.diff(ticks["monotonic_s"][changes])[counts[changes[1:]]]
    # an equal reading hides that it is one
    return float(np.quantile(between_s, 0.25)) if between_s.size else math.nan


def _rises_s(known: Known, ticks: Columns) -> float:
    """Return how long after a turned handle's TURNED_MM the force has come to RISEN of its stroke's."""
    speed, force_N = np.abs(ticks["handle_rate_mm_s"]), ticks["device_force_N"]
    rises_s = []
    for rows in np.split(np.arange(speed.size), np.flatnonzero(np.diff(speed > STILL_MM_S)) + 1):
        if speed[rows[0]] > STILL_MM_S and rows.size * known.period_s > STROKE_S:
            level_N = np.median(force_N[rows[rows.size // 2 :]])
            has_risen = force_N[rows] * np.sign(level_N) > RISEN * abs(level_N)
            has_turned = np.cumsum(speed[rows]) * known.period_s > TURNED_MM
            rises_s.append(float(np.argmax(has_risen)) - float(np.argmax(has_turned)))
    return float(np.median(rises_s)) * known.period_s if rises_s else math.nan


def _bent(ticks: Columns) -> list[Finding]:
    """Compare the force with the model's: of a closing gap with an opening one's, and its curve."""
    over_N, closes = ticks["predicted_cf"] / ticks["trim"] - MIDDLE_N, -_smooth(ticks["reference_gap_mm"], 200)
    rows = np.column_stack([np.ones_like(over_N), over_N, over_N**2, np.sign(np.gradient(closes))])
    slides = (np.abs(ticks["handle_rate_mm_s"]) > SLIDING_MM_S) & np.isfinite(over_N + ticks["measured_cf"])
    (_, slope, curve, half_N), *_ = np.linalg.lstsq(rows[slides], ticks["measured_cf"][slides], rcond=None)
    return [
        finding("force of a closing gap over an opening one's", 2.0 * half_N, "mN", STUCK_MN, STICKS, 1e3),
        finding("force's curve, of sensor or magnets", curve / slope**2, "1/N", CURVE, BENT),
    ]


def memory(known: Known) -> Course[list[Finding]]:
    """Hold the gap at a low force, step up and hold it there, and return what the force does meanwhile."""
    low_N, high_N = known.force_N(0.0), known.force_N(1.0)
    yield from ready(low_N)
    yield from watch(RESTED_S, lambda t_s: low_N)
    low = yield from _held(low_N)
    yield from watch(RISEN_S, lambda t_s: high_N)
    high = yield from _held(high_N)
    (low_N, _, low_zero_N, *_), _ = _at_held(known, low)
    (high_N, dies_N, zero_N, *waves_N), widths = _at_held(known, high)
    dies, width, way = -math.log(10.0) / high_N, widths[1], (zero_N - low_zero_N) / (high_N - low_N)
    found = [
        finding(
            "force that dies away from 0.5 to 5 s",
            100.0 * dies * dies_N,
            "%",
            (-2.0, 4.5),
            WORN,
            half_width=100.0 * float(abs(dies) * width),
        ),
        finding(WAY, way, "%", (-6.0, 6.0), SHAFT, 100.0),
    ]
    if waves_N:
        largest_N = max(map(math.hypot, waves_N[::2], waves_N[1::2]))
        found.append(finding("friction's ripple over a turn", largest_N / high_N, "%", (0.0, 8.0), SHAFT, 100.0))
    return found


def _held(force_N: float) -> Course[Columns]:
    yield from given("pause", lambda row: bool(row[_STATE] == "PAUSED"), ENABLE_S, force_N)
    ticks = yield from watch(HELD_S, lambda t_s: force_N, states=("PAUSED",))
    yield from given("resume", lambda row: bool(row[_STATE] == "ENABLED"), ENABLE_S, force_N)
    return ticks


def _at_held(known: Known, ticks: Columns) -> tuple[Array, Array]:
    """Fit the force along the motion: F = a + b ln t + d z, and over a whole turn a_k cos k angle + b_k sin k angle."""
    since_s, way = ticks["monotonic_s"] - ticks["monotonic_s"][0] + RISEN_S, _way(known, ticks)
    slides = np.abs(ticks["handle_rate_mm_s"]) > SLIDING_MM_S
    angle = math.tau / TURN_MM * ticks["device_handle_mm"]
    is_whole = np.ptp(angle) > math.tau
    waves = [wave(k * angle) for k in HARMONICS for wave in (np.cos, np.sin) if is_whole]
    rows = np.column_stack([np.ones_like(since_s), np.log(since_s / RISEN_S), way, *waves])[slides]
    return fitted(rows, (way * ticks["device_force_N"])[slides], np.floor(since_s[slides]))


def require_sliding(ticks: Columns) -> None:
    """Raise StoppedError where the handle moved for less than MIN_SLIDING of the ticks."""
    rates = ticks["handle_rate_mm_s"]
    share = float(np.mean(np.abs(rates) >= MOVING_MM_S)) if rates.size else 0.0
    if share < MIN_SLIDING:
        raise StoppedError(
            "handle_still",
            f"the handle moved in {share:.0%} of the time: needed are {MIN_SLIDING:.0%}, at {MOVING_MM_S:g} mm/s",
            "turn it to and fro until the gap opens",
        )


def _way(known: Known, ticks: Columns) -> Array:
    return np.sign(np.gradient(_smooth(ticks["device_handle_mm"], round(0.02 / known.period_s))))


def _smooth(values: Array, window: int) -> Array:
    """Return the running mean, continued at both ends."""
    window = max(window, 1) | 1
    padded = np.pad(values, window // 2, mode="edge")
    return np.convolve(padded, np.full(window, 1.0 / window), "valid")
