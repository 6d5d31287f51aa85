"""A connection that lasts: it opens the port, watches it, and opens it again after a loss. It never re-arms anything.

CLOSED --> IDENTIFYING <--> UNANSWERED             the port is opened: --> IDENTIFYING
             |     ^                               the port fails, or a running device falls silent: --> LOST
             v     | reset, replaced               the port is opened again, in vain: --> BACK_OFF
          RUNNING, REFUSED
"""

import logging
from collections.abc import Callable
from typing import Any

from firmware_protocol.codec import PROTOCOL_VERSION, SCHEMA_HASH, DriveMode, Message
from tormagd.config import Device
from tormagd.ground.plain_values import Kinds, plain, restore
from tormagd.hardware.backend import Backend, BackendError, Sent
from tormagd.hardware.link import RUNNING, DeviceLink, LinkState
from tormagd.hardware.measurement import DeviceRequest, Measurement
from tormagd_client.messages import ClockReport, LinkReport

FIRST_BACK_OFF_S = 0.05
LONGEST_BACK_OFF_S = 1.0
COUNTERS = ("frames", "bytes", "corrupt", "lost", "repeated", "resynchronisations", "unsent")

_REMEDIES = {
    LinkState.BACK_OFF: "check cable, supply, device.port and who holds it (tormagctl ports); it is tried again",
    LinkState.UNANSWERED: "make sure that it is the device, is on, and has the configured rate; it is asked again",
    LinkState.REFUSED: "install firmware and daemon of the same protocol schema",
    LinkState.LOST: "check cable and supply; it is tried again",
}

_REMEDY_OF_HOST = "run `tormagctl doctor`; look for load on this machine; it is tried again"

READ, WROTE, CONNECTED = "read", "wrote", "connected"
"""What `traffic` hears: `READ, now_s, raw`; the frames of one period as `WROTE, now_s, raw, unsent`, which counts all
messages that the wire has not taken at once; `CONNECTED, memory` of a conversation that begins, None where it ends."""

log = logging.getLogger(__name__)


class Connection:
    """The connection to one device, over as many openings of its port as it takes."""

    def __init__(
        self,
        device: Device,
        open_backend: Callable[[], Backend],
        on_loss: Callable[[], None],
        host: Callable[[float], str] = lambda now_s: "",
    ) -> None:
        self._device, self._open_backend, self._on_loss, self._host = device, open_backend, on_loss, host
        self._backend: Backend | None = None
        self._link: DeviceLink | None = None
        self._waiting = LinkState.CLOSED
        self._cause, self._remedy = "not opened yet", ""
        self._back_off_s, self._reopen_s, self._requested = FIRST_BACK_OFF_S, 0.0, 0
        self._unfinished = DeviceRequest.NONE
        self._seen = LinkState.CLOSED
        self.losses, self._last_loss = 0, ""
        self.traffic: Callable[..., None] = lambda *what: None
        "Hears what passes between daemon and device: the black box's journal."

    @property
    def state(self) -> LinkState:
        return self._waiting if self._link is None else self._link.state

    @property
    def cause(self) -> str:
        """Why the device does not run, or what a measurement still lacks."""
        link, backend = self._link, self._backend
        if link is None or backend is None:
            return self._cause
        heard = backend.stream.statistics
        if link.state is RUNNING:
            return link.missing(heard.refused)
        if link.state is not LinkState.UNANSWERED:
            return link.cause
        refusals = ", ".join([f"{name}: {why}" for name, why in sorted(heard.refused.items())])
        refused = f" ({refusals})" if refusals else ""
        if heard.frames:
            return f"{link.cause}, though it sends messages{refused}"
        return f"{link.cause}; " + (f"what it sends is not this protocol{refused}" if heard.corrupt else "it is silent")

    @property
    def remedy(self) -> str:
        if self.state is RUNNING:
            return self.cause and "wait a moment; if it stays, look at what the firmware sends, and at its CRC-8"
        return self._remedy or _REMEDIES.get(self.state, "")

    @property
    def serial_number(self) -> int | None:
        identity = None if self._link is None else self._link.identity
        return None if identity is None else identity.serial_number

    @property
    def measurement(self) -> Measurement | None:
        return self._link.measurement if self._link is not None and self._link.state is RUNNING else None

    @property
    def pending(self) -> DeviceRequest:
        return self._unfinished if self._link is None else self._link.pending

    def open(self, now_s: float) -> None:
        """Open the port and repeat an unfinished RETRACT; on failure, log it once and go to BACK_OFF."""
        try:
            self._backend = self._open_backend()
        except BackendError as error:
            # only the first failure is news
            log.log(logging.WARNING if str(error) != self._cause else logging.DEBUG, "%s", error)
            self._wait(now_s, LinkState.BACK_OFF, str(error), error.remedy)
            return
        self._remedy, self._link = "", DeviceLink(now_s)
        if self._unfinished is DeviceRequest.RETRACT:
            self._link.request(now_s, self._unfinished)
        self._unfinished = DeviceRequest.NONE
        self.traffic(CONNECTED, self.memory())
        log.info("%s is open", self._device.port)
        self._notice()

    def receive(self, now_s: float) -> None:
        """Hand what the device has sent to `traffic`, undecoded, and to the conversation."""
        backend, link = self._backend, self._link
        if backend is None or link is None:
            return
        try:
            messages = backend.receive()
        except BackendError as error:
            self._lose(now_s, str(error), error.remedy)
            return
        if backend.stream.received:
            self.traffic(READ, now_s, backend.stream.received)
        for message in messages:
            link.receive(now_s, message)
            self._notice()

    def exchange(
        self, now_s: float, left_duty: float, right_duty: float, mode: DriveMode, request: DeviceRequest, number: int
    ) -> None:
        """Send this period's Drive to a running device, then the Hello or command that is due."""
        if self._link is None and self._waiting is not LinkState.CLOSED and now_s >= self._reopen_s:
            self.open(now_s)
        link, backend = self._link, self._backend
        if link is None or backend is None:
            return
        if number != self._requested:
            self._requested = number
            # opening the gap waits for a device; no other request may move one that has come since
            if request is DeviceRequest.RETRACT or link.state is RUNNING:
                link.request(now_s, request)
        sent: list[Sent] = []
        try:
            if link.state is RUNNING:
                sent.append(_sent(backend, link.drive(left_duty, right_duty, mode)))
            sent += [_sent(backend, message) for message in link.due(now_s)]
        except BackendError as error:
            self._lose(now_s, str(error), error.remedy)
            return
        heard = backend.stream.statistics
        self.traffic(WROTE, now_s, sent, heard.unsent)
        link.judge(now_s, heard.frames, heard.corrupt, heard.unsent)
        if link.state is LinkState.LOST:
            host = self._host(now_s)
            self._lose(now_s, "; ".join(filter(None, (link.cause, host))), host and _REMEDY_OF_HOST)
        else:
            self._notice()

    def close(self) -> None:
        self._release()
        self._waiting, self._cause, self._remedy, self._seen = LinkState.CLOSED, "closed", "", LinkState.CLOSED

    def memory(self) -> Any:
        """Return the conversation's state as plain data, from which `remember` continues it elsewhere."""
        if self._link is None or self._backend is None:
            return None
        return {"requested": self._requested, "link": plain(self._link), "stream": plain(self._backend.stream)}

    def remember(self, memory: Any, known: Kinds) -> None:
        self._requested = memory["requested"]
        assert self._backend is not None, "it has just been opened"
        restore(self._link, memory["link"], known)
        restore(self._backend.stream, memory["stream"], known)
        self._seen = self.state

    def report(self) -> LinkReport:
        link, backend = self._link, self._backend
        identity = None if link is None else link.identity
        statistics = None if backend is None else backend.stream.statistics
        counted = {name: getattr(statistics, name, None) for name in COUNTERS}
        if link is not None and counted["repeated"] is not None:
            counted["repeated"] += link.repeated  # a repetition is counted by whoever drops it
        return LinkReport(
            state=str(self.state),
            cause=self.cause,
            remedy=self.remedy,
            backend=self._device.backend,
            port=self._device.port,
            losses=self.losses,
            last_loss=self._last_loss,
            firmware=None if identity is None else f"{identity.firmware_major}.{identity.firmware_minor}",
            serial_number=None if identity is None else identity.serial_number,
            firmware_schema=None if identity is None else f"{identity.schema_hash:08x}",
            daemon_schema=f"{SCHEMA_HASH:08x}",
            protocol_version=PROTOCOL_VERSION,
            **counted,
            round_trip_us=None if link is None else link.round_trip.report(),
            # a State is on its way for about half of the shortest round trip
            clock=None if link is None else clock_report(link.clock.fit(), link.round_trip.least_s / 2.0),
            refused={} if statistics is None else dict(statistics.refused),
            unanswered_share=None if link is None or link.measurement is None else round(link.quality.unanswered, 4),
            damaged_share=None if link is None or link.measurement is None else round(link.quality.damaged, 4),
        )

    def _lose(self, now_s: float, cause: str, remedy: str) -> None:
        """End the conversation as lost for `cause`, close the port, and wait in LOST until it is opened again."""
        self._unfinished = self.pending
        self._release()
        self._wait(now_s, LinkState.LOST, cause, remedy)

    def _release(self) -> None:
        if self._backend is not None:
            self._backend.close()
            self.traffic(CONNECTED, None)
        self._backend = self._link = None

    def _wait(self, now_s: float, state: LinkState, cause: str, remedy: str) -> None:
        """Wait in `state` before the port is opened again, twice as long each time, to LONGEST_BACK_OFF_S; tell it."""
        self._waiting, self._cause, self._remedy = state, cause, remedy
        self._reopen_s = now_s + self._back_off_s
        self._back_off_s = min(2.0 * self._back_off_s, LONGEST_BACK_OFF_S)
        self._notice()

    def _notice(self) -> None:
        before, state = self._seen, self.state
        if state is before:
            return
        self._seen = state
        if state is RUNNING:
            self._back_off_s = FIRST_BACK_OFF_S
            log.info("the device on %s runs", self._device.port)
        elif before is RUNNING:
            self.losses += 1
            self._last_loss = self.cause
            log.warning("the link to %s is lost: %s; next: %s", self._device.port, self.cause, self.remedy)
            self._on_loss()
        elif state in (LinkState.REFUSED, LinkState.UNANSWERED):
            log.warning("%s: %s; next: %s", self._device.port, self.cause, self.remedy)


def _sent(backend: Backend, message: Message) -> Sent:
    backend.send(message)
    return backend.stream.sent


def clock_report(fit: ClockReport | None, way_s: float = 0.0) -> ClockReport | None:
    if fit is None:
        return None
    return ClockReport(
        offset_s=round(fit.offset_s - way_s, 6),
        drift_ppm=round(fit.drift_ppm, 2),
        residual_us=round(fit.residual_us, 1),
        windows=fit.windows,
        outliers=fit.outliers,
    )
