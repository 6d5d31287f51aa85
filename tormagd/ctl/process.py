"""A module of tormagd that runs in a process of its own: what operates a daemon does not load its core."""

import subprocess
import sys
from collections.abc import Iterable


def answer_of(module: str, arguments: Iterable[str], longest_s: float) -> str:
    """What `python -m MODULE` prints. Raises TimeoutError, or ChildProcessError with the last line of its complaint."""
    command = [sys.executable, "-P", "-m", module, *arguments]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=longest_s, check=False)
    except subprocess.TimeoutExpired as error:
        raise TimeoutError(f"not done after {longest_s:g} s") from error
    if done.returncode:
        raise ChildProcessError((done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1])
    return done.stdout
