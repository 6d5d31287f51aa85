"""The simulator as a process, over a real pseudo-terminal."""

import contextlib
import csv
import itertools
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from firmware_protocol.codec import PROTOCOL_VERSION, SCHEMA_HASH, Hello, Identity, Message, Status
from tormagd.config import Device
from tormagd.hardware.serial_backend import SerialOptions, open_serial
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


def meet(path: str, nonce: int) -> None:
    """Opens the line as the daemon does, repeats Hello until both Identity and Status have come, and closes it."""
    seen: set[type[Message]] = set()
    deadline_s = time.monotonic() + LIMIT_S
    with contextlib.closing(open_serial(Device(port=path), SerialOptions())) as port:
        while not {Identity, Status} <= seen:
            assert time.monotonic() < deadline_s, f"only {seen} in {LIMIT_S} s"
            port.send(Hello(SCHEMA_HASH, PROTOCOL_VERSION, nonce))
            select.select([port.fileno()], [], [], 0.1)
            seen |= {type(message) for message in port.receive()}


def test_hello_is_answered_across_two_hosts_and_the_truth_is_kept(simulator) -> None:
    process, path, truth = simulator
    assert Path(path).is_char_device()
    for nonce in (1, 2):
        meet(path, nonce)
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
