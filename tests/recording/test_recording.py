"""Recordings: what was written comes back, whatever the disk does; and all of one at a glance."""

import contextlib
import errno
import json
import math
import shutil
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import msgspec
import numpy as np
import pytest
from hypothesis import example, given, strategies as st
from jsonschema import Draft202012Validator
from mcap.reader import make_reader
from mcap.records import ChunkIndex
from sent import COLUMNS, START_NS, back, batch, telemetry, tell

from tormagd.record.overview import MAX_STRETCHES, Codes, Glance, OverviewBuilder, unpacked
from tormagd.record.reader import RecordingError, RecordingFile, overview_of
from tormagd.record.stream import TOLD
from tormagd.record.ticks import decode_ticks
from tormagd.record.writer import THINNED, RecordingWriter
from tormagd.view.plot import figure, save_plot
from tormagd_client.messages import Mark, MessageError, encode


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("written") / "a.mcap"
    with RecordingWriter(path, {"scene": "pulse"}) as writer:
        for k in range(5):
            limits, faults = ("RATE",) if k in (1, 2) else (), ("SKEW",) if k == 4 else ()
            codes = {"operating_state": "FAULT" if faults else "ENABLED", "limits": limits, "faults": faults}
            rows = [(20 * k + i, 1.5, 1.6, 35.0, 36.0, 0.25, 70.0, *codes.values()) for i in range(20)]
            writer.ticks(batch(*rows, columns=(*COLUMNS, "reference_gap_mm", *codes)))
            tell(writer, telemetry(20 * k, k, **codes, measured_cf=9.0))
    return path


def test_a_recording_comes_back_as_it_was_written(written):
    recording = back(written)
    assert (recording.is_complete, recording.metadata["scene"], recording.ms()) == (True, "pulse", [*range(100)])
    assert (recording.ticks[0].t_ns, {each.message["measured_cf"] for each in recording.ticks}) == (START_NS, {1.6})
    told = [each.message for each in recording.snapshots]
    assert [each["duty"][1] for each in told] == [-0.5] * 5
    assert [each["limits"] for each in told] == [[], ["RATE"], ["RATE"], [], []]
    assert (told[4]["operating_state"], told[4]["tick"]["exec_us"]) == ("FAULT", 100.0)
    assert not any("setpoint_cf" in each for each in told)


def test_other_tools_find_json_messages_with_schemas(written):
    with written.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        topics = {channel.topic: channel for channel in summary.channels.values()}
        assert {topic: channel.message_encoding for topic, channel in topics.items()} == {
            "/telemetry": "json",
            "/ticks": "json",
        }
        schemas = {topic: summary.schemas[channel.schema_id] for topic, channel in topics.items()}
        assert {schema.encoding for schema in schemas.values()} == {"jsonschema"}
        assert set(json.loads(schemas["/ticks"].data)["properties"]) >= set(COLUMNS)
        assert {index.compression for index in summary.chunk_indexes} == {"zstd"}
        _, _, message = next(iter(reader.iter_messages(topics="/ticks")))
        assert (message.log_time, json.loads(message.data)["left_mm"]) == (START_NS, 35.0)


def obey(path: Path) -> int:
    validator = cache(lambda schema: Draft202012Validator(json.loads(schema)))
    with path.open("rb") as file:
        messages = list(make_reader(file).iter_messages())
    for schema, _, message in messages:
        validator(schema.data).validate(json.loads(message.data))
    return len(messages)


def test_what_is_not_known_is_left_out_and_comes_back_as_not_a_number(tmp_path):
    path = tmp_path / "a.mcap"
    with RecordingWriter(path) as writer:
        writer.ticks(batch((0, math.nan, math.inf, None, 1.0, 0.0), (1, 1.0, 1.0, 35.0, 1.0, 0.0)))
        tell(writer, telemetry(0, 0, measured_cf=math.nan, measured_jp=(math.nan, 1.0), confidence=math.inf))
        tell(writer, telemetry(20, 1, measured_jp=(1.0, 1.0), measured_cf=1.0))
    assert obey(path) == 4
    with path.open("rb") as file:
        texts = [message.data for _, _, message in make_reader(file).iter_messages()]
    assert not any(word in text for text in texts for word in (b"NaN", b"Infinity", b"null"))
    assert "measured_cf" not in back(path).ticks[0].message


@given(
    st.lists(
        st.tuples(
            *5 * [st.none() | st.booleans() | st.integers(-9, 9) | st.floats() | st.text(max_size=2)],
            st.lists(st.sampled_from(["RATE", "F_MIN"]), max_size=2).map(tuple),
        ),
        min_size=1,
        max_size=8,
    )
)
# what was a word and a boolean is a number in the last: another schema
@example(
    [
        (None, None, None, None, None, ()),
        ("RUN", 1.5, 1.5, None, True, ("RATE",)),
        (None, math.nan, math.inf, "a word", False, ("RATE", "F_MIN")),
        ("RUN", 2, 2, "a word", None, ()),
        ("RUN", 2.5, 2.5, 3.0, 1.0, ()),
    ]
)
def test_no_row_of_any_daemon_breaks_the_schema_it_is_filed_under(tmp_path_factory, rows):
    path = Path(tmp_path_factory.getbasetemp()) / "any.mcap"
    path.unlink(missing_ok=True)
    with RecordingWriter(path) as writer:
        writer.ticks(
            batch((0, "RUN", 1.5), columns=("t_ns", "device_mode", "measured_cf"))
        )  # then another daemon comes
        columns = ("t_ns", "device_mode", "device_force_N", "measured_cf", "a", "b", "limits")
        writer.ticks(batch(*((ms, *row) for ms, row in enumerate(rows, 1)), columns=columns))
    assert obey(path) == 1 + len(rows)


@pytest.mark.parametrize("chunks", [0, 1, 2, 9])
def test_before_a_disk_is_full_all_that_came_is_closed_in_order(tmp_path, monkeypatch, chunks):
    path = tmp_path / "full.mcap"
    free = iter([16_100_000] * chunks + [15_900_000])
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=next(free)))
    writer = RecordingWriter(path)
    with pytest.raises(OSError, match=r"No space left on device: 15\.9 MB are free, needed are 16\.0"):
        write(writer)
    recording = back(path)
    assert not recording.is_complete
    assert "15.9 MB" in recording.metadata["cut_by"]
    with path.open("rb") as file:
        told = make_reader(file).get_summary().statistics.message_count
    assert obey(path) == told == writer.tick_count + writer.telemetry_count
    assert (len(recording.ticks), len(recording.snapshots)) == (writer.tick_count, writer.telemetry_count)
    assert (writer.tick_count + 400) // 500 == chunks


def test_a_disk_that_is_full_at_the_end_costs_a_thinned_recording_what_waited(tmp_path, monkeypatch):
    writer = RecordingWriter(tmp_path / "full.mcap", every=2)
    writer.ticks(batch(*((ms, 1.0, 1.0, 35.0, 35.0, 0.0) for ms in range(3_000))))
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=0))
    with pytest.raises(OSError, match="No space left on device"):
        writer.close()
    assert RecordingFile(writer.path).notes[0] == "cut short: No space left on device: 0.0 MB are free, needed are 16.0"


def test_half_a_second_is_written_at_once(tmp_path):
    path = tmp_path / "a.mcap"
    writer = RecordingWriter(path)
    for ms in range(0, 3_000, 20):  # as slow as control may be, and far less than a chunk holds
        writer.ticks(batch((ms, 1.0, 1.0, 35.0, 35.0, 0.0)))
        if ms >= 600 and ms % 100 == 0:
            assert ms - back(path).ms()[-1] <= 550
    writer.close()
    assert len(back(path).ticks) == 150


def test_losses_are_counted(tmp_path):
    with RecordingWriter(tmp_path / "a.mcap") as writer:
        writer.ticks(batch(*((tick, tick) for tick in (3, 4, 8, 0, 1)), columns=("t_ns", "tick")))
    assert (writer.tick_count, writer.ticks_lost, writer.restarts) == (5, 3, 1)


def test_quantities_come_from_the_ticks(written):
    series = RecordingFile(written).overview.series
    force, gap = series("measured_cf"), series("gap_mm")
    assert (force.low.tolist(), gap.high.tolist()) == (pytest.approx([1.6] * 100), [71.0] * 100)
    assert (series("gap_setpoint_mm").low.tolist(), series("right_duty")) == ([70.0] * 100, None)
    assert force.t_s[:3].tolist() == pytest.approx([0.0005, 0.0015, 0.0025])


def test_the_picture_names_what_happened_and_a_line_that_lies_on_another_leaves_it_visible(written):
    drawn = figure(RecordingFile(written).overview, "a title")
    assert drawn.get_suptitle() == "a title  ·  faults: SKEW"
    assert [label.get_text() for label in drawn.axes[-1].get_yticklabels()] == [
        "state",
        "limit RATE 40.4%",
        "FAULT SKEW",
    ]
    force, *others, _ = [axes.lines for axes in drawn.axes]
    assert [line.get_label() for line in force] == ["measured", "asked"]
    assert all(lower.get_linewidth() > 2.0 * upper.get_linewidth() for lower, upper, *_ in others)


def test_of_a_recording_that_could_not_begin_nothing_is_left(tmp_path, monkeypatch):
    monkeypatch.setattr("mcap.writer.Writer.start", Mock(side_effect=OSError(errno.ENOSPC, "No space left on device")))
    with pytest.raises(OSError, match="No space"):
        RecordingWriter(tmp_path / "a.mcap")
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize("name", ["a.png", "new.png"])
def test_a_disk_that_is_full_keeps_the_picture_that_was_there(written, tmp_path, monkeypatch, name):
    (tmp_path / "a.png").write_bytes(b"precious")

    def half(path: Path, data: bytes) -> int:
        with path.open("wb") as file:
            file.write(data[: len(data) // 2])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", half)
    with pytest.raises(OSError, match="No space"):
        save_plot(figure(RecordingFile(written).overview, "x"), tmp_path / name)
    assert {path.name for path in tmp_path.iterdir()} == {"a.png"}
    assert (tmp_path / "a.png").read_bytes() == b"precious"


@pytest.mark.parametrize("suffix", [".png", ".svg", ".pdf"])
def test_pictures_in_each_format(written, tmp_path, suffix):
    target = tmp_path / f"a{suffix}"
    save_plot(figure(RecordingFile(written).overview, "x"), target)
    assert target.stat().st_size > 5_000


def test_other_formats_and_empty_recordings_are_refused(written, tmp_path):
    with pytest.raises(ValueError, match=r"\.png"):
        save_plot(figure(RecordingFile(written).overview, "x"), tmp_path / "a.docx")
    with RecordingWriter(tmp_path / "empty.mcap"):
        pass
    with pytest.raises(ValueError, match="no control ticks"):
        figure(RecordingFile(tmp_path / "empty.mcap").overview, "x")


def test_a_telemetry_message_is_no_tick_batch():
    with pytest.raises(MessageError, match="columns"):
        decode_ticks(encode(telemetry(0, 0)))


@given(st.binary(max_size=200))
def test_any_bytes_are_a_batch_or_a_message_error(data):
    with contextlib.suppress(MessageError):
        assert decode_ticks(data).columns[0] == "t_ns"


ALL_COLUMNS = (
    "t_ns",
    "setpoint_cf",
    "measured_cf",
    "left_mm",
    "right_mm",
    "operating_state",
    "limits",
    "faults",
    "tick",
)


def row(k: int) -> tuple[Any, ...]:
    asked_N = 1.5 + 0.3 * math.sin(2e-3 * math.pi * k)
    felt_N = 0.5 if k < 1_000 else 1.5 + 0.3 * math.sin(2e-3 * math.pi * (k - 20))
    limits, faults = ("RATE",) if 2_000 <= k < 3_000 else (), ("SKEW",) if k >= 25_000 else ()
    return (k, asked_N, felt_N, 34.0, 36.0, "FAULT" if faults else "ENABLED", limits, faults, k)


def write(writer: RecordingWriter) -> None:
    with writer:
        for k in range(0, 30_000, 20):
            writer.ticks(batch(*(row(k + i) for i in range(20)), columns=ALL_COLUMNS))
            mark = Mark(t_ns=START_NS + 15_000_000_000, text="here") if k >= 15_000 else None
            tell(writer, telemetry(k, k // 20, mark=mark))
    assert writer.ticks_lost == 0


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("overview") / "a.mcap"
    write(RecordingWriter(made))
    return made


def altered(folder: Path, data: bytes) -> RecordingFile:
    path = folder / "altered.mcap"
    path.write_bytes(data)
    return RecordingFile(path)


def chunks_in(path: Path) -> list[ChunkIndex]:
    with path.open("rb") as file:
        return make_reader(file).get_summary().chunk_indexes


@pytest.mark.parametrize("hole_at", [0.2, 0.45, 0.7, 0.9])
def test_a_hole_costs_the_chunks_that_it_is_in_and_no_other(path: Path, tmp_path: Path, hole_at: float) -> None:
    far, chunks = 2**63 - 1, chunks_in(path)
    data = bytearray(
        path.read_bytes().replace(*[at.to_bytes(8, "little") for at in (chunks[3].chunk_start_offset, far)])
    )
    first = int(hole_at * chunks[-1].chunk_start_offset)
    data[first : first + 4096] = bytes(4096)
    known = altered(tmp_path, data)
    holed = [each for each in chunks if first - each.chunk_length < each.chunk_start_offset < first + 4096]
    assert set(known.lost) == {far, *(each.chunk_start_offset for each in holed)}
    assert ("damaged" in known.notes[0], f"left out: {len(known.lost)}" in known.notes[1]) == (True, True)
    assert known.overview.duration_s == pytest.approx(30.0, abs=0.1)
    everything = known.between(chunks[0].message_start_time, chunks[-1].message_end_time, Glance)
    assert len(everything) == known.overview.ticks + known.overview.snapshots


@pytest.mark.parametrize("tail", [b"", bytes(1_000_000)], ids=["nothing", "zeros"])
def test_a_damaged_chunk_of_a_file_that_was_not_ended_costs_no_other(path: Path, tmp_path: Path, tail: bytes) -> None:
    chunks = chunks_in(path)
    data = bytearray(path.read_bytes()[: chunks[20].chunk_start_offset] + tail)  # its recorder was killed there
    data[chunks[10].chunk_start_offset + 200] ^= 1
    known = altered(tmp_path, data)
    assert (known.is_complete, list(known.lost)) == (False, [chunks[10].chunk_start_offset])
    assert known.overview.end_ns == chunks[19].message_end_time


@pytest.mark.parametrize("step_s", [-5.0, 3_600.0, START_NS * 1e-9])
@pytest.mark.parametrize("is_closed", [True, False])
def test_a_step_of_the_clock_is_shown_and_stretches_nothing(tmp_path: Path, step_s: float, is_closed: bool) -> None:
    path, early_ms = tmp_path / "step.mcap", -step_s * 1e3 if step_s > 1e6 else 0.0
    with RecordingWriter(path) as writer:
        for k in range(900):
            ms = 10.0 * k + early_ms + (1e3 * step_s if k >= 500 else 0.0)
            tell(writer, telemetry(ms, k))  # it knows of the step before the ticks do
            writer.ticks(batch((ms, 40.0 + 0.01 * k, 1.5), columns=("t_ns", "monotonic_s", "measured_cf")))
        tell(writer, telemetry(ms, 900, mark=Mark(t_ns=START_NS + int(ms * 1e6), text="here")))
    if not is_closed:
        path.write_bytes(path.read_bytes()[:-1])
    overview = RecordingFile(path).overview
    assert overview.duration_s == pytest.approx(8.99)
    step, mark = ((each.text, (each.t_ns - overview.start_ns) * 1e-9) for each in overview.marks)
    assert step == (f"the clock stepped by {step_s:+.6g} s", pytest.approx(5.0))
    assert mark == ("here", pytest.approx(8.99, abs=1e-3))


def test_what_the_recorder_wrote_is_what_its_messages_give(path: Path, tmp_path: Path) -> None:
    known, again = RecordingFile(path), altered(tmp_path, path.read_bytes()[:-1])
    assert (known.is_complete, again.is_complete) == (True, False)
    assert known.overview == again.overview == unpacked(msgspec.msgpack.encode(known.overview))
    overview = known.overview
    assert (overview.ticks, overview.snapshots, [mark.text for mark in overview.marks]) == (30_000, 1_500, ["here"])
    force = overview.series("measured_cf")
    assert len(force.t_s) <= MAX_STRETCHES
    assert (force.low.min(), force.high.max()) == (0.5, pytest.approx(1.8))
    assert overview.spans_s("limits") == {"RATE": [pytest.approx((2.0, 3.0))]}
    assert overview.codes["limits"]["RATE"].held_ns == pytest.approx(1e9)
    assert overview.spans_s("operating_state")["FAULT"] == [pytest.approx((25.0, 30.0), abs=1e-6)]


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [(b"\xa4SKEW", b"\xa4SHOW", "the CRC of its data is wrong"), (b"tormagd.Tick", b"tormagd.Tack", "its summary")],
)
def test_what_no_crc_vouches_for_is_named_and_an_overview_not_shown(path, tmp_path, old, new, said) -> None:
    known = altered(tmp_path, path.read_bytes().replace(old, new))
    assert said in known.damage in known.notes[0]
    assert (list(known.overview.codes["faults"]), known.overview) == (["SKEW"], RecordingFile(path).overview)


@given(place=st.floats(0.0, 1.0), value=st.integers(1, 255), keep=st.just(1.0) | st.floats(0.0, 1.0))
def test_no_byte_is_changed_unnoticed_and_the_rest_is_a_recording_or_a_recording_error(
    written, place, value, keep
) -> None:
    data, changed = bytearray(written.read_bytes()), written.with_name("changed.mcap")
    data[int(place * (len(data) - 1))] ^= value
    changed.write_bytes(data[: int(keep * len(data))])
    assert overview_of(changed)[0] is None
    try:
        back(changed)
    except RecordingError as error:
        assert "changed.mcap" in str(error)  # noqa: PT017


def test_neither_approach_nor_decay_is_in_how_well_a_force_was_followed(path: Path) -> None:
    overview = RecordingFile(path).overview
    known = overview.following
    assert known.rms_N == pytest.approx(0.6 * math.sin(0.02 * math.pi) / math.sqrt(2.0), rel=0.01)
    assert (overview.followed_s, known.delay_ms) == (pytest.approx(23.6, abs=0.1), 20.0)
    assert known.aligned_rms_N == pytest.approx(0.0, abs=1e-9)
    # the sensor's noise is in the figure, and whoever reads it has to know
    said = "followed to 27 mN RMS, 0 mN with a delay of 20 ms taken out (sensor noise included)"
    assert said in figure(overview, "").get_suptitle()


def test_any_seconds_of_it_are_those_of_the_whole(path: Path) -> None:
    from_ns, to_ns = START_NS + 7_000_000_000, START_NS + 9_500_000_000
    some = [each for each in RecordingFile(path).between(from_ns, to_ns, Glance) if each.is_tick]
    whole = [each for each in back(path).ticks if from_ns <= each.t_ns <= to_ns]
    assert [(each.t_ns, each.message["measured_cf"]) for each in some] == [
        (each.t_ns, each.message["measured_cf"]) for each in whole
    ]
    assert "tick" not in some[0].message


def test_a_thinned_recording_has_all_around_a_fault_and_a_mark_and_says_so(tmp_path: Path) -> None:
    path = tmp_path / "thin.mcap"
    write(RecordingWriter(path, every=50))
    recording = back(path)
    assert recording.metadata[THINNED].startswith("one tick of 50;")
    at_ms = np.array(recording.ms())
    # the mark is at 15 s, the fault at 25 s
    assert np.array_equal(at_ms[at_ms >= 5_020], np.arange(5_020, 30_000))
    assert len(at_ms[at_ms < 5_020]) == pytest.approx(100, abs=2)
    assert RecordingFile(path).overview.ticks == 30_000
    assert len(chunks_in(path)) < 2 * 30 + 10


@pytest.mark.parametrize("made_ms", [-10, 10])
def test_all_is_kept_around_a_mark_also_one_made_just_before_the_file(tmp_path: Path, made_ms: int) -> None:
    mark = Mark(t_ns=START_NS + made_ms * 1_000_000, text="here")
    sent = batch(*(row(k) for k in range(500)), columns=ALL_COLUMNS)
    told = [TOLD, msgspec.to_builtins(telemetry(0, 0, mark=mark))]
    frame = ["read", 1.0, b"frame"]
    with RecordingWriter(tmp_path / "a.mcap", every=50) as writer:
        writer.ticks(msgspec.structs.replace(sent, core=msgspec.msgpack.encode([*sent.rows, frame, told])))
    recording = back(writer.path)
    assert (len(recording.ticks), len(recording.snapshots)) == (500, 1)
    with writer.path.open("rb") as file:
        topics = {channel.topic for channel in make_reader(file).get_summary().channels.values()}
    assert topics == {"/ticks", "/telemetry"}


@pytest.mark.parametrize(
    "change",
    [
        {"late_counts": [1]},
        {"codes": {}},
        {"width_ns": 0},
        {"codes": {"limits": {"$\\frac{": Codes([], 0)}, "faults": {}, "operating_state": {}}},
        {"codes": {"limits": {"RATE": Codes([[0, 1]] * 2_000, 0)}, "faults": {}, "operating_state": {}}},
        {"stretches": b"12345678", "sides": b"1234"},
        {"marks": [Mark(t_ns=0, text="x")] * 2_000},
    ],
)
def test_an_overview_that_no_tormagd_writes_is_refused(path: Path, change: dict[str, Any]) -> None:
    odd = msgspec.structs.asdict(RecordingFile(path).overview) | change
    with pytest.raises(ValueError, match="its overview: "):
        unpacked(msgspec.msgpack.encode(odd))


def test_any_length_is_held_in_bounds() -> None:
    builder = OverviewBuilder()
    late_us = [edge_us - early_us for edge_us in (10, 20, 50, 100, 200, 500, 1e3, 2e3, 5e3) for early_us in (0.1, 0.0)]
    for k in range(19_800):
        builder.add(
            *(k * 1_600_000_000_000, True),
            {"limits": ("RATE",) if k % 2 else (), "measured_cf": float(k), "lateness_us": late_us[k % 18]},
        )
    made = builder.made()
    assert made.late_counts == [1_100, *[2_200] * 8, 1_100]
    assert len(msgspec.msgpack.encode(made)) < 200_000
    force = made.series("measured_cf")
    assert (force.low.min(), force.high.max()) == (0.0, 19_799.0)
    assert len(made.codes["limits"]["RATE"].spans_ns) <= 1_000
