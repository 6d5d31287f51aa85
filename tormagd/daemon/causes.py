"""Causes of faults and limits, with figures from the moment at which they came up."""

import logging
import math
from collections import deque
from collections.abc import Collection, Iterable, Mapping
from typing import Any

from tormagd.config import Device
from tormagd.control.core import Stepper
from tormagd.control.safety.codes import FAULTS, LIMITS, Explanation, Fault, Limit
from tormagd.daemon.beat import Delay
from tormagd.hardware.link_statistics import LOSES
from tormagd.hardware.measurement import Measurement
from tormagd_client.messages import Explained, StallReport

WAITED_SHARE = 0.1
"If the host kept the control loop waiting for more of the last second, it caused the silence: not device or cable."
SILENCES = {
    *("MEASUREMENT_STALE", "SENSE_STALE", "STATUS_STALE", "LINK_DEGRADED", "DEVICE_COMMAND_TIMEOUT"),
    *("DEVICE_SILENT", "CLOCK"),
}

log = logging.getLogger(__name__)


class Causes:
    def __init__(self, device: Device) -> None:
        self._device = device
        self.stall: StallReport | None = None
        "The newest stall of the control loop; None before the first."
        self.plan_failure = ""
        "Why the newest plan that failed did."
        self._told: dict[str, Explained] = {}
        self._waits = deque([(-math.inf, 0.0)], maxlen=1_000)

    def note_stall(self, stepper: Stepper, delay: Delay) -> None:
        """Keep as `stall` the delay of the step that just ran, if the step counts it as a stall."""
        sight, known, stall_ms = stepper.measure.sight, self.stall, round(stepper.measure.sight.stall_s * 1e3, 1)
        if sight.stalled_s == stepper.time_s and (known is None or known.ms != stall_ms):
            self.stall = StallReport(stall_ms, delay.culprit)

    def note_loss(self, cause: str, remedy: str) -> None:
        """Keep why the link was lost, as the connection has judged."""
        fault = Fault.LINK_LOST
        self._told[fault] = Explained(fault, f"{FAULTS[fault].cause}: {cause}", f"{remedy}; then `tormagctl arm`")

    def note_wait(self, now_s: float, wait_s: float) -> None:
        """Note that the control loop was not given the processor for the last `wait_s`, or since the last such wait."""
        self._waits.append((now_s, min(wait_s, now_s - self._waits[-1][0])))

    def host(self, now_s: float, least: float = WAITED_SHARE) -> str:
        """Say how long this host kept the control loop waiting; empty if that is `least` of a second or less."""
        waits_s = [min(wait_s, at_s + 1.0 - now_s) for at_s, wait_s in self._waits if now_s - at_s < 1.0]
        if sum(waits_s) <= least:
            return ""
        return (
            f"this host kept the control loop waiting for {sum(waits_s) * 1e3:.0f} ms of the last second, "
            f"{max(waits_s) * 1e3:.0f} ms at once"
        )

    def tell(self, faults: tuple[Fault, ...], stepper: Stepper, measurement: Measurement | None) -> None:
        """Log the newly latched `faults` as errors with cause and remedy, and remember the figures of their causes."""
        causes = {} if measurement is None else _causes(stepper, measurement)
        hosts = self._hosts(stepper.time_s, measurement)
        causes[Fault.HOST_STALL] = (
            f"{self._stood_still()}; the device opened the gap by itself after {self._device.command_timeout_ms:g} ms"
        )
        causes[Fault.PLAN_FAILED] = self.plan_failure
        of_others = [fault for fault in faults if fault is not Fault.LINK_LOST]
        self._told |= {fault: _explained(fault, FAULTS, causes, hosts) for fault in of_others}
        for explained in self.of_faults(faults):
            log.error("fault: %s: %s; next: %s", explained.code, explained.cause, explained.remedy)

    def of_faults(self, faults: Iterable[str]) -> tuple[Explained, ...]:
        """Return each fault with its cause and its remedy, in the order of `faults`."""
        return tuple(self._told.get(fault) or _explained(fault, FAULTS, {}, {}) for fault in faults)

    def of_limits(
        self,
        limits: Collection[str],
        replaced: str,
        of_sources: Mapping[Limit, Explanation],
        measurement: Measurement | None,
        now_s: float,
    ) -> tuple[Explained, ...]:
        if not limits:
            return ()
        told = {
            Limit.HOST_STALL: f"{self._stood_still()}; the gap was held until the device answered",
            Limit.MODEL_RANGE: f"outside what the model was shown: {replaced}",
        }
        if measurement is not None:
            told[Limit.LINK_DEGRADED] = f"{LIMITS[Limit.LINK_DEGRADED].cause}: {measurement.link}"
            told[Limit.CLOCK] = f"{LIMITS[Limit.CLOCK].cause}: {measurement.link.clock_drift:+.1%}"
        known, hosts = {**LIMITS, **of_sources}, self._hosts(now_s, measurement)
        return tuple(_explained(limit, known, told, hosts) for limit in limits)

    def _hosts(self, now_s: float, measurement: Measurement | None) -> dict[str, str]:
        """Return what the host did to each of SILENCES; a lossy wire is its doing if it waited as much as was lost."""
        hosts = dict.fromkeys(SILENCES, self.host(now_s))
        if measurement is not None and measurement.link.damaged <= LOSES < measurement.link.lost:
            hosts["LINK_DEGRADED"] = self.host(now_s, min(measurement.link.lost, WAITED_SHARE))
        return hosts

    def _stood_still(self) -> str:
        stall = self.stall
        return "" if stall is None else f"the control loop stood still for {stall.ms:.0f} ms ({stall.culprit})"


def _causes(stepper: Stepper, measurement: Measurement) -> dict[Fault, str]:
    """Return the causes, with figures, of those faults that have any now; the others are no keys."""
    leap, homing, opening = stepper.measure.leap, stepper.homing, stepper.opening
    silent_ms, behind_ms = (stepper.time_s - measurement.received_s) * 1e3, measurement.delay_s * 1e3
    figures = {
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
    return {
        **{fault: f"{FAULTS[fault].cause}: {figure}" for fault, figure in figures.items()},
        Fault.MEASUREMENT_STALE: f"the device had sent no new state for {silent_ms:.0f} ms"
        if silent_ms > behind_ms
        else f"the device was {behind_ms:.0f} ms behind with the commands that it obeyed",
    }


def _explained(
    code: str, table: Mapping[Any, Explanation], told: Mapping[Any, str], hosts: Mapping[str, str]
) -> Explained:
    """Return a code with its cause and remedy from `table`; a cause in `told` goes before."""
    cause = told.get(code, table[code].cause)
    if host := hosts.get(code):
        return Explained(str(code), f"{host}; {cause}", table["HOST_STALL"].remedy)
    return Explained(str(code), cause, table[code].remedy)
