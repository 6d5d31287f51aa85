"""The telemetry loop: at 50 Hz publish the snapshot and the ticks, answer commands and `status`, feed the watchdog."""

import logging
import time
from pathlib import Path
from typing import Any

import msgspec

from firmware_protocol.build import settle
from tormagd import __version__
from tormagd.assembly.belief import beliefs
from tormagd.assembly.build import Core
from tormagd.assembly.conditions import conditions, is_busy, is_homed
from tormagd.config import Config
from tormagd.control.believe.sensor import Disputed
from tormagd.control.move.opening import is_open
from tormagd.control.records import Plan
from tormagd.daemon import notify
from tormagd.daemon.black_box import ASKED, BlackBox
from tormagd.daemon.callbacks import Callbacks
from tormagd.daemon.causes import Causes
from tormagd.daemon.control_loop import ControlLoop
from tormagd.daemon.endpoint import Endpoint
from tormagd.daemon.inference_loop import InferenceLoop
from tormagd.daemon.profiles import Profiles
from tormagd.daemon.rate_group import ERROR_PERIODS, RateGroup
from tormagd.daemon.service import READY, Service, status_line
from tormagd.daemon.telemetry import snapshot, tick_record
from tormagd.daemon.way import Way
from tormagd.hardware.connection import Connection
from tormagd.safety.operating_state import Conditions, RefusedError, next_commands
from tormagd.scenes.scene import terms_of
from tormagd_client.messages import (
    Description,
    DeviceReport,
    OutputReport,
    PortraitReport,
    Request,
    Status,
    Telemetry,
    TickRecord,
)

NS = 1_000_000_000
MOST_TICKS = 100
"Ticks in one recording message at most."
SERVED_BEFORE_NS = 200_000
"No command is taken up later than this before the next control tick: an answer takes a quarter of it."
PORTRAIT_STEP = 5
"Every fifth point of the portrait is told: it is smooth."

log = logging.getLogger(__name__)


class TelemetryLoop:
    """Tells everybody else what the control and inference loops do. It runs in their slack, after a control tick.

    `not_granted` is what the kernel refused at the start.
    """

    def __init__(
        self,
        config: Config,
        core: Core,
        control: ControlLoop,
        inference: InferenceLoop,
        profiles: Profiles,
        connection: Connection,
        endpoint: Endpoint,
        callbacks: Callbacks,
        causes: Causes,
        box: BlackBox,
        not_granted: list[str],
    ) -> None:
        self._config, self._core, self._not_granted = config, core, tuple(not_granted)
        self._control, self._inference, self._profiles = control, inference, profiles
        self._connection, self._endpoint = connection, endpoint
        self._callbacks, self._causes, self._box = callbacks, causes, box
        self.timing = RateGroup("telemetry", NS // config.rates.telemetry_hz)
        self._groups = [control.timing, inference.timing, self.timing]
        if inference.beside is not None:
            self._groups.append(inference.beside.timing)
        self._newest: Telemetry
        self._started_s = time.monotonic()
        self._ticks: list[TickRecord] = []
        self._way = Way()
        self._service = Service()
        self._status: dict[str, Any] | None = None

    def record(self, used: Plan) -> None:
        """Keeps the control tick that just ran, with what had been planned when it did."""
        control = self._control
        if control.output is None:
            return
        self._way.ticked(control.stepper.time_s, used)
        timing = control.timing
        record = tick_record(
            control.stepper,
            control.output,
            used,
            control.measurement,
            timing.lateness_us,
            timing.exec_us,
            timing.runs,
        )
        self._ticks.append(record)
        self._box.ticked(record, control.stepper, self._inference.planner)

    def publish(self, due_ns: int) -> None:
        """One telemetry period, which was due at `due_ns`."""
        start_ns = time.monotonic_ns()
        self._newest = self._snapshot(start_ns * 1e-9)
        self._endpoint.publish(self._newest)
        link = self._connection.link
        identity = None if link is None else link.identity
        self._profiles.look(
            None if identity is None else identity.serial_number, self._control.stepper.safety.is_driven
        )
        self._endpoint.publish_ticks(self._ticks[-MOST_TICKS:])
        self._ticks.clear()
        self._refresh(start_ns * 1e-9)
        self._box.look()
        self._status = None
        self._tell_service(start_ns * 1e-9, self._newest.is_homed)
        self._report_late_ticks()
        self._report_sources(start_ns * 1e-9)
        self.timing.record(due_ns, start_ns, time.monotonic_ns())

    def serve(self) -> None:
        """Answers the requests that wait, with what was published last."""
        until_ns = self._control.next_tick_ns - SERVED_BEFORE_NS
        self._endpoint.serve(time.monotonic(), self._answer, until_ns)

    def take_requests(self) -> None:
        """Takes the requests that have arrived: `stop` and `disable` are carried out, the rest waits for `serve`."""
        self._endpoint.take_requests(self._command)

    def keep(self, reason: str, after_s: float) -> Path:
        """Has a black box written, with what comes `after_s` later; where it will be. Raises RefusedError."""
        link, profile = self._connection.report(), self._profiles.report()
        details = {
            "firmware": link.firmware or "",
            "serial_number": "" if link.serial_number is None else f"{link.serial_number:08x}",
            "profile_sha256": self._profiles.digest if profile.is_used else "",
        }
        return self._box.write(reason, after_s, details)

    def conditions(self) -> Conditions:
        """What a command is decided on now."""
        return conditions(
            time.monotonic(),
            self._config,
            self._connection,
            self._control.stepper,
            self._control.output,
            self._endpoint.inbox.newest,
            self._inference.planner.believe.min_N,
            sensor_doubted=self._inference.planner.believe.sensor.is_doubted,
        )

    def is_busy(self) -> bool:
        """Whether the device homes or opens, or is about to."""
        connection, control = self._connection, self._control
        return is_busy(connection.measurement, connection.pending, control.stepper, control.output)

    def is_open(self) -> bool | None:
        """Whether the gap is open; None without a device."""
        measurement = self._connection.measurement
        return None if measurement is None else is_open(measurement, self._is_homed())

    def _is_homed(self) -> bool:
        return is_homed(self._connection.measurement, self._control.stepper.measured)

    def _snapshot(self, now_s: float) -> Telemetry:
        stamp = self._endpoint.inbox.newest
        age_s = None if stamp is None else now_s - stamp.stamp_s
        planner, stepper = self._inference.planner, self._control.stepper
        believed = beliefs(planner, stepper, now_s, terms_of(self._core.scene))
        return snapshot(self._ticks[-1], self.timing.runs, self._is_homed(), self.is_busy(), age_s, believed)

    def take_over(self, config: Config) -> None:
        """Goes on with another configuration, of which only what a loop looks at each time may differ."""
        self._config = config
        self._endpoint.inbox.priority = config.sources.priority

    def _tell_service(self, now_s: float, is_homed_: bool) -> None:
        """Says to systemd how it stands, and feeds its watchdog while plans and device states are fresh."""
        connection, safety, service = self._connection, self._control.stepper.safety, self._service
        plan, measurement, link = self._inference.planner.planned, connection.measurement, connection.state
        is_alive = service.is_alive(
            now_s,
            self._config.realtime.watchdog_ms * 1e-3,
            plan.time_s if plan.number else None,
            link,
            None if measurement is None else measurement.received_s,
        )
        status = status_line(
            link,
            connection.cause,
            connection.remedy,
            str(safety.operating_state),
            is_homed_,
            [str(fault) for fault in safety.faults],
            self._core.scene.name,
        )
        for message in service.news(now_s, is_alive, link, status):
            if message == READY:
                log.info("ready: the device is identified; next: %s", "enable" if is_homed_ else "home")
            notify.notify(message)

    def _report_late_ticks(self) -> None:
        news = self._callbacks.news()
        if news is not None:
            is_stall = news.worst.took_ns > ERROR_PERIODS * self._control.timing.period_ns
            log.log(logging.ERROR if is_stall else logging.WARNING, "%s", news)

    def _refresh(self, now_s: float) -> None:
        """Makes one report anew: all of them at once would make a tick wait."""
        turn = self.timing.runs % (len(self._groups) + 2)
        if turn < len(self._groups):
            self._groups[turn].refresh()
        elif turn == len(self._groups):
            self._way.refresh()
        else:
            self._endpoint.inbox.refresh(now_s)

    def _report_sources(self, now_s: float) -> None:
        news = self._endpoint.inbox.news(now_s)
        if news is not None:
            log.warning("%s", news)

    def _answer(self, request: Request) -> dict[str, Any]:
        if request.command == "status":
            # built once for everybody who asks in this period
            if self._status is None:
                self._status = msgspec.to_builtins(self._build_status(self._newest))
            return self._status
        return self._describe() if request.command == "describe" else self._command(request)

    def _describe(self) -> dict[str, Any]:
        link = self._connection.report()
        description = Description(
            version=__version__,
            build=str(settle()),
            configuration=msgspec.to_builtins(self._config),
            scene=msgspec.to_builtins(self._core.scene),
            model=self._core.model,
            profile=self._profiles.report(),
            firmware=link.firmware,
            serial_number=link.serial_number,
            portrait=self._portrait(),
        )
        described: dict[str, Any] = msgspec.to_builtins(description)
        return described

    def _portrait(self) -> PortraitReport:
        portrait, device = self._core.portrait, self._inference.planner.believe.device
        scaled_mm_s = device.scale * self._core.gap_speed_mm_s
        return PortraitReport(
            force_N=tuple(round(device.force_N(force_N), 4) for force_N in portrait.force_N[::PORTRAIT_STEP]),
            rate_N_s=tuple(round(scaled_mm_s * slope, 4) for slope in portrait.slope_N_mm[::PORTRAIT_STEP]),
        )

    def _command(self, request: Request) -> dict[str, Any]:
        self._status = None
        if request.command == "take":
            return self._give(request.args.get("source"))
        if request.command == "confirm":
            return self._confirm(request.args.get("what"))
        if request.command == "blackbox":
            return {"file": str(self.keep(ASKED, 0.0))}
        self._control.command(request.command, self.conditions())
        return {
            "operating_state": str(self._control.stepper.safety.operating_state),
            # without a device nothing moves yet: a request to open is kept for it, and no other is taken
            "is_connected": self._connection.measurement is not None,
        }

    def _confirm(self, what: object) -> dict[str, Any]:
        try:
            wrong = msgspec.convert(what, Disputed)
        except msgspec.ValidationError as error:
            raise RefusedError(
                "bad_confirmation", f"args.what = {what!r}: allowed are device and sensor", "tormagctl confirm device"
            ) from error
        if not self._inference.planner.believe.sensor.is_disputed:
            raise RefusedError(
                "not_disputed", "the readings agree with the device: there is nothing to confirm", "tormagctl status"
            )
        self._inference.confirm(wrong)
        log.warning("confirm: %s", "the device has changed" if wrong == "device" else "the force sensor is wrong")
        return {"confirmed": wrong}

    def _give(self, source: object) -> dict[str, Any]:
        if not isinstance(source, str):
            raise RefusedError("bad_source", "args.source is no text", "tormagctl take SOURCE")
        inbox = self._endpoint.inbox
        before = inbox.hold.source
        inbox.give(source, time.monotonic())
        log.info("take: %r", source)
        return {"source": source, "instead_of": before}

    def _build_status(self, newest: Telemetry) -> Status:
        stepper, planner = self._control.stepper, self._inference.planner
        safety, plan, believe, acted = stepper.safety, planner.planned, planner.believe, stepper.move.acted
        device = believe.device
        # a command or the end of a homing changes these after the snapshot, and whoever waits for that asks now
        is_homed_ = self._is_homed()
        known = msgspec.structs.asdict(newest) | {
            "operating_state": str(safety.operating_state),
            "is_homed": is_homed_,
            "is_busy": self.is_busy(),
            "faults": safety.faults,
        }
        now_s, inbox, link = time.monotonic(), self._endpoint.inbox, self._connection.report()
        outside = ", ".join(f"{it.quantity} {it.asked:.4g} asked, {it.used:.4g} used" for it in plan.outside)
        return Status(
            **known,
            version=__version__,
            build=str(settle()),
            scene=self._core.scene.name,
            scene_fingerprint=self._core.scene.fingerprint,
            terms_out=terms_of(self._core.scene).left_out,
            solver=self._core.solver.solver,
            roller_radius_mm=self._core.scene.roller_radius_mm,
            uptime_s=round(time.monotonic() - self._started_s, 1),
            least_N=round(believe.min_N, 3),
            most_N=round(device.force_N(self._core.portrait.max_N), 3),
            trim=round(plan.trim, 4),
            device=DeviceReport(
                scale=round(device.scale, 4),
                scale_sd=round(device.scale_sd, 4),
                offset_N=round(device.offset_N, 4),
                offset_sd_N=round(device.offset_sd_N, 4),
                sensor_zero_N=round(believe.zero.zero_N, 4),
                sensor_zero_sd_N=round(believe.zero.sd_N(now_s), 4),
                lag_ms=round(believe.carriages.lag_s * 1e3, 1),
            ),
            profile=self._profiles.report(),
            least_gap_mm=round(plan.min_gap_mm, 2),
            link=link,
            setpoints=inbox.report(now_s),
            peers=self._endpoint.report(),
            rates={group.name: group.report for group in self._groups},
            late_ticks_by=dict(self._callbacks.blamed),
            fault_details=self._causes.of_faults(safety.faults),
            limit_details=self._causes.of_limits(newest.limits, outside, inbox.told(now_s), self._control.measurement),
            newest_stall=self._causes.newest_stall(),
            not_granted=self._not_granted,
            way=self._way.report(
                None if link.round_trip_us is None else link.round_trip_us.p50, believe.carriages.lag_s
            ),
            black_box=self._box.report(),
            output=OutputReport(rate=acted.rate, slew=acted.slew, not_finite=acted.not_finite, range=acted.range),
            next_commands=tuple(map(str, next_commands(safety, is_homed_))),
            is_open=self.is_open(),
        )
