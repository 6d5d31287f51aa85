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
    # which takes longer is for the figures to say: of one start of each a busy machine may say the opposite
    for what, ratio in (("wall_ms", "ratio"), ("cpu_ms", "cpu_ratio")):
        both = result["status"][what], result["import_zmq"][what]
        assert min(both) > 0.0
        assert result[ratio] == pytest.approx(both[0] / both[1], rel=0.01)
    command.print_table(result)
    assert "allowed are 150 ms" in capsys.readouterr().out
