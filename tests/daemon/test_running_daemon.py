"""The daemon's own event loop without a device: whatever becomes of planning, it can be seen and stopped."""

import asyncio
import gc
import signal
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
import zmq
import zmq.asyncio

from firmware_protocol.build import settle
from tormagd.config import Config, Endpoints, Rates, RealTime
from tormagd.control.core import Core, build_core
from tormagd.control.plan import PlanState
from tormagd.control.sight import Sight
from tormagd.daemon import notify
from tormagd.daemon.callbacks import KERNEL, Delay
from tormagd.daemon.daemon import Daemon
from tormagd.hardware.backend import Backend, BackendError
from tormagd.physics.errors import DomainError
from tormagd.safety.codes import FAULTS, Fault
from tormagd_client.messages import VERSION, Description, Reply, Request, decode, encode

pytestmark = pytest.mark.live

PATIENCE_S = 20.0
WATCHDOG_MS = 100.0
Command = Callable[[str], Awaitable[dict[str, Any]]]


@pytest.fixture(scope="module")
def core() -> Core:
    return build_core(Config())


@pytest.fixture(autouse=True)
def thawed() -> Iterator[None]:
    """The daemon takes what lives out of the collector's reach, for good."""
    yield
    gc.unfreeze()


class FailingPlanner:
    """Plans as the core's does, until its error is set."""

    def __init__(self, core: Core) -> None:
        self._planner = core.planner
        self.portrait, self.start, self.foresee = core.planner.portrait, core.planner.start, core.planner.foresee
        self.error: Exception | None = None

    def plan(self, *arguments: Any) -> PlanState:
        if self.error is not None:
            raise self.error.with_traceback(None)  # or it would grow by each time, and take long to log
        return self._planner.plan(*arguments)


def no_device() -> Backend:
    raise BackendError("no such port", "plug it in")


def run(
    core: Core,
    folder: Path,
    operate: Callable[[Command, FailingPlanner], Awaitable[None]],
    rates: Rates = Rates(),  # noqa: B008 it is immutable
) -> None:
    """A daemon that has no device, for as long as `operate` takes."""
    planner = FailingPlanner(core)
    addresses = {name: f"ipc://{folder}/{name}" for name in ("setpoint", "telemetry", "control", "recording")}
    config = Config(endpoints=Endpoints(**addresses), rates=rates, realtime=RealTime(watchdog_ms=WATCHDOG_MS))

    async def both() -> None:
        made: Any = core._replace(planner=planner)  # type: ignore[arg-type]
        running = asyncio.create_task(Daemon(config, made, no_device, []).run())
        with zmq.asyncio.Context() as context, context.socket(zmq.DEALER) as client:
            client.linger = 0
            client.connect(addresses["control"])

            async def command(name: str) -> dict[str, Any]:
                await client.send(encode(Request(v=VERSION, id=1, command=name)))
                reply = decode(await asyncio.wait_for(client.recv(), PATIENCE_S), Reply)
                assert reply.ok, reply.error
                return reply.result or {}

            try:
                await operate(command, planner)
            finally:
                signal.raise_signal(signal.SIGTERM)
                await running

    asyncio.run(both())


def test_stop_without_a_device_says_that_there_is_none(core: Core, tmp_path: Path) -> None:
    async def operate(command: Command, _planner: FailingPlanner) -> None:
        assert await command("stop") == {"operating_state": "FAULT", "is_connected": False}
        status = await command("status")
        assert (status["faults"], status["governed_cf"], status["is_busy"]) == (["STOPPED"], None, False)
        assert status["build"] == str(settle())

    run(core, tmp_path, operate)


@pytest.mark.parametrize("ticks_per_snapshot", [1, 2, 50])
def test_requests_are_answered_with_the_newest_snapshot_however_few_ticks_it_stands_for(
    core: Core, tmp_path: Path, ticks_per_snapshot: int
) -> None:
    async def operate(command: Command, _planner: FailingPlanner) -> None:
        numbers = [(await command("status"))["seq"] for _ in range(4)]
        assert numbers == sorted(set(numbers))  # one answer in a period

    rates = Rates(control_hz=100, inference_hz=100, telemetry_hz=100 // ticks_per_snapshot)
    run(core, tmp_path, operate, rates)


def test_a_daemon_describes_what_it_runs(core: Core, tmp_path: Path) -> None:
    async def operate(command: Command, _planner: FailingPlanner) -> None:
        described = msgspec.convert(await command("describe"), Description)
        assert described.scene["name"] == core.scene.name
        assert described.configuration["realtime"]["watchdog_ms"] == WATCHDOG_MS
        assert (described.model, described.build) == (core.model, str(settle()))
        assert (described.firmware, described.serial_number) == (None, None)
        # a device that has shown nothing yet is the model, at the gap speed of the configuration
        shown, told = core.planner.portrait, described.portrait
        assert told is not None
        assert told.force_N == pytest.approx(shown.force_N[::5], abs=1e-4)
        speed_mm_s = described.configuration["position"]["gap_speed_mm_s"]
        assert told.rate_N_s == pytest.approx(
            [shown.force_rate_N_s(f, speed_mm_s) for f in shown.force_N[::5]], abs=1e-4
        )

    run(core, tmp_path, operate)


@pytest.mark.parametrize("error", [DomainError("displacement_mm", 1e10, "less"), TypeError("nobody expects this")])
def test_a_daemon_that_cannot_plan_can_be_seen_and_stopped(core: Core, tmp_path: Path, error: Exception) -> None:
    async def operate(command: Command, planner: FailingPlanner) -> None:
        planner.error = error
        first = await command("status")
        while (status := await command("status"))["seq"] < first["seq"] + 3:
            assert ("PLAN_FAILED" in status["faults"]) >= ("PLAN_FAILED" in first["faults"])
        assert ("PLAN_FAILED" in status["faults"]) == isinstance(error, DomainError)
        await command("stop")
        assert "STOPPED" in (await command("status"))["faults"]

    run(core, tmp_path, operate)


def test_the_watchdog_is_fed_while_plans_are_fresh(core: Core, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    notified: list[str] = []
    monkeypatch.setattr(notify, "notify", notified.append)

    async def operate(command: Command, planner: FailingPlanner) -> None:
        while "WATCHDOG=1" not in notified:
            await command("status")
        planner.error = TypeError("nobody expects this")
        broken_ns = (await command("status"))["t_ns"]
        while (await command("status"))["t_ns"] < broken_ns + 2e6 * WATCHDOG_MS:
            pass
        notified.clear()
        newest = (await command("status"))["seq"]
        while (await command("status"))["seq"] < newest + 5:
            pass
        assert notified == []

    run(core, tmp_path, operate)


def test_a_fault_is_told_with_what_was_known_when_it_was_latched(
    core: Core, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Length and culprit are those of the stall that did it, whatever stalls come after."""
    addresses = {name: f"ipc://{tmp_path}/{name}" for name in ("setpoint", "telemetry", "control", "recording")}

    async def tell() -> None:
        daemon = Daemon(Config(endpoints=Endpoints(**addresses)), core, no_device, [])
        control, causes = daemon._control, daemon._causes

        def stall(now_s: float, took_s: float, culprit: str) -> None:
            control.state = control.state.replaced(time_s=now_s, sight=Sight(now_s, now_s, took_s, is_blind=True))
            causes.note_stall(control.state, Delay(round(took_s * 1e9), culprit, 1))

        stall(10.0, 0.083, KERNEL)
        # a late tick that is no stall is not taken for one
        control.state = control.state.replaced(time_s=10.1)
        causes.note_stall(control.state, Delay(2_000_000, "TelemetryLoop.publish", 1_500_000))
        control.latch(Fault.HOST_STALL)
        causes.tell(control.new_faults(), control.state, None)
        stall(11.0, 0.006, "somebody else")
        control.latch(Fault.PLAN_FAILED)
        causes.tell(control.new_faults(), control.state, None)
        assert control.new_faults() == ()
        daemon._endpoint.close()

    asyncio.run(tell())
    assert [record.getMessage() for record in caplog.records if record.getMessage().startswith("fault")] == [
        "fault: HOST_STALL: the control loop stood still for 83 ms (kernel); "
        f"the device opened the gap by itself after 50 ms; next: {FAULTS[Fault.HOST_STALL].remedy}",
        f"fault: PLAN_FAILED: {FAULTS[Fault.PLAN_FAILED].cause}; next: {FAULTS[Fault.PLAN_FAILED].remedy}",
    ]
