"""The dashboard's HTTP server, reachable only from this machine.

It only shows; with a secret, whoever has it may look and command. Foreign pages are refused by Origin (RFC 6454), DNS
rebinding by Host. The secret travels in headers, because addresses get into logs and Referer.
"""

import asyncio
import contextlib
import hmac
import logging
import math
import re
import signal
from collections.abc import Awaitable, Callable
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple

import msgspec
from aiohttp import web
from aiohttp.http_exceptions import HttpProcessingError
from aiohttp.typedefs import Handler

from tormagd.record.overview import LATE_US
from tormagd.record.reader import RecordingError
from tormagd.view.frame import SHOWN_S
from tormagd.view.live import Live
from tormagd.view.recorded import Recorded
from tormagd_client.errors import ClientError

LOOPBACK = "127.0.0.1"
OWN = re.compile(r"(127\.0\.0\.1|localhost)(:[1-6]?[0-9]{1,4})?", re.IGNORECASE)
"By another name for this address, a foreign page could read the answers."
MAX_BROWSERS = 32
MAX_BODY_BYTES = 256
HEARTBEAT_S = 10.0
PROTOCOL = "tormag"
"Of the WebSocket. The secret stands behind it: a page can set no other header there."
PAGE = Path(__file__).parent / "page"
HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src data:; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
    "X-Frame-Options": "DENY",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}


class Asked(msgspec.Struct, forbid_unknown_fields=True):
    """What a page may tell the daemon to do."""

    command: Literal["stop", "disable", "pause", "resume", "arm"]


class Operating(NamedTuple):
    """A secret of this start, and what gives the daemon a command."""

    secret: str
    give: Callable[[str], Awaitable[str]]
    "Returns what was done, or raises ClientError."


def application(
    shown: Live | Recorded, operating: Operating | None = None, origin: str | None = None
) -> web.Application:
    """Return the server, for its own pages and those from `origin`."""

    async def page(request: web.Request) -> web.StreamResponse:
        return web.FileResponse(PAGE / "index.html")

    async def about(request: web.Request) -> web.Response:
        return _json({"shown_s": SHOWN_S, "late_us": LATE_US, "operates": operating is not None, **shown.about})

    made = web.Application(middlewares=[_admission(operating, origin)], client_max_size=MAX_BODY_BYTES)
    made.on_response_prepare.append(_headers)
    made.router.add_get("/", page)
    made.router.add_get("/about", about)
    if isinstance(shown, Live):
        made.router.add_get("/live", partial(_stream, shown))
    else:
        made.router.add_get("/frame", partial(_frame, shown))
    if operating is not None:
        made.router.add_post("/command", partial(_command, operating))
    made.router.add_static("/page", PAGE)
    return made


async def serve(made: web.Application, port: int, ready: Callable[[str], None]) -> None:
    """Serve on LOOPBACK until SIGINT or SIGTERM; `port` 0 takes a free one."""
    over = asyncio.Event()
    logging.getLogger("aiohttp.server").addFilter(is_own)
    runner = web.AppRunner(made, access_log=None, shutdown_timeout=0.5)
    await runner.setup()
    try:
        await web.TCPSite(runner, LOOPBACK, port).start()
        for number in (signal.SIGINT, signal.SIGTERM):
            asyncio.get_running_loop().add_signal_handler(number, over.set)
        ready(f"http://{LOOPBACK}:{runner.addresses[0][1]}/")
        await over.wait()
    finally:
        await runner.cleanup()


def is_own(record: logging.LogRecord) -> bool:
    """Tell whether an error is no malformed request's, which is answered."""
    return record.exc_info is None or not isinstance(record.exc_info[1], HttpProcessingError)


def _admission(operating: Operating | None, origin: str | None) -> Callable[..., Awaitable[web.StreamResponse]]:

    @web.middleware
    async def admission(request: web.Request, handler: Handler) -> web.StreamResponse:
        if not OWN.fullmatch(request.host):
            raise web.HTTPForbidden(text=f"allowed hosts are {LOOPBACK} and localhost")
        came_from = request.headers.getall("Origin", [])  # none where a browser gets from its own page
        if (came_from or request.method == "POST") and came_from not in ([f"http://{request.host}"], [origin]):
            raise web.HTTPForbidden(text="allowed is a page of tormagctl dashboard itself, or of its --origin")
        is_public = request.path == "/" or request.path.startswith("/page/")
        if operating is not None and not is_public and not _has(request, operating.secret):
            raise web.HTTPUnauthorized(text="open the link that tormagctl dashboard has printed at its last start")
        return await handler(request)

    return admission


def _has(request: web.Request, secret: str) -> bool:
    given = request.headers.get("Tormag-Secret")
    if given is None:
        given = request.headers.get("Sec-WebSocket-Protocol", "").rpartition(",")[2].strip()
    return hmac.compare_digest(given.encode(errors="surrogateescape"), secret.encode())


async def _frame(shown: Recorded, request: web.Request) -> web.Response:
    at_s = _seconds(request.query.get("at_s", ""))
    try:
        return _json(await asyncio.to_thread(shown.frame, at_s))
    except RecordingError as error:  # the file was taken away, or is damaged there
        raise web.HTTPGone(text=str(error)) from error


async def _stream(shown: Live, request: web.Request) -> web.StreamResponse:
    if len(shown.browsers) >= MAX_BROWSERS:
        raise web.HTTPServiceUnavailable(text=f"{MAX_BROWSERS} browsers look already")
    socket = web.WebSocketResponse(
        heartbeat=HEARTBEAT_S, protocols=(PROTOCOL,), compress=False, max_msg_size=MAX_BODY_BYTES
    )
    await socket.prepare(request)
    with shown.browser() as events:
        telling = asyncio.create_task(_tell(socket, events))
        try:
            await socket.receive()  # nothing is expected: whatever comes ends it
        finally:
            telling.cancel()
    await socket.close()
    return socket


async def _command(operating: Operating, request: web.Request) -> web.Response:
    if request.content_type != "application/json":
        raise web.HTTPUnsupportedMediaType(text="allowed is application/json")
    try:
        asked = msgspec.json.decode(await request.read(), type=Asked)
        return web.Response(text=await operating.give(asked.command))
    except msgspec.DecodeError as error:
        raise web.HTTPBadRequest(text=str(error)) from error
    except ClientError as error:
        raise web.HTTPConflict(text=str(error)) from error


async def _tell(socket: web.WebSocketResponse, events: asyncio.Queue[str]) -> None:
    with contextlib.suppress(ConnectionError):
        while True:
            await socket.send_str(await events.get())


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
