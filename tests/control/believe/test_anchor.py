"""What a device first showed: a curve that readings teach, and forgets nothing (synthetic)."""

import pytest

from tormagd.control.believe.sensor import KNOWN_N
from tormagd.control.believe.strength import LEAST_N, MIDDLE_N, UNSEEN, Anchor

PERIOD_S = 0.004


def device_N(model_N: float) -> float:
    """A device of another field law than the model's."""
    return 1.1 * model_N - 0.05 + 0.07 * (model_N - 1.2) ** 2


@pytest.fixture
def known() -> Anchor:
    anchor = Anchor(UNSEEN)
    for model_N in (0.6, 0.9, 1.3, 2.0):
        for _ in range(900):
            anchor.learn(model_N, device_N(model_N), PERIOD_S)
    return anchor


def test_the_curve_of_a_device_is_learned(known: Anchor) -> None:
    for model_N in (0.6, 0.9, 1.3, 1.7, 2.0):
        assert known.force_N(model_N) == pytest.approx(device_N(model_N), abs=0.01)
        assert known.deviation_N(model_N) < KNOWN_N
        # the term for wide gaps is not inverted
        assert model_N < LEAST_N or known.model_N(known.force_N(model_N)) == pytest.approx(model_N)


def test_at_another_force_it_is_less_sure() -> None:
    anchor = Anchor(UNSEEN)
    for _ in range(900):
        anchor.learn(0.8, device_N(0.8), PERIOD_S)
    assert anchor.deviation_N(0.8) < KNOWN_N < 0.1 < anchor.deviation_N(2.0)


def test_a_force_that_the_curve_never_gives_is_beyond_where_it_gives_most(known: Anchor) -> None:
    known.values[2] = -0.2
    assert known.model_N(50.0) > MIDDLE_N + 0.5 * known.values[0] / 0.2


def test_a_wide_gap_with_another_field_leaves_the_forces_of_scenes_as_they_are() -> None:
    anchor = Anchor(UNSEEN)
    for model_N, seconds in ((0.53, 1.0), (0.9, 3.0), (2.3, 3.0)):
        for _ in range(round(seconds / PERIOD_S)):
            anchor.learn(model_N, 0.89 * model_N - 0.09 + 0.64 * max(1.0 - model_N, 0.0) ** 2, PERIOD_S)
    assert [anchor.force_N(model_N) for model_N in (0.53, 0.9, 2.3)] == pytest.approx([0.523, 0.717, 1.957], abs=0.02)
