"""One period: what the step is given, and what is kept of it."""

import time
from types import SimpleNamespace
from typing import Any

import pytest

from firmware_protocol.codec import DriveMode
from tormagd.assembly.journal import Journal
from tormagd.control.records import Duty
from tormagd.daemon.control_loop import ControlLoop
from tormagd.safety.operating_state import DeviceRequest


def test_the_measurement_that_a_step_was_given_is_kept_though_the_exchange_brings_a_newer_one() -> None:
    given = []
    connection: Any = SimpleNamespace(measurement="old")

    def exchange(*_arguments: Any) -> None:
        connection.measurement = "new"

    def step(_now_s: float, measurement: Any, _plan: Any) -> Duty:
        given.append(measurement)
        return Duty(DriveMode.OFF, 0.0, 0.0, DeviceRequest.NONE, 0, ())

    connection.exchange = exchange
    connection.receive = lambda: given.append("received")
    stepper: Any = SimpleNamespace(step=step)
    loop = ControlLoop(stepper, connection, 1_000_000, Journal())
    plan: Any = None
    for seen in ("old", "new"):
        loop.tick(0, 0, plan)
        assert (given[-1], loop.measurement) == (seen, seen)
    # after missed periods what has come is read first
    loop.tick(0, 3, plan)
    assert given[-2:] == ["received", "new"]


@pytest.mark.parametrize(
    ("since_due_us", "wait_us"),
    [
        (-150.0, 0.0),
        (-90.0, 390.0),
        (0.0, 300.0),
        (290.0, 10.0),
        (310.0, 0.0),
        (899.0, 0.0),
        # of a loop that stands still, or has not begun, nobody waits for ever
        (7_100.0, 200.0),
        (7_500.0, 0.0),
    ],
)
def test_another_thread_keeps_clear_of_a_tick(
    monkeypatch: pytest.MonkeyPatch, since_due_us: float, wait_us: float
) -> None:
    loop = ControlLoop(SimpleNamespace(), SimpleNamespace(), 1_000_000, Journal())  # type: ignore[arg-type]
    loop.next_tick_ns = 50_000_000_000
    monkeypatch.setattr(time, "monotonic_ns", lambda: loop.next_tick_ns + round(since_due_us * 1e3))
    assert loop.until_slack_s() * 1e6 == pytest.approx(wait_us)
