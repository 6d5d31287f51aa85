"""Where the measured data are that some tools play."""

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture
def recordings() -> Path:
    """The folder of measured data, which is not part of the repository."""
    folder = Path(os.environ.get("TORMAG_DATA", ROOT / ".." / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip("no measured data: set TORMAG_DATA to its folder")
    return folder
