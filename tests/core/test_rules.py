"""What holds in every step of the core: many more of the hostile histories that both builds run."""

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

from tormagd.control.assembly.build import Core


class Unseen:
    def see(self, thing: object) -> None:
        """Drop it."""


@pytest.fixture
def histories() -> ModuleType:
    spec = importlib.util.spec_from_file_location("histories", Path(__file__).parent / "histories.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_no_hostile_history_breaks_a_rule(core: Core, histories: ModuleType) -> None:
    histories.hostile(core, Unseen(), episodes=270)
