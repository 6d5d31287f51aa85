"""Answers requests: status, description, and what a command has done.

A status takes several beats: each makes some reports anew, or the status, or sends answers.
"""

import math
import os
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import msgspec

from firmware_protocol.build import settle
from tormagd import __version__
from tormagd.control.safety.operating_state import next_commands
from tormagd.daemon.beat import Beat, Phases
from tormagd.daemon.black_box import OF_CORE
from tormagd.daemon.causes import Causes
from tormagd.daemon.commands import Commands
from tormagd.daemon.control_loop import ControlLoop
from tormagd.daemon.endpoint import Endpoint
from tormagd.daemon.inference_loop import InferenceLoop
from tormagd.daemon.telemetry_loop import TelemetryLoop
from tormagd_client.messages import (
    ArmReport,
    Description,
    DeviceReport,
    Explained,
    OutputReport,
    PortraitReport,
    Request,
    Status,
    Telemetry,
)

REPORTED_S = 0.1
PORTRAIT_STEP = 5
"The portrait is smooth: every fifth point will do."


class Answers:
    def __init__(
        self,
        control: ControlLoop,
        inference: InferenceLoop,
        endpoint: Endpoint,
        telemetry: TelemetryLoop,
        commands: Commands,
        phases: Phases,
        causes: Causes,
        not_granted: list[str],
        config_file: str | None,
    ) -> None:
        self._control, self._inference, self._endpoint = control, inference, endpoint
        self._telemetry, self._commands, self._phases, self._causes = telemetry, commands, phases, causes
        self._not_granted, self._config_file = tuple(not_granted), config_file
        self._started_s = time.monotonic()
        self._status = msgspec.Raw(b"")
        self._said: Telemetry | None = None
        "The snapshot of which `_status` is made."
        self._reports: dict[str, Any] = {}
        self._parts = self._report_device, self._report_peers, self._report_rates, self._report_phases
        self._steps: deque[Callable[[], None]] = deque()
        "What is left to do for the requests that wait."
        self.reset()
        self._reported_state = commands.connection.state

    def reset(self) -> None:
        self._said, self._reported_s = None, -math.inf

    def serve(self, _beat: Beat) -> bool:
        """Take the next step of what is asked for: prepare a status, or send answers."""
        if self._telemetry.waiting and not self._steps:
            self._prepare()
        if not self._steps:
            return False
        self._steps.popleft()()
        return True

    def _prepare(self) -> None:
        """List the steps to answers with the newest snapshot."""
        now_s, state = time.monotonic(), self._commands.connection.state
        if now_s - self._reported_s >= REPORTED_S or state is not self._reported_state:
            self._reported_s, self._reported_state = now_s, state
            self._steps.extend(self._parts)
        if self._said is not self._telemetry.newest:
            self._steps.append(self._tell)
        self._steps.append(self._send)

    def _send(self) -> None:
        telemetry = self._telemetry
        answered = self._endpoint.serve(self._answer, telemetry.waiting)
        telemetry.waiting = telemetry.waiting - answered if answered else 0

    def command(self, request: Request) -> dict[str, Any]:
        self.reset()
        return self._commands.carry_out(request)

    def _answer(self, request: Request) -> Any:
        if request.command == "status":
            self._tell()
            return self._status
        return self._describe() if request.command == "describe" else self.command(request)

    def _tell(self) -> None:
        """Make the status of the newest snapshot, if it is not there yet."""
        if self._said is not self._telemetry.newest:
            self._said = self._telemetry.newest
            self._status = msgspec.Raw(msgspec.msgpack.encode(self.status()))

    def _describe(self) -> Description:
        core, link = self._telemetry.core, self._commands.connection.report()
        portrait, device = core.portrait, self._inference.planner.believe.device
        scaled_mm_s = device.scale * core.gap_speeds.opening_mm_s
        return Description(
            version=__version__,
            build=str(settle()),
            configuration=msgspec.to_builtins(self._commands.config),
            scene=msgspec.to_builtins(core.scene),
            model=core.model,
            profile=self._commands.profiles.report(),
            firmware=link.firmware,
            serial_number=link.serial_number,
            portrait=PortraitReport(
                force_N=tuple(round(device.force_N(force_N), 4) for force_N in portrait.force_N[::PORTRAIT_STEP]),
                rate_N_s=tuple(round(scaled_mm_s * slope, 4) for slope in portrait.slope_N_mm[::PORTRAIT_STEP]),
            ),
            configuration_file=self._config_file,
            core={name: self._commands.box.header[name] for name in OF_CORE},
        )

    def status(self) -> Status:
        core, newest = self._telemetry.core, self._telemetry.newest
        stepper, planner = self._control.stepper, self._inference.planner
        safety, plan, believe, acted = stepper.safety, planner.planned, planner.believe, stepper.move.acted
        device = believe.device
        # a command or a homing may have changed these since the snapshot
        is_homed = self._control.is_homed()
        known = msgspec.structs.asdict(newest) | {
            "operating_state": str(safety.operating_state),
            "is_homed": is_homed,
            "is_busy": self._control.is_busy(),
            "faults": safety.faults,
        }
        now_s = time.monotonic()
        if self._reported_s == -math.inf:  # a command may have changed all
            self._reported_s = now_s
            for part in self._parts:
                part()
        outside = ", ".join(f"{it.quantity} {it.asked:.4g} asked, {it.used:.4g} used" for it in plan.outside)
        return Status(
            **known,
            **self._reports,
            version=__version__,
            build=str(settle()),
            scene=core.scene.name,
            scene_fingerprint=core.scene.fingerprint,
            terms_out=core.scene.terms.left_out,
            solver=core.solver.solver,
            roller_radius_mm=core.scene.roller_radius_mm,
            uptime_s=round(time.monotonic() - self._started_s, 1),
            least_N=round(believe.device.force_N(believe.memory.open_N()), 3),
            most_N=round(device.force_N(core.portrait.max_N), 3),
            trim=round(plan.trim, 4),
            device=DeviceReport(
                scale=round(device.scale, 4),
                scale_sd=round(device.scale_sd, 4),
                offset_N=round(device.offset_N, 4),
                offset_sd_N=round(device.deviation_N(0.0), 4),
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
            next_commands=tuple(map(str, next_commands(safety, is_homed))),
            arm=self._arm_report(),
            scene_change=self._commands.scene_change.newest,
            is_open=self._control.is_open(),
            following=self._telemetry.following.report(),
            process_id=os.getpid(),
        )

    def _arm_report(self) -> ArmReport | None:
        arming = self._control.arming
        if arming is None:
            return None
        why = arming.refusal
        ended = None if why is None else Explained(why.code, why.message, why.hint)
        return ArmReport(given=arming.given, is_over=arming.is_over, error=ended)

    def _report_device(self) -> None:
        commands, telemetry = self._commands, self._telemetry
        link, lag_s = commands.connection.report(), self._inference.planner.believe.carriages.lag_s
        device_us = None if link.round_trip_us is None else link.round_trip_us.p50
        self._reports |= {
            "link": link,
            "way": telemetry.way.report(device_us, lag_s, telemetry.core.scene.budget),
            "profile": commands.profiles.report(),
            "calibration": commands.calibrations.report(),
        }

    def _report_peers(self) -> None:
        self._reports |= {
            "setpoints": self._endpoint.inbox.report(time.monotonic()),
            "peers": self._endpoint.report(),
            "black_box": self._commands.box.report(),
        }

    def _report_rates(self) -> None:
        self._reports["rates"] = {group.name: group.report() for group in self._telemetry.groups}

    def _report_phases(self) -> None:
        self._reports |= {
            "phases_us": {name: spent.report() for name, spent in self._phases.spent.items()},
            "late_ticks_by": dict(self._phases.blamed),
        }
