import os
import pty
import re
import signal
import subprocess
import sys
from unittest.mock import Mock

import pytest

from tormagd.daemon import main as daemon_main
from tormagd.ground import entry

# -- Ctrl-C until a command runs ---------------------------------------------------------------------------------------


COMMANDS = {
    "tormagd": "from tormagd.daemon.__main__ import command; sys.exit(command())",
    "tormagctl": "from tormagd.ctl.__main__ import command; sys.argv[1:] = ['status']; sys.exit(command())",
    "simulation": "import runpy; sys.argv[1:] = ['--pty']; runpy.run_module('tormagd.simulation', run_name='__main__')",
}
SIGNALLED_AT = """
import os, sys

class Finder:
    @staticmethod
    def find_spec(name, path, target=None):
        if name == {module!r}:
            os.kill(os.getpid(), {number})

sys.meta_path.insert(0, Finder)
{command}
"""


def test_ctrl_c_is_seen_to_before_anything_slow(monkeypatch: pytest.MonkeyPatch):
    before = signal.getsignal(signal.SIGINT)
    monkeypatch.setattr("tormagd.daemon.start.start", lambda _options: signal.getsignal(signal.SIGINT))
    assert daemon_main.main([]) is signal.SIG_DFL
    assert signal.getsignal(signal.SIGINT) == before


def test_what_is_slow_to_load_is_not_loaded_before_that():
    script = "import sys, tormagd.daemon.main; sys.exit(bool({'torch', 'uvloop', 'zmq'} & set(sys.modules)))"
    subprocess.run([sys.executable, "-c", script], check=True, timeout=60)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize(
    ("command", "module"),
    [
        ("tormagd", "tormagd.daemon.main"),
        ("tormagd", "uvloop"),
        ("tormagd", "tormagd.control.assembly.build"),
        ("tormagctl", "tormagd.ctl.main"),
        ("tormagctl", "tormagd.config"),
        ("simulation", "numpy"),
        ("simulation", "tormagd.simulation.pty_port"),
    ],
)
def test_a_signal_in_the_middle_of_loading_ends_a_command_without_a_word(
    command: str, module: str, number: signal.Signals
):
    script = SIGNALLED_AT.format(command=COMMANDS[command], module=module, number=int(number))
    ended = subprocess.run([sys.executable, "-c", script], check=False, capture_output=True, text=True, timeout=60)
    assert (ended.returncode, ended.stdout, ended.stderr) == (-number, "", "")


def test_ctrl_c_between_loading_and_running_is_quiet_too(monkeypatch: pytest.MonkeyPatch):
    before = signal.getsignal(signal.SIGINT)
    monkeypatch.setattr(daemon_main, "main", Mock(side_effect=KeyboardInterrupt))
    assert entry.run("tormagd.daemon.main") == entry.INTERRUPTED
    assert signal.getsignal(signal.SIGINT) == before


# -- what is loaded: nothing of the training ---------------------------------------------------------------------------


LOADED = """
import sys
import tormagd.daemon.daemon, tormagd.daemon.main, tormagd.control.assembly.build
import tormagd.hardware.serial_backend, tormagd.hardware.can_backend
names = sorted(sys.modules)
ours = [name for name in names if name.startswith(("tormagd.", "tormagd_client.", "firmware_protocol."))]
print(*[name for name in ours if "__mypyc" not in name])
print(*sorted({name.partition(".")[0] for name in names} & set(sys.argv[1:])))
"""
ROOMS = {"config", "control", "daemon", "element", "ground", "hardware", "record", "scenes"}
LIBRARIES = (
    "can",
    "matplotlib",
    "mcap",
    "msgpack",
    "msgspec",
    "numpy",
    "pandas",
    "safetensors",
    "scipy",
    "serial",
    "sklearn",
    "torch",
    "zmq",
)


def test_the_daemon_loads_the_model_and_nothing_of_its_training() -> None:
    ours, libraries = subprocess.run(
        [sys.executable, "-P", "-c", LOADED, *LIBRARIES], capture_output=True, text=True, check=True, timeout=60
    ).stdout.splitlines()
    assert {name.split(".")[1] for name in ours.split() if name.startswith("tormagd.")} == ROOMS
    rooms = ("tormagd.element.inverse.", "tormagd.element.model.", "tormagd_client.")
    assert {name for name in ours.split() if name.startswith(rooms)} == {
        "tormagd.element.inverse.choice",
        "tormagd.element.inverse.nearest",
        "tormagd.element.inverse.newton",
        "tormagd.element.inverse.solution",
        "tormagd.element.model.displacement",
        "tormagd.element.model.features",
        "tormagd.element.model.force_curve",
        "tormagd.element.model.memory",
        "tormagd.element.model.model_file",
        "tormagd_client.endpoints",
        "tormagd_client.keys",
        "tormagd_client.messages",
        "tormagd_client.printable",
        "tormagd_client.regular_file",
    }
    assert libraries.split() == ["can", "msgpack", "msgspec", "numpy", "safetensors", "serial", "zmq"]


# -- the log -----------------------------------------------------------------------------------------------------------


SAY = "import logging, tormagd.ground.terminal as t; t.log_to_stderr(); logging.getLogger('room').warning('a\\x1b[2J')"


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


UNREAD = """
import contextlib, logging, os, tormagd.ground.terminal as t
far, near = os.pipe()
os.dup2(near, 2)
os.set_blocking(near, False)
with contextlib.suppress(BlockingIOError):
    while os.write(near, bytes(4096)): pass
os.set_blocking(near, True)
t.log_to_stderr()
logging.warning("lost")
os.read(far, 1 << 20)
logging.warning("heard")
print(os.read(far, 1 << 20).decode())
"""


def test_control_waits_for_no_reader_of_the_log() -> None:
    told = subprocess.run([sys.executable, "-c", UNREAD], capture_output=True, text=True, check=True, timeout=30)
    assert told.stdout.strip() == "WARNING root: heard (1 lines before were not read, and are lost)"
