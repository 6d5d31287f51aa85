"""`tormagctl dashboard`: a page for a browser on this machine, showing the daemon live or a recording."""

import asyncio
import secrets
import sys
import time
from functools import partial
from pathlib import Path

from tormagd.ctl.operate import armed, done, report_step
from tormagd.ctl.outcome import CommandError, Exit, Outcome, as_usage_error, usage_error
from tormagd.ctl.report import opened
from tormagd.ground.terminal import write_line
from tormagd.view.live import Live
from tormagd.view.recorded import Recorded
from tormagd.view.server import LOOPBACK, Operating, application, serve
from tormagd_client.aio import AsyncClient
from tormagd_client.endpoints import Endpoints
from tormagd_client.errors import RefusedError


def dashboard(
    endpoints: Endpoints, path: Path | None, port: int, is_operated: bool, origin: str | None, wait_s: float
) -> Outcome:
    """Serve the page of a recording, or of the live daemon, until Ctrl-C or SIGTERM."""
    start_s = time.monotonic()
    if path is not None and is_operated:
        raise usage_error(f"{path}: a recording cannot be operated", "leave out --operate, or the recording")
    try:
        asyncio.run(
            _live(endpoints, port, is_operated, origin, wait_s) if path is None else _recorded(path, port, origin)
        )
    except OSError as error:
        raise usage_error(
            f"nothing is served at {LOOPBACK}:{port}: {error.strerror}", "give another --port; 0 takes one that is free"
        ) from error
    seconds = time.monotonic() - start_s
    return Outcome({"seconds": round(seconds, 1)}, f"shown for {seconds:.0f} s")


async def _live(endpoints: Endpoints, port: int, is_operated: bool, origin: str | None, wait_s: float) -> None:
    async with AsyncClient(endpoints, wait_s) as client:
        shown = Live(client, await client.status(), await client.describe())
        operating = None
        if is_operated:
            await _require_operator(client)
            operating = Operating(secrets.token_urlsafe(), partial(_give, endpoints, wait_s))
        listening = asyncio.create_task(shown.run())
        try:
            ready = partial(_ready, "" if operating is None else f"#{operating.secret}")
            await serve(application(shown, operating, origin), port, ready)
        finally:
            listening.cancel()


async def _recorded(path: Path, port: int, origin: str | None) -> None:
    (file,) = opened([path])
    with as_usage_error(ValueError, hint="give a recording with data"):
        shown = Recorded(file)
    await serve(application(shown, origin=origin), port, partial(_ready, ""))


async def _require_operator(client: AsyncClient) -> None:
    """Raise RefusedError for a key that may only look: even an unknown command is forbidden to it."""
    try:
        await client.request("operate")
    except RefusedError as error:
        if error.code == "forbidden":
            raise


async def _give(endpoints: Endpoints, wait_s: float, command: str) -> str:
    """Give the daemon a command by a connection of its own, so that `stop` waits for no other."""
    begun_s = time.monotonic()
    async with AsyncClient(endpoints, wait_s) as client:
        if command == "arm":
            return armed(await client.arm(told=report_step), await client.status(), time.monotonic() - begun_s).text
        outcome = done(command, await client.request(command))
    if outcome.exit_code is not Exit.DONE:
        raise CommandError(outcome.exit_code, "not_done", outcome.text, "")
    return outcome.text


def _ready(fragment: str, address: str) -> None:
    write_line(f"tormagctl dashboard: {address}{fragment}  (Ctrl-C ends)", sys.stderr)
