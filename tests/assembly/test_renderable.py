"""What carriages of a top speed miss of a force, held against what can be said by hand."""

import numpy as np
import pytest

from tormagd.control.aim.portrait import Portrait
from tormagd.control.assembly.build import missed

# 1 N over 50 mm, evenly: at 25 mm/s half a newton a second everywhere
EVEN = Portrait(np.linspace(95.0, 45.0, 11).tolist(), np.linspace(0.5, 1.5, 11).tolist(), [0.02] * 11)
TIMES_S = np.linspace(0.0, 1.0, 1001)


@pytest.mark.parametrize(
    ("forces_N", "rms_N", "share"),
    [
        (np.full(1001, 0.5), 0.0, 0.0),
        (0.5 + 0.49 * TIMES_S, 0.0, 0.0),
        (np.where(TIMES_S > 0.0, 1.2, 0.7), 0.5 / np.sqrt(3.0), 0.001),
        # faster than half a newton a second where the sine is above 0.4
        (1.0 - 0.4 * np.cos(np.pi * TIMES_S), None, 1.0 - 2.0 * np.arcsin(0.5 / (0.4 * np.pi)) / np.pi),
    ],
    ids=["stands", "slow", "step", "too fast for a while"],
)
def test_carriages_miss_what_is_faster_than_they_are(forces_N, rms_N: float | None, share: float) -> None:
    found = missed(EVEN, TIMES_S.tolist(), forces_N.tolist(), 25.0)
    assert rms_N is None or found.rms_N == pytest.approx(rms_N, rel=2e-3, abs=1e-12)
    assert found.share == pytest.approx(share, abs=0.005 if rms_N is None else 1e-9)
