"""The daemon's log: one line for each record, with its time where nobody else writes that down."""

import os
import pty
import re
import subprocess
import sys

import pytest

SAY = "import logging, tormagd.daemon.log as log; log.log_to_stderr(); logging.getLogger('room').warning('a\\x1b[2J')"


@pytest.mark.parametrize(
    ("opened", "time", "end"), [(pty.openpty, r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3} ", "\r\n"), (os.pipe, "", "\n")]
)
def test_a_line_has_its_time_on_a_terminal_and_none_for_the_journal(opened, time, end):
    far, near = opened()
    try:
        subprocess.run([sys.executable, "-c", SAY], stderr=near, check=True, timeout=60)
        assert re.fullmatch(rf"{time}WARNING room: a\S*{end}", os.read(far, 1024).decode())
    finally:
        os.close(far)
        os.close(near)
