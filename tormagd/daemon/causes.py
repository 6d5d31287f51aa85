"""Causes of faults and limits, in the figures of the moment at which they came up."""

import logging
from collections.abc import Iterable, Mapping
from typing import Any

from tormagd.config import Device
from tormagd.control.core import Stepper
from tormagd.daemon.beat import Delay
from tormagd.hardware.measurement import Measurement
from tormagd.safety.codes import FAULTS, LIMITS, Explanation, Fault, Limit
from tormagd_client.messages import Explained, StallReport

log = logging.getLogger(__name__)


class Causes:
    """Remembers the newest stall of the control loop, and the cause of each latched fault in figures."""

    def __init__(self, device: Device) -> None:
        self._device = device
        self.stall: StallReport | None = None
        "The newest stall of the control loop; None before the first."
        self._told: dict[str, str] = {}

    def note_stall(self, stepper: Stepper, delay: Delay) -> None:
        """Set `stall` where the step that just ran has taken its own delay for a stall; else change nothing."""
        sight, known, stall_ms = stepper.measure.sight, self.stall, round(stepper.measure.sight.stall_s * 1e3, 1)
        if sight.stalled_s == stepper.time_s and (known is None or known.ms != stall_ms):
            self.stall = StallReport(stall_ms, delay.culprit)

    def tell(self, faults: tuple[Fault, ...], stepper: Stepper, measurement: Measurement | None) -> None:
        """Log the newly latched `faults` as errors with cause and remedy, and remember the figures of their causes."""
        figures = {} if measurement is None else _figures(stepper, measurement)
        for fault in faults:
            self._told.pop(fault, None)
            if fault in figures:
                self._told[fault] = f"{FAULTS[fault].cause}: {figures[fault]}"
        if Fault.HOST_STALL in faults:
            opened = f"the device opened the gap by itself after {self._device.command_timeout_ms:g} ms"
            self._told[Fault.HOST_STALL] = f"{self._stood_still()}; {opened}"
        if Fault.MEASUREMENT_STALE in faults and measurement is not None:
            silent_ms, behind_ms = (stepper.time_s - measurement.received_s) * 1e3, measurement.delay_s * 1e3
            self._told[Fault.MEASUREMENT_STALE] = (
                f"the device had sent no new state for {silent_ms:.0f} ms"
                if silent_ms > behind_ms
                else f"the device was {behind_ms:.0f} ms behind with the commands that it obeyed"
            )
        for explained in self.of_faults(faults):
            log.error("fault: %s: %s; next: %s", explained.code, explained.cause, explained.remedy)

    def of_faults(self, faults: Iterable[str]) -> tuple[Explained, ...]:
        """Return each fault with its cause and its remedy, in the order of `faults`."""
        return _explained(faults, FAULTS, self._told)

    def of_limits(
        self,
        limits: Iterable[str],
        replaced: str,
        of_sources: Mapping[Limit, Explanation],
        measurement: Measurement | None,
    ) -> tuple[Explained, ...]:
        """Return each limit with its cause, in figures where there are any, and its remedy; in the order of `limits`."""
        told = {
            Limit.HOST_STALL: f"{self._stood_still()}; the gap was held until the device answered",
            Limit.MODEL_RANGE: f"outside what the model was shown: {replaced}",
        }
        if measurement is not None:
            told[Limit.LINK_DEGRADED] = f"{LIMITS[Limit.LINK_DEGRADED].cause}: {measurement.link}"
            told[Limit.CLOCK] = f"{LIMITS[Limit.CLOCK].cause}: {measurement.link.clock_drift:+.1%}"
        return _explained(limits, {**LIMITS, **of_sources}, told)

    def _stood_still(self) -> str:
        stall = self.stall
        return "" if stall is None else f"the control loop stood still for {stall.ms:.0f} ms ({stall.culprit})"


def _figures(stepper: Stepper, measurement: Measurement) -> dict[Fault, str]:
    leap, homing, opening = stepper.measure.leap, stepper.homing, stepper.opening
    return {
        Fault.SENSE_STALE: f"for {(stepper.time_s - measurement.sensed_s) * 1e3:.0f} ms",
        Fault.STATUS_STALE: f"for {(stepper.time_s - measurement.reported_s) * 1e3:.0f} ms",
        Fault.LINK_DEGRADED: str(measurement.link),
        Fault.CLOCK: f"by {measurement.link.clock_drift:+.1%}",
        Fault.OUT_OF_STROKE: f"left {measurement.left_mm:.1f} mm, right {measurement.right_mm:.1f} mm from home, where "
        f"the switches say {measurement.switches.name}",
        **({} if leap is None else {Fault.ENCODER: str(leap)}),
        **dict.fromkeys(homing.faults, str(homing)),
        **dict.fromkeys(opening.faults, str(opening)),
    }


def _explained(
    codes: Iterable[str], table: Mapping[Any, Explanation], told: Mapping[Any, str]
) -> tuple[Explained, ...]:
    return tuple(Explained(str(code), told.get(code, table[code].cause), table[code].remedy) for code in codes)
