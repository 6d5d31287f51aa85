"""What the tests of all three distributions share."""

import os
import signal
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

# No test asserts a wall-clock duration. One commit has one verdict: a property's cases are drawn from its source, and
# `make search` draws others, whose finds become an `@example`
UNHURRIED = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("tormagd", UNHURRIED, derandomize=True, max_examples=40)
settings.register_profile("search", UNHURRIED, print_blob=True, max_examples=200)
settings.load_profile("tormagd")
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # pytest-xdist's workers ignore Ctrl-C, and what a test starts would inherit that
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture
def recordings() -> Path:
    folder = Path(os.environ.get("TORMAG_DATA", Path(__file__).parents[1] / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip("no measured data: set TORMAG_DATA to its folder")
    return folder
