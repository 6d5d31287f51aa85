"""The daemon's own loops in virtual time, with a simulated device or none."""

import asyncio
import contextlib
import gc
import logging
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar
from unittest.mock import Mock

import msgspec
import pytest
from failing_search import FailingSearch

from firmware_protocol.build import settle
from firmware_protocol.codec import Message
from tormagd.config import Config, Device as DeviceTable, Rates, RealTime, Sources, load_calibration
from tormagd.control.assembly.build import Core
from tormagd.control.safety.codes import FAULTS, LIMITS, Fault, Limit
from tormagd.ctl.record import listening
from tormagd.daemon import daemon as daemon_module, service
from tormagd.daemon.beat import KERNEL, Beat, Delay
from tormagd.daemon.causes import Causes
from tormagd.daemon.daemon import Daemon
from tormagd.element.physics.errors import DomainError
from tormagd.hardware.backend import BackendError
from tormagd.hardware.link_statistics import LinkQuality
from tormagd.record.stream import COLUMNS
from tormagd.record.ticks import decode_ticks
from tormagd.record.writer import is_tick
from tormagd.simulation.closed_loop import VirtualPort
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.hand import ReversingHand
from tormagd.simulation.parameters import load_plant
from tormagd_client import Client, RefusedError, UnreachableError
from tormagd_client.endpoints import Curve, Endpoints, in_folder
from tormagd_client.messages import VERDICT_TOPIC, Description, Motion, Verdict
from tormagd_client.wire import Pending

NOT_GRANTED, CONFIG_FILE = ("realtime.lock_memory: no",), "/etc/tormag/a.toml"
PATIENCE_TICKS = 20_000
LOOK_TICKS = 50
SLOW_NS = 3_000_000_000
START_NS = 1_800_000_000_000_000_000
WATCHDOG_MS = 100.0
SAMPLE = load_plant("sample_1")
NEAR_HOME = msgspec.structs.replace(
    SAMPLE, assumed=msgspec.structs.replace(SAMPLE.assumed, start_left_mm=46.9, start_right_mm=46.7)
)


class Clock:
    def __init__(self) -> None:
        self.now_ns = 0

    def slow(self, _record: object = None) -> bool:
        self.now_ns += SLOW_NS
        return True


class Heartbeat:
    made: ClassVar["list[Heartbeat]"] = []

    def __init__(self, period_ns: int) -> None:
        self.period_ns, self.due_ns = period_ns, time.monotonic_ns()
        self._fd, self._is_over = os.eventfd(0), False
        self.made.append(self)

    def fileno(self) -> int:
        return self._fd

    def beats(self) -> int:
        beats = 0 if self._is_over else (time.monotonic_ns() - self.due_ns) // self.period_ns
        self.due_ns += beats * self.period_ns
        return beats

    def close(self) -> None:
        self._is_over = True
        os.close(self._fd)


class Port:
    def __init__(self) -> None:
        self.line = VirtualPort(VirtualDevice(NEAR_HOME, ReversingHand(2.0), seed=1))
        self.is_plugged_in, self.is_mute = True, False

    def open(self) -> "Port":
        if not self.is_plugged_in:
            raise BackendError("no such port", "plug it in")
        self.line.open()
        return self

    def receive(self) -> Any:
        if not self.is_plugged_in:
            raise BackendError("the port is gone", "plug it in")
        return self.line.receive()

    def send(self, message: Message) -> None:
        if self.is_mute:
            raise BackendError("the port takes nothing", "plug it in")
        self.line.send(message)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.line, name)


class Running:
    """A daemon that beats when the test says so, and an operator's client."""

    def __init__(self, runner: asyncio.Runner, clock: Clock, core: Core, folder: Path) -> None:
        self.search = FailingSearch(core)
        self.clock, self.port, self.core = clock, Port(), self.search.core
        self._runner, self.folder = runner, str(folder)
        self.clients: list[Client] = []
        self.client = self.publisher("test")

    def publisher(self, source: str) -> Client:
        self.clients.append(Client.local(self.folder, 1e-3, source))
        return self.clients[-1]

    def start(
        self,
        rates: Rates = Rates(),  # noqa: B008 it is immutable
        *,
        is_plugged_in: bool = True,
        device: DeviceTable = DeviceTable(),  # noqa: B008
    ) -> None:
        self.port.is_plugged_in = is_plugged_in
        config = Config(endpoints=in_folder(self.folder), rates=rates, realtime=RealTime(watchdog_ms=WATCHDOG_MS))
        self._runner.run(self._begun(msgspec.structs.replace(config, device=device)))

    async def _begun(self, config: Config) -> None:
        self.daemon = Daemon(config, self.core, self.port.open, list(NOT_GRANTED), config_file=CONFIG_FILE)
        # bound before the clock was replaced
        self.daemon._inference._clock_ns = self.daemon._phases._clock_ns = time.monotonic_ns
        self.clock.slow()
        self._run = asyncio.create_task(self.daemon.run())
        while not Heartbeat.made:
            await asyncio.sleep(0)
        self._heartbeat = Heartbeat.made.pop()

    def tick(self, times: int = 1) -> None:
        self._runner.run(self._ticked(times))

    async def _ticked(self, times: int) -> None:
        for _ in range(times):
            self.clock.now_ns += self._heartbeat.period_ns
            self.port.advance(time.monotonic())
            asyncio.get_running_loop().call_soon(self.daemon._beat, self._heartbeat)
            await asyncio.sleep(0)

    def answer(self, pending: Pending) -> dict[str, Any]:
        for _ in range(PATIENCE_TICKS):
            if (result := self.client.answer(pending, 1e-3)) is not None:
                return result
            self.tick()
        pytest.fail(f"no answer to {pending}")

    def command(self, name: str, **args: Any) -> dict[str, Any]:
        return self.answer(self.client.ask(name, **args))

    def refused(self, name: str, **args: Any) -> str:
        with pytest.raises(RefusedError) as refused:
            self.command(name, **args)
        return refused.value.code

    def until(self, reached: Callable[[dict[str, Any]], bool], what: str) -> dict[str, Any]:
        for _ in range(PATIENCE_TICKS // LOOK_TICKS):
            self.tick(LOOK_TICKS)
            if reached(status := self.command("status")):
                return status
        pytest.fail(f"not reached: {what}")

    def arm(self) -> None:
        status = self.until(lambda status: status["link"]["state"] == "RUNNING", "the link runs")
        if not status["is_homed"]:
            self.command("home")
        self.until(lambda status: status["is_homed"] and not status["is_busy"], "homed")
        self.command("enable")

    def scene(self, name: str) -> dict[str, Any]:
        self.command("use-scene", scene=name)
        return self.until(lambda status: status["scene_change"]["is_over"], "the scene has changed")

    def ask(self, force_N: float, by: Client | None = None) -> None:
        inbox = self.daemon._endpoint.inbox
        before = inbox.accepted + inbox.refused
        for _ in range(PATIENCE_TICKS):
            with contextlib.suppress(UnreachableError):  # without beats nobody is told that the daemon listens
                (by or self.client).publish(force_N, 30_000.0)
                break
            self.tick()
        while inbox.accepted + inbox.refused == before:
            self.tick()

    def end(self) -> None:
        signal.raise_signal(signal.SIGTERM)
        self._runner.run(self._ended())
        for client in self.clients:
            client.close()

    async def _ended(self) -> None:
        while not self._run.done():
            await self._ticked(1)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Iterator[Clock]:
    made = Clock()
    monkeypatch.setattr(time, "monotonic_ns", lambda: made.now_ns)
    monkeypatch.setattr(time, "monotonic", lambda: made.now_ns * 1e-9)
    monkeypatch.setattr(time, "time_ns", lambda: START_NS + made.now_ns)
    monkeypatch.setattr(daemon_module, "Heartbeat", Heartbeat)
    yield made
    Heartbeat.made.clear()
    gc.unfreeze()  # the daemon freezes garbage


@pytest.fixture
def running(clock: Clock, core: Core, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Running]:
    told: list[str] = []
    monkeypatch.setattr(daemon_module, "notify", told.append)
    with asyncio.Runner() as runner:
        made = Running(runner, clock, core, tmp_path)
        yield made
        made.end()
    assert told == ["STOPPING=1"]


@pytest.fixture
def alone(running: Running) -> Running:
    running.start(is_plugged_in=False)
    return running


@pytest.fixture
def armed(running: Running) -> Running:
    running.start()
    running.arm()
    return running


# -- without a device ----------------------------------------------------------------------------------------------


def test_stop_without_a_device_says_that_there_is_none(alone: Running) -> None:
    assert alone.command("stop") == {"operating_state": "FAULT", "is_connected": False}
    status = alone.command("status")
    known = {"faults": ["STOPPED"], "governed_cf": None, "is_busy": False, "build": str(settle())}
    assert {name: status[name] for name in known} == known


@pytest.mark.parametrize("ticks_per_snapshot", [1, 2, 50])
def test_requests_are_answered_with_the_newest_snapshot_however_few_ticks_it_stands_for(
    running: Running, ticks_per_snapshot: int
) -> None:
    running.start(Rates(control_hz=100, inference_hz=100, telemetry_hz=100 // ticks_per_snapshot), is_plugged_in=False)
    numbers = [running.command("status")["seq"] for _ in range(4)]
    assert numbers == sorted(set(numbers))  # one answer in a period


def test_however_seldom_telemetry_is_told_every_tick_is_recorded(running: Running) -> None:
    running.start(Rates(telemetry_hz=5))
    at, numbers = COLUMNS.index("tick"), list[int]()
    with listening(in_folder(running.folder)) as recorder:
        running.until(lambda _: bool(recorder.poll(1)), "ticks come")
        running.tick(450)
        while recorder.poll(100):
            batch = decode_ticks(recorder.recv())
            told = [row[at] for row in batch.rows]
            assert told == [entry[at] for entry in msgspec.msgpack.decode(batch.core) if is_tick(entry)]
            numbers.extend(told)
    assert numbers == [*range(numbers[0], numbers[0] + max(len(numbers), 440))]


def test_a_daemon_describes_what_it_runs(alone: Running) -> None:
    described = msgspec.convert(alone.command("describe"), Description)
    names = ("model", "build", "firmware", "serial_number", "configuration_file")
    assert [getattr(described, name) for name in names] == [alone.core.model, str(settle()), None, None, CONFIG_FILE]
    of_parts = described.scene["name"], described.configuration["realtime"]["watchdog_ms"]
    assert of_parts == (alone.core.scene.name, WATCHDOG_MS)
    assert alone.command("status")["not_granted"] == [*NOT_GRANTED]
    # a device that has shown nothing yet is the model
    shown, told = alone.core.portrait, described.portrait
    assert told.force_N == pytest.approx(shown.force_N[::5], abs=1e-4)
    speed_mm_s = described.configuration["position"]["gap_speed_mm_s"]
    assert told.rate_N_s == pytest.approx([shown.force_rate_N_s(f, speed_mm_s) for f in shown.force_N[::5]], abs=1e-4)


@pytest.mark.parametrize("error", [DomainError("displacement_mm", 1e10, "less"), TypeError("nobody expects this")])
def test_a_daemon_that_cannot_plan_can_be_seen_and_stopped_and_feeds_no_watchdog_without_fresh_plans(
    alone: Running, error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    notified: list[str] = []
    monkeypatch.setattr(service, "notify", notified.append)
    alone.tick(100)
    assert "WATCHDOG=1" in notified
    alone.search.error = error
    alone.tick(round(2 * WATCHDOG_MS))
    notified.clear()
    alone.tick(100)
    is_latched = isinstance(error, DomainError)
    assert (notified != [], "PLAN_FAILED" in alone.command("status")["faults"]) == (is_latched, is_latched)
    alone.command("stop")
    assert "STOPPED" in alone.command("status")["faults"]


@pytest.mark.parametrize(
    ("read", "said", "watchdog_ms"),
    [
        (
            Config(
                scene="pulse",
                device=DeviceTable(port="/dev/other", options={"baud": 9600}),
                rates=Rates(inference_hz=250),
                realtime=RealTime(watchdog_ms=800.0, fifo_priority=50),
                endpoints=Endpoints(curve=Curve(server_secret="s", also_local=True)),
                sources=Sources(priority=("robot",), playout_ms=60.0),
            ),
            [
                "configuration read again: now in force: realtime.watchdog_ms, sources.playout_ms, sources.priority",
                "not before a restart (systemctl restart tormagd): device.options.baud, device.port, "
                "endpoints.curve, rates.inference_hz, realtime.fifo_priority, scene",
            ],
            800.0,
        ),
        (
            # a file's value is above the timeout
            Config(
                realtime=RealTime(watchdog_ms=40.0),
                device=DeviceTable(command_timeout_ms=30.0, measurement_timeout_ms=30.0),
            ),
            [
                "the configuration stays as it was: realtime.watchdog_ms = 40.0: allowed is over "
                "device.command_timeout_ms = 50, which stays until a restart; next: mend that and reload again"
            ],
            WATCHDOG_MS,
        ),
        (Config(realtime=RealTime(watchdog_ms=WATCHDOG_MS)), ["configuration read again: no news"], WATCHDOG_MS),
    ],
    ids=["what waits", "what is refused", "nothing new, beside a scene that was chosen"],
)
def test_sighup_takes_over_what_it_can_and_names_the_rest(
    alone: Running, caplog: pytest.LogCaptureFixture, read: Config, said: list[str], watchdog_ms: float
) -> None:
    endpoints = msgspec.structs.replace(in_folder(alone.folder), curve=read.endpoints.curve)
    alone.daemon._read_again = lambda: msgspec.structs.replace(read, endpoints=endpoints)
    alone.scene("brain")
    with caplog.at_level(logging.INFO):
        signal.raise_signal(signal.SIGHUP)
        while "configuration " not in caplog.text:
            alone.tick()
    found = [record.getMessage() for record in caplog.records][-1 - len(said) :]
    assert found == ["no list of keys to read again: there is no endpoints.curve", *said]
    known = msgspec.convert(alone.command("describe")["configuration"], Config)
    assert (known.realtime.watchdog_ms, known.sources) == (watchdog_ms, read.sources)


def test_a_slow_start_is_graded_as_a_fast_one(running: Running, caplog: pytest.LogCaptureFixture) -> None:
    said = logging.getLogger(daemon_module.__name__)
    said.addFilter(running.clock.slow)
    begun_ns = running.clock.now_ns
    with caplog.at_level(logging.INFO):
        running.start(is_plugged_in=False)
        said.removeFilter(running.clock.slow)
        assert running.clock.now_ns - begun_ns >= 2 * SLOW_NS
        running.tick(200)
    daemon = running.daemon
    groups = (daemon._control.timing, daemon._inference.timing, daemon._telemetry.timing)
    assert [group.report().grade for group in groups] == ["good"] * 3
    assert (daemon._control.timing.runs, daemon._control.timing.merged) == (200, 0)
    assert not [record for record in caplog.records if record.levelno >= logging.ERROR]


@pytest.mark.parametrize(("late_ms", "ran_ms", "is_blamed"), [(8, 0, True), (8, 4, False), (1, 0, False)])
def test_a_silence_of_the_device_is_put_down_to_a_host_that_kept_the_loop_waiting(
    alone: Running, late_ms: int, ran_ms: int, is_blamed: bool
) -> None:
    daemon, stepper, causes = alone.daemon, alone.daemon._control.stepper, alone.daemon._causes
    daemon._phases._cpu_ns = lambda: daemon._phases._cpu_before_ns + ran_ms * 1_000_000
    for at_ns in range(10_000_000_000, 11_000_000_000, 50_000_000):
        daemon._receive(Beat(at_ns - 1_000_000, at_ns, late_ms - 1))
    stepper.time_s = 10.95
    causes.tell((Fault.STATUS_STALE, Fault.SKEW), stepper, None)
    told = [
        *causes.of_faults(["STATUS_STALE", "SKEW"]),
        *(row for now_s in (10.95, 12.0) for row in causes.of_limits(["DEVICE_SILENT"], "", {}, None, now_s)),
    ]
    assert [("160 ms of the last second, 8 ms at once; " in each.cause, "doctor" in each.remedy) for each in told] == [
        *((is_blamed, is_blamed), (False, False)) * 2
    ]


@pytest.mark.parametrize(
    ("link", "is_blamed"),
    [
        (LinkQuality(unanswered=0.03), True),
        (LinkQuality(unsent=0.03), True),
        (LinkQuality(unanswered=0.05), False),
        (LinkQuality(unanswered=0.03, damaged=0.03), False),
        (LinkQuality(round_trip_s=9e-3), False),
    ],
)
def test_a_wire_loses_by_a_host_that_waited_as_much(link: LinkQuality, is_blamed: bool) -> None:
    causes, measurement = Causes(DeviceTable()), SimpleNamespace(link=link)
    for number in range(21):
        causes.note_wait(10.0 + 0.05 * number, 2e-3)
    told = causes.of_limits(["LINK_DEGRADED"], "", {}, measurement, 11.0)
    assert [("40 ms of the last second" in each.cause, "cable" in each.remedy) for each in told] == [
        (is_blamed, not is_blamed)
    ]


def test_a_command_that_is_repeated_is_logged_once_a_second(alone: Running, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO):
        for _ in range(5):
            alone.command("stop")
        alone.tick(1_000)
        alone.command("stop")
    assert [record.getMessage() for record in caplog.records if record.getMessage().startswith("stop")] == [
        "stop: DISABLED to FAULT: the device is asked to open the gap",
        "stop: FAULT to FAULT: the device is asked to open the gap; 4 times more before",
    ]


def test_a_fault_is_told_with_what_was_known_when_it_was_latched(
    alone: Running, caplog: pytest.LogCaptureFixture
) -> None:
    control, causes = alone.daemon._control, alone.daemon._causes

    def stall(now_s: float, took_s: float, culprit: str) -> None:
        stepper, sight = control.stepper, control.stepper.measure.sight
        stepper.time_s = sight.stalled_s = now_s
        sight.stall_s = took_s
        causes.note_stall(stepper, Delay(round(took_s * 1e9), culprit, 1))

    stall(10.0, 0.083, KERNEL)
    control.stepper.time_s = 10.1
    causes.note_stall(control.stepper, Delay(2_000_000, "TelemetryLoop.publish", 1_500_000))
    control.latch(Fault.HOST_STALL)
    causes.tell(control.new_faults(), control.stepper, None)
    stall(11.0, 0.006, "somebody else")
    control.latch(Fault.PLAN_FAILED)
    causes.plan_failure = "no gap could be planned: no field"
    causes.tell(control.new_faults(), control.stepper, None)
    assert control.new_faults() == ()
    assert [record.getMessage() for record in caplog.records if record.getMessage().startswith("fault")] == [
        "fault: HOST_STALL: the control loop stood still for 83 ms (kernel); "
        f"the device opened the gap by itself after 50 ms; next: {FAULTS[Fault.HOST_STALL].remedy}",
        f"fault: PLAN_FAILED: no gap could be planned: no field; next: {FAULTS[Fault.PLAN_FAILED].remedy}",
    ]


# -- with a device -------------------------------------------------------------------------------------------------


def test_a_homing_that_is_over_shows_as_one_that_succeeded(running: Running) -> None:
    running.start()
    running.until(lambda status: status["link"]["state"] == "RUNNING", "the link runs")
    running.command("home")
    for _ in range(PATIENCE_TICKS):
        running.port.advance(time.monotonic() + 0.5e-3)  # between two ticks
        running.daemon._connection.receive(time.monotonic())
        look = running.daemon._answers.status()
        if not look.is_busy:
            break
        running.tick()
    assert look.is_homed


def test_force_follows_the_setpoint_and_what_holds_it_back_is_said(armed: Running) -> None:
    assert armed.command("status")["following"] is None
    for force_N in (1.0, 1.6):
        armed.ask(force_N)
        status = armed.until(lambda status, asked=force_N: abs(status["measured_cf"] - asked) < 0.06, f"{force_N} N")  # type: ignore[misc]
    assert (status["operating_state"], status["setpoint_cf"]) == ("ENABLED", 1.6)
    followed = armed.until(
        lambda status: status["following"] is not None and status["following"]["rms_N"] < 0.05, "it is followed"
    )
    assert followed["following"]["aligned_rms_N"] <= followed["following"]["rms_N"]
    assert abs(status["skew_mm"]) < 0.05
    armed.ask(0.1)
    status = armed.until(lambda status: abs(status["governed_cf"] - status["least_N"]) < 5e-3, "the least force")
    assert "F_MIN" in status["limits"]
    assert {"code": "F_MIN", "remedy": LIMITS[Limit.F_MIN].remedy}.items() <= status["limit_details"][0].items()


def test_plans_go_on_whatever_is_wrong_with_what_was_sent(armed: Running) -> None:
    armed.ask(1.0)
    buckets, before = armed.daemon._endpoint._allowance._buckets, armed.daemon._inference.planner.planned.number
    buckets.update(dict.fromkeys(buckets, ()))
    for _ in range(100):
        armed.client.publish(1.0, 30_000.0)
        armed.tick()
    assert armed.daemon._inference.planner.planned.number == before + 50


def test_the_handles_motion_is_told_to_who_listens(running: Running) -> None:
    running.start(Rates(motion_hz=250))
    running.arm()
    client = running.client
    assert (client.motions(), client.telemetry()) == ([], [])
    running.until(lambda _status: bool(client.motions(1e-3)), "somebody listens")
    found: list[Motion] = []
    for _ in range(100):
        running.tick(4)
        found += client.motions(1e-3)
    assert 95 <= len(found) <= 101
    times_s = [each.device_s for each in found]
    assert times_s == sorted(set(times_s))
    assert found[-1].t_ns - found[0].t_ns == pytest.approx((times_s[-1] - times_s[0]) * 1e9, abs=2e6)
    assert all(0.0 <= time.time_ns() - each.t_ns < 5e8 for each in found)
    travelled_mm = sum(each.handle_mm_s for each in found[1:]) * 4e-3
    assert travelled_mm == pytest.approx(found[-1].handle_mm - found[0].handle_mm, abs=1.0)
    newest = client.telemetry()[-1]
    assert newest.handle_mm == pytest.approx(found[-1].handle_mm, abs=2.0)
    assert newest.handle_mm_s is not None


def verdicts(client: Client, count: int) -> list[Verdict]:
    found: list[Verdict] = []
    while len(found) < count:
        found += client.verdicts(1.0)
    return found


def test_every_setpoint_gets_its_verdict_and_a_second_publisher_is_named_until_it_is_given_the_brake(
    armed: Running,
) -> None:
    client, console = armed.client, armed.publisher("console")
    assert (armed.command("status")["verdict"], client.verdicts()) == (None, [])
    armed.until(lambda _status: armed.daemon._endpoint.listeners.has(VERDICT_TOPIC), "somebody listens")
    armed.ask(1.6)
    armed.tick()
    (first,) = verdicts(client, 1)
    assert (first.source, first.outcome, first.why) == ("test", "arrives", ())
    assert 20.0 < (first.arrives_ms or 0.0) < 2_000.0
    status = armed.until(lambda status: status["verdict"]["outcome"] == "rendered", "rendered")
    assert (status["verdict"]["seq"], status["verdict"]["arrives_ms"]) == (first.seq, 0.0)
    assert abs(status["measured_cf"] - 1.6) < 0.06
    armed.ask(0.9, by=console)
    armed.ask(1.6)
    armed.tick()
    told = {each.source: (each.outcome, each.why) for each in verdicts(client, 2)}
    assert told == {"console": ("cannot", ("OTHER_SOURCE",)), "test": ("rendered", ())}
    status = armed.until(lambda status: "OTHER_SOURCE" in status["limits"], "the other one is named")
    causes = {each["code"]: each["cause"] for each in status["limit_details"]}
    named = "'console' sends setpoints too, and 'test' holds the brake"
    assert (causes["OTHER_SOURCE"], status["setpoint_cf"]) == (named, 1.6)
    assert (armed.refused("take"), armed.refused("take", source="nobody")) == ("bad_source", "unknown_source")
    assert armed.command("take", source="console") == {"source": "console", "instead_of": "test"}
    governed_N: list[float] = []
    status = armed.until(
        lambda status: governed_N.append(status["governed_cf"]) or governed_N[-1] == 0.9,  # type: ignore[func-returns-value]
        "the ramp ends at 0.9 N",
    )
    assert governed_N == sorted(governed_N, reverse=True)
    assert sum(0.9 < force_N < 1.6 for force_N in governed_N) >= 5
    assert status["setpoints"]["by_source"]["test"]["state"] == "refused"
    armed.command("pause")
    status = armed.until(lambda status: status["verdict"]["outcome"] == "cannot", "held")
    assert status["verdict"]["why"] == ["PAUSED"]


def test_what_may_not_be_done_yet_is_refused_and_whatever_else_is_commanded_ends_an_arming(armed: Running) -> None:
    armed.command("disable")
    armed.until(lambda status: not status["is_busy"], "open")
    home, enable, look = (armed.client.ask(name) for name in ("home", "enable", "status"))
    assert armed.answer(home)
    with pytest.raises(RefusedError, match="homes"):
        armed.answer(enable)
    assert armed.answer(look)["is_busy"]
    for name in ("arm", "disable"):
        armed.command(name)
    armed.tick(3_000)
    status = armed.command("status")
    assert (status["operating_state"], status["faults"]) == ("DISABLED", [])
    assert (status["arm"]["given"], status["arm"]["error"]["code"]) == ([], "overtaken")


def test_a_scene_is_changed_while_disabled_and_the_device_stays_homed(armed: Running) -> None:
    assert armed.refused("use-scene", scene="pulse") == "not_disabled"
    armed.command("pause")
    assert armed.refused("use-scene", scene="pulse") == "not_disabled"
    armed.command("disable")
    assert armed.refused("use-scene", scene="pulse") == "busy"
    armed.until(lambda status: not status["is_busy"], "open")
    assert [armed.refused("use-scene", scene=scene) for scene in (7, "")] == ["bad_scene"] * 2
    status = armed.scene("nowhere")
    assert (status["scene"], status["scene_change"]["error"]["code"]) == ("coronary", "bad_scene")
    status = armed.scene("pulse")
    assert (status["scene"], status["is_homed"], status["scene_change"]["error"]) == ("pulse", True, None)
    assert armed.command("describe")["configuration"]["scene"] == "pulse"
    armed.command("arm")
    armed.ask(1.5)
    status = armed.until(lambda status: (status["measured_cf"] or 0.0) > 1.45, "1.5 N")
    assert status["arm"]["given"] == ["enable"]
    armed.command("stop")
    assert armed.refused("use-scene", scene="coronary") == "fault"
    assert armed.command("arm")["operating_state"] == "FAULT"  # the gap still opens
    status = armed.until(lambda status: status["arm"]["is_over"], "armed")
    assert status["arm"] == {"given": ["clear-fault", "enable"], "is_over": True, "error": None}


def test_a_scene_that_needs_higher_rates_or_fails_is_refused_with_why(running: Running) -> None:
    running.start(Rates(inference_hz=83))
    running.until(lambda status: not status["is_busy"], "at rest")
    error = running.scene("cardiovascular")["scene_change"]["error"]
    assert "rates.inference_hz = 83" in error["cause"]
    assert "state [rates], or start with that scene" in error["remedy"]
    running.daemon._commands.scene_change._build = Mock(side_effect=OverflowError("nobody expects this"))
    error = running.scene("pulse")["scene_change"]["error"]
    assert (error["code"], error["cause"]) == ("failed", "OverflowError: nobody expects this")


def test_a_device_runs_by_its_calibration_and_is_busy_until_then(
    running: Running, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, gate = tmp_path / "00000001.toml", threading.Event()

    def once_open(path: Path, config: Config, serial_number: int) -> Config:
        gate.wait()
        return load_calibration(path, config, serial_number)

    monkeypatch.setattr("tormagd.daemon.configuration.load_calibration", once_open)

    def in_force(text: str) -> tuple[float, dict[str, str]]:
        file.write_text(text)
        running.until(lambda status: awaits(1), "it is to be read")
        assert running.refused("enable") == running.refused("use-scene", scene="pulse") == "busy"
        gate.set()
        known = running.until(lambda status: not awaits(1), "it was read")["calibration"]
        gate.clear()
        return running.command("describe")["configuration"]["motor"]["resistance_ohm"], known

    running.start(device=DeviceTable(calibrations=str(tmp_path)))
    awaits = running.daemon._calibrations.is_awaited
    calibrated = "serial_number = 1\n[motor]\nresistance_ohm = 2.5\n[trim]\nleast = 0.7\n"
    assert in_force(calibrated) == (2.5, {"file": str(file), "refusal": "", "folder": str(tmp_path)})
    running.arm()
    running.command("disable")
    running.until(lambda status: not status["is_busy"], "open")
    assert running.scene("pulse")["scene_change"]["error"] is None
    assert running.command("describe")["configuration"]["motor"]["resistance_ohm"] == 2.5
    running.daemon._read_again = lambda: running.daemon._calibrations.configured
    for refused, says in (
        (calibrated.replace("= 1", "= 2"), "serial_number = 2: allowed is 1, the device's (line 1)"),
        (calibrated.replace("2.5", "0.0"), "$.motor.resistance_ohm` (it is 0.0) (line 3)"),
        ("serial_number = 1\n[position]\nproportional_per_mm = 900.0\n", f"{file}: position: these gains leave"),
    ):
        signal.raise_signal(signal.SIGHUP)
        resistance_ohm, known = in_force(refused)
        assert (resistance_ohm, known["file"], says in known["refusal"]) == (2.2, "", True), known


def test_fifty_changes_of_the_scene_leave_nothing_behind(alone: Running) -> None:
    alone.tick()
    counts = []
    for number in range(50):
        alone.scene(("pulse", "coronary")[number % 2])
        if number in (19, 49):
            gc.collect()
            counts.append((len(gc.get_objects()), len(list(Path("/proc/self/fd").iterdir())), threading.active_count()))
    assert counts[1][1:] == counts[0][1:]
    assert counts[1][0] - counts[0][0] < 300


def test_an_operator_settles_a_dispute_and_a_mark_stands_in_every_snapshot_that_follows(alone: Running) -> None:
    assert [alone.refused("confirm", what=what) for what in ("both", "device")] == ["bad_confirmation", "not_disputed"]
    sensor = alone.daemon._inference.planner.believe.sensor
    sensor.outside_s = 1.0
    assert (alone.command("confirm", what="sensor"), sensor.is_doubted) == ({"confirmed": "sensor"}, True)
    assert {alone.refused("mark", text=text) for text in ("", "a\nb", "x" * 201, 3)} == {"bad_mark"}
    told = alone.command("mark", text="it stuck")
    assert told["text"] == "it stuck"
    assert alone.until(lambda status: status["mark"] is not None, "the mark")["mark"] == told


def test_a_device_that_is_unplugged_in_motion_comes_back_without_re_arming_and_one_that_is_mute_is_lost(
    armed: Running,
) -> None:
    armed.ask(1.5)
    armed.until(lambda status: status["gap_mm"] < 85.0, "closing")
    armed.port.is_plugged_in = False
    status = armed.until(lambda status: "LINK_LOST" in status["faults"], "the loss is named")
    assert (status["link"]["cause"], status["link"]["remedy"]) == ("no such port", "plug it in")
    told = next(each for each in status["fault_details"] if each["code"] == "LINK_LOST")
    assert told["cause"].endswith("disappeared: the port is gone")
    assert told["remedy"] == "plug it in; then `tormagctl arm`"
    armed.tick(500)
    armed.port.is_plugged_in = True
    status = armed.until(lambda status: status["link"]["state"] == "RUNNING" and not status["is_busy"], "back, open")
    assert status["operating_state"] == "FAULT"
    assert armed.command("clear-fault")["operating_state"] == "DISABLED"
    armed.ask(0.5)
    armed.arm()
    control, connection = armed.daemon._control, armed.daemon._connection
    armed.port.is_mute = True
    armed.tick()
    assert (control.measurement is None, connection.measurement) == (False, None)
    armed.tick()
    assert control.measurement is None
