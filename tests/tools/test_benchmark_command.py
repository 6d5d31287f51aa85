import argparse
import subprocess
import sys

import pytest
from benchmarks import command


def test_a_command_that_fails_is_no_figure():
    with pytest.raises(subprocess.CalledProcessError):
        command.timed([sys.executable, "-c", "import sys; sys.exit(3)"])


def test_both_are_timed_and_compared(capsys):
    result = command.measure(argparse.Namespace(runs=1))
    assert set(result) == {"import_zmq", "status", "ratio", "cpu_ratio", "allowed_ms"}
    # what every client needs is part of what the command does
    assert 0.0 < result["import_zmq"]["cpu_ms"] < result["status"]["cpu_ms"]
    command.print_table(result)
    assert "allowed are 150 ms" in capsys.readouterr().out
