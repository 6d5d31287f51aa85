"""What is generated is what is committed, and the DBC cannot say what the codec cannot do."""

import shutil
from pathlib import Path

import pytest

from firmware_protocol.codec import SCHEMA_HASH
from firmware_protocol.dbc import read_schema
from firmware_protocol.generate import main

ROOM = Path(__file__).parents[2] / "firmware_protocol"


@pytest.fixture
def room(tmp_path: Path) -> Path:
    for name in ("tormag.dbc", "README.md", "enumerations.py", "layouts.py", "wire.py"):
        shutil.copy(ROOM / name, tmp_path)
    for folder in ("vectors", "c"):
        shutil.copytree(ROOM / folder, tmp_path / folder)
    return tmp_path


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")


def test_the_committed_files_are_what_the_dbc_gives(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--check"], ROOM) == 0
    assert capsys.readouterr().out == ""


def test_a_stale_file_is_shown_with_the_remedy_and_not_touched(room: Path, capsys: pytest.CaptureFixture[str]) -> None:
    edit(room / "layouts.py", "0.0001", "0.0002")
    before = (room / "layouts.py").read_bytes()
    assert main(["--check"], room) == 1
    output = capsys.readouterr().out
    assert '-            Signal("left_duty", float, 0.0002, -1, 1),' in output
    assert "out of date: layouts.py; remedy: python -m firmware_protocol.generate" in output
    assert (room / "layouts.py").read_bytes() == before


def test_generating_repairs_every_file_and_then_has_nothing_to_do(room: Path) -> None:
    names = ("enumerations.py", "layouts.py", "wire.py", "README.md", "vectors/messages.json", "vectors/frames.json")
    committed = {name: (room / name).read_bytes() for name in names}
    (room / "layouts.py").unlink()
    (room / "wire.py").unlink()
    edit(room / "enumerations.py", "RUN = 1", "RUN = 2")
    edit(room / "README.md", "`left_duty` | i16", "`left_duty` | i32")
    edit(room / "vectors" / "messages.json", '"Drive"', '"Dive"')
    (room / "vectors" / "frames.json").write_text("{}", encoding="utf-8")
    assert main(["--check"], room) == 1
    assert main([], room) == 0
    assert {name: (room / name).read_bytes() for name in names} == committed
    assert main(["--check"], room) == 0


@pytest.mark.parametrize(
    ("old", "new", "is_same"),
    [
        ("(0.0001,0)", "(0.0002,0)", False),
        ("[-1|1]", "[-0.5|0.5]", False),
        ("SG_ right_duty : 16|16@1-", "SG_ right_force : 16|16@1-", False),
        ('1 "COMMAND_TIMEOUT" ;', '1 "TIMEOUT" ;', False),
        ("BO_ 33 Drive", "BO_ 33 Motors", False),
        ('BA_ "ProtocolVersion" 1;', 'BA_ "ProtocolVersion" 2;', False),
        ('BA_ "Kind" SG_ 65 handle_position_mm 1;', "", False),
        ('"mm" Host', '"cm" Host', False),
        ("Motor duties. Every 1 ms", "Duties of the motors, every 1 ms", True),
        ('BA_ "GenMsgCycleTime" BO_ 33 1;', 'BA_ "GenMsgCycleTime" BO_ 33 2;', True),
    ],
)
def test_a_change_of_layout_changes_the_hash_and_one_of_comment_or_cycle_time_does_not(
    room: Path, old: str, new: str, is_same: bool
) -> None:
    edit(room / "tormag.dbc", old, new)
    assert (read_schema(room / "tormag.dbc").schema_hash() == SCHEMA_HASH) is is_same
