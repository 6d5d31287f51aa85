"""Short slices of the processor, as the kernel itself reports them."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tormagd.ground.scheduling import SHORTEST_NS

TOLD = """
import threading
from tormagd.ground.scheduling import ask_for_slices

def told():
    with open("/proc/thread-self/sched") as lines:
        print(*[line.split(":")[1] for line in lines if line.startswith("se.slice")])

ask_for_slices(0)  # whoever began this process may have asked for short ones
told()
ask_for_slices()
told()
thread = threading.Thread(target=told)
thread.start()
thread.join()
ask_for_slices(0)
told()
"""
NICE = """
import os
from tormagd.ground.scheduling import ask_for_slices

os.nice(1)
before = os.getpriority(os.PRIO_PROCESS, 0), os.sched_getscheduler(0)
ask_for_slices()
print(before == (os.getpriority(os.PRIO_PROCESS, 0), os.sched_getscheduler(0)))
"""
GIVES = tuple(map(int, re.findall(r"\d+", os.uname().release)[:2])) >= (6, 12)


def printed(script: str) -> list[str]:
    return subprocess.check_output([sys.executable, "-c", script], text=True).split()


@pytest.mark.skipif(not GIVES, reason="before Linux 6.12 everybody has the same slices")
@pytest.mark.skipif(not Path("/proc/self/sched").exists(), reason="this kernel does not say how long slices are")
def test_slices_are_as_short_as_the_kernel_gives_them_and_threads_inherit_them() -> None:
    usual_ns, given_ns, of_thread_ns, again_ns = map(int, printed(TOLD))
    assert given_ns == of_thread_ns == SHORTEST_NS < usual_ns == again_ns


def test_asking_changes_no_niceness_and_no_policy() -> None:
    assert printed(NICE) == ["True"]
