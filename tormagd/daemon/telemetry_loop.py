"""The telemetry loop, at 50 Hz: publishes snapshot and ticks, answers requests, feeds the watchdog."""

import logging
import math
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec

from firmware_protocol.build import settle
from tormagd import __version__
from tormagd.config import Config
from tormagd.control.assembly.belief import beliefs
from tormagd.control.assembly.build import Core
from tormagd.control.assembly.conditions import conditions, is_busy, is_homed
from tormagd.control.believe.sensor import Disputed
from tormagd.control.move.opening import is_open
from tormagd.control.safety.operating_state import Conditions, RefusedError, next_commands
from tormagd.daemon.beat import Beat, Phases
from tormagd.daemon.black_box import BlackBox
from tormagd.daemon.calibrations import Calibrations
from tormagd.daemon.causes import Causes
from tormagd.daemon.control_loop import ControlLoop
from tormagd.daemon.endpoint import Endpoint
from tormagd.daemon.force_delay import Way
from tormagd.daemon.inference_loop import InferenceLoop
from tormagd.daemon.profiles import Profiles
from tormagd.daemon.rate_group import Histogram, RateGroup
from tormagd.daemon.scene_change import SceneChange
from tormagd.daemon.service import READY, Service, notify, status_line
from tormagd.daemon.topics import Topics
from tormagd.hardware.connection import Connection
from tormagd.record.force_following import Following
from tormagd.record.keeper_messages import REQUEST
from tormagd.record.telemetry import snapshot, tick_record
from tormagd_client.messages import (
    MAX_MARK_CHARACTERS,
    ArmReport,
    Description,
    DeviceReport,
    Explained,
    Mark,
    OutputReport,
    PortraitReport,
    Request,
    Status,
    Telemetry,
    TickRecord,
)

MAX_TICKS = 100
REQUESTS = 16
"Answered in a telemetry period: a client that keeps asking must not keep a `stop` waiting."
TELL_S = 0.1
REFRESHED = 2
FORGETS_S = 5.0
"After this time a tracking error counts 1/e."
PORTRAIT_STEP = 5
"The portrait is smooth: every fifth point will do."

log = logging.getLogger(__name__)


class TelemetryLoop:
    def __init__(
        self,
        config: Config,
        core: Core,
        control: ControlLoop,
        inference: InferenceLoop,
        profiles: Profiles,
        calibrations: Calibrations,
        connection: Connection,
        endpoint: Endpoint,
        phases: Phases,
        causes: Causes,
        box: BlackBox,
        scene_change: SceneChange,
        not_granted: list[str],
        config_file: str | None,
    ) -> None:
        self._not_granted, self._config_file = tuple(not_granted), config_file
        self._control, self._inference = control, inference
        self._calibrations, self._connection, self._endpoint = calibrations, connection, endpoint
        self._phases, self._causes, self._box, self._scene_change = phases, causes, box, scene_change
        self.timing = RateGroup("telemetry", 1_000_000_000 // config.rates.telemetry_hz)
        self._groups = [control.timing, inference.timing, self.timing]
        if inference.beside is not None:
            self._groups.append(inference.beside.timing)
        self._newest: Telemetry
        self._started_s = time.monotonic()
        self._ticks: list[TickRecord] = []
        self._way = Way()
        self.topics = Topics(config, core, control, inference, endpoint)
        self._service = Service()
        self._mark: Mark | None = None
        self._left, self._beats_per_snapshot = 0, config.rates.control_hz // config.rates.telemetry_hz
        self._answers, self._told_s = 0, -math.inf
        self._histograms = self._in_turn()
        self._reports: dict[str, Any] = {}
        self._reported_state = connection.state
        self.run_scene(config, core, profiles)

    def run_scene(self, config: Config, core: Core, profiles: Profiles) -> None:
        self.config = config
        "A reload replaces it, with changes only in keys that are looked up at each use."
        self._core, self.topics.core, self._profiles = core, core, profiles
        self._following = Following(1.0 / config.rates.telemetry_hz, FORGETS_S)
        self._status: msgspec.Raw | None = None
        self._reported_s = -math.inf

    def record(self, _beat: Beat) -> None:
        control = self._control
        if control.output is None or control.used is None:
            return
        self._left -= 1
        self._way.ticked(control.stepper.time_s, control.used, self._endpoint.inbox.sources.playout_ms * 1e-3)
        timing = control.timing
        record = tick_record(
            control.stepper,
            control.output,
            control.used,
            control.measurement,
            timing.lateness_us,
            timing.exec_us,
            timing.runs,
        )
        if len(self._ticks) == MAX_TICKS:  # telemetry is slow: the recording does not wait for it
            self._publish_ticks()
        self._ticks.append(record)
        self._box.ticked(record, control.stepper, self._inference.planner)

    def publish(self, beat: Beat) -> bool:
        if self._left > 0 or not self._ticks:
            return False
        self._left = max(self._left + self._beats_per_snapshot, 1)
        start_ns = time.monotonic_ns()
        endpoint, connections = self._endpoint, self._endpoint.admission.connections()
        tick = self._ticks[-1]
        self._following.look(
            tick.operating_state,
            tick.limits,
            tick.setpoint_cf,
            tick.measured_cf,
            tick.handle_mm,
            tick.handle_rate_mm_s,
        )
        # requests that wait now are answered with this snapshot, later ones with the next
        self._status, self._answers = None, min(endpoint.requests.count, REQUESTS)
        if connections["telemetry"] or self._answers:
            self._newest = self._snapshot(start_ns * 1e-9)
            endpoint.publish(self._newest)
        self._publish_ticks()
        # before the next plan learns from a new device
        self._look_at_device()
        self.timing.record(beat.due_ns, start_ns, time.monotonic_ns())
        return True

    def _look_at_device(self) -> None:
        serial_number, is_driven = self._connection.serial_number, self._control.stepper.safety.is_driven
        change = self._scene_change.newest
        is_idle = not (is_driven or self.is_busy()) and (change is None or change.is_over)
        self._calibrations.look(serial_number, self.config, is_idle=is_idle)
        is_awaited = self._calibrations.is_awaited(serial_number)
        self._profiles.look(None if is_awaited else serial_number, is_driven)

    def _publish_ticks(self) -> None:
        if self._endpoint.admission.connections()["recording"]:
            self._endpoint.publish_ticks(self._ticks)
        self._ticks = []

    def tell(self, _beat: Beat) -> bool:
        """Feed log, systemd and black box, and continue an arming; return False if it is not time."""
        now_s = time.monotonic()
        if now_s - self._told_s < TELL_S:
            return False
        self._told_s = now_s
        for _ in range(REFRESHED):
            next(self._histograms).refresh()
        self._endpoint.inbox.refresh(now_s)
        self._endpoint.inbox.tell(now_s)
        self._box.look()
        self._tell_service(now_s, self._is_homed())
        self._control.go_on_arming(self.conditions())
        self._endpoint.tell(now_s)
        self._phases.tell()
        return True

    def serve(self, _beat: Beat) -> bool:
        answered = self._endpoint.serve(self._answer, self._answers)
        self._answers = self._answers - answered if answered else 0
        return answered > 0

    def keep(self, reason: str, after_s: float) -> Path:
        link = self._connection.report()
        details = {
            "firmware": link.firmware or "",
            "serial_number": "" if link.serial_number is None else f"{link.serial_number:08x}",
            "profile_sha256": self._profiles.digest if self._profiles.report().is_used else "",
        }
        return self._box.write(reason, after_s, details)

    def conditions(self) -> Conditions:
        control, doubted = self._control, self._inference.planner.believe.sensor.is_doubted
        found = conditions(
            time.monotonic(), self.config, self._connection, control.stepper, control.output, sensor_doubted=doubted
        )
        return found.replaced(busy=True) if self._calibrations.is_awaited(self._connection.serial_number) else found

    def is_busy(self) -> bool:
        """Tell whether the device homes or opens, or has been asked to."""
        connection = self._connection
        return is_busy(connection.measurement, connection.pending, self._control.stepper, self._control.output)

    def is_open(self) -> bool | None:
        measurement = self._connection.measurement
        return None if measurement is None else is_open(measurement, self._is_homed())

    def _is_homed(self) -> bool:
        return is_homed(self._connection.measurement, self._control.stepper.measured)

    def _snapshot(self, now_s: float) -> Telemetry:
        in_force = self._endpoint.inbox.in_force
        return snapshot(
            self._ticks[-1],
            self.timing.runs,
            self._is_homed(),
            self.is_busy(),
            None if in_force is None else now_s - in_force.stamp_s,
            beliefs(self._inference.planner, self._control.stepper, now_s, self._core.scene.terms),
            self.topics.handle(),
            self.topics.verdict(),
            self._mark,
        )

    def _tell_service(self, now_s: float, is_homed_: bool) -> None:
        connection, safety, service = self._connection, self._control.stepper.safety, self._service
        plan, measurement, link = self._inference.planner.planned, connection.measurement, connection.state
        is_alive = service.is_alive(
            now_s,
            self.config.realtime.watchdog_ms * 1e-3,
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
        for message in service.news(is_alive, link, status):
            if message == READY:
                log.info("ready: the device is identified; next: tormagctl arm")
            notify(message)

    def _in_turn(self) -> Iterator[Histogram]:
        while True:
            for group in self._groups:
                yield from (group.lateness, group.exec)
            yield from (self._way.to_duty, *self._phases.spent.values())

    def _answer(self, request: Request) -> Any:
        if request.command == "status":
            if self._status is None:
                self._status = msgspec.Raw(msgspec.msgpack.encode(self._build_status(self._newest)))
            return self._status
        return self._describe() if request.command == "describe" else self.command(request)

    def _describe(self) -> Description:
        link, portrait, device = self._connection.report(), self._core.portrait, self._inference.planner.believe.device
        scaled_mm_s = device.scale * self._core.gap_speed_mm_s
        return Description(
            version=__version__,
            build=str(settle()),
            configuration=msgspec.to_builtins(self.config),
            scene=msgspec.to_builtins(self._core.scene),
            model=self._core.model,
            profile=self._profiles.report(),
            firmware=link.firmware,
            serial_number=link.serial_number,
            portrait=PortraitReport(
                force_N=tuple(round(device.force_N(force_N), 4) for force_N in portrait.force_N[::PORTRAIT_STEP]),
                rate_N_s=tuple(round(scaled_mm_s * slope, 4) for slope in portrait.slope_N_mm[::PORTRAIT_STEP]),
            ),
            configuration_file=self._config_file,
        )

    def command(self, request: Request) -> dict[str, Any]:
        """Carry out a request that changes something."""
        self._status, self._reported_s = None, -math.inf
        if request.command == "take":
            return self._give(request.args.get("source"))
        if request.command == "confirm":
            return self._confirm(request.args.get("what"))
        if request.command == "mark":
            return self._add_mark(request.args.get("text"))
        if request.command == "blackbox":
            return {"file": str(self.keep(REQUEST, 0.0))}
        if request.command == "arm":
            self._control.arm(self.conditions())
        elif request.command == "use-scene":
            self._scene_change.begin(request.args.get("scene"))
        else:
            self._control.command(request.command, self.conditions())
        return {
            "operating_state": str(self._control.stepper.safety.operating_state),
            # without a device, a request to open is kept for it, and no other is taken
            "is_connected": self._connection.measurement is not None,
        }

    def _add_mark(self, text: object) -> dict[str, Any]:
        if not isinstance(text, str) or not text.isprintable() or not 0 < len(text) <= MAX_MARK_CHARACTERS:
            allowed = f"allowed are 1..{MAX_MARK_CHARACTERS} printable characters"
            raise RefusedError("bad_mark", f"args.text = {str(text)[:80]!r}: {allowed}", "tormagctl mark TEXT")
        self._mark = Mark(t_ns=time.time_ns(), text=text)
        log.info("mark: %s", text)
        return msgspec.to_builtins(self._mark)  # type: ignore[no-any-return]

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
        log.warning(
            "an operator has confirmed: %s",
            "the device has changed" if wrong == "device" else "the force sensor is wrong",
        )
        return {"confirmed": wrong}

    def _give(self, source: object) -> dict[str, Any]:
        if not isinstance(source, str):
            raise RefusedError("bad_source", "args.source is no text", "tormagctl take SOURCE")
        inbox = self._endpoint.inbox
        before = inbox.holder
        inbox.give(source, time.monotonic())
        log.info("the brake is given to the source %r", source)
        return {"source": source, "instead_of": before}

    def _build_status(self, newest: Telemetry) -> Status:
        stepper, planner = self._control.stepper, self._inference.planner
        safety, plan, believe, acted = stepper.safety, planner.planned, planner.believe, stepper.move.acted
        device = believe.device
        # a command or a homing may have changed these since the snapshot
        is_homed_ = self._is_homed()
        known = msgspec.structs.asdict(newest) | {
            "operating_state": str(safety.operating_state),
            "is_homed": is_homed_,
            "is_busy": self.is_busy(),
            "faults": safety.faults,
        }
        now_s = time.monotonic()
        outside = ", ".join(f"{it.quantity} {it.asked:.4g} asked, {it.used:.4g} used" for it in plan.outside)
        return Status(
            **known,
            **self._slowly_changing(now_s),
            version=__version__,
            build=str(settle()),
            scene=self._core.scene.name,
            scene_fingerprint=self._core.scene.fingerprint,
            terms_out=self._core.scene.terms.left_out,
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
            least_gap_mm=round(plan.min_gap_mm, 2),
            fault_details=self._causes.of_faults(safety.faults),
            limit_details=self._causes.of_limits(
                newest.limits, outside, self._endpoint.inbox.told(now_s), self._control.measurement, now_s
            ),
            newest_stall=self._causes.stall,
            not_granted=self._not_granted,
            output=OutputReport(rate=acted.rate, slew=acted.slew, not_finite=acted.not_finite, range=acted.range),
            next_commands=tuple(map(str, next_commands(safety, is_homed_))),
            arm=self._arm_report(),
            scene_change=self._scene_change.newest,
            is_open=self.is_open(),
            following=self._following.report(),
            process_id=os.getpid(),
        )

    def _arm_report(self) -> ArmReport | None:
        arming = self._control.arming
        if arming is None:
            return None
        why = arming.refusal
        ended = None if why is None else Explained(why.code, why.message, why.hint)
        return ArmReport(given=arming.given, is_over=arming.is_over, error=ended)

    def _slowly_changing(self, now_s: float) -> dict[str, Any]:
        """Return the reports that take most of the time; made anew every TELL_S."""
        if now_s - self._reported_s >= TELL_S or self._connection.state is not self._reported_state:
            self._reported_s, self._reported_state = now_s, self._connection.state
            link = self._connection.report()
            device_us = None if link.round_trip_us is None else link.round_trip_us.p50
            self._reports = {
                "link": link,
                "profile": self._profiles.report(),
                "calibration": self._calibrations.report(),
                "setpoints": self._endpoint.inbox.report(now_s),
                "peers": self._endpoint.report(),
                "rates": {group.name: group.report() for group in self._groups},
                "phases_us": {name: spent.report for name, spent in self._phases.spent.items()},
                "late_ticks_by": dict(self._phases.blamed),
                "way": self._way.report(
                    device_us, self._inference.planner.believe.carriages.lag_s, self._core.scene.budget
                ),
                "black_box": self._box.report(),
            }
        return self._reports
