"""One period: what the step is given, and what is kept of it."""

from unittest.mock import Mock

from tormagd.assembly.journal import Journal
from tormagd.daemon.beat import Beat
from tormagd.daemon.control_loop import ControlLoop


def test_the_measurement_that_a_step_was_given_is_kept_though_the_exchange_brings_a_newer_one() -> None:
    connection, stepper = Mock(measurement="old"), Mock()
    connection.exchange.side_effect = lambda *_: setattr(connection, "measurement", "new")
    loop = ControlLoop(stepper, connection, 1_000_000, Journal())
    for seen in ("old", "new"):
        loop.drive(Beat(0, 0, 0), Mock())
        assert (stepper.step.call_args.args[1], loop.measurement) == (seen, seen)
