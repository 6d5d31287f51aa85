"""Unplug and replug with real processes: a few cycles; `tools/replug.py --cycles 200` is the evidence."""

import pytest
import replug


@pytest.mark.live
def test_the_cable_is_pulled_in_motion_and_put_back() -> None:
    result = replug.run("serial", 2, seed=3, fifo_priority=50)
    assert result["cycles"] == 2
    assert result["losses"] >= 2
    assert result["rearmed"] == 0
    assert result["states_after"] == ["FAULT"]
    assert result["descriptors"]["last"] == result["descriptors"]["first"]
    # the device opens by its own timeout, so not before the host's last Drive is as old
    assert result["device_opening_ms"]["max"] >= 50.0 - replug.BETWEEN_STATUS_MS
    assert set(result["lost_after_ms"]) == {"unplugged", "cut"}


def one(how: str = "unplugged", **changes: object) -> replug.Cycle:
    known = replug.Cycle(how, 500.0, 1.0, 40.0, 55.0, 80.0, 0.1, 0.2, 36, 200_000, "FAULT", False)
    return known._replace(**changes)  # type: ignore[arg-type]


def test_the_summary_keeps_the_worst_and_what_grew() -> None:
    cycles = [one(), one("cut", lost_after_ms=81.0), *[one()] * 7, one(running_after_ms=900.0, descriptors=40)]
    result = replug.summary("serial", cycles, 10)
    assert result["lost_after_ms"]["unplugged"]["max"] == 1.0
    assert result["lost_after_ms"]["cut"] == {"p50": 81.0, "p99": 81.0, "max": 81.0}
    assert (result["running_after_ms"]["p50"], result["running_after_ms"]["max"]) == (80.0, 900.0)
    assert result["descriptors"] == {"first": 36, "last": 40}
    assert result["rearmed"] == 0


def test_a_device_that_was_armed_again_is_counted() -> None:
    assert replug.summary("serial", [one(), one(rearmed=True, state_after="ENABLED")], 2)["rearmed"] == 1
