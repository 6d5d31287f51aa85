"""All of a recording at a glance: what its recorder wrote is what its messages give; and any seconds of it."""

import math
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from sent import START_NS, back, batch, telemetry

from tormagd.recording.overview import MAX_STRETCHES, Codes, Curves, Glance, Overview, OverviewBuilder, unpacked
from tormagd.recording.plot import figure
from tormagd.recording.reader import RecordingFile
from tormagd.recording.seal import State
from tormagd.recording.writer import OVERVIEW, THINNED, RecordingWriter
from tormagd_client.messages import Mark

COLUMNS = ("t_ns", "setpoint_cf", "measured_cf", "left_mm", "right_mm", "operating_state", "limits", "faults", "tick")


def row(k: int) -> tuple[Any, ...]:
    """A tick each ms: 1 s of approach, then a sine that comes 20 ms late; RATE in the third second, SKEW at 25 s."""
    asked_N = 1.5 + 0.3 * math.sin(2e-3 * math.pi * k)
    felt_N = 0.5 if k < 1_000 else 1.5 + 0.3 * math.sin(2e-3 * math.pi * (k - 20))
    limits, faults = ("RATE",) if 2_000 <= k < 3_000 else (), ("SKEW",) if k >= 25_000 else ()
    return (k, asked_N, felt_N, 34.0, 36.0, "FAULT" if faults else "ENABLED", limits, faults, k)


def write(path: Path, **settings: Any) -> Path:
    """Thirty seconds, with a mark at 15 s."""
    with RecordingWriter(path, **settings) as writer:
        for k in range(0, 30_000, 20):
            writer.ticks(batch(*(row(k + i) for i in range(20)), columns=COLUMNS))
            mark = Mark(t_ns=START_NS + 15_000_000_000, text="here") if k >= 15_000 else None
            writer.telemetry(telemetry(k, k // 20, mark=mark))
    assert writer.ticks_lost == 0
    return path


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("overview") / "a.mcap")


def test_what_the_recorder_wrote_is_what_its_messages_give(path: Path, tmp_path: Path) -> None:
    known = RecordingFile(path)
    killed = tmp_path / "killed.mcap"
    killed.write_bytes(path.read_bytes()[:-1])
    again = RecordingFile(killed)
    assert (known.is_complete, again.is_complete) == (True, False)
    assert known.overview == again.overview == unpacked(known.overview.packed())
    overview = known.overview
    assert (overview.ticks, overview.snapshots, [mark.text for mark in overview.marks]) == (30_000, 1_500, ["here"])
    force = overview.series("measured_cf")
    assert len(force.t_s) <= MAX_STRETCHES
    assert (force.low.min(), force.high.max()) == (0.5, pytest.approx(1.8))
    assert overview.spans_s("limits") == {"RATE": [pytest.approx((2.0, 3.0))]}
    assert overview.codes["limits"]["RATE"].held_ns == pytest.approx(1e9)
    assert overview.spans_s("operating_state")["FAULT"] == [pytest.approx((25.0, 30.0), abs=1e-6)]


def rewritten(path: Path, target: Path, overview: Overview) -> Path:
    """The same messages of the fault by the usual writer, without seals, and with another overview."""
    with path.open("rb") as source, target.open("wb") as made:
        writer, channels = Writer(made), {}
        writer.start()
        for schema, channel, message in make_reader(source).iter_messages(starting_at=START_NS + 24_000_000_000):
            if channel.id not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, number)
            writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        writer.add_attachment(0, 0, OVERVIEW, "application/msgpack", overview.packed())
        writer.finish()
    return target


def test_an_overview_that_nothing_vouches_for_is_not_shown(path: Path, tmp_path: Path) -> None:
    own = RecordingFile(path).overview
    no_fault = msgspec.structs.replace(own, codes=own.codes | {"faults": {}}, end_ns=own.start_ns)
    unsealed = rewritten(path, tmp_path / "unsealed.mcap", no_fault)
    spoilt = tmp_path / "spoilt.mcap"
    assert own.packed() != no_fault.packed()
    spoilt.write_bytes(path.read_bytes().replace(b"\xa4SKEW", b"\xa4SHOW"))
    for file, state in ((unsealed, State.UNSEALED), (spoilt, State.ALTERED)):
        known = RecordingFile(file)
        assert (known.seal.state, list(known.overview.codes["faults"]), known.overview.end_ns) == (
            state,
            ["SKEW"],
            own.end_ns,
        )
    assert RecordingFile(spoilt).notes[0].startswith("altered or damaged: the bytes ")


def test_neither_approach_nor_decay_is_in_how_well_a_force_was_followed(path: Path) -> None:
    """A sine of 0.3 N that is 20 ms late is 2 sin(pi * 0.02) * 0.3 / sqrt(2) off."""
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
    path = write(tmp_path / "thin.mcap", every=50)
    recording = back(path)
    assert recording.metadata[THINNED].startswith("one tick of 50;")
    at_ms = np.array(recording.ms())
    # the mark is at 15 s, the fault at 25 s
    assert np.array_equal(at_ms[at_ms >= 5_020], np.arange(5_020, 30_000))
    assert len(at_ms[at_ms < 5_020]) == pytest.approx(100, abs=2)
    assert RecordingFile(path).overview.ticks == 30_000


@pytest.mark.parametrize(
    "change",
    [
        {"late_counts": [1]},
        {"codes": {}},
        {"width_ns": 0},
        {"codes": {"limits": {"$\\frac{": Codes([], 0)}, "faults": {}, "operating_state": {}}},
        {"codes": {"limits": {"RATE": Codes([(0, 1)] * 2_000, 0)}, "faults": {}, "operating_state": {}}},
        {"of_ticks": Curves(b"12345678", {"gap_mm": b"1234"}, {"gap_mm": b""})},
        {"marks": [Mark(t_ns=0, text="x")] * 2_000},
    ],
)
def test_an_overview_that_no_tormagd_writes_is_refused(path: Path, change: dict[str, Any]) -> None:
    odd = msgspec.structs.replace(RecordingFile(path).overview, **change)
    with pytest.raises(ValueError, match="its overview: "):
        unpacked(odd.packed())


def test_any_length_is_held_in_bounds() -> None:
    """A year of snapshots, with a limit in every other."""
    builder = OverviewBuilder()
    for k in range(20_000):
        builder.add(k * 1_600_000_000_000, False, {"limits": ("RATE",) if k % 2 else (), "gap_mm": float(k)})
    made = builder.made()
    assert len(made.packed()) < 200_000
    gap = made.series("gap_mm")
    assert (gap.low.min(), gap.high.max()) == (0.0, 19_999.0)
    assert len(made.codes["limits"]["RATE"].spans_ns) <= 1_000
