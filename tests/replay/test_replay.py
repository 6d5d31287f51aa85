"""A black box run again: bit for bit, from the middle too; changes in it are found; other files are refused."""

import contextlib
import json
import math
import os
import random
import subprocess
import sys
from pathlib import Path
from typing import Any

import msgspec
import pytest
from flight import Flight, altered, asked, frames
from hostile import messages

from firmware_protocol.build import SWITCH, settle
from tormagd import __version__
from tormagd.config import Config
from tormagd.control.assembly.build import SOURCES, Core, sources_hash
from tormagd.control.records import TimedSetpoint
from tormagd.control.safety.codes import Fault
from tormagd.record.reader import BlackBoxFile, RecordingError, Shown, read_recording
from tormagd.record.rerun import ReplayError, differences, rebuilt, recorded, rerun, ticks_of
from tormagd.record.stream import ANSWER, COLUMNS, CONFIRM, FORMAT, MISSING
from tormagd.record.writer import Derived, write_black_box

CHANGED_TICK = 3_210
TICKS = 4_000
ROOT = Path(__file__).parents[2]
FORMER = (
    f"format = '4', written by tormagd {__version__!r}: allowed is {FORMAT}, which tormagd {__version__} writes; "
    "replay it with the version that wrote it"
)
NO_TICKS = [msgspec.msgpack.encode(["step"])]


@pytest.fixture(scope="module")
def box(path: Path) -> BlackBoxFile:
    return BlackBoxFile(path)


def test_a_fault_is_replayed_bit_for_bit_from_the_file_alone(ended: Flight, box: BlackBoxFile, path: Path) -> None:
    assert ended.loop.stepper.safety.faults == (Fault.ENCODER,)
    known = recorded(box)
    assert known.config == ended.config
    done = rerun(rebuilt(known), box.entries)
    assert (done.difference, done.gaps, done.ticks, done.from_s, done.snapshots) == (None, 0, TICKS, 0.0, 7)
    assert (done.frames, differences(known.box.metadata)) == (len(frames(path)), [])


def test_what_a_search_beside_the_plans_answered_is_replayed_not_searched_for(fly: Any, tmp_path: Path) -> None:
    # a few of the thesis's fields, because each is a pass of torch
    shipped = (ROOT / "examples" / "scenes" / "thesis.toml").read_text(encoding="utf-8")
    scene = tmp_path / "thesis.toml"
    scene.write_text(shipped.replace("step_mT = 1.0", "step_mT = 50.0"), encoding="utf-8")
    flown = fly(until_s=3.0, config=Config(scene=str(scene)))
    box = BlackBoxFile(flown.write(tmp_path / "thesis.mcap"))
    answers = [entry for entry in box.entries if entry[0] == ANSWER]
    assert len(answers) > 100
    done = rerun(flown.core, box.entries)
    assert (done.difference, done.gaps, done.ticks) == (None, 0, 3_000)
    assert rerun(flown.core, box.entries, 2.7).difference is None
    # another field in one of them is found
    answers[-5][1]["Answer"]["solution"]["FieldSolution"]["field_mT"] += 0.5
    assert rerun(flown.core, box.entries, 2.7).difference is not None


def test_what_an_operator_confirmed_is_replayed(fly: Any, tmp_path: Path) -> None:
    flown = fly(until_s=3.0)
    for _ in range(1_000):
        flown.tick(TimedSetpoint(1.0, flown.loop.now_s, 0.1))
    forces = flown.loop.simulated.plant.element._force._values
    forces[:] = [0.7 * force_N for force_N in forces]
    while not flown.planner.believe.sensor.is_disputed:
        flown.tick(TimedSetpoint(1.0, flown.loop.now_s, 0.1))
    flown.inference.confirm("device")
    for _ in range(500):
        flown.tick(TimedSetpoint(1.0, flown.loop.now_s, 0.1))
    box = BlackBoxFile(flown.write(tmp_path / "confirmed.mcap"))
    assert rerun(flown.core, box.entries).difference is None
    box.entries.remove([CONFIRM, "device"])
    assert rerun(flown.core, box.entries, flown.loop.now_s - 0.5).difference is not None


@pytest.mark.parametrize(("from_s", "begins_s"), [(0.2, 0.0), (2.9, 2.5), (3.7, 3.5)])
def test_it_is_from_the_middle_of_the_run(core: Core, box: BlackBoxFile, from_s: float, begins_s: float) -> None:
    done = rerun(core, box.entries, from_s)
    assert (done.difference, done.from_s, done.ticks) == (
        None,
        pytest.approx(begins_s, abs=1e-9),
        TICKS - round(1e3 * begins_s),
    )


@pytest.mark.parametrize(
    ("fault", "silent_s", "told"),
    [
        ("commands_vanish@2.5", 0.0, "MEASUREMENT_STALE"),
        ("", 0.083, "HOST_STALL"),
    ],
)
def test_black_boxes_of_planted_faults_replay(fly: Any, core: Core, tmp_path: Path, fault, silent_s, told) -> None:
    flight = fly(*([fault] if fault else []), until_s=2.8, silent_s=silent_s)
    assert str(flight.loop.stepper.safety.faults[0]) == told
    box = BlackBoxFile(flight.write(tmp_path / "planted.mcap"))
    done = rerun(core, box.entries)
    assert done.difference is None
    ticks = ticks_of(box.entries)
    assert done.ticks == len(ticks) > 2_700
    assert told in {name for tick in ticks.values() for name in tick.faults}


def test_the_other_build_replays_them_to_the_bit(fly: Any, path: Path, tmp_path: Path) -> None:
    switch = "0" if settle().is_compiled else "1"
    stalled = fly(until_s=2.8, silent_s=0.083).write(tmp_path / "stalled.mcap")
    for box, from_s, ticks in ((path, 3.0, TICKS - 3_000), (stalled, 0.0, 3_000)):
        command = [sys.executable, "-P", "-m", "tormagd.ctl.main", "--json", "replay", str(box), "--from", str(from_s)]
        result = json.loads(
            subprocess.check_output(command, env=os.environ | {SWITCH: switch, "PYTHONPATH": str(ROOT)}, text=True)
        )["result"]
        assert (result["rerun"]["difference"], result["rerun"]["ticks"]) == (None, ticks)
        assert switch == "1" or result["build"].startswith("interpreted")


def test_a_black_box_is_drawn_like_a_recording(path: Path) -> None:
    seen: list[Shown] = []
    assert read_recording(path, dict[str, Any], seen.append).is_complete
    assert (len(seen), seen[-1].message["faults"]) == (TICKS, ["ENCODER"])
    assert {name for each in seen for name in each.message} <= set(COLUMNS)


def test_a_plan_that_failed_fails_again_and_what_followed_is_the_same(fly: Any, core: Core, tmp_path: Path) -> None:
    flight = fly(until_s=3.1)
    number = flight.planner.planned.number
    flight.tick(asked(flight.loop.now_s).replaced(force_N=math.nan))
    assert (flight.loop.stepper.safety.faults, flight.planner.planned.number) == ((Fault.PLAN_FAILED,), number + 1)
    for _ in range(499):
        flight.tick(asked(flight.loop.now_s))
    box = BlackBoxFile(flight.write(tmp_path / "failed.mcap"))
    (place,) = [place for place, entry in enumerate(box.entries) if entry[0] == "afresh"]
    tried, latched, afresh = box.entries[place - 2 : place + 1]
    assert (tried[0], tried[1], latched) == ("plan", afresh[1], ["latch", "PLAN_FAILED"])
    assert math.isnan(tried[2][0])
    done = rerun(core, box.entries)
    assert (done.difference, done.ticks, done.snapshots) == (None, 3_600, 7)
    # a plan that fails only here is no such plan
    found = rerun(core, [*box.entries[: place - 1], *box.entries[place + 1 :]], 3.0).difference
    assert (found.tick, found.field, found.recorded, found.replayed) == (
        3_101,
        "plan",
        "made",
        "failed: force_N = nan is not allowed: a finite number within +-1e+09",
    )


def test_over_a_gap_it_goes_on_from_the_next_snapshot(core: Core, box: BlackBoxFile, tmp_path: Path) -> None:
    places = list(ticks_of(box.entries))
    parts = box.entries[: places[3_100] + 1], box.entries[places[3_120] + 1 :]
    write_black_box(tmp_path / "lost.mcap", box.metadata, map(msgspec.msgpack.encode, parts))
    for entries in ([*parts[0], [MISSING], *parts[1]], BlackBoxFile(tmp_path / "lost.mcap").entries):
        done = rerun(core, entries)
        assert (done.difference, done.gaps, done.ticks) == (None, 1, TICKS - 3_500 + 3_101)


@pytest.mark.parametrize(
    ("column", "add", "shows"),
    [
        ("device_left_mm", 0.05, "left_mm"),
        ("device_force_N", 1e-12, "measured_cf"),
        ("left_duty", 1e-15, "left_duty"),
        ("device_time_s", 1e-4, "handle_rate_mm_s"),
        ("plan_gap_mm", 1e-9, "plan_gap_mm"),
    ],
)
def test_a_changed_number_is_found_in_its_tick(core: Core, box: BlackBoxFile, column, add, shows) -> None:
    place, record = list(ticks_of(box.entries).items())[CHANGED_TICK - 1]
    entries = altered(box.entries, place, COLUMNS.index(column), getattr(record, column) + add)
    done = rerun(core, entries, 3.0)
    assert (done.difference.tick, done.difference.field, done.ticks) == (CHANGED_TICK, shows, CHANGED_TICK - 1 - 3_000)


def test_a_changed_setpoint_is_found_in_its_tick(core: Core, box: BlackBoxFile) -> None:
    places = list(ticks_of(box.entries))
    place = next(p for p in range(places[3_400], len(box.entries)) if box.entries[p][0] == "plan")
    force_N, *others = box.entries[place][2]
    tick = 1 + next(number for number, p in enumerate(places) if p > place)
    found = rerun(core, altered(box.entries, place, 2, [force_N + 1e-9, *others]), 3.0).difference
    assert (found.tick, found.field) == (tick, "setpoint_cf")


def test_a_command_that_is_missing_is_found(core: Core, box: BlackBoxFile) -> None:
    entries = [it for it in box.entries if not (it[0] == "command" and it[1] == "home")]
    assert rerun(core, entries).difference.field == "request"


@pytest.mark.parametrize(
    ("was_refused", "recorded", "replayed"), [(True, "refused", "taken"), (False, "taken", "refused: ")]
)
def test_a_command_that_is_now_taken_or_refused_is_found(
    core: Core, box: BlackBoxFile, was_refused: bool, recorded: str, replayed: str
) -> None:
    place = next(n for n, it in enumerate(box.entries) if it[0] == "command" and it[3] is not was_refused)
    found = rerun(core, altered(box.entries, place, 3, was_refused)).difference
    assert (found.field, found.recorded) == (box.entries[place][1], recorded)
    assert found.replayed.startswith(replayed)


@pytest.mark.parametrize(
    "edit",
    [
        lambda shown: shown._replace(message=shown.message | {"operating_state": "ENABLED"}),
        lambda shown: shown._replace(t_ns=shown.t_ns + 1),
        lambda shown: None,
        lambda shown: shown._replace(sequence=7),
        lambda shown: shown._replace(topic="/telemetry", sequence=1),
    ],
)
def test_what_people_see_is_what_replays_or_is_named(path: Path, tmp_path: Path, monkeypatch: Any, edit) -> None:
    box = BlackBoxFile(path)
    assert box.odd == ""
    head = [*box.entries[: list(ticks_of(box.entries))[600]], ["told", {"t_ns": 1, "seq": 0}]]
    derived = Derived.of

    def other(self: Derived, columns: Any, entries: Any) -> Any:
        for shown in derived(self, columns, entries):
            is_it = shown.topic == "/ticks" and shown.sequence == 300
            if not is_it:
                yield shown
            elif (edited := edit(shown)) is not None:
                yield edited

    monkeypatch.setattr(Derived, "of", other)
    write_black_box(tmp_path / "edited.mcap", box.metadata, [msgspec.msgpack.encode(head)])
    monkeypatch.undo()
    assert BlackBoxFile(tmp_path / "edited.mcap").odd == "message 300 in /ticks is not what /core has"


def test_a_message_that_is_missing_at_the_end_is_named(box: BlackBoxFile, tmp_path: Path, monkeypatch: Any) -> None:
    head, derived = box.entries[: list(ticks_of(box.entries))[60] + 1], Derived.of
    monkeypatch.setattr(Derived, "of", lambda *told: list(derived(*told))[:-1])
    write_black_box(tmp_path / "short.mcap", box.metadata, [msgspec.msgpack.encode(head)])
    monkeypatch.undo()
    assert BlackBoxFile(tmp_path / "short.mcap").odd == "message 60 in /ticks is not what /core has"


def test_the_sources_hash_is_of_every_room(monkeypatch: pytest.MonkeyPatch) -> None:
    known = sources_hash()
    for room in SOURCES:
        monkeypatch.setattr("tormagd.control.assembly.build.SOURCES", [other for other in SOURCES if other != room])
        assert sources_hash() != known, room


def test_what_is_not_as_it_was_is_told(box: BlackBoxFile) -> None:
    told = differences({**box.metadata, "sources_sha256": "0" * 64, "platform": "PDP-11"})
    assert [line.partition(":")[0] for line in told] == ["build", "platform"]


def run(path: Path) -> None:
    found = BlackBoxFile(path)
    rerun(rebuilt(recorded(found)), found.entries)


def refusal(path: Path) -> str:
    with pytest.raises((RecordingError, ReplayError)) as refused:
        run(path)
    text = str(refused.value)
    assert "\n" not in text
    assert len(text) < 600
    return text


def test_one_that_breaks_off_late_is_replayed_so_far(core: Core, path: Path, tmp_path: Path) -> None:
    (tmp_path / "broken.mcap").write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    box = BlackBoxFile(tmp_path / "broken.mcap")
    assert not box.is_complete
    done = rerun(core, box.entries)
    assert done.difference is None
    assert 1_000 < done.ticks < TICKS


def test_random_bytes_are_refused_and_of_damaged_ones_the_rest_is_replayed(
    core: Core, path: Path, tmp_path: Path
) -> None:
    rng, broken, data = random.Random(3), tmp_path / "broken.mcap", path.read_bytes()
    broken.write_bytes(rng.randbytes(5_000))
    assert "not an intact MCAP file" in refusal(broken)
    for _ in range(5):
        damaged = bytearray(data)
        for place in rng.sample(range(len(data) // 2), 20):
            damaged[place] ^= 1 << rng.randrange(8)
        broken.write_bytes(damaged)
        with contextlib.suppress(RecordingError, ReplayError):
            box = BlackBoxFile(broken)
            assert box.odd
            assert rerun(core, box.entries).difference is None


def test_another_recording_or_version_is_refused(box: BlackBoxFile, tmp_path: Path) -> None:
    for data, said in (
        (other := messages(b"{}", topic="/core", about={}), "no black box"),
        (b"x" + other[1:], "damaged"),
    ):
        (tmp_path / "other.mcap").write_bytes(data)
        assert said in refusal(tmp_path / "other.mcap")
    for number, (header, said) in enumerate(
        (
            (box.metadata | {"format": "4"}, FORMER),
            (box.metadata | {"configuration": '{"rates": 1}'}, "its configuration is refused"),
            (box.metadata | {"model": "f" * 64}, "the model with the hash 'ffffffffffff'"),
            (box.metadata | {"columns": json.dumps(["t_ns"])}, "its ticks have other columns"),
            ({name: text for name, text in box.metadata.items() if name != "scene"}, "its header has no 'scene'"),
            (box.metadata, "no tick in it"),
        )
    ):
        write_black_box(tmp_path / f"{number}.mcap", header, NO_TICKS)
        assert said in refusal(tmp_path / f"{number}.mcap")


def test_no_entries_break_it(core: Core, box: BlackBoxFile) -> None:
    rng = random.Random(5)
    rubbish: list[Any] = [None, -1, 2**63, "x", float("nan"), b"\0", {}, [], [[]], [1], ["plan"], ["unheard"]]
    rubbish += [["state", 1, 2], ["command", "stop", 1.0, False], ["latch", "SKEWED"], ["afresh", "now"]]
    rubbish += [["teach", {"Learned": {}}], ["teach", {"Limit": "RATE"}], ["confirm", "both"]]
    head = box.entries[: list(ticks_of(box.entries))[60] + 1]
    for _ in range(100):
        entries = list(head)
        place, spoilt = rng.randrange(len(entries)), rng.choice(rubbish)
        if isinstance(entries[place], list) and entries[place] and rng.random() < 0.7:
            inner = rng.randrange(len(entries[place]))
            spoilt = [*entries[place][:inner], spoilt, *entries[place][inner + 1 :]]
        entries[place] = spoilt
        with contextlib.suppress(ReplayError):
            assert rerun(core, entries).ticks <= 61
