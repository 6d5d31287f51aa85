"""How late the control loop is while browsers look at `tormagctl dashboard`, beside the same daemon without one.

Blocks without and with take turns in one run of the daemon. A browser is a stream of the page's events, read as the
page reads it, or with `--chromium` a headless Chromium of its own on this machine, which also draws. The simulated
device stands for another machine, and has FIFO and locked memory where the kernel grants them.
"""

import argparse
import asyncio
import contextlib
import multiprocessing
import statistics
import subprocess
import sys
import tempfile
from collections.abc import AsyncIterator, Iterator
from contextlib import AsyncExitStack, asynccontextmanager
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

from aiohttp import ClientSession, ClientTimeout
from machines.chromium import browser
from rendering.show import DEVICE_FIFO

from benchmarks.loop import (
    QUANTILES,
    WARM_UP_S,
    Block,
    Stand,
    add_realtime_arguments,
    as_block,
    asked_for,
    collect,
    daemon,
    end,
    merge,
    quantiles,
    realtime_settings,
    recording,
)
from tormagd_client import Client

CTL = ("-P", "-m", "tormagd.ctl.main")
OPEN_S = 120.0
"Until every browser shows the daemon; ten that are started on two processors take their time."
WINDOW = 1440, 900
ENDLESS = ClientTimeout(total=None)
LOOK_S = 0.1
"Between two looks whether it is over."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `benchmark browsers`."""
    add_realtime_arguments(parser)
    parser.add_argument("--browsers", type=int, default=10, metavar="N", help="that look at once (%(default)s)")
    parser.add_argument("--chromium", action="store_true", help="real ones, which draw on this machine")
    parser.add_argument("--seconds", type=float, default=20.0, help="length of a block (%(default)s)")
    parser.add_argument("--pairs", type=int, default=5, help="blocks of each kind (%(default)s)")


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """What `summary` says, and `{browsers, kind, state}`: that of the daemon at the end."""
    realtime = realtime_settings(options)
    pairs: list[tuple[Block, Block]] = []
    with tempfile.TemporaryDirectory(prefix="tormag-") as folder:
        stand = Stand(realtime, device_fifo=DEVICE_FIFO)
        with daemon(stand, Path(folder)) as running, recording(running.config.endpoints) as recorder:

            def block() -> Block:
                collect(recorder, WARM_UP_S)  # what came while nobody read, too
                return as_block(collect(recorder, options.seconds), running.config.rates.control_hz)

            for _ in range(options.pairs):
                without = block()
                with looking(Path(folder, "tormagd.toml"), options.browsers, options.chromium):
                    pairs.append((without, block()))
            with Client(running.config.endpoints, 5.0) as client:
                state = client.status().operating_state
    kind = "chromium" if options.chromium else "streams"
    return {"browsers": options.browsers, "kind": kind, "state": state} | summary(pairs) | asked_for(realtime)


def summary(pairs: list[tuple[Block, Block]]) -> dict[str, Any]:
    """`{without: {lateness_us, merged_share}, looked_at: the same, ratio: {p50, p99, p999}, pairs}` of blocks without
    browsers and with them; a ratio is the median over the pairs."""
    lateness_us = [(quantiles(without.lateness_us), quantiles(looked_at.lateness_us)) for without, looked_at in pairs]
    return {
        "without": _told([without for without, _ in pairs]),
        "looked_at": _told([looked_at for _, looked_at in pairs]),
        "ratio": {
            name: round(statistics.median(looked_at[name] / without[name] for without, looked_at in lateness_us), 2)
            for name in ("p50", "p99", "p999")
        },
        "pairs": len(pairs),
    }


def _told(blocks: list[Block]) -> dict[str, Any]:
    whole = merge(blocks)
    return {"lateness_us": quantiles(whole.lateness_us), "merged_share": round(whole.merged / whole.ticks, 6)}


@contextlib.contextmanager
def looking(config: Path, count: int, chromium: bool) -> Iterator[None]:
    """A dashboard, and so many browsers that show the daemon. Raises TimeoutError where they do not get to it."""
    serving = [sys.executable, *CTL, "--config", str(config), "dashboard", "--port", "0"]
    dashboard = subprocess.Popen(serving, stderr=subprocess.PIPE, text=True)
    shown, over = multiprocessing.Event(), multiprocessing.Event()
    try:
        assert dashboard.stderr is not None  # a pipe
        address = dashboard.stderr.readline().split()[2]
        viewers = multiprocessing.Process(target=look, args=(address, count, chromium, shown, over))
        viewers.start()
        try:
            while not shown.wait(LOOK_S):
                if not viewers.is_alive():  # it has said why
                    raise TimeoutError(f"{count} browsers do not show the daemon within {OPEN_S:g} s")
            yield
        finally:
            over.set()
            viewers.join()
    finally:
        end(dashboard)


def look(address: str, count: int, chromium: bool, shown: Event, over: Event) -> None:
    """So many browsers, until it is over; `shown` is set when all of them show the daemon."""
    asyncio.run(_look(address, count, chromium, shown, over))


async def _look(address: str, count: int, chromium: bool, shown: Event, over: Event) -> None:
    async with AsyncExitStack() as stack:
        async with asyncio.timeout(OPEN_S):
            for _ in range(count):
                await stack.enter_async_context(_chromium(address) if chromium else _stream(address))
        shown.set()
        while not over.is_set():
            await asyncio.sleep(LOOK_S)


@asynccontextmanager
async def _stream(address: str) -> AsyncIterator[None]:
    async with ClientSession() as session, session.get(f"{address}live", timeout=ENDLESS) as answer:
        await answer.content.readline()

        async def read() -> None:
            async for _ in answer.content.iter_any():
                pass

        reading = asyncio.create_task(read())
        yield
        reading.cancel()


@asynccontextmanager
async def _chromium(address: str) -> AsyncIterator[None]:
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        async with browser(Path(profile)) as page:
            await page.open(address, *WINDOW)
            await page.until("document.querySelector('#late td') !== null")
            yield


def print_table(result: dict[str, Any]) -> None:
    """The object for a person."""
    print(f"{'':14s}{'p50':>9s}{'p99':>9s}{'p99.9':>9s}{'max':>9s}   lateness, us (fifo {result['fifo_priority']})")
    for name, shown in (("without", "no dashboard"), ("looked_at", f"{result['browsers']} {result['kind']}")):
        late_us = result[name]["lateness_us"]
        row = "".join(f"{late_us[key]:9.1f}" for key in QUANTILES)
        print(f"{shown:14s}{row}   merged {result[name]['merged_share']:.3%}")
    print(f"{'ratio':14s}" + "".join(f"{ratio:9.2f}" for ratio in result["ratio"].values()))
    print(f"median of {result['pairs']} pairs; {result['state']} at the end")
