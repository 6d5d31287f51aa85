"""A headless Chromium, told what to do over its debugging protocol."""

import asyncio
import base64
import itertools
import shutil
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from aiohttp import ClientSession, ClientWebSocketResponse

CHROMIUM = next(
    (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), ""
)
OPTIONS = ("--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--hide-scrollbars")
PHONE = 600
"A narrower window is a phone's."


class Page:
    """One page. `complaints` are its errors, and what its content policy has refused."""

    def __init__(self, socket: ClientWebSocketResponse) -> None:
        self._socket, self._ids = socket, itertools.count(1)
        self.complaints: list[str] = []

    async def tell(self, method: str, **parameters: Any) -> dict[str, Any]:
        """The result of a command of the protocol."""
        number = next(self._ids)
        await self._socket.send_json({"id": number, "method": method, "params": parameters})
        while True:
            said = await self._socket.receive_json()
            known = said.get("params", {})
            if "exceptionDetails" in known or known.get("entry", {}).get("level") == "error":
                self.complaints.append(str(known))
            if said.get("id") == number:
                if "error" in said:
                    raise RuntimeError(f"{method}: {said['error']}")
                result: dict[str, Any] = said["result"]
                return result

    async def open(self, address: str, width: int, height: int) -> None:
        """Goes to a page, in a window of this size."""
        for domain in ("Runtime", "Log", "Page"):
            await self.tell(f"{domain}.enable")
        await self.resize(width, height)
        await self.tell("Page.navigate", url=address)

    async def resize(self, width: int, height: int) -> None:
        """Gives the window another size."""
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < PHONE}
        await self.tell("Emulation.setDeviceMetricsOverride", **metrics)

    async def ask(self, expression: str) -> Any:
        """The value of a JavaScript expression."""
        said = await self.tell("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in said:
            raise RuntimeError(f"{expression}: {said['exceptionDetails']}")
        return said["result"].get("value")

    async def until(self, expression: str) -> None:
        """Waits for it to be true."""
        while not await self.ask(expression):
            await asyncio.sleep(0.05)

    async def picture(self, path: Path) -> None:
        """What the window shows, as PNG."""
        said = await self.tell("Page.captureScreenshot")
        path.write_bytes(base64.b64decode(said["data"]))


@asynccontextmanager
async def browser(profile: Path) -> AsyncIterator[Page]:
    """A browser of its own, with its files in the folder `profile`; ends with it."""
    process = await asyncio.create_subprocess_exec(
        CHROMIUM,
        *OPTIONS,
        f"--user-data-dir={profile}",
        "--remote-debugging-port=0",
        "about:blank",
        stderr=asyncio.subprocess.PIPE,
    )
    try:
        assert process.stderr is not None  # a pipe
        async for line in process.stderr:
            if b"DevTools listening on ws://" in line:
                port = line.split(b":")[2].split(b"/")[0].decode()
                break
        async with ClientSession() as session:
            async with session.get(f"http://127.0.0.1:{port}/json") as answer:
                target = next(each for each in await answer.json() if each["type"] == "page")
            async with session.ws_connect(target["webSocketDebuggerUrl"], max_msg_size=1 << 26) as socket:
                yield Page(socket)
    finally:
        process.kill()
        await process.wait()
