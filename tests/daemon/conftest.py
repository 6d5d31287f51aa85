import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from tormagd.assembly.build import Core, build_core
from tormagd.config import Config


@pytest.fixture(scope="session")
def core() -> Core:
    return build_core(Config())
