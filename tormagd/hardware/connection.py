"""Keeps a device connected: opens the port, watches it, and opens it again after a loss. Never re-arms anything."""

import asyncio
import logging
import time
from collections.abc import Callable
from typing import Any

from firmware_protocol.codec import DriveMode
from tormagd.config import Device
from tormagd.hardware.backend import Backend, BackendError
from tormagd.hardware.link import DeviceLink, LinkState
from tormagd.hardware.measurement import Measurement
from tormagd.safety.operating_state import DeviceRequest

FIRST_BACK_OFF_S = 0.05
LONGEST_BACK_OFF_S = 1.0

_REMEDIES = {
    LinkState.CLOSED: "check cable, supply, device.port and its holder (tormagctl doctor); it is tried again",
    LinkState.IDENTIFYING: "is this the device, and is device.baud its rate?",
    LinkState.REFUSED: "install firmware and daemon of the same protocol schema",
    LinkState.LOST: "check cable and supply; it is tried again",
}

log = logging.getLogger(__name__)


class Connection:
    """One device, however often its cable is pulled. States are those of the link, CLOSED while no port is open."""

    def __init__(self, device: Device, open_backend: Callable[[Device], Backend], on_loss: Callable[[], None]) -> None:
        self._device, self._open_backend, self._on_loss = device, open_backend, on_loss
        self._backend: Backend | None = None
        self._link: DeviceLink | None = None
        self._back_off_s = FIRST_BACK_OFF_S
        self._cause = "not opened yet"
        self._is_closing = False
        self._requested = 0
        self._reopening: asyncio.TimerHandle | None = None
        self.losses = 0

    @property
    def state(self) -> LinkState:
        """Where the conversation with the device stands."""
        return LinkState.CLOSED if self._link is None else self._link.state

    @property
    def measurement(self) -> Measurement | None:
        """The newest measurement while the link runs."""
        return self._link.measurement if self._link is not None and self._link.state is LinkState.RUNNING else None

    def open(self) -> None:
        """Opens the port, now or as soon as it can be."""
        self._reopening = None
        try:
            self._backend = self._open_backend(self._device)
        except BackendError as error:
            # the first failure is news, the same one again is not
            log.log(logging.WARNING if str(error) != self._cause else logging.DEBUG, "%s", error)
            self._cause = str(error)
            self._open_later()
            return
        self._link = DeviceLink(time.monotonic())
        asyncio.get_running_loop().add_reader(self._backend.fileno(), self._receive)
        log.info("%s is open", self._device.port)

    def exchange(
        self, now_s: float, left_duty: float, right_duty: float, mode: DriveMode, request: DeviceRequest, number: int
    ) -> None:
        """Sends one drive message, and whatever handshake or request is due."""
        link, backend = self._link, self._backend
        if link is None or backend is None:
            return
        if number != self._requested:
            self._requested = number
            link.request(now_s, request)
        due = link.due(now_s)
        if link.state is LinkState.LOST:
            self._lose(link.cause)
            return
        try:
            if link.state is LinkState.RUNNING:
                backend.send(link.drive(left_duty, right_duty, mode))
            for message in due:
                backend.send(message)
        except BackendError as error:
            self._lose(str(error))

    def close(self) -> None:
        """Closes the port for good."""
        self._is_closing = True
        if self._reopening is not None:
            self._reopening.cancel()
        self._give_back()

    def report(self) -> dict[str, Any]:
        """State, cause and remedy, identity and counters."""
        report: dict[str, Any] = {
            "state": str(self.state),
            "cause": self._cause if self._link is None else self._link.cause,
            "remedy": _REMEDIES.get(self.state, ""),
            "port": self._device.port,
            "losses": self.losses,
        }
        if self._link is not None and self._link.identity is not None:
            identity = self._link.identity
            report["firmware"] = f"{identity.firmware_major}.{identity.firmware_minor}"
            report["serial_number"] = identity.serial_number
        if self._backend is not None:
            counted = self._backend.statistics
            for name in ("frames", "bytes", "corrupt", "lost", "repeated", "resynchronisations"):
                report[name] = getattr(counted, name)
        return report

    def _receive(self) -> None:
        backend, link = self._backend, self._link
        if backend is None or link is None:
            return
        try:
            messages = backend.receive()
        except BackendError as error:
            self._lose(str(error))
            return
        now_s = time.monotonic()
        for message in messages:
            link.receive(now_s, message)
        if link.state is LinkState.RUNNING:
            self._back_off_s = FIRST_BACK_OFF_S

    def _lose(self, cause: str) -> None:
        log.warning("link lost: %s", cause)
        self._cause = cause
        self.losses += 1
        self._give_back()
        self._on_loss()
        self._open_later()

    def _give_back(self) -> None:
        if self._backend is not None:
            asyncio.get_running_loop().remove_reader(self._backend.fileno())
            self._backend.close()
        self._backend = self._link = None

    def _open_later(self) -> None:
        if self._is_closing:
            return
        self._reopening = asyncio.get_running_loop().call_later(self._back_off_s, self.open)
        self._back_off_s = min(2.0 * self._back_off_s, LONGEST_BACK_OFF_S)
