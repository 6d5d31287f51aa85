"""`tormagctl foxglove`: telemetry live in Foxglove, in two topics that a recording has, served by its own SDK."""

import asyncio
import contextlib
import signal
import sys

import msgspec
from foxglove import Channel, Context, start_server

from tormagd.ctl.outcome import Outcome, usage_error
from tormagd.ground.terminal import write_line
from tormagd.record.writer import TELEMETRY_TOPIC, TICK_SCHEMA, TICKS_TOPIC, only_known, plain_schema
from tormagd_client.aio import AsyncClient
from tormagd_client.endpoints import Endpoints
from tormagd_client.messages import MessageError, Telemetry

LOOPBACK = "127.0.0.1"
SCHEMAS = {TELEMETRY_TOPIC: plain_schema(Telemetry), TICKS_TOPIC: TICK_SCHEMA}
UNITS = {"units": "at the end of a name; _cf is N, _jp is mm"}


def foxglove(endpoints: Endpoints, port: int, wait_s: float) -> Outcome:
    """Serve telemetry on LOOPBACK until Ctrl-C or SIGTERM."""
    asyncio.run(_serve(endpoints, port, wait_s))
    return Outcome({}, "the daemon goes on")


async def _serve(endpoints: Endpoints, port: int, wait_s: float) -> None:
    context = Context()
    channels = [Channel(topic, schema=SCHEMAS[topic], metadata=UNITS, context=context) for topic in SCHEMAS]
    async with AsyncClient(endpoints, wait_s) as client:
        await client.status()
        try:
            server = start_server(name="tormagd", host=LOOPBACK, port=port, context=context)
        except RuntimeError as error:
            raise usage_error(
                f"nothing is served at {LOOPBACK}:{port}: {error}", "give another --port; 0 takes one that is free"
            ) from error
        telling = asyncio.create_task(_tell(client, *channels))
        for number in (signal.SIGINT, signal.SIGTERM):
            asyncio.get_running_loop().add_signal_handler(number, telling.cancel)
        write_line(f"tormagctl foxglove: ws://{LOOPBACK}:{server.port}  (Ctrl-C ends)", sys.stderr)
        with contextlib.suppress(asyncio.CancelledError):
            await telling
        server.stop()


async def _tell(client: AsyncClient, telemetry: Channel, ticks: Channel) -> None:
    """Publish each snapshot without end, and its tick as a recording of ticks would have it."""
    while True:
        with contextlib.suppress(MessageError):  # what cannot be decoded is left out
            async for snapshot in client.telemetry():
                known = only_known(msgspec.to_builtins(snapshot))
                telemetry.log(msgspec.json.encode(known), log_time=snapshot.t_ns)
                duties = dict(zip(("left_duty", "right_duty"), known.pop("duty", ()), strict=False))
                tick = {name: known[name] for name in known.keys() & TICK_SCHEMA["properties"].keys()}
                ticks.log(msgspec.json.encode(tick | duties | known["tick"]), log_time=snapshot.t_ns)
