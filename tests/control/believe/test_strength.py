"""What a device shows of itself: scale told from offset as far as its forces allow, and no further."""

import math

import numpy as np
import pytest

from tormagd.control.believe.strength import (
    ERROR_N2_S,
    OFFSET_SD_N,
    SCALE_LASTS_S,
    SCALE_SD,
    SURE,
    UNSEEN,
    DeviceFit,
    adapting_s,
    forgotten,
    observe,
)

PERIOD_S = 0.004
LEAST, MOST = SCALES = (0.6, 1.6)
OFFSETS_N = (-0.2, 0.3)


def shown(
    levels: list[tuple[float, float]],
    scale: float,
    offset_N: float,
    fit: DeviceFit = UNSEEN,
    adapts_in_s: float = 0.5,
) -> DeviceFit:
    """The fit after a device of that scale and offset was held at these model forces, with noise."""
    random = np.random.default_rng(1)
    for seconds, model_N in levels:
        for noise_N in random.normal(0.0, 0.01, round(seconds / PERIOD_S)).tolist():
            measured_N = scale * model_N + offset_N + noise_N
            fit, _ = observe(
                fit, model_N, measured_N, PERIOD_S, adapts_in_s=adapts_in_s, scales=SCALES, offsets_N=OFFSETS_N
            )
    return fit


@pytest.mark.parametrize(("scale", "offset_N"), [(1.0, 0.0), (0.7, -0.05), (1.4, -0.1), (1.2, 0.05)])
def test_two_forces_tell_scale_and_offset_apart(scale: float, offset_N: float) -> None:
    fit = shown([(1.0, 0.7), (1.0, 2.0), (1.0, 0.7)], scale, offset_N)
    for model_N in (0.7, 2.0):
        assert fit.force_N(model_N) == pytest.approx(scale * model_N + offset_N, abs=0.07)
    assert fit.scale == pytest.approx(scale, abs=0.06)


def test_one_force_is_right_where_it_was_shown_and_uncertain_elsewhere() -> None:
    fit = shown([(2.0, 0.7)], 1.3, 0.0)
    assert fit.force_N(0.7) == pytest.approx(0.91, abs=0.01)
    assert fit.deviation_N(0.7) < 0.07
    assert fit.deviation_N(2.0) > 2.0 * fit.deviation_N(0.7)
    assert abs(fit.force_N(2.0) - 2.6) < SURE * fit.deviation_N(2.0)


def test_an_offset_is_learned_in_its_time_and_the_scale_stays() -> None:
    known = shown([(1.0, 0.7), (2.0, 2.0)], 1.1, 0.0)
    drifted = shown([(1.5, 2.0)], 1.1, -0.1, known)
    assert (drifted.force_N(2.0), drifted.scale) == (pytest.approx(2.1, abs=0.02), pytest.approx(1.1, abs=0.05))


def test_a_scale_beyond_its_bounds_is_held_and_said() -> None:
    before = DeviceFit(1.0, 0.05)
    fit, is_held = observe(before, 2.0, 6.0, 1.0, adapts_in_s=0.5, scales=SCALES, offsets_N=(-0.2, 2.9))
    assert (is_held, fit.scale) == (True, MOST)
    assert fit.force_N(2.0) == pytest.approx(6.0, abs=0.1), "the offset takes what is left"
    held, is_held = observe(before, 2.0, 6.0, 1.0, adapts_in_s=0.5, scales=SCALES, offsets_N=OFFSETS_N)
    assert (is_held, held.scale, held.offset_N) == (True, MOST, OFFSETS_N[1])


STRONGEST = 1.53
"Friction, modulus and field are all at the ends of the plant card."


@pytest.mark.parametrize("levels", [[], [(0.2, 0.7)], [(2.0, 0.7)], [(2.0, 0.7), (2.0, 1.6)]])
@pytest.mark.parametrize("scale", [LEAST, 0.8, 1.0, 1.2, STRONGEST])
def test_what_is_surely_within_is_within(levels: list[tuple[float, float]], scale: float) -> None:
    most_N = 2.5
    model_N = shown(levels, scale, 0.0).surely_within_N(most_N, SCALES)
    assert scale * model_N <= 1.03 * most_N * (1.0 if levels else STRONGEST / (1.0 + SURE * SCALE_SD))
    assert most_N / MOST <= model_N <= most_N / LEAST


def test_the_ceiling_moves_once_a_weak_device_has_shown_itself() -> None:
    weak = shown([(2.0, 0.7), (2.0, 1.6)], 0.75, 0.0)
    assert weak.surely_within_N(2.5, SCALES) > 1.5 * DeviceFit().surely_within_N(2.5, SCALES)


def test_a_device_of_which_nothing_is_sure_is_taken_for_the_strongest() -> None:
    assert DeviceFit(scale=2.0 * SCALE_SD).surely_within_N(2.5, SCALES) == 2.5 / MOST


def test_where_stronger_devices_are_allowed_the_ceiling_holds_for_them() -> None:
    strong = DeviceFit(3.0, scale_variance=0.0, offset_variance_N2=0.0)
    assert strong.force_N(strong.surely_within_N(2.5, (LEAST, 4.0))) == pytest.approx(2.5)


@pytest.mark.parametrize("relaxed_N", [0.0, 0.1, 0.25])
def test_over_the_force_without_memory_it_says_the_same(relaxed_N: float) -> None:
    fit = DeviceFit(0.9, -0.05, 0.01, -0.004, 0.006)
    over = fit.relaxed(relaxed_N)
    for model_N in (0.5, 1.0, 2.0):
        assert (over.force_N(model_N), over.deviation_N(model_N)) == pytest.approx(
            (fit.force_N(model_N - relaxed_N), fit.deviation_N(model_N - relaxed_N))
        )


@pytest.mark.parametrize("factor", [0.8, 1.0, 1.25])
def test_of_so_many_times_the_force_it_is_as_many_times_as_unsure(factor: float) -> None:
    fit = DeviceFit(0.9, -0.05, 0.01, -0.004, 0.006)
    more = fit.times(factor)
    assert (more.scale_sd, more.deviation_N(0.0)) == pytest.approx((factor * 0.1, factor * math.sqrt(0.006)))
    for model_N in (0.5, 2.0):
        assert (more.force_N(model_N), more.deviation_N(model_N)) == pytest.approx(
            (factor * fit.force_N(model_N), factor * fit.deviation_N(model_N))
        )


def test_what_is_known_is_forgotten_in_its_time() -> None:
    known, adapts_in_s = DeviceFit(1.2, 0.05, 0.01, 0.001, 0.002), 0.5
    offset_lasts_s = 2.0 * OFFSET_SD_N**2 * adapts_in_s**2 / ERROR_N2_S
    left = math.exp(-2.0)
    warmed, relaxed = (forgotten(known, dt_s, adapts_in_s) for dt_s in (SCALE_LASTS_S, offset_lasts_s))
    assert (warmed.scale, warmed.offset_N, warmed.scale_variance) == (
        known.scale,
        known.offset_N,
        pytest.approx(SCALE_SD**2 + left * (0.01 - SCALE_SD**2)),
    )
    assert relaxed.offset_variance_N2 == pytest.approx(OFFSET_SD_N**2 + left * (0.002 - OFFSET_SD_N**2))
    half = forgotten(known, 0.5 * offset_lasts_s, adapts_in_s)
    assert forgotten(half, 0.5 * offset_lasts_s, adapts_in_s).covariance_N == pytest.approx(relaxed.covariance_N)
    assert 0.0 < relaxed.covariance_N < left**0.5 * known.covariance_N


@pytest.mark.parametrize("learns", [(True, False), (False, True), (False, False)])
def test_what_is_left_out_keeps_its_uncertainty_and_is_counted_with(learns: tuple[bool, bool]) -> None:
    fit, terms = (
        DeviceFit(1.1, 0.02, 0.02, 0.001, 0.008),
        {"adapts_in_s": 0.5, "scales": SCALES, "offsets_N": OFFSETS_N},
    )
    found, _ = observe(fit, 1.5, 1.7, 0.01, learns=learns, **terms)
    aged, _ = observe(fit, 1.5, 1.7, 0.01, learns=(False, False), **terms)
    before = np.array([[aged.scale_variance, aged.covariance_N], [aged.covariance_N, aged.offset_variance_N2]])
    seen = np.array([1.5, 1.0])
    noise_N2 = ERROR_N2_S / 0.01
    gains = before @ seen / (seen @ before @ seen + noise_N2) * learns
    kept = np.eye(2) - np.outer(gains, seen)
    joseph = kept @ before @ kept.T + noise_N2 * np.outer(gains, gains)
    assert (found.scale_variance, found.covariance_N, found.offset_variance_N2) == pytest.approx(
        (*joseph[0], joseph[1, 1])
    )
    assert (found.scale != fit.scale, found.offset_N != fit.offset_N) == learns


KNOWN = DeviceFit(scale_variance=1e-6, offset_variance_N2=1e-4)


def test_a_surprise_is_learned_sooner_and_noise_is_none() -> None:
    soon_s = adapting_s(0.5, 0.1)
    assert adapting_s(0.5, 0.0) == 0.5
    assert shown([(0.15, 1.5)], 1.0, 0.1, KNOWN, soon_s).force_N(1.5) > 1.58
    assert shown([(0.15, 1.5)], 1.0, 0.1, KNOWN).force_N(1.5) < 1.52
    assert shown([(10.0, 1.5)], 1.0, 0.0, KNOWN, adapting_s(0.5, 0.003)).force_N(1.5) == pytest.approx(1.5, abs=1e-3)
