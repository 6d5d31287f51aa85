"""What the force shows: the sensor, force over gap and rate, how steps are followed, and the element's memory."""

import math
from collections.abc import Sequence

import numpy as np

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
FAST_MM_S = 40.0
WORN = "compare the insert with the scene's; replace one that is worn or swollen"
STRENGTH = (0.6, 1.5)
"The lower bound is the default `[trim]` for the weakest device; of 60 healthy draws the weakest has 0.63."
GAINS = "let the daemon run by the calibration that this commissioning writes (device.calibrations)"
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
    jumps_N = np.abs(np.diff(raw_N))
    over_model = later["measured_cf"] / later["predicted_cf"]
    slow, fast = (over_model[(speed > low) & (speed <= high)] for low, high in ((MOVING_MM_S, 25.0), (40.0, np.inf)))
    still = jumps_N[(speed[1:] > SLIDING_MM_S) & (jumps_N > 0.0)]
    return [
        finding("sensor's zero", np.array(halves), "mN", (-60.0, 60.0), SENSOR, 1e3),
        finding(
            "sensor's noise", np.sqrt(np.mean(still**2) / 2.0) if still.size else np.nan, "mN", (0.0, 40.0), SENSOR, 1e3
        ),
        finding("sensor's resolution", jumps_N[jumps_N > 1e-6].min(initial=np.inf), "mN", (0.0, 25.0), SENSOR, 1e3),
        finding(
            "force when slow over force at speed, to the model's",
            float(np.nanmean(slow) / np.nanmean(fast)) if slow.size and fast.size else np.nan,
            "",
            (0.85, 1.15),
            "clean shaft and insert; train the insert with these motions",
        ),
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
    apart_mm = np.abs(ticks["left_mm"] - ticks["right_mm"])
    limit_mm = known.config.limits.skew_warning_mm
    return [
        finding("steps, off the asked force in the mean", np.array(errors_N).mean(), "mN", (-60.0, 60.0), SENSOR, 1e3),
        finding("steps, at worst", np.abs(errors_N).max(), "mN", (0.0, 100.0), SENSOR, 1e3),
        finding("carriages overshoot", max(0.0, *overshoots), "%", (0.0, 5.0), GAINS, 100.0),
        finding("carriages apart, of 99 % of the time", np.percentile(apart_mm, 99), "mm", (0.0, limit_mm), GAINS),
    ]


def memory(known: Known) -> Course[list[Finding]]:
    """Step up, hold that gap, and return the share of the force that dies away."""
    low_N, high_N = known.force_N(0.0), known.force_N(1.0)
    yield from ready(low_N)
    yield from watch(RESTED_S, lambda t_s: low_N)
    yield from watch(RISEN_S, lambda t_s: high_N)
    yield from given("pause", lambda row: bool(row[_STATE] == "PAUSED"), ENABLE_S, high_N)
    ticks = yield from watch(HELD_S, lambda t_s: high_N, states=("PAUSED",))
    yield from given("resume", lambda row: bool(row[_STATE] == "ENABLED"), ENABLE_S, high_N)
    since_s = ticks["monotonic_s"] - ticks["monotonic_s"][0] + RISEN_S
    slides = (np.abs(ticks["handle_rate_mm_s"]) > FAST_MM_S) & np.isfinite(ticks["measured_cf"])
    # F = a + b ln t, and the sensor's zero, whose sign the handle's direction turns over
    rows = np.column_stack([np.ones_like(since_s), np.log(since_s / RISEN_S), _way(known, ticks)])[slides]
    values, widths = fitted(rows, ticks["measured_cf"][slides], np.floor(since_s[slides]))
    share = -math.log(10.0) / values[0]
    dies, width = 100.0 * share * values[1], float(100.0 * abs(share * widths[1]))
    return [finding("force that dies away from 0.5 to 5 s", dies, "%", (-2.0, 4.5), WORN, half_width=width)]


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
