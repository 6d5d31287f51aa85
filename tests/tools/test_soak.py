"""The soak in small, and that it would notice."""

import copy
import os
import subprocess
import sys
from typing import Any

import pytest
import soak

QUIET: dict[str, Any] = {
    "virtual": {"growth_kB": 100, "faults": [], "mean_error_first_N": 0.02, "mean_error_last_N": 0.021},
    "daemon": {"growth_kB": -4, "faults": [], "descriptor_growth": 0},
}


def test_the_virtual_loop_tracks_without_a_fault() -> None:
    result = soak.virtual(0.02)
    assert result["ticks"] == 1_200
    assert result["faults"] == []
    assert 0.0 < result["mean_error_last_N"] < 0.1
    assert result["memory_kB"] > 10_000


def test_growth_is_over_the_second_quarter() -> None:
    assert soak.growth([1, 90, 100, 100, 100, 100, 100, 100]) == 0
    assert soak.growth([1, 90, 100, 101, 102, 103, 104, 110]) == 9
    assert soak.growth([5, 5, 5, 4]) == -1


@pytest.mark.parametrize(
    ("part", "key", "value", "says"),
    [
        ("virtual", "growth_kB", 5_000, "virtual: memory grew by 5000 kB"),
        ("virtual", "faults", ["SKEW"], "virtual: faults SKEW"),
        ("virtual", "mean_error_last_N", 0.2, "the force error grew by 0.180 N"),
        ("daemon", "growth_kB", 5_000, "daemon: memory grew"),
        ("daemon", "descriptor_growth", 1, "1 more descriptors"),
        ("daemon", "faults", ["LINK_LOST"], "LINK_LOST"),
    ],
)
def test_what_grows_or_fails_is_named(part: str, key: str, value: object, says: str) -> None:
    assert soak.failures(QUIET) == []
    result = copy.deepcopy(QUIET)
    result[part][key] = value
    (failure,) = soak.failures(result)
    assert says in failure


def test_it_finds_its_own_children_only() -> None:
    with pytest.raises(LookupError):
        soak.child("tormagd.daemon.main")
    with subprocess.Popen([sys.executable, "-m", "http.server", "--help"], stdout=subprocess.PIPE) as other:
        other.wait()
        # a zombie's command line is empty
        with pytest.raises(LookupError):
            soak.child("http.server")
    with subprocess.Popen(
        [sys.executable, "-c", "import sys; print(flush=True); sys.stdin.read()", "some.module"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    ) as waiting:
        assert waiting.stdout is not None
        waiting.stdout.readline()  # while it is being replaced, a process has no command line
        assert soak.child("some.module") == waiting.pid
        assert soak.resident_kB(waiting.pid) > 0
        waiting.communicate()
    assert soak.resident_kB(os.getpid()) > 10_000
