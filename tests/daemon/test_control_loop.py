"""One period: what the step is given, and what is kept of it."""

from types import SimpleNamespace
from typing import Any

from firmware_protocol.codec import DriveMode
from tormagd.assembly.journal import Journal
from tormagd.control.records import Duty
from tormagd.daemon.beat import Beat
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
    stepper: Any = SimpleNamespace(step=step)
    loop = ControlLoop(stepper, connection, 1_000_000, Journal())
    plan: Any = None
    for seen in ("old", "new"):
        loop.drive(Beat(0, 0, 0), plan)
        assert (given[-1], loop.measurement) == (seen, seen)
