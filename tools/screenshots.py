"""The pictures of `tormagctl top` and `tormagctl dashboard` in the documentation.

    python tools/screenshots.py --config my.toml --page http://127.0.0.1:8733/

beside the daemon of `my.toml` and a `tormagctl dashboard`, live or of a recording. It takes a Chromium.
"""

import argparse
import asyncio
import base64
import io
import itertools
import shutil
import tempfile
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from aiohttp import ClientSession, ClientWebSocketResponse
from rich.console import Console

from tormagd.client.blocking import Client
from tormagd.config import load_config
from tormagd.ctl.top import REDRAW_S, Watcher
from tormagd.ctl.top_screen import Seen, screen

CHROMIUM = next(
    (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), ""
)
OPTIONS = ("--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--hide-scrollbars")


PHONE = 600
"A narrower window is a phone's."
TERMINALS = ((80, 24), (160, 50))
PAGES = {"wide": (1440, 900), "phone": (390, 844)}
WATCHED_S = 22.0
"Until all that is shown is of the run."
SETTLED_S = 1.0
"By then a page has drawn itself in its new size."


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


def look(config: Path) -> Seen:
    """What `tormagctl top` would have gathered of the daemon by now."""
    with Client(load_config(config).endpoints) as client:
        watcher, end_s = Watcher(client), time.monotonic() + WATCHED_S
        while time.monotonic() < end_s:
            seen = watcher.look()
            time.sleep(REDRAW_S)
        return seen


async def terminal(page: Page, seen: Seen, folder: Path, out: Path) -> None:
    """The pictures of `tormagctl top`."""
    for width, height in TERMINALS:
        console = Console(width=width, height=height, record=True, file=io.StringIO(), force_terminal=True)
        console.print(screen(seen, width, height))
        drawn = folder / "top.svg"
        console.save_svg(str(drawn), title="tormagctl top")
        await page.open(drawn.as_uri(), width, height)
        box = await page.ask("(({width, height}) => [width, height])(document.documentElement.viewBox.baseVal)")
        await page.resize(*map(round, box))
        await page.picture(out / f"top_{width}x{height}.png")


async def dashboard(page: Page, address: str, out: Path) -> None:
    """The pictures of `tormagctl dashboard`."""
    for name, (width, height) in PAGES.items():
        await page.open(address, width, height)
        await page.until("document.querySelector('#late td') !== null && portrait !== null")
        await page.resize(width, await page.ask("document.documentElement.scrollHeight"))
        await asyncio.sleep(SETTLED_S)
        await page.picture(out / f"dashboard_{name}.png")


async def main(config: Path | None, address: str | None, out: Path) -> None:
    """Takes those that are asked for."""
    seen = None if config is None else look(config)
    with tempfile.TemporaryDirectory() as folder:
        async with browser(Path(folder)) as page:
            if seen is not None:
                await terminal(page, seen, Path(folder), out)
            if address is not None:
                await dashboard(page, address, out)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config", type=Path, help="of the daemon that top is to show")
    parser.add_argument("--page", help="the address that tormagctl dashboard has printed")
    parser.add_argument("--out", type=Path, default=Path("docs/images"))
    options = parser.parse_args()
    asyncio.run(main(options.config, options.page, options.out))
