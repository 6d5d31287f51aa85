"""Seals: any byte changed, cut, put elsewhere or of another file is named; an end that is missing is told apart."""

import itertools
import random
from pathlib import Path

import hostile
import pytest
from mcap.reader import make_reader
from sent import batch, telemetry

from tormagd.recording.folder import Budget, RecordingFolder
from tormagd.recording.seal import State, read_key, verified
from tormagd.recording.stream import HEAD, MAGIC, SEAL, records
from tormagd.recording.writer import RecordingWriter

KEY = b"0123456789abcdef"
CHANGES = 200


def write(path: Path, force_N: float, key: bytes = b"") -> Path:
    """Three seconds of a force, with a seal each half of one."""
    rng = random.Random(path.name)
    with RecordingWriter(path, {"scene": "pulse"}, key) as writer:
        for k in range(150):
            writer.ticks(batch(*((20 * k + i, force_N, rng.random(), 35.0, 36.0, 0.25) for i in range(20))))
            writer.telemetry(telemetry(20 * k, k))
    return path


@pytest.fixture(scope="module")
def sealed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("sealed") / "a.mcap", 1.5)


@pytest.fixture(scope="module")
def other(sealed: Path) -> Path:
    return write(sealed.with_name("b.mcap"), 1.7)


def pieces(path: Path) -> list[bytes]:
    """The file, cut behind each seal."""
    data, ends = path.read_bytes(), [0]
    with path.open("rb") as file:
        ends += [each.at + HEAD.size + len(each.body) for each in records(file) if each.opcode == SEAL]
    return [data[a:b] for a, b in zip(ends, [*ends[1:], len(data)], strict=True)]


def changed(rng: random.Random, data: bytes, of_other: bytes) -> bytes:
    """With one byte changed, some taken out, some put elsewhere, or some of another file; its end stays."""
    size, at = rng.randrange(1, 5_000), rng.randrange(len(data))
    if rng.random() < 0.4:
        return data[:at] + bytes([data[at] ^ (1 << rng.randrange(8))]) + data[at + 1 :]
    at = rng.randrange(len(data) - size - len(MAGIC))
    match rng.randrange(3):
        case 0:
            return data[:at] + data[at + size :]
        case 1:
            to = rng.randrange(len(data) - size - len(MAGIC))
            moved = data[:at] + data[at + size :]
            return moved[:to] + data[at : at + size] + moved[to:]
        case _:
            return data[:at] + of_other[at : at + size] + data[at + size :]


def test_a_file_that_is_whole_says_so_and_others_read_it(sealed: Path) -> None:
    assert verified(sealed).state is State.WHOLE
    with sealed.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert reader.get_summary().statistics.message_count == len(list(reader.iter_messages())) == 3_150


def test_whatever_is_changed_is_named(sealed: Path, other: Path, tmp_path: Path) -> None:
    rng, data, of_other = random.Random(39), sealed.read_bytes(), other.read_bytes()
    path = tmp_path / "changed.mcap"
    spoilt = {changed(rng, data, of_other) for _ in range(CHANGES)} - {data}
    assert len(spoilt) > 0.9 * CHANGES
    for each in spoilt:
        path.write_bytes(each)
        assert verified(path).state is State.ALTERED


def test_a_file_that_was_cut_is_one_that_was_not_finished(sealed: Path, tmp_path: Path) -> None:
    rng, data, path = random.Random(7), sealed.read_bytes(), tmp_path / "cut.mcap"
    parts = pieces(sealed)
    assert len(parts) > 6
    whole = b"".join(parts[:4])
    for size in (len(whole), *(rng.randrange(len(parts[0]), len(data)) for _ in range(50)), len(data) - 1):
        path.write_bytes(data[:size])
        assert verified(path).state is State.UNFINISHED
    path.write_bytes(whole)
    assert f"its first {len(whole)} bytes" in verified(path).why
    # cut, and changed before that: it is the change that is told
    at = len(parts[0]) + 500
    path.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :] + b"abc")
    assert verified(path).state is State.ALTERED
    for order in ([0, 2, 1, 3], [0, 1, 1, 2], [0, 2, 3]):
        path.write_bytes(b"".join(parts[i] for i in order))
        assert verified(path).state is State.ALTERED


def test_who_has_no_key_cannot_seal(tmp_path: Path, sealed: Path) -> None:
    keyed = write(tmp_path / "k.mcap", 1.5, KEY)
    assert [verified(keyed, key).state for key in (KEY, KEY[::-1])] == [State.WHOLE, State.ALTERED]
    unchecked = verified(keyed)
    assert (unchecked.state, unchecked.is_sound) == (State.OTHER_KEY, False)
    assert "it was not checked" in unchecked.text()
    # whose seals were taken away
    (tmp_path / "bare.mcap").write_bytes(hostile.messages(b"{}"))
    assert [verified(tmp_path / "bare.mcap", key).is_sound for key in (KEY, b"")] == [False, True]
    # sealed anew by somebody who changed it
    assert verified(sealed, KEY).state is State.NO_KEY


def test_a_key_is_read_without_its_line_end_and_one_that_is_too_short_refused(tmp_path: Path) -> None:
    for name, data in (("key", KEY + b"\n"), ("short", b"short")):
        (tmp_path / name).write_bytes(data)
    assert (read_key(str(tmp_path / "key")), read_key("")) == (KEY, b"")
    with pytest.raises(ValueError, match=r"a key of 5 bytes: allowed are 16\.\.64"):
        read_key(str(tmp_path / "short"))


def test_segments_follow_each_other(tmp_path: Path) -> None:
    budget = Budget(segment_bytes=1_000_000, segment_s=1.0, most_bytes=100_000_000, most_s=1e9, free_bytes=0)
    with RecordingWriter(RecordingFolder(tmp_path, budget, itertools.count(1_790_000_000).__next__)) as writer:
        for k in range(5):
            writer.ticks(batch(*((2_000 * k + i, 1.5, 1.5, 35.0, 36.0, 0.25) for i in range(20))))
    said = [verified(path) for path in sorted(tmp_path.iterdir())]
    assert [(each.state, each.follows) for each in said] == [
        (State.WHOLE, ""),
        (State.WHOLE, said[0].last),
        (State.WHOLE, said[1].last),
    ]
