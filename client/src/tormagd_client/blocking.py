"""The blocking client: its calls return when they are done."""

import contextlib
import math
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Any, Self

import zmq

from tormagd_client.endpoints import Endpoints
from tormagd_client.errors import ClientError, RefusedError
from tormagd_client.messages import (
    MOTION_TOPIC,
    TELEMETRY_TOPIC,
    VERDICT_TOPIC,
    ArmReport,
    Description,
    Motion,
    Status,
    Telemetry,
    Verdict,
    decode,
)
from tormagd_client.wire import (
    SUBSCRIBED,
    Connections,
    Pending,
    Told,
    answered,
    arm_report,
    armed,
    asked,
    understood,
)

RETRY_S = 0.1


class Client(Connections["zmq.Socket[bytes]"]):
    """Blocking client of the daemon at `endpoints`: commands, setpoints, telemetry. Several threads may command and
    publish; one may read a topic.
    """

    _made = zmq.Context

    def __init__(self, endpoints: Endpoints, wait_s: float = 1.0, source: str = "client") -> None:
        super().__init__(endpoints, wait_s, source)
        self._commanding, self._publishing = threading.Lock(), threading.Lock()

    def request(self, command: str, **args: Any) -> dict[str, Any]:
        """Give `command` and return its result.

        Raises UnreachableError without an answer in time, RefusedError, InFaultError.
        """
        return self._result(command, args, self._wait_s)

    def ask(self, command: str, **args: Any) -> Pending:
        """Send `command` without waiting, and return what `answer` takes."""
        pending = Pending(next(self._ids), command)
        # a daemon that refused the key is no peer of the socket, and sending would block for ever
        with contextlib.suppress(zmq.Again):
            self._socket(zmq.DEALER, self._endpoints.control).send(asked(pending, args), zmq.NOBLOCK)
        return pending

    def answer(self, pending: Pending, wait_s: float = 0.0) -> dict[str, Any] | None:
        """Return the result of an asked command, or None without an answer within `wait_s`. Raises RefusedError,
        InFaultError, and UnreachableError for an answer that is not understood.
        """
        deadline_s = time.monotonic() + wait_s
        left_s = wait_s
        control = self._socket(zmq.DEALER, self._endpoints.control)
        while left_s >= 0.0 and control.poll(round(left_s * 1e3)):
            result = answered(control.recv_multipart()[-1], pending)
            if result is not None:
                return result
            left_s = deadline_s - time.monotonic()  # a late answer to a request that was given up
        return None

    def status(self, wait_s: float = math.inf) -> Status:
        """Return what the daemon is doing, waiting at most `wait_s`. Raises as `request`."""
        return understood(self._result("status", {}, min(wait_s, self._wait_s)), Status)

    def describe(self) -> Description:
        """Return what the daemon runs: configuration, scene, model, device. Raises as `request`."""
        return understood(self.request("describe"), Description)

    def arm(self, timeout_s: float = 30.0, told: Callable[[str], object] = lambda command: None) -> tuple[str, ...]:
        """Have the daemon clear, home and enable, as far as needed, and return the commands given. Warn whoever holds
        the handle before. Raises as `request`, and RefusedError if arming failed.
        """
        until_s, report = time.monotonic() + timeout_s, ArmReport(given=(), is_over=False)
        try:
            self.request("arm")
            while not report.is_over:
                if time.monotonic() > until_s:
                    raise RefusedError("arm", "timeout", f"not armed within {timeout_s:g} s", "tormagctl status")
                before, report = report, arm_report(self.request("status"))
                for command in report.given[len(before.given) :]:
                    told(command)
                time.sleep(0.0 if report.is_over else RETRY_S)
        finally:
            if not report.is_over:
                with contextlib.suppress(ClientError):
                    self.request("disable")
        return armed(report)

    def publish(self, force_N: float, valid_for_ms: float = 100.0, stamp_ns: int | None = None, **fields: Any) -> None:
        """Ask for a force at the roller, N, meant at `stamp_ns`, CLOCK_REALTIME (None: now), and valid for
        `valid_for_ms`.

        Raises ValueError for a value that is not allowed, TypeError for an unknown field, and UnreachableError if
        nobody takes setpoints within `wait_s`.
        """
        with self._publishing:
            self.require_taken().send(self._numbering.setpoint(force_N, valid_for_ms, stamp_ns, **fields))

    def require_taken(self) -> "zmq.Socket[bytes]":
        """Wait until the daemon takes setpoints, and return the socket for them. Raises UnreachableError."""
        # XPUB speaks to SUB as PUB does, and hears of the subscription: before it, setpoints would be lost
        setpoints = self._socket(zmq.XPUB, self._endpoints.setpoint)
        while setpoints.poll(0 if self._is_taken else round(self._wait_s * 1e3)):
            self._is_taken = setpoints.recv().startswith(SUBSCRIBED)
        if not self._is_taken:
            raise self._untaken()
        return setpoints

    def telemetry(self, wait_s: float = 0.0) -> list[Telemetry]:
        """Return the telemetry since the last call, oldest first; wait up to `wait_s` for the first message. Of more
        than 1,000 that wait the newest are lost: call it every second. Raises MessageError for an invalid one.
        """
        return self._arrived(TELEMETRY_TOPIC, Telemetry, wait_s)

    def motions(self, wait_s: float = 0.0) -> list[Motion]:
        """Return the handle's motions since the last call, `rates.motion_hz` a second; as `telemetry`."""
        return self._arrived(MOTION_TOPIC, Motion, wait_s)

    def verdicts(self, wait_s: float = 0.0) -> list[Verdict]:
        """Return what became of setpoints since the last call, whoever sent them; as `telemetry`."""
        return self._arrived(VERDICT_TOPIC, Verdict, wait_s)

    def _arrived(self, topic: bytes, kind: type[Told], wait_s: float) -> list[Told]:
        socket = self._socket(zmq.SUB, self._endpoints.telemetry, topic)
        arrived: list[Told] = []
        while socket.poll(0 if arrived else round(wait_s * 1e3)):
            arrived.append(decode(socket.recv_multipart()[-1], kind))
        return arrived

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def _result(self, command: str, args: dict[str, Any], wait_s: float) -> dict[str, Any]:
        with self._commanding:
            result = self.answer(self.ask(command, **args), wait_s)
        if result is None:
            raise self._unanswered(wait_s)
        return result
