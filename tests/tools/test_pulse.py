"""The demonstration's profile and its score."""

import numpy as np
import pytest
from rendering import human_pulse
from rendering.tracking import tracking


def test_the_pulse_spans_what_was_asked_and_has_no_images():
    times_s, forces_N = human_pulse.pulse_profile(10.0, 1.4, 1.7, 500)
    assert len(times_s) == 5_000
    assert forces_N.min() == pytest.approx(1.4)
    assert forces_N.max() == pytest.approx(1.7)
    spectrum = np.abs(np.fft.rfft((forces_N - forces_N.mean()) * np.hanning(len(forces_N))))
    high = np.fft.rfftfreq(len(forces_N), 2e-3) > 30.0
    assert spectrum[high].max() < 1e-3 * spectrum.max()


def test_a_longer_pulse_than_was_recorded_is_refused():
    with pytest.raises(ValueError, match="allowed is up to"):
        human_pulse.pulse_profile(60.0, 1.4, 1.7, 500)


def test_the_approach_ends_where_the_pulse_begins():
    times_s, forces_N = human_pulse.with_approach(*human_pulse.pulse_profile(2.0, 1.4, 1.7, 500), 0.6, 1.0, 0.5)
    assert forces_N[0] == 0.6
    assert np.abs(np.diff(forces_N)).max() < 0.01
    assert times_s[-1] == pytest.approx(3.5, abs=0.01)


def test_nothing_is_removed_from_the_error():
    reference = np.sin(np.linspace(0.0, 20.0, 1_000))
    result = tracking(reference, reference + 0.5)
    assert result.rms_N == pytest.approx(0.5)
    assert result.mean_N == pytest.approx(0.5)
    assert result.variance_accounted_for == pytest.approx(1.0 - 0.25 / reference.var())
