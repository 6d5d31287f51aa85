"""The daemon put together: one thread, one event loop, three loops in it."""

import asyncio
import logging
import math
import signal
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import msgspec

from tormagd import __version__
from tormagd.config import Config
from tormagd.control.core import Core
from tormagd.control.plan import PlanState
from tormagd.daemon import notify
from tormagd.daemon.callbacks import Callbacks, Delay
from tormagd.daemon.control_loop import ControlLoop
from tormagd.daemon.endpoint import Endpoint
from tormagd.daemon.heartbeat import Heartbeat
from tormagd.daemon.inference_loop import InferenceLoop
from tormagd.daemon.rate_group import ERROR_PERIODS, RateGroup
from tormagd.daemon.realtime import freeze_garbage, priority_of_threads
from tormagd.daemon.telemetry import Stall, TickRow, explanations, snapshot, tick_row
from tormagd.hardware.backend import Backend
from tormagd.hardware.connection import Connection
from tormagd.hardware.link import LinkState
from tormagd.messages import Request, Telemetry
from tormagd.safety.codes import FAULTS, LIMITS, Fault, Limit
from tormagd.safety.operating_state import Conditions, DeviceRequest, OperatingState

NS = 1_000_000_000
OPENING_LOOK_S = 0.02
"How often the end of the opening is looked for: Status comes as often."
LONGEST_RETRACT_S = 10.0
"A full stroke takes the firmware 3 s at its own retract speed; longer means that it cannot, and it says so itself."
ROWS = 100
"Ticks in one recording message at most."
SERVED_BEFORE_NS = 200_000
"No command is taken up later than this before the next control tick: an answer takes a quarter of it."

log = logging.getLogger(__name__)


class Daemon:
    """Runs one scene on one device until it is told to end."""

    def __init__(self, config: Config, core: Core, open_backend: Callable[[Any], Backend], refused: list[str]) -> None:
        self._config, self._core, self._refused = config, core, refused
        self._started_s = time.monotonic()
        self._loop = asyncio.get_running_loop()
        self._callbacks = Callbacks(self._loop)
        self._connection = Connection(config.device, open_backend, self._lose_link)
        self._endpoint = Endpoint(config.endpoints, priority_of_threads())
        rates = config.rates
        self._control = ControlLoop(core.stepper, self._connection, NS // rates.control_hz)
        self._inference = InferenceLoop(
            core.planner,
            self._endpoint,
            NS // rates.inference_hz,
            self._started_s,
            on_failure=partial(self._control.latch, Fault.PLAN_FAILED),
        )
        self._telemetry = RateGroup("telemetry", NS // rates.telemetry_hz)
        self._groups = (self._control.timing, self._inference.timing, self._telemetry)
        self._status: dict[str, Any] = {}
        self._ticks_per_snapshot = rates.control_hz // rates.telemetry_hz
        self._rows: list[TickRow] = []
        self._snapshot: Telemetry | None = None
        self._stall: Stall | None = None
        self._told: dict[str, str] = {}
        self._ended = asyncio.Event()

    async def run(self) -> None:
        """Runs until SIGTERM or SIGINT; opens the gap before it returns."""
        for number in (signal.SIGTERM, signal.SIGINT):
            self._loop.add_signal_handler(number, self._ended.set)
        self._connection.open(self._callbacks)
        freeze_garbage()
        self._callbacks.add_reader(self._endpoint.fileno(), self._receive_setpoints)
        heartbeat = Heartbeat(NS // self._config.rates.control_hz)
        # not on one account: its parts have their own
        self._loop.add_reader(heartbeat.fileno(), self._beat, heartbeat)
        notify.notify("READY=1")
        solver = self._core.solver
        log.info(
            "running scene %s with the %s solver at %g mT, %s (%s)",
            self._core.scene.name,
            solver.solver,
            solver.step_mT,
            solver.dtype,
            solver.reason,
        )
        await self._ended.wait()
        notify.notify("STOPPING=1")
        await self._open_gap()
        self._loop.remove_reader(heartbeat.fileno())
        self._callbacks.remove_reader(self._endpoint.fileno())
        self._connection.close()
        heartbeat.close()
        self._endpoint.close()
        log.info("ended")

    def _beat(self, heartbeat: Heartbeat) -> None:
        beats = heartbeat.beats()
        if not beats:
            return  # a spurious wake-up
        callbacks, timing = self._callbacks, self._control.timing
        start_ns = time.monotonic_ns()
        used = self._inference.state
        self._control.tick(heartbeat.due_ns, beats - 1, used.plan)
        driven_ns = time.monotonic_ns()
        callbacks.ran(ControlLoop.tick.__qualname__, start_ns, driven_ns)
        if timing.delay_ns > timing.period_ns:
            self._note_stall(callbacks.blame(driven_ns - timing.delay_ns, driven_ns))
        else:
            callbacks.forget()
        if faults := self._control.new_faults():
            self._tell(faults)
        try:
            self._inference.after_tick(self._control.state.estimate)
        finally:  # whatever becomes of planning, the daemon can be seen and stopped
            planned_ns = time.monotonic_ns()
            callbacks.ran(InferenceLoop.after_tick.__qualname__, driven_ns, planned_ns)
            self._record(used)
            if timing.runs % self._ticks_per_snapshot == 0:
                self._publish(heartbeat.due_ns)
                callbacks.ran(self._publish.__qualname__, planned_ns, time.monotonic_ns())

    def _note_stall(self, delay: Delay) -> None:
        sight, known = self._control.state.sight, self._stall
        # only what the step took for a stall, too; of two that come close together it keeps the longer
        if sight.stalled_s == self._control.state.time_s and (known is None or known.took_s != sight.stall_s):
            self._stall = Stall(sight.stall_s, delay.culprit)

    def _tell(self, faults: tuple[Fault, ...]) -> None:
        """Says which faults are new, and remembers what is known of their causes now."""
        device, measurement = self._config.device, self._control.measurement
        for fault in faults:
            self._told.pop(fault, None)
        if Fault.HOST_STALL in faults:
            opened = f"the device opened the gap by itself after {device.command_timeout_ms:g} ms"
            self._told[Fault.HOST_STALL] = f"{self._stall}; {opened}"
        if Fault.MEASUREMENT_STALE in faults and measurement is not None:
            silent_ms = (self._control.state.time_s - measurement.received_s) * 1e3
            self._told[Fault.MEASUREMENT_STALE] = (
                f"the device had sent no new state for {silent_ms:.0f} ms"
                if silent_ms > measurement.delay_s * 1e3
                else f"the device was {measurement.delay_s * 1e3:.0f} ms behind with the commands that it obeyed"
            )
        for explained in explanations(faults, FAULTS, self._told):
            log.error("fault: %(code)s: %(cause)s", explained)

    def _receive_setpoints(self) -> None:
        self._inference.receive(self._control.state.estimate, self._control.next_tick_ns)

    def _record(self, used: PlanState) -> None:
        control = self._control
        if control.output is None:
            return
        timing = control.timing
        self._rows.append(
            tick_row(
                control.state.time_s,
                control.state,
                control.output,
                used.plan,
                used.trim,
                control.measurement,
                timing.lateness_us,
                timing.exec_us,
            )
        )

    def _publish(self, due_ns: int) -> None:
        start_ns = time.monotonic_ns()
        row = self._rows[-1]
        stamp = self._endpoint.inbox.newest
        age = None if stamp is None else start_ns * 1e-9 - stamp.stamp_s
        self._snapshot = snapshot(row, self._telemetry.runs, self._is_homed(), self._is_busy(), age)
        self._endpoint.publish(self._snapshot)
        self._endpoint.publish_ticks(TickRow._fields, self._rows[-ROWS:])
        self._rows.clear()
        self._groups[self._telemetry.runs % len(self._groups)].refresh()  # one a period: none costs the loop much
        self._status = {}
        self._endpoint.serve(start_ns * 1e-9, self._answer, self._control.next_tick_ns - SERVED_BEFORE_NS)
        if self._is_alive(start_ns * 1e-9):
            notify.notify("WATCHDOG=1")
        self._report_late_ticks()
        self._telemetry.record(due_ns, start_ns, time.monotonic_ns())

    def _is_alive(self, now_s: float) -> bool:
        """Whether plans and device states are as fresh as systemd's watchdog wants them; ticks are, or nobody asks."""
        timeout_s = self._config.realtime.watchdog_ms * 1e-3
        plan, measurement = self._inference.state.plan, self._connection.measurement
        if plan.number == 0 or now_s - plan.time_s > timeout_s:
            return False
        # without a port there are no states to be fresh, and starting the daemon again would not bring one
        return self._connection.state is not LinkState.RUNNING or (
            measurement is not None and now_s - measurement.received_s < timeout_s
        )

    def _is_homed(self) -> bool:
        """Whether the carriages' positions are known; the device's word alone is not enough."""
        estimate = self._control.state.estimate
        return self._connection.measurement is not None and estimate is not None and estimate.is_homed

    def _is_busy(self) -> bool:
        """Whether the device homes or opens, or was asked to and has not said yet that it does."""
        measurement, output = self._connection.measurement, self._control.output
        if measurement is None:
            return False
        is_asked = output is not None and output.request_number != self._control.state.safety.request_number
        return is_asked or self._connection.pending is not DeviceRequest.NONE or measurement.is_busy

    def _report_late_ticks(self) -> None:
        news = self._callbacks.news()
        if news is not None:
            is_stall = news.worst.took_ns > ERROR_PERIODS * self._control.timing.period_ns
            log.log(logging.ERROR if is_stall else logging.WARNING, "%s", news)

    def _answer(self, request: Request) -> dict[str, Any]:
        if request.command == "status":
            # built once for everybody who asks in this period
            self._status = self._status or self._build_status()
            return self._status
        self._control.command(request.command, self._conditions())
        self._status = {}
        return {
            "operating_state": str(self._control.state.safety.operating_state),
            # without a device nothing moves yet: a request to open is kept for it, and no other is taken
            "is_connected": self._connection.measurement is not None,
        }

    def _conditions(self) -> Conditions:
        measurement = self._connection.measurement
        setpoint = self._endpoint.inbox.newest
        now_s = time.monotonic()
        is_current = setpoint is not None and now_s - setpoint.stamp_s <= setpoint.valid_for_s
        timeout_s = self._config.device.measurement_timeout_ms * 1e-3
        return Conditions(
            connected=measurement is not None,
            fresh=measurement is not None and now_s - measurement.received_s < timeout_s,
            homed=self._is_homed(),
            busy=self._is_busy(),
            device_latched=measurement is not None and measurement.is_latched,
            requested_N=setpoint.force_N if setpoint is not None and is_current else None,
            neutral_N=self._least_N() + self._config.limits.neutral_margin_N,
            sensor_doubted=self._inference.state.sensor.is_doubted,
        )

    def _least_N(self) -> float:
        """F_min of this device, as far as it has shown itself."""
        return self._inference.state.device.force_N(self._core.planner.portrait.least_N)

    def _build_status(self) -> dict[str, Any]:
        snapshot_ = self._snapshot
        if snapshot_ is None:
            return {}
        known: dict[str, Any] = msgspec.to_builtins(snapshot_)
        safety, planned, shown = self._control.state.safety, self._inference.state.plan, self._inference.state.device
        return known | {
            # a command of this very period has changed the state since the snapshot, and whoever gave it asks now
            "operating_state": str(safety.operating_state),
            "is_busy": self._is_busy(),
            "faults": [str(fault) for fault in safety.faults],
            "version": __version__,
            "scene": self._core.scene.name,
            "uptime_s": round(time.monotonic() - self._started_s, 1),
            "least_N": round(self._least_N(), 3),
            "most_N": round(shown.force_N(self._core.planner.portrait.most_N), 3),
            "trim": round(self._inference.state.trim, 4),
            "device": {
                "scale": round(shown.scale, 4),
                "scale_sd": round(math.sqrt(max(shown.scale_variance, 0.0)), 4),
                "offset_N": round(shown.offset_N, 4),
                "offset_sd_N": round(math.sqrt(max(shown.offset_variance_N2, 0.0)), 4),
            },
            "least_gap_mm": round(planned.least_gap_mm, 2),
            "link": self._connection.report(),
            "setpoints": self._endpoint.inbox.report(),
            "rates": {group.name: group.report for group in self._groups},
            "late_ticks_by": dict(self._callbacks.blamed),
            "fault_details": explanations(safety.faults, FAULTS, self._told),
            "limit_details": explanations(
                snapshot_.limits,
                LIMITS,
                {
                    Limit.HOST_STALL: f"{self._stall}; the gap was held until the device answered",
                    Limit.MODEL_RANGE: "outside what the model was shown: "
                    + ", ".join(f"{it.quantity} {it.asked:.4g} asked, {it.used:.4g} used" for it in planned.outside),
                },
            ),
            "newest_stall": self._stall and {"ms": round(self._stall.took_s * 1e3, 1), "culprit": self._stall.culprit},
            "not_granted": self._refused,
        }

    def _lose_link(self) -> None:
        self._control.lose_link()

    async def _open_gap(self) -> None:
        """Asks the device to open and waits until it has; what it cannot do in time it goes on doing without us."""
        if self._control.state.safety.operating_state is not OperatingState.FAULT and self._connection.measurement:
            self._control.command("disable", self._conditions())
        until_s = time.monotonic() + LONGEST_RETRACT_S
        while self._is_busy() and time.monotonic() < until_s:
            await asyncio.sleep(OPENING_LOOK_S)
