"""A stream that is closed or full, or whose reader has gone, changes neither what was done nor the exit code."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

CTL = ("tormagd.ctl.main",)
LIST = (*CTL, "scene", "list")
LOST = "the answer could not be written: No space left on device"


def run(redirected: str, *arguments: str) -> "subprocess.CompletedProcess[str]":
    """A module of ours, run by a shell that redirects its streams."""
    return subprocess.run(
        ["sh", "-c", f'"$@" {redirected}', "sh", sys.executable, "-m", *arguments],
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )


@pytest.mark.parametrize(("redirected", "said"), [("> /dev/full", LOST), (">&-", ""), (">&- 2>&-", "")])
@pytest.mark.parametrize("form", [(), ("--json",)])
def test_an_answer_that_nobody_gets_does_not_change_the_exit_code(redirected, said, form):
    ran = run(redirected, *LIST, *form)
    assert (ran.returncode, ran.stderr.removeprefix("tormagctl scene: ").strip()) == (0, said)


def test_a_refusal_without_stderr_leaves_the_object_alone_on_stdout(tmp_path: Path):
    ran = run("2>&-", *CTL, "--endpoint", f"ipc://{tmp_path}/control", "--wait", "0.05", "--json", "home")
    assert ran.returncode == 3
    assert json.loads(ran.stdout)["error"]["code"] == "unreachable"


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (LIST, 0, ""),
        (("tormagd.daemon.main", "--check"), 0, ""),
        # a device whose address nobody learns is of no use
        (("tormagd.simulation", "--pty"), 1, "could not be written to stdout"),
    ],
)
def test_a_reader_that_has_gone_makes_no_traceback(arguments, code, said):
    reading, writing = os.pipe()
    os.close(reading)
    try:
        ran = subprocess.run(
            [sys.executable, "-m", *arguments],
            stdout=writing,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
            timeout=60,
        )
    finally:
        os.close(writing)
    assert ran.returncode == code
    assert said in ran.stderr
    assert len(ran.stderr.splitlines()) == bool(said)
