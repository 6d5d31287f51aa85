import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from tormagd.config import Config
from tormagd.control.assembly.build import Core, build_core


@pytest.fixture(scope="session")
def core() -> Core:
    return build_core(Config())
