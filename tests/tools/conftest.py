"""The tools are scripts; their folder is put on the path as it is when they are run."""

import os
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "tools"))


@pytest.fixture
def recordings() -> Path:
    """The folder of measured data, which is not part of the repository."""
    folder = Path(os.environ.get("TORMAG_DATA", ROOT / ".." / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip("no measured data: set TORMAG_DATA to its folder")
    return folder
