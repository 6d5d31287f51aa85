"""What other programs are told: `tormagctl metrics` as Prometheus reads it, `foxglove` as Foxglove does."""

import asyncio
import itertools
import json
import math
import os
import re
import shutil
import signal
import struct
import subprocess
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import pytest
from aiohttp import ClientSession, WSMsgType
from prometheus_client.metrics_core import Metric
from prometheus_client.parser import text_string_to_metric_families

from tormagd.control.safety.codes import Fault, Limit
from tormagd.ctl.main import main

ROOT = Path(__file__).parents[2]
BOARD = ROOT / "examples/grafana.json"
MESSAGES = (ROOT / "docs/messages.md").read_text(encoding="utf-8")
BASE_UNITS = ("seconds", "newtons", "meters", "teslas", "hertz", "ratio")
PROMTOOL = shutil.which("promtool")


def read(text: str) -> dict[str, Metric]:
    return {family.name: family for family in text_string_to_metric_families(text)}


def values(families: dict[str, Metric], name: str, **labels: str) -> list[float]:
    return [each.value for each in families[name].samples if each.labels == labels]


@pytest.fixture
def full(fake_daemon: Any, source_with: Callable[..., dict[str, Any]]) -> Any:
    fake_daemon.says(
        setpoints={"by_source": {'"\\\n': source_with()}},
        faults=["SKEW"],
        limits=["RATE"],
        late_ticks_by={"kernel": 2},
        not_granted=["realtime.fifo_priority = 50: Operation not permitted; see LimitRTPRIO"],
        following={"rms_N": 0.136, "aligned_rms_N": 0.044, "delay_ms": 180.0},
    )
    return fake_daemon


def printed(ctl: Any, daemon: Any) -> str:
    return ctl(*daemon.at, "metrics").ended(0).out


SHOWN: list[tuple[str, dict[str, str], Any]] = [
    ("up", {}, 1.0),
    ("force_measured_newtons", {}, 1.49),
    ("gap_meters", {}, pytest.approx(0.07)),
    ("field_teslas", {}, pytest.approx(0.12)),
    ("operating_state", {"tormag_operating_state": "ENABLED"}, 1.0),
    ("operating_state", {"tormag_operating_state": "FAULT"}, 0.0),
    ("fault", {"code": "SKEW"}, 1.0),
    ("limit", {"code": "RATE"}, 1.0),
    ("not_granted", {"setting": "realtime.fifo_priority"}, 1.0),
    ("following_rms_newtons", {}, 0.136),
    ("following_aligned_rms_newtons", {}, 0.044),
    ("following_delay_seconds", {}, pytest.approx(0.18)),
    ("loop_stalls", {"loop": "control"}, 3.0),
    ("loop_lateness_seconds", {"loop": "control", "percentile": "p99"}, pytest.approx(304e-6)),
    ("late_ticks", {"culprit": "kernel"}, 2.0),
    ("link_round_trip_seconds", {"percentile": "p50"}, pytest.approx(402.5e-6)),
    ("setpoints_accepted", {}, 3.0),
    # a name with quote, backslash and line's end is one printable label
    ("source_lost", {"source": '"\\\\n'}, 3.0),
]


def test_the_status_is_there_in_base_units(full: Any, ctl: Any) -> None:
    families = read(printed(ctl, full))
    found = [(name, labels, values(families, f"tormag_{name}", **labels)) for name, labels, _ in SHOWN]
    assert found == [(name, labels, [expected]) for name, labels, expected in SHOWN]
    told = {name: families[f"tormag_setpoints_{name}"].documentation for name in ("refused", "dropped")}
    assert all(f"- `{name}` (int): {text.removeprefix('Setpoints ')}\n" in MESSAGES for name, text in told.items())


def test_names_and_types_keep_to_the_conventions(full: Any, ctl: Any) -> None:
    for name, family in read(printed(ctl, full)).items():
        assert re.fullmatch(r"tormag(_[a-z]+)*", name)
        assert family.documentation
        assert family.type in ("gauge", "counter"), name
        if family.type == "counter":
            assert all(sample.name == f"{name}_total" for sample in family.samples)
        assert not name.endswith(("_N", "_mm", "_mT", "_us", "_ms"))
        if re.search("force|gap|skew|field|age|delay|lateness|execution|round_trip|uptime", name):
            assert name.endswith(BASE_UNITS), name


@pytest.mark.skipif(PROMTOOL is None, reason="no promtool here: it comes with Debian's package prometheus")
def test_prometheus_s_own_parser_finds_no_fault(full: Any, ctl: Any) -> None:
    checked = subprocess.run(
        [str(PROMTOOL), "check", "metrics"],
        input=printed(ctl, full),
        text=True,
        capture_output=True,
        check=False,
    )
    assert (checked.returncode, checked.stdout, checked.stderr) == (0, "", "")


def test_without_its_extra_it_says_which(ctl: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "prometheus_client", None)
    monkeypatch.delitem(sys.modules, "tormagd.ctl.metrics")
    error = ctl("--json", "metrics").ended(2).error
    assert (error["message"], error["hint"]) == (
        "metrics needs prometheus_client, which is not installed",
        "pip install 'tormagd[metrics]'",
    )


def test_what_is_not_known_has_no_sample(fake_daemon: Any, ctl: Any) -> None:
    fake_daemon.says(measured_cf=None, gap_mm=None, faults=[])
    families = read(printed(ctl, fake_daemon))
    assert "tormag_force_measured_newtons" not in families
    assert not families["tormag_fault"].samples
    assert all(math.isfinite(sample.value) for family in families.values() for sample in family.samples)
    assert read(ctl(*fake_daemon.at, "--json", "metrics").ended(0).result["metrics"]).keys() == families.keys()


def test_a_scrape_asks_anew_and_says_when_the_daemon_has_gone(full: Any, capsys: pytest.CaptureFixture[str]) -> None:
    scraped: list[dict[str, Metric]] = []

    def scrape() -> None:
        try:
            while "tormagctl metrics: " not in (said := capsys.readouterr().err):
                time.sleep(0.01)
            for is_there in (True, True, False):
                if not is_there:
                    full.is_over.set()
                    full.join()
                with urlopen(said.split()[2], timeout=30.0) as answer:
                    scraped.append(read(answer.read().decode()))
        finally:
            os.kill(os.getpid(), signal.SIGINT)

    scraper = threading.Thread(target=scrape)
    scraper.start()
    assert main(["--endpoint", full.control, "--wait", "0.5", "metrics", "--port", "0"]) == 0
    scraper.join()
    assert [values(families, "tormag_up") for families in scraped] == [[1.0], [1.0], [0.0]]
    assert (scraped[2].keys(), full.commands) == ({"tormag_up"}, ["status"] * 3)
    assert main(["--endpoint", full.control, "--wait", "0.5", "metrics"]) == 3
    assert values(read(capsys.readouterr().out.partition("the daemon goes on\n")[2]), "tormag_up") == [0.0]


RULES = re.findall(
    r"- alert: (\w+).*\n +expr: (.+)\n", (ROOT / "examples/prometheus_rules.yml").read_text(encoding="utf-8")
)
EXPRESSION = re.compile(
    r"(abs\()?(?:(?P<over>increase|delta)\()?(?P<name>tormag_\w+)"
    r"(?:{(?P<label>\w+)(?P<how>=~|!~|=)\"(?P<wanted>.+)\"})?(?:\[\w+\]\)+)? (?P<compare>==|>) (?P<limit>.+)"
)
OF_USE = {"NO_SETPOINT", "STANDBY", "F_MIN", "TAKEOVER"}
"Limits that nobody is to be called for."


def fired(then: str, now: str) -> set[tuple[str, ...]]:
    """The alerts that two scrapes fire, with their code or setting."""
    found = set()
    before = {(each.name, *each.labels.values()): each.value for it in read(then).values() for each in it.samples}
    for alert, expression in RULES:
        parts = EXPRESSION.fullmatch(expression).groupdict()
        limit, wanted, is_not = float(parts["limit"]), parts["wanted"] or "", parts["how"] == "!~"
        for sample in (each for it in read(now).values() for each in it.samples if each.name == parts["name"]):
            if bool(re.fullmatch(wanted, sample.labels.get(parts["label"], ""))) == is_not:
                continue
            value = abs(sample.value - (before[sample.name, *sample.labels.values()] if parts["over"] else 0.0))
            if value == limit if parts["compare"] == "==" else value > limit:
                about = {name: each for name, each in sample.labels.items() if name in ("code", "setting")}
                found.add((alert, *about.values()))
    return found


def test_each_fault_and_limit_and_whatever_else_is_to_be_seen_to_fires_its_rule(fake_daemon: Any, ctl: Any) -> None:
    def scrape(**changes: Any) -> str:
        fake_daemon.says(**changes)
        return printed(ctl, fake_daemon)

    before = scrape()
    assert fired(before, before) == set()
    everything = fired(before, scrape(faults=[*Fault], limits=[*Limit]))
    assert {code for alert, code in everything if alert == "TormagFault"} == {*Fault}
    told = [code for alert, code in everything if alert in ("TormagLimit", "TormagHeldBack")]
    assert (sorted(told), len(told)) == (sorted({*Limit} - OF_USE), len({*told}))
    for changes, alert in (
        ({"link": {"state": "BACK_OFF"}}, ("TormagDeviceLost",)),
        ({"not_granted": ["realtime.cpus = [9]: no"]}, ("TormagNotGranted", "realtime.cpus")),
        ({"rates": {"control": {"stalls": 9}}}, ("TormagStalls",)),
        ({"setpoints": {"refused": 500}}, ("TormagRefusing",)),
        ({"following": {"rms_N": 0.3, "aligned_rms_N": 0.2, "delay_ms": 20.0}}, ("TormagNotFollowed",)),
        ({"device": {"scale": 0.85}}, ("TormagDrift",)),
    ):
        assert fired(before, scrape(**changes)) == {alert}
    assert fired(before, "# TYPE tormag_up gauge\ntormag_up 0.0\n") == {("TormagSilent",)}


def test_the_board_asks_for_what_there_is(full: Any, ctl: Any) -> None:
    known = {sample.name for family in read(printed(ctl, full)).values() for sample in family.samples}
    board = json.loads(BOARD.read_text(encoding="utf-8"))
    asked = [target["expr"] for panel in board["panels"] for target in panel["targets"]]
    assert {name for expression in asked for name in re.findall(r"tormag_[a-z_]+", expression)} <= known
    assert len(asked) >= 10
    for panel in board["panels"]:
        assert panel["title"]
        assert all(target["datasource"]["uid"] == "${prometheus}" for target in panel["targets"])


# -- Foxglove ----------------------------------------------------------------------------------------------------------


pytest.importorskip("foxglove")
LONGEST_S = 60.0
HEADER = struct.Struct("<BIQ")
"Kind (1: a message), subscription, time in ns."


async def heard(address: str) -> dict[str, list[tuple[int, dict[str, Any]]]]:
    """Subscribe to all topics, and return their messages with their times, until there are twenty."""
    told: defaultdict[str, list[tuple[int, dict[str, Any]]]] = defaultdict(list)
    topics: dict[int, str] = {}
    async with (
        asyncio.timeout(LONGEST_S),
        ClientSession() as session,
        session.ws_connect(address, protocols=("foxglove.sdk.v1",)) as stream,
    ):
        while sum(map(len, told.values())) < 20:
            message = await stream.receive()
            if message.type is WSMsgType.BINARY and message.data[0] == 1:
                _, number, t_ns = HEADER.unpack_from(message.data)
                told[topics[number]].append((t_ns, json.loads(message.data[HEADER.size :])))
            elif message.type is WSMsgType.TEXT and (channels := message.json().get("channels")):
                topics |= {each["id"]: each["topic"] for each in channels}
                asked = [{"id": each["id"], "channelId": each["id"]} for each in channels]
                await stream.send_json({"op": "subscribe", "subscriptions": asked})
    return told


def test_foxglove_hears_force_gap_and_limits(fake_daemon: Any, started: Any, ctl: Any) -> None:
    with started("foxglove", "--port", "0") as process:
        port = next(found[1] for line in process.stderr if (found := re.search(r"ws://127.0.0.1:(\d+)", line)))
        told = asyncio.run(heard(f"ws://127.0.0.1:{port}"))
        assert "give another --port" in ctl(*fake_daemon.at, "foxglove", "--port", port).ended(2).err
        process.send_signal(signal.SIGINT)
        assert process.wait(LONGEST_S) == 0
    for values in told.values():
        assert {then[0] - now[0] for now, then in itertools.pairwise(values)} == {20_000_000}
    assert {(each["setpoint_cf"], each["gap_mm"], *each["limits"]) for _, each in told["/telemetry"]} == {(1.5, 70.0)}
    assert {(each["measured_cf"], each["right_duty"], each["lateness_us"]) for _, each in told["/ticks"]} == {
        (1.49, -0.1, 20.0)
    }
