"""The dashboard's HTTP server: reachable only from this machine, and read-only."""

import asyncio
import contextlib
import math
import signal
from collections.abc import Callable
from pathlib import Path

import msgspec
from aiohttp import web
from aiohttp.typedefs import Handler

from tormagd.record.overview import LATE_US
from tormagd.record.reader import RecordingError
from tormagd.view.frame import SHOWN_S
from tormagd.view.live import Live
from tormagd.view.recorded import Recorded

LOOPBACK = "127.0.0.1"
NAMES = (LOOPBACK, "localhost")
"By another name for this address, a foreign page could read the answers."
MAX_BROWSERS = 32
PAGE = Path(__file__).parent / "page"
HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src data:; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}


def application(shown: Live | Recorded) -> web.Application:

    async def page(request: web.Request) -> web.StreamResponse:
        return web.FileResponse(PAGE / "index.html")

    async def about(request: web.Request) -> web.Response:
        return _json({"shown_s": SHOWN_S, "late_us": LATE_US, **shown.about})

    async def live(request: web.Request) -> web.StreamResponse:
        assert isinstance(shown, Live)
        if len(shown.browsers) >= MAX_BROWSERS:
            raise web.HTTPServiceUnavailable(text=f"{MAX_BROWSERS} browsers look already")
        response = web.StreamResponse(headers={"Content-Type": "text/event-stream"})
        await response.prepare(request)
        with shown.browser() as events, contextlib.suppress(ConnectionError):
            while True:
                await response.write(await events.get())
        return response

    async def frame(request: web.Request) -> web.Response:
        assert isinstance(shown, Recorded)
        at_s = _seconds(request.query.get("at_s", ""))
        try:
            return _json(await asyncio.to_thread(shown.frame, at_s))
        except RecordingError as error:  # the file was taken away, or is damaged there
            raise web.HTTPGone(text=str(error)) from error

    made = web.Application(middlewares=[_only_this_machine])
    made.on_response_prepare.append(_headers)
    made.router.add_get("/", page)
    made.router.add_get("/about", about)
    made.router.add_get("/live", live) if isinstance(shown, Live) else made.router.add_get("/frame", frame)
    made.router.add_static("/page", PAGE)
    return made


async def serve(shown: Live | Recorded, port: int, ready: Callable[[str], None]) -> None:
    """Serve the page on LOOPBACK until SIGINT or SIGTERM; `port` 0 takes a free one."""
    over = asyncio.Event()
    runner = web.AppRunner(application(shown), access_log=None, shutdown_timeout=0.5)
    await runner.setup()
    try:
        await web.TCPSite(runner, LOOPBACK, port).start()
        for number in (signal.SIGINT, signal.SIGTERM):
            asyncio.get_running_loop().add_signal_handler(number, over.set)
        ready(f"http://{LOOPBACK}:{runner.addresses[0][1]}/")
        await over.wait()
    finally:
        await runner.cleanup()


@web.middleware
async def _only_this_machine(request: web.Request, handler: Handler) -> web.StreamResponse:
    """Raise HTTPForbidden for a host name other than NAMES."""
    if request.url.host not in NAMES:
        raise web.HTTPForbidden(text=f"allowed hosts are {' and '.join(NAMES)}")
    return await handler(request)


async def _headers(request: web.Request, response: web.StreamResponse) -> None:
    response.headers.update(HEADERS)


def _json(value: object) -> web.Response:
    return web.Response(body=msgspec.json.encode(value), content_type="application/json")


def _seconds(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not math.isfinite(seconds):
        raise web.HTTPBadRequest(text=f"at_s = {text[:80]!r}: allowed is a finite number of seconds")
    return seconds
