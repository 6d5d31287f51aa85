"""Short slices of the processor, as the kernel itself says that it gives them."""

import os
import subprocess
import sys

import pytest

from tormagd.slices import SHORTEST_NS

TELL = """
import sys, threading
from tormagd.slices import ask_for_slices

def told():
    with open("/proc/thread-self/sched") as lines:
        found = [line.split(":")[1] for line in lines if line.startswith("se.slice")]
    print(int(found[0]) if found else 0)

told()
ask_for_slices(int(sys.argv[1]))
told()
thread = threading.Thread(target=told)
thread.start()
thread.join()
ask_for_slices(0)
told()
"""


def slices_ns(asked_ns: int) -> list[int]:
    """Of a process of its own: at first, when it has asked, of a thread that it then begins, and when it asks for the
    kernel's own."""
    command = [sys.executable, "-c", TELL, str(asked_ns)]
    return [int(line) for line in subprocess.check_output(command, text=True).split()]


def test_slices_are_as_short_as_the_kernel_gives_them_and_threads_inherit_them() -> None:
    usual_ns, given_ns, of_thread_ns, again_ns = slices_ns(SHORTEST_NS)
    if given_ns == usual_ns:
        pytest.skip(
            "this kernel gives everybody the same slices, or does not say (it needs 6.12 and CONFIG_SCHED_DEBUG)"
        )
    assert given_ns == of_thread_ns == SHORTEST_NS < usual_ns == again_ns


def test_asking_changes_no_niceness() -> None:
    told = (
        "import os\nfrom tormagd.slices import ask_for_slices\nask_for_slices()\n"
        "print(os.getpriority(os.PRIO_PROCESS, 0), os.sched_getscheduler(0))"
    )
    printed = subprocess.check_output([sys.executable, "-c", f"import os\nos.nice(7)\n{told}"], text=True)
    assert printed.split() == [str(os.getpriority(os.PRIO_PROCESS, 0) + 7), str(os.SCHED_OTHER)]
