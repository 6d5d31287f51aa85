"""The client of `tormagd_client.blocking` for asyncio: other tasks run while a call waits."""

import asyncio
import contextlib
import math
from collections.abc import AsyncIterator, Callable
from types import TracebackType
from typing import Any, Self

import zmq
import zmq.asyncio

from tormagd_client.blocking import RETRY_S
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


class AsyncClient(Connections[zmq.asyncio.Socket]):
    """Asyncio client of the daemon at `endpoints`, with the calls and errors of `blocking.Client`."""

    _made = zmq.asyncio.Context

    def __init__(self, endpoints: Endpoints, wait_s: float = 1.0, source: str = "client") -> None:
        super().__init__(endpoints, wait_s, source)
        self._turn, self._publishing = asyncio.Lock(), asyncio.Lock()

    async def request(self, command: str, **args: Any) -> dict[str, Any]:
        """Give `command` and return its result; requests of several tasks wait for each other.

        Raises UnreachableError without an answer in time, RefusedError, InFaultError.
        """
        return await self._result(command, args, self._wait_s)

    async def status(self, wait_s: float = math.inf) -> Status:
        """Return what the daemon is doing, waiting at most `wait_s`. Raises as `request`."""
        return understood(await self._result("status", {}, min(wait_s, self._wait_s)), Status)

    async def describe(self) -> Description:
        """Return what the daemon runs: configuration, scene, model, device. Raises as `request`."""
        return understood(await self.request("describe"), Description)

    async def arm(
        self, timeout_s: float = 30.0, told: Callable[[str], object] = lambda command: None
    ) -> tuple[str, ...]:
        """Have the daemon clear, home and enable, as far as needed, and return the commands given. Warn whoever holds
        the handle before. Raises as `request`, and RefusedError if arming failed.
        """
        until_s, report = asyncio.get_running_loop().time() + timeout_s, ArmReport(given=(), is_over=False)
        try:
            await self.request("arm")
            while not report.is_over:
                if asyncio.get_running_loop().time() > until_s:
                    raise RefusedError("arm", "timeout", f"not armed within {timeout_s:g} s", "tormagctl status")
                before, report = report, arm_report(await self.request("status"))
                for command in report.given[len(before.given) :]:
                    told(command)
                await asyncio.sleep(0.0 if report.is_over else RETRY_S)
        finally:
            if not report.is_over:
                with contextlib.suppress(ClientError):
                    await self.request("disable")
        return armed(report)

    async def publish(
        self, force_N: float, valid_for_ms: float = 100.0, stamp_ns: int | None = None, **fields: Any
    ) -> None:
        """Ask for a force at the roller, as `blocking.Client.publish` does."""
        async with self._publishing:
            setpoints = self._socket(zmq.XPUB, self._endpoints.setpoint)
            while await setpoints.poll(0 if self._is_taken else round(self._wait_s * 1e3)):
                self._is_taken = (await setpoints.recv()).startswith(SUBSCRIBED)
            if not self._is_taken:
                raise self._untaken()
            await setpoints.send(self._numbering.setpoint(force_N, valid_for_ms, stamp_ns, **fields))

    def telemetry(self) -> AsyncIterator[Telemetry]:
        """Yield every telemetry message from now on. Raises MessageError for an invalid one."""
        return self._heard(TELEMETRY_TOPIC, Telemetry)

    def motions(self) -> AsyncIterator[Motion]:
        """Yield the handle's motion, `rates.motion_hz` times a second. Raises as `telemetry`."""
        return self._heard(MOTION_TOPIC, Motion)

    def verdicts(self) -> AsyncIterator[Verdict]:
        """Yield what becomes of every setpoint, whoever sent it. Raises as `telemetry`."""
        return self._heard(VERDICT_TOPIC, Verdict)

    async def _heard(self, topic: bytes, kind: type[Told]) -> AsyncIterator[Told]:
        with self._socket(zmq.SUB, self._endpoints.telemetry, topic) as socket:
            # each hears all, and nothing old waits for the next
            del self._sockets[zmq.SUB, topic]
            while True:
                yield decode((await socket.recv_multipart())[-1], kind)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    async def _result(self, command: str, args: dict[str, Any], wait_s: float) -> dict[str, Any]:
        async with self._turn:
            control, pending = self._socket(zmq.DEALER, self._endpoints.control), Pending(next(self._ids), command)
            try:
                async with asyncio.timeout(wait_s):
                    await control.send(asked(pending, args))
                    while True:
                        result = answered((await control.recv_multipart())[-1], pending)
                        if result is not None:
                            return result
            except TimeoutError as error:
                raise self._unanswered(wait_s) from error
