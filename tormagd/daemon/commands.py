"""Carries out what an operator asks of the running daemon, by what is known of the device now."""

import logging
import time
from pathlib import Path
from typing import Any

import msgspec

from tormagd.config import Config
from tormagd.control.assembly.conditions import conditions
from tormagd.control.believe.sensor import Disputed
from tormagd.control.safety.operating_state import Conditions, RefusedError
from tormagd.daemon.black_box import BlackBox
from tormagd.daemon.configuration import Calibrations, SceneChange
from tormagd.daemon.control_loop import ControlLoop
from tormagd.daemon.inbox import SetpointInbox
from tormagd.daemon.inference_loop import InferenceLoop
from tormagd.daemon.profiles import Profiles
from tormagd.hardware.connection import Connection
from tormagd.record.keeper import REQUEST
from tormagd_client.messages import MAX_MARK_CHARACTERS, Mark, Request

log = logging.getLogger(__name__)


class Commands:
    def __init__(
        self,
        config: Config,
        control: ControlLoop,
        inference: InferenceLoop,
        connection: Connection,
        inbox: SetpointInbox,
        box: BlackBox,
        profiles: Profiles,
        calibrations: Calibrations,
        scene_change: SceneChange,
    ) -> None:
        self.config, self.profiles = config, profiles
        "A reload replaces both, with changes of the configuration only in keys that are looked up at each use."
        self._control, self._inference, self.connection = control, inference, connection
        self._inbox, self.box = inbox, box
        self.calibrations, self.scene_change = calibrations, scene_change
        self.mark: Mark | None = None

    def conditions(self) -> Conditions:
        control, doubted = self._control, self._inference.planner.believe.sensor.is_doubted
        found = conditions(
            time.monotonic(), self.config, self.connection, control.stepper, control.output, sensor_doubted=doubted
        )
        return found.replaced(busy=True) if self.calibrations.is_awaited(self.connection.serial_number) else found

    def look_at_device(self) -> None:
        """Load or keep the calibration and profile of the connected device."""
        serial_number, is_driven = self.connection.serial_number, self._control.stepper.safety.is_driven
        change = self.scene_change.newest
        is_idle = not (is_driven or self._control.is_busy()) and (change is None or change.is_over)
        self.calibrations.look(serial_number, self.config, is_idle=is_idle)
        is_awaited = self.calibrations.is_awaited(serial_number)
        self.profiles.look(None if is_awaited else serial_number, is_driven)

    def keep(self, reason: str, after_s: float) -> Path:
        link = self.connection.report()
        return self.box.write(
            reason,
            after_s,
            {
                "firmware": link.firmware or "",
                "serial_number": "" if link.serial_number is None else f"{link.serial_number:08x}",
                "profile_sha256": self.profiles.digest if self.profiles.report().is_used else "",
            },
        )

    def carry_out(self, request: Request) -> dict[str, Any]:
        """Carry out a request that changes something."""
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
            self.scene_change.begin(request.args.get("scene"))
        else:
            self._control.command(request.command, self.conditions())
        return {
            "operating_state": str(self._control.stepper.safety.operating_state),
            # without a device, a request to open is kept for it, and no other is taken
            "is_connected": self.connection.measurement is not None,
        }

    def _add_mark(self, text: object) -> dict[str, Any]:
        if not isinstance(text, str) or not text.isprintable() or not 0 < len(text) <= MAX_MARK_CHARACTERS:
            allowed = f"allowed are 1..{MAX_MARK_CHARACTERS} printable characters"
            raise RefusedError("bad_mark", f"args.text = {str(text)[:80]!r}: {allowed}", "tormagctl mark TEXT")
        self.mark = Mark(t_ns=time.time_ns(), text=text)
        log.info("mark: %s", text)
        return msgspec.to_builtins(self.mark)  # type: ignore[no-any-return]

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
        before = self._inbox.holder
        self._inbox.give(source, time.monotonic())
        log.info("the brake is given to the source %r", source)
        return {"source": source, "instead_of": before}
