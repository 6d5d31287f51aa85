"""The pictures of `tormagctl top` and `tormagctl dashboard` in the documentation.

    python tools/screenshots.py --config my.toml --page http://127.0.0.1:8733/

beside the daemon of `my.toml` and a `tormagctl dashboard`, live or of a recording. It takes a Chromium.
"""

import argparse
import asyncio
import io
import tempfile
import time
from pathlib import Path

from machines.chromium import Page, browser
from rich.console import Console

from tormagd.config import load_config
from tormagd.ctl.top import REDRAW_S, Watcher
from tormagd.ctl.top_screen import Seen, screen
from tormagd_client.blocking import Client

TERMINALS = ((80, 24), (160, 50))
PAGES = {"wide": (1440, 900), "phone": (390, 844)}
WATCHED_S = 22.0
"Until all that is shown is of the run."
SETTLED_S = 1.0
"By then a page has drawn itself in its new size."


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
