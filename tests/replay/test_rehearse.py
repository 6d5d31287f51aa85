"""What would have happened instead: the simulator, with what was asked of the recorded one."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from flight import Flight

from tormagd.config import Config, Limits
from tormagd.ctl.main import main
from tormagd.ctl.replay import _instead
from tormagd.recording.black_box import read_black_box
from tormagd.replay.__main__ import main as run
from tormagd.replay.rebuild import ReplayError, rebuilt, recorded
from tormagd.replay.rehearse import changed, rehearse, script

Fly = Callable[..., Flight]


def test_the_simulator_does_it_again_and_a_changed_configuration_something_else(path: Path) -> None:
    known = recorded(read_black_box(path), path.parent)
    todo = script(known.columns, read_black_box(path).entries)
    assert [name for _, name in todo.commands] == ["home", "enable"]  # another enable was refused
    assert list(todo.recorded.faults) == ["ENCODER"]
    again = rehearse(rebuilt(known), known.config, todo, "sample_1", ["encoder_jump@3.5"])
    assert (list(again.faults), again.refused, again.faults["ENCODER"]) == (
        ["ENCODER"],
        [],
        pytest.approx(todo.recorded.faults["ENCODER"], abs=0.01),
    )
    config = changed(known.config, ["limits.following_error_mm=0.01", "limits.following_time_s=0.02"])
    instead = rehearse(rebuilt(known, config), config, todo, "sample_1", [])
    assert next(iter(instead.faults)) == "FOLLOWING_ERROR"
    assert instead.faults["FOLLOWING_ERROR"] < 3.5


def test_a_limit_that_was_too_narrow(fly: Fly, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Recorded: carriages that were 0.02 mm apart; with 2 mm that would have been no fault."""
    narrow = Config(limits=Limits(skew_warning_mm=0.02, skew_fault_mm=0.02))
    path = fly("drag_left=+300%@2.5", until_s=3.6, config=narrow).write(tmp_path / "narrow.mcap")
    assert run([str(path), "--set", "limits.skew_fault_mm=2", "--fault", "drag_left=+300%@2.5"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert [list(result[name]["faults"]) for name in ("recorded", "simulated", "instead")] == [["SKEW"], ["SKEW"], []]
    text = _instead(result)
    assert "simulated with limits.skew_fault_mm=2: no fault" in text
    assert "not known" not in text
    result["simulated"]["faults"] = {}
    assert "SKEW did not come in the simulation as configured then" in _instead(result)


def test_one_that_begins_in_the_middle_begins_with_a_device_that_is_driven(path: Path) -> None:
    box = read_black_box(path)
    known = recorded(box, path.parent)
    states = [place for place, entry in enumerate(box.entries) if entry[0] == "state"]
    todo = script(known.columns, box.entries[states[6] :])
    assert (todo.is_driven, todo.commands) == (True, [])
    done = rehearse(rebuilt(known), known.config, todo, "sample_2", [])
    assert (done.faults, done.refused) == ({}, [])


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("limits.skew_fault_mm=-1", "skew_fault_mm"),
        ("limits.skew_fault=2", "allowed is KEY=VALUE"),
        ("limits", "allowed is KEY=VALUE"),
        ("nothing.at.all=1", "there is no 'nothing.at.all'"),
        ("scene=", "scene"),
        ("rates.control_hz=[1]", "control_hz"),
    ],
)
def test_settings_that_are_none_are_refused(setting: str, said: str) -> None:
    if setting == "scene=":
        assert changed(Config(), [setting]).scene == ""
        return
    with pytest.raises(ReplayError, match=said):
        changed(Config(), [setting])


def test_the_commands_of_tormagctl(path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", str(path), "--from", "3"]) == 0
    assert capsys.readouterr().out.startswith("bit-exact, 1,000 ticks from 3.000 to 3.999 s")
    rubbish = tmp_path / "rubbish.mcap"
    rubbish.write_bytes(b"rubbish")
    assert main(["--json", "replay", str(rubbish)]) == 2
    captured = capsys.readouterr()
    assert json.loads(captured.out)["error"]["message"].startswith(f"{rubbish}: not an intact MCAP file")
    assert "Traceback" not in captured.err


def test_what_cannot_be_run_again_is_refused_in_one_line(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in (
        [str(path), "--from", "-1"],
        [str(path), "--set", "limits.skew=1"],
        [str(path), "--fault", "nonsense"],
        [str(path), "--fault", "no_sense", "--plant", "nowhere"],
        [str(path), "--config", "/nowhere"],
        [str(path.parent)],
    ):
        assert run(arguments) == 2
        captured = capsys.readouterr()
        assert (captured.out, captured.err.count("\n")) == ("", 1)
