import ctypes
import os
import resource
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest

from tormagd.config import RealTime
from tormagd.daemon import admission, realtime
from tormagd.ground.files import raise_open_files

pytestmark = pytest.mark.usefixtures("usual_slices")
REFUSED = PermissionError(1, "Operation not permitted")


def test_each_refusal_names_its_setting_and_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("sched_setscheduler", "sched_setaffinity"):
        monkeypatch.setattr(os, name, Mock(side_effect=REFUSED))
    monkeypatch.setattr(
        ctypes, "CDLL", lambda *_, **__: SimpleNamespace(mlockall=lambda flags: -1, syscall=lambda *_: -1)
    )
    monkeypatch.setattr(realtime, "_LATENCY", Path("/proc/version/none"))
    refused = realtime.prepare(RealTime(fifo_priority=40, cpus=(0,), lock_memory=True, keep_awake=True))
    assert [line.split(":")[0] for line in refused] == [
        "realtime.cpus = [0]",
        "realtime.fifo_priority = 40",
        "realtime.lock_memory",
        "realtime.keep_awake",
    ]
    assert all("Operation not permitted" in line for line in refused[:2])
    limit, _ = resource.getrlimit(resource.RLIMIT_RTPRIO)
    assert refused[1].endswith(f"under a limit of {limit}; see LimitRTPRIO")


@pytest.mark.parametrize("soft", [64, 4_096])
def test_as_many_files_as_the_kernel_allows_may_be_open_or_nothing_starts(
    monkeypatch: pytest.MonkeyPatch, soft: int
) -> None:
    set_limit = Mock()
    monkeypatch.setattr(resource, "setrlimit", set_limit)
    monkeypatch.setattr(resource, "getrlimit", lambda _: (soft, 4_096))
    raise_open_files(1_024)
    set_limit.assert_called_once_with(resource.RLIMIT_NOFILE, (4_096, 4_096))
    monkeypatch.setattr(resource, "getrlimit", lambda _: (512, 1_023))
    with pytest.raises(OSError, match=r"^the hard limit of open files is 1023: allowed is 1024 or more; raise Limit"):
        raise_open_files(1_024)

    assert 100 + len(admission.MAY) * (admission.CONNECTIONS + admission.CLOSING + 1) < realtime.OPEN_FILES


def test_processors_are_kept_awake_where_it_is_asked_for_as_long_as_the_file_is_open(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    latency = tmp_path / "cpu_dma_latency"
    monkeypatch.setattr(realtime, "_LATENCY", latency)
    assert realtime.prepare(RealTime()) == [], "nothing that was not asked for is refused"
    latency.touch()
    assert realtime.prepare(RealTime(keep_awake=True)) == []
    assert latency.read_bytes() == bytes(4)
    (opened,) = (link for link in Path("/proc/self/fd").iterdir() if os.path.realpath(link) == str(latency))
    os.close(int(opened.name))


def test_an_ordinary_thread_gives_its_threads_no_priority() -> None:
    assert (os.sched_getscheduler(0), realtime.priority_of_threads()) == (os.SCHED_OTHER, 0)


@pytest.mark.parametrize(
    ("own", "refusal", "theirs"),
    [(50, None, 49), (2, None, 1), (1, None, 1), (50, REFUSED, 0)],
)
def test_threads_come_right_below_their_beginner_or_stay_ordinary_where_they_may_not(
    monkeypatch: pytest.MonkeyPatch, own: int, refusal: Exception | None, theirs: int
) -> None:
    asked = Mock(side_effect=refusal)
    monkeypatch.setattr(os, "sched_getscheduler", lambda pid: os.SCHED_FIFO | os.SCHED_RESET_ON_FORK)
    monkeypatch.setattr(os, "sched_getparam", lambda pid: os.sched_param(own))
    monkeypatch.setattr(os, "sched_setscheduler", asked)
    assert realtime.priority_of_threads() == theirs
    asked.assert_called_once_with(0, os.SCHED_FIFO, os.sched_param(max(own - 1, 1)))
