"""What passed between daemon and device, run again through the same link; and what would have happened instead."""

import json
from collections import Counter
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any

import msgspec
import pytest
from flight import Flight, altered, frames
from mcap.reader import make_reader

from firmware_protocol.codec import FUNCTION, Drive, Home, State, can_identifier, decode
from firmware_protocol.framing import FrameDecoder
from tormagd.config import Config, Limits
from tormagd.control.assembly.build import Core
from tormagd.control.safety.codes import Fault
from tormagd.ctl.main import main
from tormagd.ctl.record import _instead
from tormagd.record.reader import BlackBoxFile
from tormagd.record.rerun import ReplayError, rebuilt, recorded, rerun, ticks_of
from tormagd.simulation.rehearse import changed, main as run_changed, rehearse, script

DAMAGED_TICK, SNAPSHOT_S = 2_710, 2.5
"And the newest snapshot before it, one of two a second."
DAMAGED_FROM_S = 3.0


@pytest.fixture(scope="module")
def on_can(fly: Any) -> Flight:
    """On a bus; from DAMAGED_FROM_S on every State is damaged."""
    return fly(f"state_crc@{DAMAGED_FROM_S}", until_s=3.3, bus=True)


@pytest.fixture(scope="module")
def can_path(on_can: Flight, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return on_can.write(tmp_path_factory.mktemp("boxes") / "can.mcap")


@pytest.fixture(scope="module", params=["serial", "can"])
def box(request: pytest.FixtureRequest, path: Path, can_path: Path) -> BlackBoxFile:
    return BlackBoxFile(path if request.param == "serial" else can_path)


def place_of(entries: list[Any], name: str, tick: int) -> int:
    return next(place for place in range(list(ticks_of(entries))[tick - 1], 0, -1) if entries[place][0] == name)


def damaged(raw: Any) -> Any:
    if isinstance(raw, bytes):
        return raw[:4] + bytes((raw[4] ^ 0x10,)) + raw[5:]
    (identifier, data), *others = raw
    return [[identifier, bytes((data[0] ^ 0x10,)) + data[1:]], *others]


def number_of(entries: list[Any], place: int) -> int:
    passed = [entry for entry in entries[: place + 1] if isinstance(entry, list) and entry[0] in ("read", "wrote")]
    return sum(len(entry[2]) if isinstance(entry[2], list) else 1 for entry in passed)


def test_frames_are_messages_that_anybody_can_read(path: Path, can_path: Path) -> None:
    serial, can = frames(path), frames(can_path)
    assert serial[0].keys() == {"monotonic_s", "direction", "data"}
    line = b"".join(bytes.fromhex(frame["data"]) for frame in serial if frame["direction"] == "read")
    wrote = b"".join(bytes.fromhex(frame["data"]) for frame in serial if frame["direction"] == "wrote")
    functions = Counter(type(decode(frame.function, frame.payload)) for frame in FrameDecoder().feed(line + wrote))
    assert (functions[State], functions[Drive]) == pytest.approx((4_000, 4_000), abs=30)
    assert functions[Home] >= 1
    identifiers = Counter(frame["identifier"] for frame in can if frame["direction"] == "wrote")
    assert identifiers[can_identifier(FUNCTION[Drive])] == pytest.approx(3_300, abs=30)
    with path.open("rb") as file:
        schema, _, message = next(iter(make_reader(file).iter_messages(topics="/frames")))
    assert set(json.loads(schema.data)["properties"]) == {"monotonic_s", "direction", "data", "identifier"}
    assert message.log_time > 1_700_000_000_000_000_000


def test_the_link_measures_and_writes_the_same_again(core: Core, box: BlackBoxFile) -> None:
    done = rerun(core, box.entries, 1.6)
    assert (done.difference, done.from_s) == (None, pytest.approx(1.5, abs=1e-9))
    assert done.frames > 2 * done.ticks


def test_what_came_damaged_is_measured_alike(core: Core, on_can: Flight, can_path: Path) -> None:
    assert on_can.loop.stepper.safety.faults[0] is Fault.MEASUREMENT_STALE
    assert rerun(core, BlackBoxFile(can_path).entries).difference is None


def test_a_frame_that_is_damaged_or_missing_is_found_in_its_place(core: Core, box: BlackBoxFile) -> None:
    place = place_of(box.entries, "read", DAMAGED_TICK)
    done = rerun(core, altered(box.entries, place, 2, damaged(box.entries[place][2])), SNAPSHOT_S)
    missing = rerun(core, [*box.entries[:place], *box.entries[place + 1 :]], SNAPSHOT_S)
    assert done.ticks == missing.ticks == DAMAGED_TICK - 1 - round(1e3 * SNAPSHOT_S)
    assert done.difference.frame == number_of(box.entries, place)
    found = [(each.difference.tick, each.difference.field) for each in (done, missing)]
    assert found == [(DAMAGED_TICK, "measurement.number")] * 2


def test_another_frame_that_was_written_is_found(core: Core, box: BlackBoxFile) -> None:
    place = place_of(box.entries, "wrote", DAMAGED_TICK)
    found = rerun(core, altered(box.entries, place, 2, []), SNAPSHOT_S).difference
    assert (found.tick, found.field, found.recorded, found.frame) == (
        DAMAGED_TICK,
        "written",
        "nothing",
        number_of(box.entries, place - 1) + 1,
    )


@pytest.mark.parametrize(
    ("part", "way", "field"),
    [
        (1, "Stepper.measure.Measure.measured.Measured.handle.Handle.sliding_mm_s", "step.measure.measured.handle"),
        (3, "link.DeviceLink._least_delay_s", "connection.link"),
    ],
)
def test_a_memory_that_differs_is_found_where_no_tick_shows_it(
    core: Core, box: BlackBoxFile, part: int, way: str, field: str
) -> None:
    place, (*outer, name) = place_of(box.entries, "state", DAMAGED_TICK), way.split(".")
    memory = msgspec.msgpack.decode(msgspec.msgpack.encode(box.entries[place][part]))
    reduce(getitem, outer, memory)[name] += 1e-9
    assert (
        rerun(core, altered(box.entries, place, part, memory), SNAPSHOT_S - 0.5).difference.field
        == f"state.{field}.{name}"
    )


def test_a_link_that_was_lost_and_came_back_is_run_again(fly: Any, core: Core, tmp_path: Path) -> None:
    flight = fly("frozen@2.9", until_s=3.4)
    assert (flight.loop.connection.losses, flight.loop.measurement is None) == (1, False)
    entries = BlackBoxFile(flight.write(tmp_path / "frozen.mcap")).entries
    assert [entry[1] is None for entry in entries if entry[0] == "connected"] == [True, False]
    done = rerun(core, entries)
    assert (done.difference, done.ticks, done.frames) == (None, 3_400, number_of(entries, len(entries) - 1))


def test_the_simulator_does_it_again_and_a_changed_configuration_something_else(path: Path) -> None:
    known = recorded(BlackBoxFile(path))
    todo = script(BlackBoxFile(path).entries)
    # another enable was refused
    assert ([name for _, name in todo.commands], list(todo.recorded.faults)) == (["home", "enable"], ["ENCODER"])
    repeated = rehearse(rebuilt(known), known.config, todo, "sample_1", ["encoder_jump@3.5"])
    assert (list(repeated.faults), repeated.refused, repeated.faults["ENCODER"]) == (
        ["ENCODER"],
        [],
        pytest.approx(todo.recorded.faults["ENCODER"], abs=0.01),
    )
    config = changed(known.config, ["limits.following_error_mm=0.01", "limits.following_time_s=0.02"])
    instead = rehearse(rebuilt(known, config), config, todo, "sample_1", [])
    assert next(iter(instead.faults)) == "FOLLOWING_ERROR"
    assert instead.faults["FOLLOWING_ERROR"] < 3.5


def test_a_limit_that_was_too_narrow(fly: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    narrow = Config(limits=Limits(skew_warning_mm=0.02, skew_fault_mm=0.02))
    path = fly("drag_left=+300%@2.5", until_s=3.6, config=narrow).write(tmp_path / "narrow.mcap")
    assert run_changed([str(path), "--set", "limits.skew_fault_mm=2", "--fault", "drag_left=+300%@2.5"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert [list(result[name]["faults"]) for name in ("recorded", "simulated", "instead")] == [["SKEW"], ["SKEW"], []]
    text = _instead(result)
    assert "simulated with limits.skew_fault_mm=2: no fault" in text
    assert "not known" not in text
    result["simulated"]["faults"] = {}
    assert "SKEW did not come in the simulation as configured then" in _instead(result)


def test_another_scene_is_run(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_changed([str(path), "--set", "scene=cardiovascular"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert ["RANGE" in result[name]["limits"] for name in ("simulated", "instead")] == [False, True]


def test_one_that_begins_in_the_middle_begins_with_a_device_that_is_driven(path: Path) -> None:
    box = BlackBoxFile(path)
    known = recorded(box)
    states = [place for place, entry in enumerate(box.entries) if entry[0] == "state"]
    todo = script(box.entries[states[6] :])
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
        ("rates.control_hz=[1]", "control_hz"),
        ("limits.skew_fault_mm=" + "[" * 100_000, "limits.skew_fault_mm"),
        ("limits.skew_fault_mm=" + "9" * 5_000, "limits.skew_fault_mm"),
    ],
)
def test_settings_that_are_none_are_refused(setting: str, said: str) -> None:
    with pytest.raises(ReplayError, match=said):
        changed(Config(), [setting])


@pytest.mark.parametrize(("setting", "scene"), [("scene=", ""), ("scene = a b ", "a b"), ('scene="x"', "x")])
def test_a_setting_that_is_no_toml_is_text(setting: str, scene: str) -> None:
    assert changed(Config(), ["scene=pulse", setting]).scene == scene


def test_the_commands_of_tormagctl(path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    damaged, rubbish, odd = tmp_path / "damaged.mcap", tmp_path / "rubbish.mcap", tmp_path / "\udcff.mcap"
    odd.write_bytes(path.read_bytes())  # under a name that is no UTF-8
    damaged.write_bytes(path.read_bytes().replace(b"tormagd.Tick", b"tormagd.Tack"))  # of the summary
    rubbish.write_bytes(b"rubbish of no kind")
    exact = "bit-exact, 1,000 ticks from 3.000 to 3.999 s"
    for arguments, ends, head, said in (
        (["replay", str(path), "--from", "3"], 0, exact, exact),
        (["--json", "replay", str(odd), "--from", "3"], 0, '{"command":"replay","ok":true', r"\\udcff.mcap"),
        (["plot", str(odd), "-o", f"{tmp_path}/a.png"], 0, f"{tmp_path}/a.png", ""),
        (["report", str(odd), "-o", f"{tmp_path}/a.html"], 0, f"{tmp_path}/a.html", ""),
        (["replay", str(damaged), "--from", "3"], 1, "altered: the CRC of its summary is wrong", exact),
        (
            ["--json", "replay", str(rubbish)],
            2,
            '{"command":"replay","ok":false',
            f'"{rubbish}: not an intact MCAP file',
        ),
    ):
        assert main(arguments) == ends
        captured = capsys.readouterr()
        assert (captured.out.startswith(head), said in captured.out, "Traceback" in captured.err) == (True, True, False)


def test_what_cannot_be_run_again_is_refused_in_one_line(
    path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for command, arguments, lines in (
        (main, ["replay", str(path), "--from", "-1"], 2),
        (run_changed, [str(path), "--set", "limits.skew=1"], 1),
        (run_changed, [str(path), "--set", "scene=nope"], 1),
        (run_changed, [str(path), "--fault", "nonsense"], 1),
        (run_changed, [str(path), "--fault", "no_sense", "--plant", "nowhere"], 1),
        (main, ["replay", str(path.parent)], 2),
    ):
        assert command(arguments) == 2
        captured = capsys.readouterr()
        assert (captured.out, captured.err.count("\n")) == ("", lines)


def test_a_setpoint_of_a_value_that_there_is_not_is_refused_for_a_rehearsal(box: BlackBoxFile) -> None:
    plan = next(place for place, entry in enumerate(box.entries) if entry[0] == "plan" and entry[2] is not None)
    with pytest.raises(ReplayError, match="NoWall"):
        script(altered(box.entries, plan, 2, [*box.entries[plan][2][:-1], {"NoWall": {}}]))
