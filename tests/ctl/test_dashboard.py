"""`tormagctl dashboard`: what it serves, and the page in a headless Chromium if there is one."""

import asyncio
import itertools
import json
import math
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import msgspec
import pytest
import zmq
from aiohttp import ClientResponse, ClientSession, ClientWebSocketResponse
from aiohttp.test_utils import TestClient, TestServer
from hypothesis import given, settings, strategies as st

from tormagd.control.safety.codes import FAULTS, LIMITS, Fault, Limit
from tormagd.record.overview import LATE_US
from tormagd.record.reader import RecordingFile
from tormagd.record.ticks import TickBatch
from tormagd.record.writer import RecordingWriter
from tormagd.view.frame import SHOWN_S, Frame, late_counts
from tormagd.view.live import WAITING, Live
from tormagd.view.recorded import Recorded
from tormagd.view.server import application
from tormagd_client.aio import AsyncClient
from tormagd_client.endpoints import in_folder
from tormagd_client.messages import BeliefReport, Description, ProfileReport, Status, encode

START_NS = 1_790_000_000_000_000_000
PORTRAIT = {"force_N": [0.5, 1.0, 3.0], "rate_N_s": [1.0, 2.0, 8.0]}
SECONDS = 30.0
COLUMNS: tuple[str, ...] = ("t_ns", "setpoint_cf", "governed_cf", "measured_cf", "left_mm", "right_mm")
COLUMNS += ("reference_gap_mm", "field_mT", "operating_state", "limits", "faults", "lateness_us")
Browser = TestClient[Any, Any]


def tick(k: int) -> tuple[Any, ...]:
    t_s = 0.01 * k
    force_N = 1.5 + 0.3 * math.sin(2.4 * math.pi * t_s)
    state, faults = ("FAULT", ("SKEW",)) if t_s >= 29.0 else ("ENABLED", ())
    limits = ("RATE",) if 5.0 <= t_s < 7.0 else ()
    row = (START_NS + k * 10_000_000, force_N, force_N, force_N + 0.01, 34.0, 36.0, 70.0, 120.0)
    return *row, state, limits, faults, 30.0 if k % 100 else 300.0


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    path: Path = tmp_path_factory.mktemp("recorded") / "a.mcap"
    about = {"scene": json.dumps({"name": "pulse"}), "portrait": json.dumps(PORTRAIT)}
    with RecordingWriter(path, about) as writer:
        writer.ticks(TickBatch(v=1, columns=COLUMNS, rows=tuple(tick(k) for k in range(round(100 * SECONDS)))))
    return Recorded(RecordingFile(path))


@asynccontextmanager
async def served(shown: Live | Recorded) -> AsyncIterator[Browser]:
    async with TestClient(TestServer(application(shown))) as asks:
        yield asks


@asynccontextmanager
async def live(folder: Path) -> AsyncIterator[Live]:
    async with AsyncClient(in_folder(str(folder)), 5.0) as client:
        shown = Live(client, await client.status(), await client.describe())
        listening = asyncio.create_task(shown.run())
        yield shown
        listening.cancel()


async def event(stream: ClientResponse, wanted: str) -> Any:
    while True:
        name = (await stream.content.readline()).decode().removeprefix("event: ").strip()
        data = (await stream.content.readline()).decode().removeprefix("data: ")
        assert await stream.content.readline() == b"\n"
        if name == wanted:
            return json.loads(data)


async def test_a_browser_is_sent_what_the_daemon_does(fake_daemon: Any) -> None:
    fake_daemon.says(limit_details=[{"code": "RATE", "cause": "too fast", "remedy": "ask for slower changes"}])
    described = fake_daemon.answers["describe"]()["result"] | {"portrait": PORTRAIT}
    fake_daemon.answers["describe"] = lambda: {"ok": True, "result": described}

    async with live(fake_daemon.directory) as shown, served(shown) as asks:
        about = await (await asks.get("/about")).json()
        assert (about["kind"], about["shown_s"], tuple(about["late_us"])) == ("live", SHOWN_S, LATE_US)
        stream = await asks.get("/live")
        assert stream.content_type == "text/event-stream"
        told = await event(stream, "status")
        assert (told["status"]["link"]["state"], told["explained"]) == (
            "RUNNING",
            {
                "limits": {"RATE": {"code": "RATE", "cause": "too fast", "remedy": "ask for slower changes"}},
                "faults": {},
            },
        )
        assert await event(stream, "portrait") == {"portrait": PORTRAIT}
        first = msgspec.convert(await event(stream, "frame"), Frame)
        then = msgspec.convert(await event(stream, "frame"), Frame)
        assert (first.asked_N[-1], first.gap_mm[-1], first.operating_state) == (1.5, 70.0, "ENABLED")
        assert then.t_s[0] > first.t_s[-1]
        # a late one begins with the past seconds
        assert msgspec.convert(await event(await asks.get("/live"), "frame"), Frame).t_s[0] <= first.t_s[0]
        assert sum(then.late_counts) >= len(first.t_s)
        fake_daemon.is_silent = True
        assert (await event(stream, "silence"))["seconds"] >= 0.5
    assert (set(fake_daemon.commands), fake_daemon.setpoints) == ({"status", "describe"}, [])


async def test_ten_browsers_are_one_subscriber(run_dir: Path, status_with, telemetry_with) -> None:
    profile = ProfileReport(is_used=False, age_s=None, refusal="")
    unknown: dict[str, Any] = {"configuration": {}, "scene": {}, "firmware": None, "serial_number": None}
    described = Description(version="0", build="", model="", profile=profile, **unknown)
    context = zmq.Context()
    publishes = context.socket(zmq.XPUB)
    publishes.setsockopt(zmq.XPUB_VERBOSE, 1)  # otherwise only the first is reported
    publishes.bind(f"ipc://{run_dir}/telemetry")
    async with AsyncClient(in_folder(str(run_dir)), 0.1) as client:
        shown = Live(client, msgspec.convert(status_with(), Status), described)
        listening = asyncio.create_task(shown.run())
        async with served(shown) as asks:
            streams = [await asks.get("/live") for _ in range(10)]
            publishes.send(encode(telemetry_with(1, START_NS)))
            while not publishes.poll(0):
                await asyncio.sleep(0.01)
            for seq in range(2, 5):
                publishes.send(encode(telemetry_with(seq, START_NS + seq * 20_000_000)))
            first, *others = [await event(stream, "frame") for stream in streams]
            assert others == 9 * [first]
        listening.cancel()
    told = []
    while publishes.poll(100):
        told.append(publishes.recv()[:1])
    assert told.count(b"\x01") == 1
    context.destroy(linger=0)


async def test_a_browser_that_does_not_read_misses_the_oldest_and_holds_nobody_up(fake_daemon: Any) -> None:
    async with live(fake_daemon.directory) as shown:
        with shown.browser() as events:
            for number in range(3 * WAITING):
                shown._publish("status", number)
            assert events.qsize() == WAITING
            assert events.get_nowait() == b"event: status\ndata: %d\n\n" % (2 * WAITING)
        assert not shown.browsers


async def test_nobody_from_elsewhere_reads_along_and_nobody_writes(recorded: Recorded) -> None:
    async with served(recorded) as asks:
        hosts = ("evil.example", "localhost", "127.0.0.1:8733")
        assert [(await asks.get("/about", headers={"Host": host})).status for host in hosts] == [403, 200, 200]
        assert [(await asks.post(path)).status for path in ("/", "/about", "/frame")] == [405] * 3
        page = await asks.get("/")
        assert page.headers["Content-Security-Policy"].startswith("default-src 'self'")
        text = await page.text()
        for asset in ("page/dashboard.css", "page/dashboard.js", "page/vendor/uPlot.iife.min.js"):
            assert asset in text
            assert (await asks.get(f"/{asset}")).status == 200
        # works without a network
        assert re.findall("https?://", text) == []
        assert [(await asks.get(path)).status for path in ("/page/../server.py", "/live")] == [404, 404]


def test_a_recording_is_shown_at_any_moment(recorded: Recorded) -> None:
    about = recorded.about
    assert (about["kind"], about["scene"], about["duration_s"], about["followed"]) == (
        "recording",
        "pulse",
        pytest.approx(SECONDS, abs=0.1),
        "to 10 mN RMS, without a delay",
    )
    assert msgspec.to_builtins(about["portrait"]) == {name: tuple(values) for name, values in PORTRAIT.items()}
    assert (about["overview"]["limits"], about["overview"]["marks"]) == ([pytest.approx((5.0, 7.0))], [])
    assert max(known for known in about["overview"]["high_N"] if known is not None) == pytest.approx(1.81, abs=1e-3)
    # a limit and a fault share the name
    assert about["explained"]["limits"][Limit.SKEW].remedy == LIMITS[Limit.SKEW].remedy
    assert about["explained"]["faults"][Fault.SKEW].remedy == FAULTS[Fault.SKEW].remedy
    frame = recorded.frame(20.0)
    assert (frame.t_s[0], frame.t_s[-1]) == pytest.approx((START_NS * 1e-9, START_NS * 1e-9 + 20.0))
    assert (frame.asked_N[-1], frame.gap_mm[-1], frame.gap_wanted_mm[-1], frame.field_mT[-1]) == (
        pytest.approx(1.5 + 0.3 * math.sin(48.0 * math.pi)),
        70.0,
        70.0,
        120.0,
    )
    assert [(held.code, round(held.share, 3), held.is_now) for held in frame.held] == [("RATE", 0.1, False)]
    assert (frame.operating_state, frame.faults) == ("ENABLED", [])
    # all ticks count, not only those drawn
    assert (sum(frame.late_counts), frame.late_counts[LATE_US.index(500.0)]) == (
        pytest.approx(2_000, abs=2),
        pytest.approx(20, abs=1),
    )
    fault = recorded.frame(29.5)
    # in FAULT no field is planned
    assert (fault.faults, fault.field_mT[-1], fault.field_mT[0]) == (["SKEW"], None, 120.0)
    assert frame.belief == {}  # ticks do not say
    assert [held.is_now for held in recorded.frame(6.0).held] == [True]


def test_a_recording_shows_what_was_believed_then(tmp_path: Path, telemetry_with) -> None:
    lag = BeliefReport(value=0.013, sd=None, unit="s", acts=False)
    with RecordingWriter(tmp_path / "b.mcap") as writer:
        for seq, at_s in enumerate((0.0, 0.02, 0.04, 1.0)):
            scale = BeliefReport(value=1.0 + at_s, sd=0.17, unit="", acts=True)
            belief = {"scale": scale, "carriage_lag": lag} if at_s else {}
            writer.telemetry(telemetry_with(seq, START_NS + round(at_s * 1e9), belief=belief))
    shown = Recorded(RecordingFile(tmp_path / "b.mcap"))
    assert [shown.frame(at_s).belief for at_s in (0.01, 0.5)] == [{}, {}]
    for at_s, value in ((0.03, 1.02), (0.1, 1.04), (1.0, 2.0)):
        known = BeliefReport(value=value, sd=0.17, unit="", acts=True)
        assert shown.frame(at_s).belief == {"scale": known, "carriage_lag": lag}


@settings(max_examples=25)
@given(at_s=st.floats(-1e300, 1e300) | st.floats(0.0, SECONDS))
def test_every_moment_has_a_frame(recorded: Recorded, at_s: float) -> None:
    frame = msgspec.json.decode(msgspec.json.encode(recorded.frame(at_s)), type=Frame)
    assert len({len(getattr(frame, name)) for name in ("t_s", "asked_N", "measured_N", "gap_mm", "field_mT")}) == 1
    assert list(frame.t_s) == sorted(frame.t_s)


@pytest.mark.parametrize("at_s", ["", "nan", "inf", "x" * 1000])
async def test_a_moment_that_is_none_is_refused(recorded: Recorded, at_s: str) -> None:
    async with served(recorded) as asks:
        answer = await asks.get("/frame", params={"at_s": at_s})
        assert (answer.status, "allowed is a finite number" in await answer.text()) == (400, True)


def test_lateness_falls_into_the_bar_that_names_it() -> None:
    counts = late_counts([0.0, 9.9, 10.0, 4_999.0, 5_000.0, 1e6])
    assert (counts[0], counts[1], counts[-2], counts[-1], sum(counts)) == (2, 1, 1, 2, 6)


def test_the_command_says_where_it_serves_and_ends_in_order(fake_daemon: Any) -> None:
    command = [sys.executable, "-m", "tormagd.ctl.main", "--endpoint", fake_daemon.control, "--wait", "5", "--json"]
    command += ["dashboard", "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert any(line.startswith("tormagctl dashboard: http://127.0.0.1:") for line in process.stderr)
            process.send_signal(signal.SIGINT)
            said, _ = process.communicate(timeout=60.0)
        finally:
            process.kill()
    assert (process.returncode, json.loads(said)["ok"]) == (0, True)


CHROMIUM = next(
    (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), ""
)
OPTIONS = ("--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--hide-scrollbars")
PHONE = 600
"A narrower window is a phone's."
LONGEST_S = 60.0


class Page:
    def __init__(self, socket: ClientWebSocketResponse) -> None:
        self._socket, self._ids = socket, itertools.count(1)
        self.complaints: list[str] = []

    async def tell(self, method: str, **parameters: Any) -> dict[str, Any]:
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
                return said["result"]

    async def resize(self, width: int, height: int) -> None:
        await self.tell(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=width < PHONE,
        )

    async def ask(self, expression: str) -> Any:
        said = await self.tell("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in said:
            raise RuntimeError(f"{expression}: {said['exceptionDetails']}")
        return said["result"].get("value")

    async def until(self, expression: str) -> None:
        async with asyncio.timeout(LONGEST_S):
            while not await self.ask(expression):
                await asyncio.sleep(0.05)


@asynccontextmanager
async def browser(profile: Path) -> AsyncIterator[Page]:
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


@asynccontextmanager
async def page_of(shown: Live | Recorded, tmp_path: Path, width: int, height: int) -> AsyncIterator[Page]:
    async with served(shown) as asks, browser(tmp_path) as page:
        await page.resize(width, height)
        for domain in ("Runtime", "Log", "Page"):
            await page.tell(f"{domain}.enable")
        await page.tell("Page.navigate", url=str(asks.make_url("/")))
        yield page
        assert page.complaints == []


DRAWN = """[...document.querySelectorAll("canvas")].every((it) => it.width * it.height > 0 &&
    it.getContext("2d").getImageData(0, 0, it.width, it.height).data.some((value) => value))"""
HELD_US = {"p50": 1_200.0, "p99": 3_400.0, "p999": 4_000.0, "max": 4_100.0}
FITS = "document.documentElement.scrollWidth <= window.innerWidth"
needs_chromium = pytest.mark.skipif(not CHROMIUM, reason="there is no chromium here")


@needs_chromium
async def test_the_page_shows_the_daemon_as_it_is(fake_daemon: Any, tmp_path: Path) -> None:
    async with live(fake_daemon.directory) as shown, page_of(shown, tmp_path, 1440, 900) as page:
        await page.until("document.querySelector('#state')?.textContent === 'ENABLED'")
        await page.until("document.querySelector('#source').textContent.includes('RUNNING on /dev/tormag')")
        assert await page.ask("document.querySelector('#asked_N').textContent") == "1.500"
        assert await page.ask("document.querySelector('#codes').textContent.startsWith('No fault')")
        assert await page.ask("document.querySelectorAll('canvas').length") == 3
        for width, height in ((1440, 900), (390, 844)):
            await page.resize(width, height)
            await page.until(FITS)
            await page.until(DRAWN)
        fake_daemon.says(
            not_granted=["realtime.lock_memory: no"],
            following={"rms_N": 0.136, "aligned_rms_N": 0.044, "delay_ms": 180.0},
            setpoints=fake_daemon.taken()
            | {"playout": {"playout_ms": 60.0, "held_us": HELD_US, "jitter_us": 2_340.0, "setpoints": 900, "late": 7}},
        )
        await page.until("document.querySelector('#codes').textContent.includes('did not grant realtime.lock_memory')")
        assert await page.ask("document.querySelector('#following').textContent") == (
            "136 mN RMS off, 44 with a delay of 180 ms taken out"
        )
        assert await page.ask("document.querySelector('#playout').textContent") == (
            "Playout 60 ms after the stamp: adds 1.2 ms, takes out 2.3 ms of jitter, 7 of 900 came too late."
        )
        await page.until(FITS)
        fake_daemon.is_silent = True
        await page.until("document.querySelector('#silence').textContent.startsWith('nothing heard for')")
        assert await page.ask("document.querySelector('#state').className") == ""


@needs_chromium
async def test_the_page_scrubs_through_a_recording(recorded: Recorded, tmp_path: Path) -> None:
    async with page_of(recorded, tmp_path, 390, 844) as page:
        # it begins at the first fault
        await page.until("document.querySelector('#moment')?.textContent.startsWith('29.')")
        await page.until("document.querySelector('#state').textContent === 'FAULT'")
        said = await page.ask("document.querySelector('#codes').textContent")
        assert "Next: " + FAULTS[Fault.SKEW].remedy.replace("`", "") in said
        assert await page.ask("document.querySelector('#codes em code').textContent") == "tormagctl arm"
        await page.ask("at('at').value = 6; at('at').dispatchEvent(new Event('input'))")
        await page.until("document.querySelector('#codes').textContent.startsWith('RATE')")
        assert await page.ask("document.querySelector('#state').textContent") == "ENABLED"
        await page.ask("at('play').click()")
        await page.until("parseFloat(document.querySelector('#moment').textContent) > 6.2")
        assert await page.ask("at('play').textContent") == "Pause"
        await page.until(DRAWN)
        await page.until(FITS)
