from typing import Any

import pytest

from tormagd.daemon.service import EXTENSION_S, Service, status_line
from tormagd.hardware.link import LinkState

LIMIT_S = 0.5
SILENT = (LinkState.IDENTIFYING, LinkState.UNANSWERED)
ABSENT = (LinkState.LOST, LinkState.BACK_OFF, LinkState.CLOSED)


def ready() -> Service:
    service = Service()
    assert service.is_alive(0.0, LIMIT_S, 0.0, LinkState.RUNNING, 0.0)
    assert service.news(True, LinkState.RUNNING, "up") == ["READY=1", "STATUS=up", "WATCHDOG=1"]
    return service


def test_ready_is_said_once_and_only_when_the_device_is_identified():
    service = Service()
    links = (*ABSENT, *SILENT, LinkState.REFUSED, LinkState.RUNNING, LinkState.RUNNING)
    told = ["READY=1" in service.news(True, link, "") for link in links]
    assert told == [*(False for _ in links[:-2]), True, False]


def test_while_it_waits_a_daemon_that_lives_is_given_more_time_to_start():
    service = Service()
    extension = f"EXTEND_TIMEOUT_USEC={EXTENSION_S * 1e6:.0f}"
    told = [extension in service.news(is_alive, LinkState.BACK_OFF, "") for is_alive in (True, True, False)]
    assert told == [True, True, False]
    assert service.news(True, LinkState.RUNNING, "") == ["READY=1", "WATCHDOG=1"]


def test_a_status_is_said_when_it_changes():
    service = ready()
    told = [service.news(False, LinkState.RUNNING, status) for status in ("up", "FAULT", "FAULT")]
    assert told == [[], ["STATUS=FAULT"], []]


TENTHS = [0.1 * tenths for tenths in range(100)]
Look = tuple[float, LinkState, float | None, bool]
LOOKS: dict[str, tuple[bool, list[Look]]] = {
    **{
        f"a device that was there and is silent behind an open port ends the feeding, {link}": (
            True,
            [
                (0.49, link, None, True),
                (0.51, link, None, False),
                (60.0, link, None, False),
                (61.0, LinkState.RUNNING, 61.0, True),
            ],
        )
        for link in SILENT
    },
    **{
        f"without a port or with a firmware that does not fit there is nothing to start again for, {link}": (
            True,
            [(now_s, link, None, True) for now_s in TENTHS],
        )
        for link in (*ABSENT, LinkState.REFUSED)
    },
    "a device that never came is waited for": (
        False,
        [(now_s, link, None, True) for now_s in TENTHS for link in SILENT],
    ),
    **{
        f"a running link without new states ends the feeding, the last at {received_s}": (
            True,
            [(0.4, LinkState.RUNNING, received_s, True), (0.6, LinkState.RUNNING, received_s, False)],
        )
        for received_s in (0.0, None)
    },
}


@pytest.mark.parametrize(("was_there", "looks"), LOOKS.values(), ids=LOOKS)
def test_it_is_fed_while_starting_again_would_not_help(was_there: bool, looks: list[Look]):
    service = ready() if was_there else Service()
    for now_s, link, received_s, fed in looks:
        assert (
            "WATCHDOG=1" in service.news(service.is_alive(now_s, LIMIT_S, now_s, link, received_s), link, "up")
        ) == fed, now_s


@pytest.mark.parametrize("planned_s", [None, 0.4])
def test_without_fresh_plans_it_is_not_fed(planned_s):
    assert not ready().is_alive(1.0, LIMIT_S, planned_s, LinkState.RUNNING, 1.0)


KNOWN: dict[str, Any] = {
    "link": LinkState.RUNNING,
    "cause": "",
    "remedy": "",
    "state": "DISABLED",
    "is_homed": True,
    "faults": [],
    "scene": "coronary",
}


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"state": "ENABLED"}, "ENABLED, scene coronary"),
        ({"is_homed": False}, "DISABLED, scene coronary; next: tormagctl arm"),
        ({"state": "FAULT", "faults": ["SKEW", "STOPPED"]}, "FAULT: SKEW, STOPPED; next: tormagctl status"),
        # texts of device or kernel must not add lines
        (
            {"link": LinkState.BACK_OFF, "cause": "no port\nREADY=1", "remedy": "plug it in"},
            "DISABLED, scene coronary; waiting for the device (BACK_OFF): no port READY=1; plug it in",
        ),
    ],
)
def test_the_status_line_says_how_it_stands_and_what_is_next(changes: dict[str, Any], line: str):
    assert status_line(**(KNOWN | changes)) == line
