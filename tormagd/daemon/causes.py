"""Causes of faults and limits, with figures from the moment at which they came up."""

import logging
import math
from collections import deque
from collections.abc import Iterable, Mapping
from typing import Any

from tormagd.config import Device
from tormagd.control.core import Stepper
from tormagd.daemon.beat import Delay
from tormagd.hardware.measurement import Measurement
from tormagd.safety.codes import FAULTS, LIMITS, Explanation, Fault, Limit
from tormagd_client.messages import Explained, StallReport

WAITED_SHARE = 0.1
"If the host kept the control loop waiting for more of the last second, it caused the silence: not device or cable."
SILENCES = {
    *("LINK_LOST", "MEASUREMENT_STALE", "SENSE_STALE", "STATUS_STALE", "LINK_DEGRADED", "DEVICE_COMMAND_TIMEOUT"),
    "DEVICE_SILENT",
}

log = logging.getLogger(__name__)


class Causes:
    def __init__(self, device: Device) -> None:
        self._device = device
        self.stall: StallReport | None = None
        self._told: dict[Fault, Explanation] = {}
        self._waits: deque[tuple[float, float]] = deque(maxlen=1_000)

    def note_stall(self, stepper: Stepper, delay: Delay) -> None:
        """Keep as `stall` the delay of the step that just ran, if the step counts it as a stall."""
        sight, known, stall_ms = stepper.measure.sight, self.stall, round(stepper.measure.sight.stall_s * 1e3, 1)
        if sight.stalled_s == stepper.time_s and (known is None or known.ms != stall_ms):
            self.stall = StallReport(stall_ms, delay.culprit)

    def note_wait(self, now_s: float, wait_s: float) -> None:
        last_s = self._waits[-1][0] if self._waits else -math.inf
        self._waits.append((now_s, min(wait_s, now_s - last_s)))

    def host(self, now_s: float) -> str:
        """Say how long this host kept the control loop waiting; empty if that is WAITED_SHARE or less."""
        waits_s = [min(wait_s, at_s + 1.0 - now_s) for at_s, wait_s in self._waits if now_s - at_s < 1.0]
        if sum(waits_s) <= WAITED_SHARE:
            return ""
        return (
            f"this host kept the control loop waiting for {sum(waits_s) * 1e3:.0f} ms of the last second, "
            f"{max(waits_s) * 1e3:.0f} ms at once"
        )

    def tell(self, faults: tuple[Fault, ...], stepper: Stepper, measurement: Measurement | None) -> None:
        figures = {} if measurement is None else _figures(stepper, measurement)
        causes = {fault: f"{FAULTS[fault].cause}: {figure}" for fault, figure in figures.items()}
        opened = f"the device opened the gap by itself after {self._device.command_timeout_ms:g} ms"
        causes[Fault.HOST_STALL] = f"{self._stood_still()}; {opened}"
        if measurement is not None:
            silent_ms, behind_ms = (stepper.time_s - measurement.received_s) * 1e3, measurement.delay_s * 1e3
            causes[Fault.MEASUREMENT_STALE] = (
                f"the device had sent no new state for {silent_ms:.0f} ms"
                if silent_ms > behind_ms
                else f"the device was {behind_ms:.0f} ms behind with the commands that it obeyed"
            )
        told = {fault: FAULTS[fault]._replace(cause=causes.get(fault, FAULTS[fault].cause)) for fault in faults}
        self._told |= _blamed(told, self.host(stepper.time_s), FAULTS[Fault.HOST_STALL])
        for explained in self.of_faults(faults):
            log.error("fault: %s: %s; next: %s", explained.code, explained.cause, explained.remedy)

    def of_faults(self, faults: Iterable[str]) -> tuple[Explained, ...]:
        return _explained(faults, {**FAULTS, **self._told})

    def of_limits(
        self,
        limits: Iterable[str],
        replaced: str,
        of_sources: Mapping[Limit, Explanation],
        measurement: Measurement | None,
        now_s: float,
    ) -> tuple[Explained, ...]:
        told = {
            Limit.HOST_STALL: f"{self._stood_still()}; the gap was held until the device answered",
            Limit.MODEL_RANGE: f"outside what the model was shown: {replaced}",
        }
        if measurement is not None:
            told[Limit.LINK_DEGRADED] = f"{LIMITS[Limit.LINK_DEGRADED].cause}: {measurement.link}"
            told[Limit.CLOCK] = f"{LIMITS[Limit.CLOCK].cause}: {measurement.link.clock_drift:+.1%}"
        known = {
            **LIMITS,
            **{limit: LIMITS[limit]._replace(cause=cause) for limit, cause in told.items()},
            **of_sources,
        }
        return _explained(limits, _blamed(known, self.host(now_s), LIMITS[Limit.HOST_STALL]))

    def _stood_still(self) -> str:
        stall = self.stall
        return "" if stall is None else f"the control loop stood still for {stall.ms:.0f} ms ({stall.culprit})"


def _blamed(known: dict[Any, Explanation], host: str, stall: Explanation) -> dict[Any, Explanation]:
    """Return `known`; if `host` is not empty, it begins the cause of each of SILENCES, with the remedy of `stall`."""
    if not host:
        return known
    silences = {code: row for code, row in known.items() if code in SILENCES}
    return known | {
        code: row._replace(cause=f"{host}; {row.cause}", remedy=stall.remedy) for code, row in silences.items()
    }


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


def _explained(codes: Iterable[str], table: Mapping[Any, Explanation]) -> tuple[Explained, ...]:
    return tuple(Explained(str(code), table[code].cause, table[code].remedy) for code in codes)
