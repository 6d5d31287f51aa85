"""`tormagctl dashboard`: a page for a browser on this machine, showing the daemon live or a recording."""

import asyncio
import sys
import time
from pathlib import Path

from tormagd.ctl.outcome import Outcome, as_usage_error, usage_error
from tormagd.ctl.report import opened
from tormagd.ground.terminal import write_line
from tormagd.view.live import Live
from tormagd.view.recorded import Recorded
from tormagd.view.server import LOOPBACK, serve
from tormagd_client.aio import AsyncClient
from tormagd_client.endpoints import Endpoints


def dashboard(endpoints: Endpoints, path: Path | None, port: int, wait_s: float) -> Outcome:
    """Serve the page of a recording, or of the live daemon, until Ctrl-C or SIGTERM."""
    start_s = time.monotonic()
    try:
        asyncio.run(_live(endpoints, port, wait_s) if path is None else _recorded(path, port))
    except OSError as error:
        raise usage_error(
            f"nothing is served at {LOOPBACK}:{port}: {error.strerror}", "give another --port; 0 takes one that is free"
        ) from error
    seconds = time.monotonic() - start_s
    return Outcome({"seconds": round(seconds, 1)}, f"shown for {seconds:.0f} s")


async def _live(endpoints: Endpoints, port: int, wait_s: float) -> None:
    async with AsyncClient(endpoints, wait_s) as client:
        shown = Live(client, await client.status(), await client.describe())
        listening = asyncio.create_task(shown.run())
        try:
            await serve(shown, port, _ready)
        finally:
            listening.cancel()


async def _recorded(path: Path, port: int) -> None:
    (file,) = opened([path])
    with as_usage_error(ValueError, hint="give a recording with data"):
        shown = Recorded(file)
    await serve(shown, port, _ready)


def _ready(address: str) -> None:
    write_line(f"tormagctl dashboard: {address}  (Ctrl-C ends)", sys.stderr)
