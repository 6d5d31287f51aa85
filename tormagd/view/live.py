"""The daemon as it is now: one subscriber, however many browsers look."""

import asyncio
import contextlib
import itertools
import time
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from typing import Any, ClassVar

import msgspec

from tormagd.view.believed import as_said
from tormagd.view.frame import DRIVEN, Frame, Held, late_counts
from tormagd_client.aio import AsyncClient
from tormagd_client.errors import ClientError
from tormagd_client.messages import Description, Explained, MessageError, Status, Telemetry
from tormagd_client.printable import printable

FRAME_S = 0.1
STATUS_S = 1.0
PORTRAIT_EVERY = 10
"The portrait changes slowly, so only every tenth status poll asks for it."
SILENT_S = 0.5
KEPT = 1_000
"Snapshots of `frame.SHOWN_S`."
WAITING = 50
"Events that may wait for one browser, which then misses the oldest."


class Live:
    """Listens to one daemon and sends every browser the same events; `run` must run beside the browsers."""

    about: ClassVar[dict[str, Any]] = {"kind": "live"}

    def __init__(self, client: AsyncClient, status: Status, description: Description) -> None:
        self._client, self._status = client, status
        self._kept: deque[Telemetry] = deque(maxlen=KEPT)
        self._new: list[Telemetry] = []
        self.browsers: set[asyncio.Queue[str]] = set()
        self._explained: dict[str, dict[str, Explained]] = {"limits": {}, "faults": {}}
        self._heard_s = time.monotonic()
        self._why_silent = ""
        self._portrait = description.portrait
        self._learn(status)

    async def run(self) -> None:
        """Listen and publish without end; wait for a daemon that is gone."""
        async with asyncio.TaskGroup() as tasks:
            for each in (self._listen(), self._tell(), self._ask()):
                tasks.create_task(each)

    @contextlib.contextmanager
    def browser(self) -> Iterator[asyncio.Queue[str]]:
        """Add a browser for this context, and give the queue of its events."""
        events: asyncio.Queue[str] = asyncio.Queue(WAITING)
        if self._kept:
            events.put_nowait(event("frame", self._frame(self._kept)))
        events.put_nowait(event("status", self._status))
        events.put_nowait(event("explained", self._explained))
        events.put_nowait(event("portrait", self._portrait))
        self.browsers.add(events)
        try:
            yield events
        finally:
            self.browsers.discard(events)

    async def _listen(self) -> None:
        """Keep each snapshot; after one that cannot be decoded listen anew."""
        while True:
            try:
                async for snapshot in self._client.telemetry():
                    self._heard_s, self._why_silent = time.monotonic(), ""
                    self._kept.append(snapshot)
                    self._new.append(snapshot)
            except MessageError as error:
                self._why_silent = f"what comes is not understood: {printable(str(error))}"

    async def _tell(self) -> None:
        while True:
            await asyncio.sleep(FRAME_S)
            silent_s = time.monotonic() - self._heard_s
            if self._new:
                self._publish("frame", self._frame(self._new))
                self._new.clear()
            elif silent_s > SILENT_S:
                self._publish("silence", {"seconds": round(silent_s, 1), "why": self._why_silent})

    async def _ask(self) -> None:
        for number in itertools.count(1):
            await asyncio.sleep(STATUS_S)
            if time.monotonic() - self._heard_s < SILENT_S:
                with contextlib.suppress(ClientError):  # the page says that nothing is heard
                    self._status = await self._client.status()
                    self._learn(self._status)
                    self._publish("status", self._status)
                    self._publish("explained", self._explained)
                    if number % PORTRAIT_EVERY == 0:
                        self._portrait = (await self._client.describe()).portrait
                        self._publish("portrait", self._portrait)

    def _publish(self, name: str, value: object) -> None:
        data = event(name, value)
        for events in self.browsers:
            if events.full():
                events.get_nowait()
            events.put_nowait(data)

    def _learn(self, status: Status) -> None:
        self._explained["limits"] |= {each.code: each for each in status.limit_details}
        self._explained["faults"] |= {each.code: each for each in status.fault_details}

    def _frame(self, snapshots: Sequence[Telemetry]) -> Frame:
        newest, kept = snapshots[-1], self._kept
        times = Counter(code for each in kept for code in each.limits)
        return Frame(
            t_s=[each.t_ns * 1e-9 for each in snapshots],
            asked_N=[each.setpoint_cf for each in snapshots],
            governed_N=[each.governed_cf for each in snapshots],
            measured_N=[each.measured_cf for each in snapshots],
            gap_mm=[each.gap_mm for each in snapshots],
            gap_wanted_mm=[each.gap_setpoint_mm for each in snapshots],
            field_mT=[each.field_mT if each.operating_state in DRIVEN else None for each in snapshots],
            operating_state=newest.operating_state,
            held=[Held(code, count / len(kept), code in newest.limits) for code, count in times.most_common()],
            faults=newest.faults,
            believed=as_said(newest.belief),
            late_counts=late_counts(each.tick.lateness_us for each in kept),
        )


def event(name: str, value: object) -> str:
    """Return an event as JSON, by its name; NaN becomes null."""
    return msgspec.json.encode({name: value}).decode()
