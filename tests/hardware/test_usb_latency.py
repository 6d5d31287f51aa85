"""The latency timer of USB serial chips, on a directory that stands for sysfs."""

import logging
import os
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest
import serial

from tormagd.hardware.usb_latency import latency_ms, make_prompt


class Chip:
    """A port whose driver has a latency timer, of `sysfs`; `takes` is what low-latency mode does to it."""

    def __init__(self, sysfs: Path, takes: str | None = "1") -> None:
        self.port = "/dev/ttyUSB7"
        self.timer = sysfs / "ttyUSB7" / "latency_timer"
        self.timer.parent.mkdir()
        self.timer.write_text("16\n")
        self.takes = takes
        self.asked = 0

    def set_low_latency_mode(self, is_low: bool) -> None:
        assert is_low
        self.asked += 1
        if self.takes is None:
            raise ValueError("Failed to update ASYNC_LOW_LATENCY flag")
        self.timer.write_text(self.takes)


@pytest.fixture
def pty() -> Iterator[serial.Serial]:
    far, near = os.openpty()
    tty.setraw(near)
    with serial.Serial(os.ttyname(near)) as port:
        yield port
    os.close(far)
    os.close(near)


def test_the_timer_is_read_through_the_stable_name_too(tmp_path: Path) -> None:
    Chip(tmp_path)
    link = tmp_path / "tormag"
    link.symlink_to("/dev/ttyUSB7")
    assert latency_ms("/dev/ttyUSB7", tmp_path) == latency_ms(str(link), tmp_path) == 16
    assert latency_ms("/dev/ttyACM0", tmp_path) is None


@pytest.mark.parametrize("text", ["", "soon", "1.5"])
def test_a_timer_that_is_no_number_is_no_timer(tmp_path: Path, text: str) -> None:
    chip = Chip(tmp_path)
    chip.timer.write_text(text)
    assert latency_ms(chip.port, tmp_path) is None


def test_a_driver_that_can_is_made_prompt_without_a_word(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    chip = Chip(tmp_path)
    make_prompt(chip, tmp_path)  # type: ignore[arg-type]
    assert latency_ms(chip.port, tmp_path) == 1
    make_prompt(chip, tmp_path)  # type: ignore[arg-type]
    assert chip.asked == 1, "what is prompt already is left alone"
    assert caplog.records == []


@pytest.mark.parametrize("takes", [None, "16"], ids=["refuses", "ignores it"])
def test_one_that_will_not_is_a_plain_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, takes: str | None
) -> None:
    make_prompt(Chip(tmp_path, takes), tmp_path)  # type: ignore[arg-type]
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    assert all(word in record.message for word in ("/dev/ttyUSB7", "16 ms", "tormagctl doctor"))


def test_a_port_without_a_timer_is_not_asked(
    pty: serial.Serial, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    make_prompt(pty, tmp_path)
    assert caplog.records == []


def test_a_pty_that_is_said_to_have_a_timer_refuses(
    pty: serial.Serial, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The driver's real refusal, as pyserial hands it on."""
    timer = tmp_path / Path(pty.port).name / "latency_timer"
    timer.parent.mkdir()
    timer.write_text("16")
    make_prompt(pty, tmp_path)
    assert "Failed to update" in caplog.text
