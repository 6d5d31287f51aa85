"""A force over time has one reader, whoever it is for: all read the same files, and refuse others in the same words."""

from collections.abc import Callable
from pathlib import Path

import pytest

from tormagd.ctl.waveform import read_csv
from tormagd.force_file import read_forces
from tormagd.scenes.signal import recorded

READERS: tuple[Callable[[Path], object], ...] = (read_csv, recorded, read_forces)


@pytest.mark.parametrize("text", ["t_s,force_N\n0,1\n1,2\n3,1\n", "rate_mm_s,force_N,t_s\n5,1,7\n5,2,8\n-5,0,9.5\n"])
def test_all_read_the_same_files(tmp_path: Path, text: str) -> None:
    path = tmp_path / "task.csv"
    path.write_text(text)
    sent, (time_s, force_N), table = read_csv(path), recorded(path), read_forces(path)
    assert [sent.at(at_s).force_N for at_s in time_s] == force_N.tolist() == list(table["force_N"])
    assert [at_s - table["t_s"][0] for at_s in table["t_s"]] == time_s.tolist()


@pytest.mark.parametrize(
    "text",
    [
        "",
        "t_s,force_N\n0,1\n",
        "t_s,force_N\n0,1\n1,-0.5\n2,1\n",
        "t_s,force_N\n0,1\n1,1001\n2,1\n",
        "t_s,force_N\n0,1\n1,nan\n2,1\n",
        "t_s,force_N\n0,1\n1,1_5\n2,1\n",
        "t_s,force_N\n0,1\n0,2\n2,1\n",
        "t_s,force_N\n0,1\n1\n2,1\n",
        "t_s,force_N,mood\n0,1,2\n1,1,2\n2,1,2\n",
        't_s,force_N\n0,"1\n',
        None,
    ],
)
def test_the_same_mistake_is_told_in_the_same_words(tmp_path: Path, text: str | None) -> None:
    path = tmp_path / "task.csv"
    if text is not None:
        path.write_text(text)
    said = set()
    for read in READERS:
        with pytest.raises(ValueError, match=str(path)) as refused:
            read(path)
        said.add(str(refused.value).removeprefix("signal.file = "))
    assert len(said) == 1
