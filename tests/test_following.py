"""How well the force is followed: what counts, and which delay explains the most of it."""

import math
from collections.abc import Iterable, Iterator
from typing import Any

import pytest

from tormagd.daemon.verdict import HOLDING
from tormagd.record.force_following import NOT_FOLLOWED, Following
from tormagd.record.overview import OverviewBuilder

HZ = 50
FOLLOWED: dict[str, Any] = {"operating_state": "ENABLED", "limits": (), "handle_rate_mm_s": 20.0}


def pulse_N(at_s: float) -> float:
    return 1.5 + 0.12 * math.sin(math.tau * 1.2 * at_s)


def ticks(lasts_s: float, late_s: float = 0.0, **changes: Any) -> Iterator[Any]:
    for k in range(round(lasts_s * HZ)):
        told = {"setpoint_cf": pulse_N(k / HZ), "measured_cf": pulse_N(k / HZ - late_s), "handle_mm": 20.0 * k / HZ}
        yield FOLLOWED | told | changes


def reported(*runs: Iterable[Any]) -> Any:
    following = Following(1.0 / HZ, 5.0)
    for run in runs:
        for tick in run:
            forces, handle = (tick["setpoint_cf"], tick["measured_cf"]), (tick["handle_mm"], tick["handle_rate_mm_s"])
            following.look(tick["operating_state"], tick["limits"], *forces, *handle)
    return following.report()


def recorded(*runs: Iterable[Any]) -> Any:
    builder = OverviewBuilder()
    for number, tick in enumerate(tick for run in runs for tick in run):
        builder.add(number * 20_000_000, True, tick)
    return builder.made().following


def test_a_delay_is_told_from_what_is_wrong_besides() -> None:
    found = reported(ticks(10.0, 0.18))
    assert (found.delay_ms, found.aligned_rms_N) == (180.0, pytest.approx(0.0, abs=1e-3))
    assert found.rms_N == pytest.approx(0.12 * math.sqrt(2.0) * math.sin(math.tau * 1.2 * 0.09), rel=0.05)
    assert reported(ticks(10.0)).rms_N == 0.0


@pytest.mark.parametrize(
    "uncounted",
    [
        {"measured_cf": 0.5},  # on the way to the first force
        {"setpoint_cf": None},  # it decays
        {"operating_state": "PAUSED"},
        {"measured_cf": None},
        {"measured_cf": 0.2, "handle_rate_mm_s": 0.3, "handle_mm": 7.0},  # the handle sticks
        {"limits": ("F_MIN",), "setpoint_cf": 0.1},
        {"limits": ("TAKEOVER",)},
    ],
    ids=str,
)
def test_what_could_not_be_followed_does_not_count(uncounted: dict[str, Any]) -> None:
    for told in (reported, recorded):
        assert told(ticks(10.0, **uncounted)) is None
        assert told(ticks(2.0, **uncounted), ticks(5.0)).rms_N == 0.0


def test_it_is_forgotten_some_seconds_after_the_last_and_without_a_handle_all_counts() -> None:
    after = {"setpoint_cf": None}
    assert reported(ticks(10.0), ticks(3.0, **after)).rms_N == 0.0
    assert reported(ticks(10.0), ticks(10.0, **after)) is None
    assert reported(ticks(5.0, handle_rate_mm_s=None)).rms_N == 0.0


def test_a_handle_that_has_just_turned_feels_no_whole_force_and_does_not_count() -> None:
    turned = [tick for way in (-20.0, 20.0) * 9 for tick in ticks(0.08, handle_rate_mm_s=way, measured_cf=0.2)]
    assert [of(ticks(5.0), turned, ticks(2.0)).rms_N for of in (reported, recorded)] == [0.0, 0.0]


def test_what_status_and_a_recording_say_of_the_same_ticks_is_the_same() -> None:
    runs = [list(ticks(1.0, measured_cf=0.5)), list(ticks(20.0, 0.1))]
    assert recorded(*runs).delay_ms == reported(*runs).delay_ms == 100.0
    assert recorded(*runs).rms_N == pytest.approx(reported(*runs).rms_N, rel=0.1)


def test_what_holds_a_force_off_is_no_error_in_following_it() -> None:
    assert {*HOLDING, "TAKEOVER"} == NOT_FOLLOWED
