"""The conditions on which operators' commands are taken: of the device, its requests and the setpoint."""

from tormagd.config import Config
from tormagd.control.core import Stepper
from tormagd.control.move.watch import SENSE_FAULT_S, STATUS_FAULT_S
from tormagd.control.records import Duty, Measured
from tormagd.control.safety.operating_state import Conditions
from tormagd.hardware.connection import Connection
from tormagd.hardware.measurement import DeviceRequest, Measurement


def is_homed(measurement: Measurement | None, measured: Measured | None) -> bool:
    """Tell whether the device says that it is homed and a step has taken its positions over."""
    return measurement is not None and measured is not None and measured.is_homed


def is_busy(measurement: Measurement | None, pending: DeviceRequest, stepper: Stepper, output: Duty | None) -> bool:
    """Tell whether the device homes, opens, or has not acknowledged a request yet."""
    if measurement is None:
        return False
    is_asked = output is not None and output.request_number != stepper.safety.request_number
    is_untaken = (
        measurement.is_homed and not is_homed(measurement, stepper.measured) and not stepper.safety.needs_homing
    )
    return is_asked or pending is not DeviceRequest.NONE or measurement.is_busy or is_untaken


def conditions(
    now_s: float,
    config: Config,
    connection: Connection,
    stepper: Stepper,
    output: Duty | None,
    *,
    sensor_doubted: bool,
) -> Conditions:
    measurement = connection.measurement
    old = "" if measurement is None else _late_stream(now_s, measurement, config.device.measurement_timeout_ms * 1e-3)
    return Conditions(
        connected=measurement is not None,
        fresh=measurement is not None and not old,
        homed=is_homed(measurement, stepper.measured),
        busy=is_busy(measurement, connection.pending, stepper, output),
        device_latched=measurement is not None and measurement.is_latched,
        sensor_doubted=sensor_doubted,
        cause=old or connection.cause,
        remedy=connection.remedy,
        round_trip_s=0.0 if measurement is None else measurement.link.round_trip_s,
        clock_drift=0.0 if measurement is None else measurement.link.clock_drift,
    )


def _late_stream(now_s: float, measurement: Measurement, timeout_s: float) -> str:
    """Return which stream has stopped, as in "no Sense for 312 ms"."""
    for name, came_s, longest_s in (
        ("State", measurement.received_s, timeout_s),
        ("Sense", measurement.sensed_s, SENSE_FAULT_S),
        ("Status", measurement.reported_s, STATUS_FAULT_S),
    ):
        if not now_s - came_s < longest_s:
            return f"no {name} for {(now_s - came_s) * 1e3:.0f} ms"
    return ""
