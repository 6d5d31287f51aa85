"""The calibration of the connected device: it is read by serial number."""

import asyncio
import logging
from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias

from tormagd.config import Config, load_calibration
from tormagd.control.assembly.build import Core, build_core
from tormagd_client.endpoints import ConfigError
from tormagd_client.messages import CalibrationReport

log = logging.getLogger(__name__)


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
