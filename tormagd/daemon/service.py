"""What systemd is told: that the device is identified (ready), a status line, and that the daemon lives."""

import logging
import os
import socket
from collections.abc import Sequence

from tormagd.control.records import Plan
from tormagd.daemon.control_loop import ControlLoop
from tormagd.hardware.connection import Connection
from tormagd.hardware.link import LinkState

READY = "READY=1"
EXTENSION_S = 30.0
"Each notice of a daemon that is not ready yet gives it so much longer to start."
_NOT_THERE = frozenset({LinkState.CLOSED, LinkState.LOST, LinkState.BACK_OFF})
"Nothing answers behind a port that is not open, and a restart of the daemon would not help."

log = logging.getLogger(__name__)


class Service:
    def __init__(self) -> None:
        self.is_ready = False
        "Whether a device has been identified; from then on systemd's watchdog runs."
        self._heard_s, self._status = 0.0, ""

    def tell(
        self, now_s: float, limit_s: float, control: ControlLoop, plan: Plan, connection: Connection, scene: str
    ) -> None:
        """Tell systemd what is new."""
        safety, measurement, link = control.stepper.safety, connection.measurement, connection.state
        is_alive = self.is_alive(
            now_s,
            limit_s,
            plan.time_s if plan.number else None,
            link,
            None if measurement is None else measurement.received_s,
        )
        status = status_line(
            link,
            connection.cause,
            connection.remedy,
            str(safety.operating_state),
            control.is_homed(),
            [str(fault) for fault in safety.faults],
            scene,
        )
        for message in self.news(is_alive, link, status):
            if message == READY:
                log.info("ready: the device is identified; next: tormagctl arm")
            notify(message)

    def is_alive(
        self, now_s: float, limit_s: float, planned_s: float | None, link: LinkState, received_s: float | None
    ) -> bool:
        """Tell whether plans and device states are fresh, so that systemd's watchdog may be fed."""
        if planned_s is None or now_s - planned_s > limit_s:
            return False
        if link is LinkState.RUNNING:
            self._heard_s = self._heard_s if received_s is None else received_s
        elif not self.is_ready or link in _NOT_THERE or link is LinkState.REFUSED:
            self._heard_s = now_s
        return now_s - self._heard_s < limit_s

    def news(self, is_alive: bool, link: LinkState, status: str) -> list[str]:
        messages = []
        if not self.is_ready and link is LinkState.RUNNING:
            self.is_ready = True
            messages.append(READY)
        if status != self._status:
            self._status = status
            messages.append(f"STATUS={status}")
        if is_alive:
            messages.append("WATCHDOG=1")
            if not self.is_ready:
                messages.append(f"EXTEND_TIMEOUT_USEC={round(EXTENSION_S * 1e6)}")
        return messages


def status_line(
    link: LinkState, cause: str, remedy: str, state: str, is_homed: bool, faults: Sequence[str], scene: str
) -> str:
    told = f"{state}: {', '.join(faults)}" if faults else f"{state}, scene {scene}"
    if link is not LinkState.RUNNING:
        # texts of the device or the kernel may have several lines
        why = " ".join(f"{cause}; {remedy}".split())
        return f"{told}; waiting for the device ({link}): {why}"
    if faults:
        return f"{told}; next: tormagctl status"
    return told if is_homed else f"{told}; next: tormagctl arm"


def notify(message: str) -> bool:
    """Send `message`, lines of `NAME=value`, to the service manager, as sd_notify(3) does."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address:
        return False
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK) as sender:
        try:
            sender.sendto(message.encode(), "\0" + address[1:] if address.startswith("@") else address)
        except OSError:
            return False
    return True
