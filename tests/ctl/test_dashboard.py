"""`tormagctl dashboard`: what it serves, and the page in a headless Chromium if there is one."""

import asyncio
import contextlib
import importlib.resources
import itertools
import json
import logging
import math
import re
import shutil
import signal
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import msgspec
import pytest
from aiohttp import ClientSession, ClientWebSocketResponse, WSMsgType, WSServerHandshakeError, web
from aiohttp.http_exceptions import BadHttpMessage
from aiohttp.test_utils import TestClient, TestServer
from hypothesis import given, settings, strategies as st
from sent import tell

from tormagd.control.safety.codes import FAULTS, LIMITS, Fault, Limit
from tormagd.record.overview import LATE_US
from tormagd.record.reader import RecordingFile
from tormagd.record.ticks import TickBatch
from tormagd.record.writer import RecordingWriter
from tormagd.view.frame import SHOWN_S, Frame, late_counts
from tormagd.view.live import WAITING, Live
from tormagd.view.recorded import Recorded
from tormagd.view.report import report
from tormagd.view.server import Operating, application, is_own
from tormagd_client.aio import AsyncClient
from tormagd_client.endpoints import in_folder
from tormagd_client.errors import RefusedError
from tormagd_client.messages import BeliefReport

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
async def served(
    shown: Live | Recorded, operating: Operating | None = None, origin: str | None = None
) -> AsyncIterator[Browser]:
    async with TestClient(TestServer(application(shown, operating, origin))) as asks:
        yield asks


@asynccontextmanager
async def live(folder: Path) -> AsyncIterator[Live]:
    async with AsyncClient(in_folder(str(folder)), 5.0) as client:
        shown = Live(client, await client.status(), await client.describe())
        listening = asyncio.create_task(shown.run())
        yield shown
        listening.cancel()


async def event(stream: ClientWebSocketResponse, wanted: str) -> Any:
    while True:
        ((name, value),) = (await stream.receive_json()).items()
        if name == wanted:
            return value


async def test_a_browser_is_sent_what_the_daemon_does(fake_daemon: Any) -> None:
    fake_daemon.says(limit_details=[{"code": "RATE", "cause": "too fast", "remedy": "ask for slower changes"}])
    described = fake_daemon.answers["describe"]()["result"] | {"portrait": PORTRAIT}
    fake_daemon.answers["describe"] = lambda: {"ok": True, "result": described}

    async with live(fake_daemon.directory) as shown, served(shown) as asks:
        about = await (await asks.get("/about")).json()
        assert (about["kind"], about["shown_s"], tuple(about["late_us"])) == ("live", SHOWN_S, LATE_US)
        stream = await asks.ws_connect("/live")
        assert (await event(stream, "status"))["link"]["state"] == "RUNNING"
        assert await event(stream, "explained") == {
            "limits": {"RATE": {"code": "RATE", "cause": "too fast", "remedy": "ask for slower changes"}},
            "faults": {},
        }
        assert await event(stream, "portrait") == PORTRAIT
        first = msgspec.convert(await event(stream, "frame"), Frame)
        then = msgspec.convert(await event(stream, "frame"), Frame)
        assert (first.asked_N[-1], first.gap_mm[-1], first.operating_state) == (1.5, 70.0, "ENABLED")
        assert then.t_s[0] > first.t_s[-1]
        # a late one begins with the past seconds
        assert msgspec.convert(await event(await asks.ws_connect("/live"), "frame"), Frame).t_s[0] <= first.t_s[0]
        assert sum(then.late_counts) >= len(first.t_s)
        fake_daemon.is_silent = True
        assert (await event(stream, "silence"))["seconds"] >= 0.5
    assert (set(fake_daemon.commands), fake_daemon.setpoints) == ({"status", "describe"}, [])


async def test_ten_browsers_are_one_subscriber(fake_daemon: Any) -> None:
    async with live(fake_daemon.directory) as shown, served(shown) as asks:
        with patch.object(shown._client, "telemetry", wraps=shown._client.telemetry) as subscribed:
            streams = [await asks.ws_connect("/live") for _ in range(10)]
            frames = [{(await event(stream, "frame"))["t_s"][-1] for _ in range(5)} for stream in streams]
    assert subscribed.call_count <= 1
    assert set.intersection(*frames)


async def test_a_browser_that_does_not_read_misses_the_oldest_and_holds_nobody_up(fake_daemon: Any) -> None:
    async with live(fake_daemon.directory) as shown:
        with shown.browser() as events:
            for number in range(3 * WAITING):
                shown._publish("status", number)
            assert events.qsize() == WAITING
            assert json.loads(events.get_nowait()) == {"status": 2 * WAITING}
        assert not shown.browsers


async def test_nobody_from_elsewhere_reads_along_and_nobody_writes(recorded: Recorded) -> None:
    async with served(recorded) as asks:
        hosts = ("evil.example", "127.0.0.1:99999", "127.0.0.1:abc", "localhost", "127.0.0.1:8733")
        assert [(await asks.get("/about", headers={"Host": host})).status for host in hosts] == [
            403,
            403,
            403,
            200,
            200,
        ]
        ours = {"Origin": str(asks.make_url("/")).rstrip("/")}
        assert [(await asks.post(path, headers=ours)).status for path in ("/", "/about", "/frame")] == [405] * 3
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
    assert frame.believed == {}  # ticks do not say
    assert [held.is_now for held in recorded.frame(6.0).held] == [True]


def test_a_recording_shows_what_was_believed_then(tmp_path: Path, telemetry_with) -> None:
    idle = BeliefReport(value=0.013, sd=None, unit="s", acts=False)
    lag = BeliefReport(value=-3.53, sd=None, unit="mT", acts=True)
    with RecordingWriter(tmp_path / "b.mcap") as writer:
        for seq, at_s in enumerate((0.0, 0.02, 0.04, 2.0)):
            scale = BeliefReport(value=1.0 + at_s, sd=0.17, unit="", acts=True)
            belief = {"scale": scale, "carriage_lag": idle, "field_lag": lag} if at_s else {}
            t_ns = START_NS + round(at_s * 1e9)
            writer.ticks(TickBatch(v=1, columns=("t_ns", "tick"), rows=((t_ns, seq),)))
            tell(writer, telemetry_with(seq, t_ns, belief=belief))
    shown = Recorded(RecordingFile(tmp_path / "b.mcap"))
    assert [shown.frame(at_s).believed for at_s in (0.01, 1.2)] == [{}, {}]
    for at_s, value in ((0.03, "1.02"), (1.0, "1.04"), (2.0, "3")):
        known = {"force over the model's": f"{value} ± 0.17", "element's field less the gap's": "3.53 mT"}
        assert shown.frame(at_s).believed == known


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


@pytest.mark.parametrize(("options", "sent"), [((), []), (("--operate",), ["operate", "stop", "pause"])])
async def test_the_command_says_where_it_serves_and_ends_in_order(
    fake_daemon: Any, started: Any, options: tuple[str, ...], sent: list[str]
) -> None:
    fake_daemon.answers["stop"] = lambda: {"ok": True, "result": {"operating_state": "FAULT", "is_connected": True}}
    fake_daemon.refuse("pause", "not_enabled")
    with started("--json", "dashboard", "--port", "0", *options) as process:
        link = next(found for line in process.stderr if (found := re.search(r"(http://127\S+)/#?(\S*)", line)))
        async with ClientSession(headers={"Origin": link[1], "Tormag-Secret": link[2]}) as session:
            given = [await session.post(f"{link[1]}/command", json={"command": each}) for each in sent[1:]]
            answers = [(each.status, (await each.text()).split(";")[0]) for each in given]
        process.send_signal(signal.SIGINT)
        said, more = process.communicate(timeout=60.0)
    assert (process.returncode, json.loads(said)["ok"], len(link[2])) == (0, True, 43 if options else 0)
    assert answers == [(200, "stopped and latched"), (409, "pause: cannot pause")][: len(answers)]
    assert not options or link[2] not in said + more
    assert [each for each in fake_daemon.commands if each not in ("status", "describe")] == sent


def test_a_key_that_may_only_look_starts_no_page_that_operates(fake_daemon: Any, ctl: Any, tmp_path: Path) -> None:
    fake_daemon.refuse("operate", "forbidden")
    assert ctl(*fake_daemon.at, "--json", "dashboard", "--operate", "--port", "0").ended(1).error["code"] == "forbidden"
    assert "cannot be operated" in ctl(*fake_daemon.at, "dashboard", str(tmp_path), "--operate").ended(2).err


LONGEST_S = 60.0
SECRET = 21 * "aB"
OURS, OTHERS, PROXY = "OURS", "http://evil.example", "https://console.example"
"OURS stands for the server's own address."


class Given(list[str]):
    async def __call__(self, command: str) -> str:
        if command == "pause":
            raise RefusedError(command, "busy", "homing", "wait for it")
        self.append(command)
        return "done"


def asked(asks: Browser, changes: dict[str, Any]) -> dict[str, Any]:
    """Return a request that stops the brake, with these headers instead; None leaves one out."""
    headers = {
        "Origin": OURS,
        "Tormag-Secret": SECRET,
        "Content-Type": "application/json",
        **changes.get("headers", {}),
    }
    kept = [
        (name, value.replace(OURS, f"http://{asks.host}:{asks.port}"))
        for name, values in headers.items()
        for value in (values if isinstance(values, tuple) else (values,))
        if value is not None
    ]
    return {"method": "POST", "path": "/command", "data": b'{"command": "stop"}', **changes, "headers": kept}


MISUSES: dict[str, tuple[int, dict[str, Any]]] = {
    "no secret": (401, {"headers": {"Tormag-Secret": None}}),
    "an empty secret": (401, {"headers": {"Tormag-Secret": ""}}),
    "another secret": (401, {"headers": {"Tormag-Secret": 43 * "b"}}),
    "a part of it": (401, {"headers": {"Tormag-Secret": SECRET[:-1]}}),
    "more than it": (401, {"headers": {"Tormag-Secret": f"{SECRET}a"}}),
    "in other letters": (401, {"headers": {"Tormag-Secret": SECRET.upper()}}),
    "not ASCII": (401, {"headers": {"Tormag-Secret": "ä" * 42}}),
    "in the address": (401, {"headers": {"Tormag-Secret": None}, "path": f"/command?secret={SECRET}"}),
    "in a cookie": (401, {"headers": {"Tormag-Secret": None, "Cookie": f"Tormag-Secret={SECRET}"}}),
    "no origin": (403, {"headers": {"Origin": None}}),
    "an empty origin": (403, {"headers": {"Origin": ""}}),
    "a foreign page": (403, {"headers": {"Origin": OTHERS}}),
    "a page of nowhere": (403, {"headers": {"Origin": "null"}}),
    "a page of another port": (403, {"headers": {"Origin": "http://127.0.0.1:1"}}),
    "a page of another scheme": (403, {"headers": {"Origin": "https://127.0.0.1"}}),
    "a name that begins like ours": (403, {"headers": {"Origin": f"{OURS}.evil.example"}}),
    "two origins": (403, {"headers": {"Origin": (OURS, OTHERS)}}),
    "a foreign name for our address": (403, {"headers": {"Host": "evil.example", "Origin": OTHERS}}),
    "GET": (405, {"method": "GET"}),
    "PUT": (405, {"method": "PUT"}),
    "leave for a foreign page": (403, {"method": "OPTIONS", "headers": {"Origin": OTHERS}}),
    "a form": (415, {"headers": {"Content-Type": "application/x-www-form-urlencoded"}, "data": b"command=stop"}),
    "plain text": (415, {"headers": {"Content-Type": "text/plain"}}),
    "a long body": (413, {"data": b'{"command": "stop"' + 1_000 * b" " + b"}"}),
    "no JSON": (400, {"data": b"stop"}),
    "no body": (400, {"data": b""}),
    "no object": (400, {"data": b'["stop"]'}),
    "an unknown command": (400, {"data": b'{"command": "explode"}'}),
    "a command that is none of the page's": (400, {"data": b'{"command": "use-scene"}'}),
    "a field more": (400, {"data": b'{"command": "stop", "scene": "x"}'}),
    "looking without the secret": (401, {"method": "GET", "path": "/about", "headers": {"Tormag-Secret": None}}),
    "the stream to a foreign page": (403, {"method": "GET", "path": "/live", "headers": {"Origin": OTHERS}}),
}


@pytest.mark.parametrize(("status", "changes"), MISUSES.values(), ids=MISUSES)
async def test_a_misuse_is_refused(recorded: Recorded, status: int, changes: dict[str, Any]) -> None:
    given = Given()
    async with served(recorded, Operating(SECRET, given)) as asks:
        answer = await asks.request(**asked(asks, changes))
        assert (answer.status, given) == (status, [])
        assert (SECRET in await answer.text(), "Access-Control-Allow-Origin" in answer.headers) == (False, False)
        # nor may a page frame it, or tell another where it was
        names = ("X-Frame-Options", "Referrer-Policy", "Cache-Control")
        assert [answer.headers[name] for name in names] == ["DENY", "no-referrer", "no-store"]
        assert "frame-ancestors 'none'" in answer.headers["Content-Security-Policy"]


async def test_a_secret_commands_a_server_of_its_start(recorded: Recorded) -> None:
    given = Given()
    for operating, expected in (
        (Operating(SECRET, given), {"stop": 200, "arm": 200, "pause": 409}),
        (Operating(f"b{SECRET[1:]}", given), {"stop": 401}),
        (None, {"stop": 404}),
    ):
        async with served(recorded, operating) as asks:
            for command, status in expected.items():
                answer = await asks.request(**asked(asks, {"data": json.dumps({"command": command})}))
                assert answer.status == status
    assert given == ["stop", "arm"]


@pytest.mark.parametrize(
    ("protocols", "origin", "status"),
    [
        ((), OURS, 401),
        (("tormag",), OURS, 401),
        (("tormag", SECRET[:-1]), OURS, 401),
        (("tormag", SECRET), OTHERS, 403),
        (("tormag", SECRET), "null", 403),
        (("tormag", SECRET), PROXY, 101),
    ],
)
async def test_the_stream_is_for_who_has_the_secret_and_only_tells(
    fake_daemon: Any, protocols: tuple[str, ...], origin: str, status: int
) -> None:
    given = Given()
    async with (
        live(fake_daemon.directory) as shown,
        served(shown, Operating(SECRET, given), PROXY) as asks,
        asyncio.timeout(LONGEST_S),
    ):
        headers = {"Origin": origin.replace(OURS, f"http://{asks.host}:{asks.port}")}
        with contextlib.nullcontext() if status == 101 else pytest.raises(WSServerHandshakeError, match=str(status)):
            stream = await asks.ws_connect("/live", protocols=protocols, headers=headers)
            assert stream.protocol == "tormag"
            await stream.send_json({"command": "stop"})
            assert [each async for each in stream if each.type is not WSMsgType.TEXT] == []
    assert given == []


CHROMIUM = next(
    (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), ""
)
OPTIONS = ("--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--hide-scrollbars")
PHONE = 600
"A narrower window is a phone's."


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
async def page_of(
    shown: Live | Recorded, tmp_path: Path, width: int, height: int, operating: Operating | None = None
) -> AsyncIterator[Page]:
    async with served(shown, operating) as asks, browser(tmp_path) as page:
        await page.resize(width, height)
        for domain in ("Runtime", "Log", "Page"):
            await page.tell(f"{domain}.enable")
        await page.tell("Page.navigate", url=f"{asks.make_url('/')}{(operating and f'#{operating.secret}') or ''}")
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


IS_STOP = """[at("stop").getBoundingClientRect()].every(({left, right, top, bottom}) =>
    left >= 0 && right <= innerWidth && top >= 0 && bottom <= innerHeight &&
    document.elementFromPoint((left + right) / 2, (top + bottom) / 2) === at("stop"))"""
STATES = ("at('operate').hidden", "at('question').open", "location.href.includes('#')")


def press(command: str) -> str:
    return f"document.querySelector('[data-command={command}]').click()"


@needs_chromium
async def test_stop_is_within_reach_and_everything_else_asks_first(fake_daemon: Any, tmp_path: Path) -> None:
    given = Given()
    async with (
        live(fake_daemon.directory) as shown,
        page_of(shown, tmp_path, 1440, 900, Operating(SECRET, given)) as page,
    ):
        await page.until("document.querySelector('#state')?.textContent === 'ENABLED'")
        for width, height in ((1440, 900), (1024, 768), (390, 844), (320, 480)):
            await page.resize(width, height)
            await page.until(f"{IS_STOP} && {FITS}")
            await page.ask(press("arm"))
            assert [await page.ask(each) for each in (*STATES, IS_STOP)] == [False, True, False, True]
            await page.ask("at('no').click()")
        assert given == []
        for command in ("resume", "disable", "arm"):
            await page.ask(press(command))
            await page.ask("at('yes').click()")
            await page.until(f"at('answer').textContent === '{command}: done'")
        await page.ask(press("arm"))
        await page.ask(press("stop"))
        await page.until("at('answer').textContent === 'stop: done'")
        assert given == ["resume", "disable", "arm", "stop"]
        await page.tell("Page.reload")
        await page.until("document.querySelector('#state')?.textContent === 'ENABLED'")
        assert [await page.ask(each) for each in STATES] == [False, False, False]


@needs_chromium
async def test_axe_finds_nothing(fake_daemon: Any, recorded: Recorded, tmp_path: Path) -> None:
    axe = (importlib.resources.files(pytest.importorskip("axe_core_python")) / "axe.min.js").read_text(encoding="utf-8")
    (tmp_path / "a.html").write_text(report([recorded._file]), encoding="utf-8")
    (tmp_path / "browser").mkdir()
    async with (
        live(fake_daemon.directory) as shown,
        served(shown, Operating(SECRET, Given())) as now,
        served(recorded) as then,
        browser(tmp_path / "browser") as page,
    ):
        pages = (
            (f"{now.make_url('/')}#{SECRET}", "document.querySelector('#state')?.textContent === 'ENABLED'"),
            (str(then.make_url("/")), "document.querySelector('#state')?.textContent === 'FAULT'"),
            ((tmp_path / "a.html").as_uri(), "document.querySelector('h2') !== null"),
        )
        for scheme, (url, is_ready) in itertools.product(("light", "dark"), pages):
            await page.tell("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
            await page.tell("Page.navigate", url=url)
            await page.until(is_ready)
            await page.ask("document.querySelector('[data-command=arm]')?.click()")
            await page.ask(f"{axe}; 0")
            await page.resize(390, 844)
            await page.until(FITS)
            found = "axe.run().then((it) => it.violations.map((each) => each.id + each.nodes[0].html))"
            assert await page.ask(found) == [], (scheme, url)


@needs_chromium
async def test_the_example_shows_the_stream(fake_daemon: Any, tmp_path: Path) -> None:
    text = (Path(__file__).parents[2] / "examples/live.html").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 15
    async with live(fake_daemon.directory) as shown, TestServer(web.Application()) as own, browser(tmp_path) as page:
        for origin, shows in ((str(own.make_url("/")).rstrip("/"), "1.50 N asked"), (None, "– N asked")):
            async with served(shown, origin=origin) as asks:
                here = text.replace("127.0.0.1:8733", f"127.0.0.1:{asks.port}")
                await page.tell("Page.navigate", url=str(own.make_url("/")))
                await page.ask(f"document.write({json.dumps(here)})")
                await page.until("stream.readyState === WebSocket.OPEN || stream.readyState === WebSocket.CLOSED")
                await page.until(f"document.body.textContent.includes({json.dumps(shows)})")
                await page.ask("stream.close()")


@pytest.mark.parametrize(
    ("error", "is_told"), [(BadHttpMessage("no method"), False), (KeyError("a"), True), (None, True)]
)
def test_a_malformed_request_is_answered_and_no_error_of_this_program(error: Exception | None, is_told: bool) -> None:
    found = None if error is None else (type(error), error, None)
    assert is_own(logging.makeLogRecord({"exc_info": found})) is is_told
