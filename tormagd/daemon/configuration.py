"""The configuration in force: the file's, with the calibration of the connected device, or an operator's scene.

A file that is read again on SIGHUP changes some keys while control runs. For a calibration or another scene a core is
built beside the beats; it replaces the running one while the device is at rest.
"""

import asyncio
import logging
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any, TypeAlias

import msgspec

from tormagd.config import Config, load_calibration
from tormagd.control.assembly.build import Core, build_core
from tormagd.control.safety.operating_state import RefusedError
from tormagd_client.endpoints import ConfigError
from tormagd_client.messages import CalibrationReport, Explained, SceneReport
from tormagd_client.printable import require

LIVE = "realtime.watchdog_ms", "sources."
"Keys, or how they begin, that a reload takes over; from all others something was built at the start."
LONGEST_NAME = 4_096
NEXT = (
    "name a scene that tormagctl scene check takes, as each of tormagctl scene list; rates stay: state [rates], or "
    "start with that scene"
)

log = logging.getLogger(__name__)


def reread(running: Config, read: Config) -> tuple[Config, list[str], list[str]]:
    """Return `running` with the keys in LIVE taken from `read`, those that changed, and those that await a restart."""
    timeout_ms, watchdog_ms = running.device.command_timeout_ms, read.realtime.watchdog_ms
    require(
        watchdog_ms > timeout_ms,
        "realtime.watchdog_ms",
        watchdog_ms,
        f"over device.command_timeout_ms = {timeout_ms:g}, which stays until a restart",
    )
    differing = [*_differing(msgspec.to_builtins(running), msgspec.to_builtins(read), "")]
    config = msgspec.structs.replace(
        running,
        sources=read.sources,
        realtime=msgspec.structs.replace(running.realtime, watchdog_ms=watchdog_ms),
    )
    taken = [key for key in differing if key.startswith(LIVE)]
    return config, taken, [key for key in differing if key not in taken]


def _differing(before: dict[str, Any], after: dict[str, Any], path: str) -> Iterator[str]:
    for name in sorted(before.keys() | after.keys()):
        old, new = before.get(name), after.get(name)
        if isinstance(old, dict) and isinstance(new, dict):
            yield from _differing(old, new, f"{path}{name}.")
        elif old != new:
            yield f"{path}{name}"


Made: TypeAlias = tuple[Config, Core | None, str, str]
"""What a device is to run by: configuration, core (None if the running one fits), the calibration's file, and why none
is used."""


class Calibrations:
    """Puts the calibration of each connected device into force, from `folder` if there is one."""

    def __init__(self, folder: Path | None, configured: Config, take: Callable[[Config, Core], None]) -> None:
        self.configured = configured
        self._folder, self._take = folder, take
        self._of: int | None = None
        self._making: tuple[tuple[int, Config, Config], asyncio.Future[Made]] | None = None
        self._file = self._refusal = ""

    def is_awaited(self, serial_number: int | None) -> bool:
        """Tell whether this device must wait for its calibration."""
        return self._folder is not None and serial_number not in (None, self._of)

    def look(self, serial_number: int | None, running: Config, *, is_idle: bool) -> None:
        """Bring the device's calibration into force, step by step, while it `is_idle`."""
        if not is_idle or serial_number is None or self._folder is None or serial_number == self._of:
            return
        # the scene may have changed while the device was away
        sought = serial_number, self.configured, running
        if self._making is None or self._making[0] != sought:
            path = self._folder / f"{serial_number:08x}.toml"
            work = asyncio.get_running_loop().run_in_executor(
                None, _make, path, serial_number, self.configured, running
            )
            self._making = sought, work
        elif self._making[1].done():
            self._note(serial_number, self._making[1])

    def read_again(self) -> None:
        self._of = self._making = None

    def report(self) -> CalibrationReport:
        return CalibrationReport(file=self._file, refusal=self._refusal, folder=str(self._folder or ""))

    def _note(self, serial_number: int, making: "asyncio.Future[Made]") -> None:
        refusal_before = self._refusal
        try:
            config, core, file, refusal = making.result()
        except ConfigError as error:
            self._refusal = f"the scene does not run without the last device's calibration: {error}"
        else:
            self._of, self._making, self._file, self._refusal = serial_number, None, file, refusal
            if core is not None:
                self._take(config, core)
            if file:
                log.info("the device's calibration is in force: %s", file)
        if self._refusal and self._refusal != refusal_before:
            log.warning("the device's calibration is not used: %s; next: tormagctl commission", self._refusal)


def _make(path: Path, serial_number: int, configured: Config, running: Config) -> Made:
    try:
        config = load_calibration(path, configured, serial_number)
    except ConfigError as error:
        refusal = "" if isinstance(error.__cause__, FileNotFoundError) else str(error)
    else:
        try:
            return config, None if config == running else build_core(config), str(path), ""
        except ConfigError as error:
            refusal = f"{path}: {error}"
    return configured, None if configured == running else build_core(configured), "", refusal


class SceneChange:
    """Changes the running scene, one change at a time; `newest` reports on the newest change."""

    def __init__(
        self, build: Callable[[str], Awaitable[Core]], require: Callable[[], None], take: Callable[[str, Core], None]
    ) -> None:
        self._build, self._require, self._take = build, require, take
        self.newest: SceneReport | None = None
        self._changing: asyncio.Task[None] | None = None

    def begin(self, scene: object) -> None:
        if not isinstance(scene, str) or not 0 < len(scene) <= LONGEST_NAME:
            raise RefusedError(
                "bad_scene", f"args.scene is no text of 1..{LONGEST_NAME} characters", "tormagctl scene list"
            )
        if self._changing is not None and not self._changing.done():
            raise RefusedError("busy", "another scene is being made ready", "tormagctl status")
        self._require()
        self.newest = SceneReport(scene=scene, is_over=False)
        self._changing = asyncio.get_running_loop().create_task(self._change(scene))

    async def _change(self, scene: str) -> None:
        error = None
        try:
            core = await self._build(scene)
            self._require()
            self._take(scene, core)
        except ConfigError as refused:
            error = Explained("bad_scene", str(refused), NEXT)
        except RefusedError as refused:
            error = Explained(refused.code, refused.message, refused.hint)
        except Exception as unexpected:  # who asked is answered, whatever it was
            log.exception("another scene failed: report the trace")
            error = Explained("failed", f"{type(unexpected).__name__}: {unexpected}", "report the trace in its log")
        if error is None:
            log.info("the scene is now %s", scene)
        else:
            log.warning("the scene stays as it was: %s; next: %s", error.cause, error.remedy)
        self.newest = SceneReport(scene=scene, is_over=True, error=error)
