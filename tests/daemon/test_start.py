"""Until a command runs, Ctrl-C just ends the process: no traceback from the middle of an import."""

import signal
import subprocess
import sys
from unittest.mock import Mock

import pytest

from tormagd import entry
from tormagd.daemon import main as daemon_main

COMMANDS = {
    "tormagd": "import tormagd.entry; sys.exit(tormagd.entry.daemon())",
    "tormagctl": "import tormagd.entry; sys.argv[1:] = ['status']; sys.exit(tormagd.entry.ctl())",
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
    monkeypatch.setattr(daemon_main, "_start", lambda _options: signal.getsignal(signal.SIGINT))
    assert daemon_main.main([]) is signal.SIG_DFL  # what starts the daemon finds, and so its exit code here
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
        ("tormagd", "tormagd.assembly.build"),
        ("tormagctl", "tormagd.ctl.main"),
        ("tormagctl", "tormagd.config"),
        ("simulation", "numpy"),
        ("simulation", "tormagd.simulation.pty_door"),
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
    assert entry.daemon() == entry.INTERRUPTED
    assert signal.getsignal(signal.SIGINT) == before
