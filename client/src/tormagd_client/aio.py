"""The same client for asyncio: other tasks run while a call waits."""

import asyncio
import math
from collections.abc import AsyncIterator
from types import TracebackType
from typing import Any, Self

import zmq
import zmq.asyncio

from tormagd_client.blocking import RETRY_S
from tormagd_client.endpoints import Endpoints
from tormagd_client.errors import RefusedError
from tormagd_client.messages import (
    MOTION_TOPIC,
    TELEMETRY_TOPIC,
    VERDICT_TOPIC,
    Description,
    Motion,
    Status,
    Telemetry,
    Verdict,
    decode,
)
from tormagd_client.wire import (
    NOT_YET,
    SUBSCRIBED,
    Connections,
    Told,
    answered,
    asked,
    understood,
)


class AsyncClient(Connections[zmq.asyncio.Socket]):
    """As `blocking.Client`, with the same arguments, results and errors; an asynchronous context manager.

    `ask` and `answer` are not needed here: a task may wait for a `request` while others run.
    """

    _made = zmq.asyncio.Context

    def __init__(self, endpoints: Endpoints, wait_s: float = 1.0, source: str = "client") -> None:
        super().__init__(endpoints, wait_s, source)
        self._turn = asyncio.Lock()

    async def request(self, command: str, **args: Any) -> dict[str, Any]:
        """The result of `command`; one after the other where several tasks ask."""
        return await self._result(command, args, self._wait_s)

    async def status(self, wait_s: float = math.inf) -> Status:
        """What the daemon is doing."""
        return understood(await self._result("status", {}, min(wait_s, self._wait_s)), Status)

    async def describe(self) -> Description:
        """What the daemon runs."""
        return understood(await self.request("describe"), Description)

    async def arm(self, timeout_s: float = 30.0) -> None:
        """Home both carriages and enable: whoever holds the handle has to know."""
        until_s = asyncio.get_running_loop().time() + timeout_s
        for command in ("home", "enable"):
            while True:
                try:
                    await self.request(command)
                    break
                except RefusedError as error:
                    if error.code not in NOT_YET or asyncio.get_running_loop().time() > until_s:
                        raise
                await asyncio.sleep(RETRY_S)

    async def publish(
        self, force_N: float, valid_for_ms: float = 100.0, stamp_ns: int | None = None, **fields: Any
    ) -> None:
        """Ask for a force at the roller; waits until the daemon takes setpoints."""
        setpoints = self._socket(zmq.XPUB, self._endpoints.setpoint)
        while await setpoints.poll(0 if self._is_taken else round(self._wait_s * 1e3)):
            self._is_taken = (await setpoints.recv()).startswith(SUBSCRIBED)
        if not self._is_taken:
            raise self._untaken()
        await setpoints.send(self._numbering.setpoint(force_N, valid_for_ms, stamp_ns, **fields))

    def telemetry(self) -> AsyncIterator[Telemetry]:
        """Every message from now on, without an end. Raises MessageError for what is none."""
        return self._heard(TELEMETRY_TOPIC, Telemetry)

    def motions(self) -> AsyncIterator[Motion]:
        """The handle's motion, `rates.motion_hz` times a second; as `telemetry`."""
        return self._heard(MOTION_TOPIC, Motion)

    def verdicts(self) -> AsyncIterator[Verdict]:
        """What becomes of every setpoint, whoever sent it; as `telemetry`."""
        return self._heard(VERDICT_TOPIC, Verdict)

    async def _heard(self, topic: bytes, kind: type[Told]) -> AsyncIterator[Told]:
        socket = self._listening(topic)
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
            control, pending = self._socket(zmq.DEALER, self._endpoints.control), self._pending(command)
            try:
                async with asyncio.timeout(wait_s):
                    await control.send(asked(pending, args))
                    while True:
                        result = answered((await control.recv_multipart())[-1], pending)
                        if result is not None:
                            return result
            except TimeoutError as error:
                raise self._unanswered(wait_s) from error
