import hashlib
import json
import re
import resource
import signal
import subprocess
import sys
import threading
from pathlib import Path

import msgpack
import pytest

from tormagd.record.folder import RecordingFolder
from tormagd.record.reader import RecordingFile


@pytest.fixture
def file(tmp_path):
    return tmp_path / "a.mcap"


def test_record_then_plot(fake_daemon, tmp_path, ctl, file):
    picture = tmp_path / "a.png"
    result = ctl(*fake_daemon.at, "--json", "record", str(file), "--duration", "2").ended(0).result
    recording = RecordingFile(file)
    assert recording.is_complete
    # what is not known of a daemon, as where its configuration is, is left out
    assert (recording.metadata["version"], "configuration_file" in recording.metadata) == ("0", False)
    assert recording.overview.ticks == result["ticks"] > 0
    assert recording.overview.snapshots == result["telemetry"] > 0
    assert (result["ticks_lost"], result["unreadable"]) == (0, 0)

    drawn = ctl("--json", "plot", str(file), "-o", str(picture)).ended(0).result
    assert (drawn["ticks"], drawn["tracking_rms_N"]) == (result["ticks"], pytest.approx(0.1 / 2**0.5, rel=0.1))
    assert picture.read_bytes().startswith(b"\x89PNG")
    # whatever other programs are told
    (tmp_path / "matplotlibrc").write_bytes(b"text.usetex: True\n\xff")
    for backend in ("module://matplotlib_inline.backend_inline", "unknown"):
        told = ("env", f"MPLBACKEND={backend}", "MATPLOTLIBRC=.", sys.executable, "-m", "tormagd.ctl.main")
        subprocess.run([*told, "plot", str(file), "-o", "b.png"], cwd=tmp_path, check=True, timeout=60)
        assert (tmp_path / "b.png").read_bytes().startswith(b"\x89PNG")
    file.write_bytes(file.read_bytes()[:-40])
    export = "recordings", "export", str(file), "--to", str(tmp_path / "copy.mcap")
    for arguments, code in (
        (("plot", str(file), "-o", str(picture)), 0),
        (export, 1),
        ((*export[:1], "list", str(tmp_path)), 0),
    ):
        assert "cut short: its recorder did not end it" in ctl(*arguments).ended(code).out


def test_a_daemon_that_does_not_say_what_it_runs_is_not_recorded(fake_daemon, tmp_path, ctl):
    fake_daemon.answers["describe"] = lambda: {"ok": True, "result": {"version": "0.0.9"}}
    assert "the description of tormagd 0.0.9" in ctl(*fake_daemon.at, "record", str(tmp_path / "a.mcap")).ended(3).err
    assert list(tmp_path.iterdir()) == []


def test_a_silent_end_is_a_daemon_that_has_gone(fake_daemon, tmp_path, ctl, file):
    described = fake_daemon.answers["describe"]()

    def describe():  # recording begins, and goes on for two seconds
        threading.Timer(0.3, setattr, (fake_daemon, "is_silent", True)).start()
        return described

    fake_daemon.answers["describe"] = describe
    found = ctl(*fake_daemon.at, "--json", "record", str(file), "--duration", "2").ended(3).result
    assert found["silent_ms"] > 1_000.0
    assert RecordingFile(file).overview.ticks == found["ticks"]


def test_lost_ticks_are_counted_and_are_no_success(fake_daemon, tmp_path, ctl):
    fake_daemon.rubbish += [
        msgpack.packb({"v": 1, "columns": ("t_ns", "tick"), "rows": [[2**60 + number, number]]})
        for number in (3, 4, 8, 9, 0, 1, 2)  # 5, 6 and 7 are lost; then the daemon restarts; and so on
    ]
    arguments = ("record", str(tmp_path / "a.mcap"), "--duration", "0.3")
    found = ctl(*fake_daemon.at, "--json", *arguments).ended(1).result
    assert found["ticks_lost"] in range(3, 300_000, 3)
    assert found["restarts"] > 0


def test_a_recording_is_never_overwritten(fake_daemon, tmp_path, ctl, file):
    file.write_text("precious")
    assert "exists" in ctl(*fake_daemon.at, "--json", "record", str(file)).ended(2).error["message"]
    assert file.read_text() == "precious"


def test_a_folder_of_recordings_is_listed_pruned_marked_and_exported(fake_daemon, tmp_path, ctl):
    folder, config = tmp_path / "recordings", tmp_path / "t.toml"
    folder.mkdir()
    config.write_text(f'[recordings]\nfolder = "{folder}"\nmost_MB = 1.0\nsegment_MB = 0.1\nfree_MB = 1.0\n')
    assert "at least twice" in ctl("--config", str(config), "recordings", "list").ended(2).err
    config.write_text(config.read_text().replace("most_MB = 1.0", "most_MB = 1.3"))
    command = ("--config", str(config), *fake_daemon.at, "--json")
    made = ctl(*command, "record", str(folder), "--duration", "1.5").ended(0).result
    listed = ctl(*command, "recordings", "list").ended(0).result
    names = [row["name"] for row in listed["recordings"]]
    assert (len(names) > 1, names[-1]) == (True, Path(made["file"]).name)
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d-\d\d-\d\d\.\d{3}Z\.mcap", names[-1])
    assert {row["is_marked"] for row in listed["recordings"]} == {False}
    kept = ctl(*command, "recordings", "mark", str(folder / names[-1])).ended(0).result["file"]
    copied = ctl(*command, "recordings", "export", kept, "--to", str(tmp_path)).ended(0).result
    assert copied["sha256"] == hashlib.sha256((tmp_path / Path(kept).name).read_bytes()).hexdigest()
    assert (copied["file"], copied["damage"]) == (str(tmp_path / Path(kept).name), "")
    data = bytearray(Path(kept).read_bytes())
    data[3_000] ^= 1  # in a chunk
    (tmp_path / "odd.mcap").write_bytes(data)
    for odd, said in (("odd.mcap", "the CRC of its data is wrong"), ("t.toml", "it does not begin as an MCAP file")):
        export = "recordings", "export", str(tmp_path / odd), "--to", str(tmp_path / f"copy of {odd}.mcap")
        assert ctl(*command, *export).ended(1).result["damage"] == said
        assert said in ctl("recordings", "list", str(tmp_path)).ended(0).out
    config.write_text(config.read_text() + "most_days = 1e-9\n")
    assert ctl(*command, "recordings", "prune").ended(0).result["removed"] == names[:-1]
    assert [path.name for path in folder.iterdir()] == [Path(kept).name]
    gone = f"/no/{Path(kept).name}"
    no_exports = f"export {kept}", f"export {gone} --to /", f"export /dev/zero --to {tmp_path}/zero"
    for wrong in ("list /no", "mark", f"mark {gone}", f"mark {config}", *no_exports):
        assert ctl(*command, "recordings", *wrong.split()).ended(2).error["hint"]


def test_a_report_is_one_page_of_one_recording_or_of_two(fake_daemon, tmp_path, ctl, file):
    ctl(*fake_daemon.at, "record", str(file), "--duration", "0.3").ended(0)
    other = tmp_path / "<b>.mcap"
    other.write_bytes(file.read_bytes().replace(b"tormagd.Tick", b"tormagd.Tack"))
    page = tmp_path / "a.html"
    ctl("report", str(file), "-o", str(page)).ended(0)
    said = ctl("--json", "report", str(file), str(other), "-o", str(page)).ended(1).result["notes"]
    assert list(said.values()) == [[], ["damaged: the CRC of its summary is wrong"]]
    both = page.read_text()
    assert both.count("data:image/png;base64,") == 2
    # no network, and no name is taken for markup
    assert ["<b>" in both, "&lt;b&gt;" in both, *re.findall("https?://|<script", both)] == [False, True]
    assert ctl("--json", "report", str(file), str(tmp_path / "no.mcap"), "-o", str(page)).ended(2).error["hint"]
    assert ctl("--json", "report", *[str(file)] * 3, "-o", str(page)).ended(2).error["hint"]


def test_rubbish_is_counted_and_left_out(fake_daemon, ctl, file):
    good = {"v": 1, "columns": ["t_ns", "x"], "rows": [[2**60, 1.0]]}
    fake_daemon.rubbish += [
        b"\xc1",
        msgpack.packb(good | {"v": 2}),
        msgpack.packb(good | {"columns": ["x", "t_ns"]}),
        msgpack.packb(good | {"columns": ["t_ns", "t_ns"]}),
        msgpack.packb(good | {"rows": [[2**60]]}),
        msgpack.packb(good | {"rows": [[-1, 1.0]]}),
        msgpack.packb(good | {"rows": [[1.5, 1.0]]}),
    ]
    captured = ctl(*fake_daemon.at, "--json", "record", str(file), "--duration", "0.6").ended(0)
    assert captured.result["unreadable"] >= 7
    assert captured.err.count("left out a message") == 1
    assert RecordingFile(file).is_complete


@pytest.mark.parametrize(
    ("limit_bytes", "program", "said", "is_told"),
    [
        # to a program the same as a full disk
        (100_000, "", "File too large", False),
        (10**9, "writer.MIN_FREE_BYTES = 1 << 60; ", "No space left on device", True),
    ],
    ids=["without a warning", "nearly full"],
)
def test_a_full_disk_ends_a_recording_that_can_still_be_read(
    fake_daemon, tmp_path, limit_bytes, program, said, is_told, file
):
    program = f"from tormagd.record import writer; {program}import sys, tormagd.ctl.main as it; sys.exit(it.main())"
    command = [sys.executable, "-c", program, *fake_daemon.at, "--wait", "20", "--json"]
    ended = subprocess.run(
        [*command, "record", str(file), "--duration", "60"],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit_bytes, limit_bytes)),
    )
    assert ended.returncode == 1
    assert "Traceback" not in ended.stderr
    error = json.loads(ended.stdout)["error"]
    assert error["code"] == "not_written"
    received = int(re.findall(rf"{said}.*, after (\d+) ticks", error["message"])[0])
    recording = RecordingFile(file)
    assert not recording.is_complete
    assert recording.overview.ticks <= received
    assert ("cut_by" in recording.metadata) == is_told
    assert is_told or recording.overview.ticks > 0


def test_a_folder_that_is_moved_away_is_told_and_not_taken_for_a_full_disk(fake_daemon, tmp_path, ctl, monkeypatch):
    folder, require_room = tmp_path / "a", RecordingFolder.require_room
    folder.mkdir()

    def moved(self: RecordingFolder, needed_bytes: int) -> None:
        folder.rename(tmp_path / "b")
        require_room(self, needed_bytes)

    monkeypatch.setattr(RecordingFolder, "require_room", moved)
    error = ctl(*fake_daemon.at, "--json", "record", str(folder)).ended(1).error
    assert (error["code"], "No such file or directory, after " in error["message"]) == ("not_written", True)
    assert error["hint"].startswith(f"see that {folder} stays in place and takes files; what is in the file")


def test_an_interrupt_ends_a_recording_cleanly(fake_daemon, started, ctl, file):
    with started("--json", "record", str(file)) as recorder:
        while recorder.poll() is None and not file.exists():
            ctl(*fake_daemon.at, "status")
        recorder.send_signal(signal.SIGINT)
        printed, _ = recorder.communicate(timeout=20)
    assert recorder.returncode == 0
    recording = RecordingFile(file)
    assert recording.is_complete
    assert json.loads(printed)["result"]["telemetry"] == recording.overview.snapshots
