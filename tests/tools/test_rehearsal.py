"""What `make run` plays in virtual time, each case for a second."""

import demo
import numpy as np
import pytest
from rendering.rehearsal import Case, rehearse

from tormagd.config import Config


@pytest.mark.parametrize("case", demo.CASES, ids=lambda case: case.label)
def test_every_case_of_the_demo_is_played(case: Case) -> None:
    times_s = np.arange(0.0, 1.0, 0.002)
    done = rehearse(Config(scene="pulse"), case, times_s, 1.5 + 0.1 * np.sin(2.0 * np.pi * times_s))
    assert np.isfinite(done.rendered_N).all()
    assert len(done.rendered_N) > 500
