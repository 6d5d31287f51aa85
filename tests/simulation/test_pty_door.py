"""The simulator as a process, over a real pseudo-terminal."""

import csv
import itertools
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import serial

from firmware_protocol.codec import FUNCTION, PROTOCOL_VERSION, SCHEMA_HASH, Hello, Identity, Status, encode
from firmware_protocol.framing import FrameDecoder, encode_frame
from tormagd.simulation.__main__ import main

LIMIT_S = 20.0


@pytest.fixture
def simulator(tmp_path: Path) -> Iterator[tuple[subprocess.Popen[str], str, Path]]:
    truth = tmp_path / "truth.csv"
    command = [sys.executable, "-m", "tormagd.simulation", "--pty", "--seed", "3", "--truth", str(truth)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        yield process, process.stdout.readline().strip(), truth
    finally:
        process.kill()
        process.communicate()


def say_hello_until_identity(path: str, nonce: int) -> set[int]:
    """Open the line, repeat Hello until Identity comes, close it; the functions seen."""
    decoder = FrameDecoder()
    seen: set[int] = set()
    deadline_s = time.monotonic() + LIMIT_S
    with serial.Serial(path, 1_000_000, exclusive=True, timeout=0) as port:
        port.reset_input_buffer()
        sequence = 0
        while not {FUNCTION[Identity], FUNCTION[Status]} <= seen:
            assert time.monotonic() < deadline_s, f"only {seen} in {LIMIT_S} s"
            hello = encode(Hello(SCHEMA_HASH, PROTOCOL_VERSION, nonce))
            port.write(encode_frame(FUNCTION[Hello], sequence % 256, hello))
            sequence += 1
            readable, _, _ = select.select([port.fd], [], [], 0.1)
            if readable:
                seen.update(frame.function for frame in decoder.feed(os.read(port.fd, 4096)))
    return seen


def test_hello_is_answered_across_two_hosts_and_the_truth_is_kept(simulator) -> None:
    process, path, truth = simulator
    assert Path(path).is_char_device()
    for nonce in (1, 2):
        say_hello_until_identity(path, nonce)
    assert process.poll() is None
    process.send_signal(signal.SIGTERM)
    output, errors = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 0, errors
    assert output == ""
    with truth.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == [
        "t_ns", "force_N", "gap_mm", "left_mm", "right_mm", "handle_mm", "handle_mm_s", "temperature_C",
    ]  # fmt: skip
    assert len(rows) > 20
    assert all(int(after["t_ns"]) > int(before["t_ns"]) for before, after in itertools.pairwise(rows))
    assert abs(int(rows[0]["t_ns"]) - time.time_ns()) < 120e9
    assert float(rows[-1]["gap_mm"]) == pytest.approx(79.0)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((), "--pty"),
        (("--pty", "--plant", "nowhere.toml"), "sample_1"),
        (("--pty", "--fault", "gremlins"), "worn_gearbox"),
        (("--pty", "--hand", "third"), "reversing"),
        (("--pty", "--baud", "7"), "1200"),
        (("--pty", "--truth", "/nonexistent/truth.csv"), "/nonexistent"),
        (("--can", "--bitrate", "7"), "10000"),
        (("--can", "--node", "16"), "16"),
        (("--can", "/nonexistent/can"), "/nonexistent"),
        (("--bus", "telepathy:0"), "telepathy"),
        (("--can", "--pty"), "not allowed"),
    ],
)
@pytest.mark.usefixtures("usual_slices")
def test_a_wrong_call_says_what_is_right_and_exits_with_2(
    arguments: tuple[str, ...], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(arguments)
    output, errors = capsys.readouterr()
    assert output == ""
    assert said in errors
