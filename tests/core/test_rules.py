"""What holds in every step of the core: many more of the hostile histories that both builds run."""

import importlib.util
from pathlib import Path
from types import ModuleType

import msgspec
import pytest

from tormagd.control.assembly.build import Core
from tormagd.control.safety.operating_state import Event, OperatingState


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


def test_a_broken_rule_is_seen(core: Core, histories: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    weak = msgspec.structs.replace(core.config.position, duty_limit=0.36)
    with monkeypatch.context() as patch:
        patch.setattr(histories, "CONFIG", msgspec.structs.replace(core.config, position=weak))
        with pytest.raises(AssertionError, match="duties = "):
            histories.hostile(core, Unseen())
    with monkeypatch.context() as patch:
        patch.setattr(histories, "DRIVEN", (OperatingState.PAUSED,))
        with pytest.raises(AssertionError, match=r"mode=.* in "):
            histories.hostile(core, Unseen())
    monkeypatch.delitem(histories.WAYS, (Event.ENABLE, OperatingState.DISABLED))
    with pytest.raises(AssertionError, match="enable was taken in DISABLED"):
        histories.hostile(core, Unseen())
