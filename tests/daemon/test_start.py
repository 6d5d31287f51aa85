"""Until the daemon runs, Ctrl-C just ends the process: no traceback from the middle of an import."""

import signal
import subprocess
import sys

import pytest

from tormagd.daemon import main as daemon_main


def test_ctrl_c_is_seen_to_before_anything_slow(monkeypatch: pytest.MonkeyPatch):
    seen = []

    def start(_options: object) -> int:
        seen.append(signal.getsignal(signal.SIGINT))
        return 0

    before = signal.getsignal(signal.SIGINT)
    monkeypatch.setattr(daemon_main, "_start", start)
    assert daemon_main.main([]) == 0
    assert seen == [signal.SIG_DFL]
    assert signal.getsignal(signal.SIGINT) == before


def test_what_is_slow_to_load_is_not_loaded_before_that():
    script = "import sys, tormagd.daemon.main; sys.exit(bool({'torch', 'uvloop', 'zmq'} & set(sys.modules)))"
    subprocess.run([sys.executable, "-c", script], check=True, timeout=60)
