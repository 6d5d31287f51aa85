"""Runs a module of tormagd in a process of its own: `tormagctl` does not load the core."""

import subprocess
import sys
from collections.abc import Iterable


def answer_of(module: str, arguments: Iterable[str], longest_s: float) -> str:
    """Run `python -m MODULE`, and return what it prints to stdout."""
    command = [sys.executable, "-P", "-m", module, *arguments]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=longest_s, check=False)
    except subprocess.TimeoutExpired as error:
        raise TimeoutError(f"not done after {longest_s:g} s") from error
    if done.returncode:
        raise ChildProcessError((done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1])
    return done.stdout
