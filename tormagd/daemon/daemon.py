"""The daemon put together: one thread, one event loop, three loops in it."""

import asyncio
import contextlib
import logging
import signal
import sys
import time
from collections.abc import Callable
from functools import partial

from tormagd.assembly.build import Core
from tormagd.config import Config
from tormagd.control.believe.strength import device_bounds
from tormagd.daemon import notify
from tormagd.daemon.black_box import AFTER_FAULT_S, BlackBox
from tormagd.daemon.callbacks import Callbacks
from tormagd.daemon.causes import Causes
from tormagd.daemon.control_loop import ControlLoop
from tormagd.daemon.endpoint import Endpoint
from tormagd.daemon.heartbeat import Heartbeat
from tormagd.daemon.inference_loop import InferenceLoop
from tormagd.daemon.profiles import ProfileFolder, Profiles, state_folder
from tormagd.daemon.realtime import freeze_garbage, priority_of_threads
from tormagd.daemon.reload import reread
from tormagd.daemon.search_process import SearchProcess
from tormagd.daemon.telemetry_loop import TelemetryLoop
from tormagd.hardware.backend import Backend
from tormagd.hardware.connection import Connection
from tormagd.keys import KeyRing
from tormagd.safety.codes import Fault
from tormagd.safety.operating_state import OperatingState, RefusedError
from tormagd.scenes.scene import terms_of
from tormagd_client.endpoints import ConfigError

NS = 1_000_000_000
OPENING_LOOK_S = 0.02
"How often the end of the opening is looked for: Status comes as often."
SWITCH_S = 1e-4
"For so long another thread may keep the interpreter's lock while this one waits for it; Python's own is 5 ms."
TAKEN_BEFORE_NS = 200_000
"Requests are taken no later than this before the next control tick."
SERVED_AFTER = 1
"""Requests are answered so many ticks after a snapshot: both after the same one made the next tick late where this
thread has no real-time priority."""
LONGEST_RETRACT_S = 10.0
"A full stroke takes the firmware 3 s at its own retract speed; longer means that it cannot, and it says so itself."
NAMED_S = 0.5
"By then a gap that does not open is a fault, and in the log."

log = logging.getLogger(__name__)


class Daemon:
    """Runs one scene on one device until it is told to end. `read_again` gives the configuration as it is now."""

    def __init__(
        self,
        config: Config,
        core: Core,
        open_backend: Callable[[], Backend],
        refused: list[str],
        keys: KeyRing | None = None,
        box: BlackBox | None = None,
        read_again: Callable[[], Config] | None = None,
        beside: SearchProcess | None = None,
    ) -> None:
        """`box` is one whose process runs already; without it none is kept. `beside` is there where the core's search
        runs beside the plans."""
        self._config, self._core, self._read_again = config, core, read_again
        self._loop = asyncio.get_running_loop()
        self._callbacks = Callbacks(self._loop)
        self._causes = Causes(config.device)
        self._connection = Connection(config.device, open_backend, self._lose_link)
        self._endpoint = Endpoint(config.endpoints, priority_of_threads(), config.sources.priority, keys)
        rates = config.rates
        self._box = box or BlackBox(None, {}, rates.control_hz)
        self._control = ControlLoop(
            core.stepper(time.monotonic()), self._connection, NS // rates.control_hz, self._box.journal
        )
        self._endpoint.admission.pause_s = self._control.until_slack_s
        self._inference = InferenceLoop(
            core.planner(time.monotonic()),
            self._endpoint,
            NS // rates.inference_hz,
            journal=self._box.journal,
            on_failure=partial(self._control.latch, Fault.PLAN_FAILED),
            beside=beside,
        )
        folder = state_folder(config.device.profiles, "profiles")
        self._profiles = Profiles(
            None
            if folder is None
            else ProfileFolder(folder, core.scene.insert.name, core.model, device_bounds(config.trim)),
            self._inference.planner.believe,
            self._inference.teach,
        )
        self._telemetry = TelemetryLoop(
            config,
            core,
            self._control,
            self._inference,
            self._profiles,
            self._connection,
            self._endpoint,
            self._callbacks,
            self._causes,
            self._box,
            refused,
        )
        self._box.begin(self._control.stepper, self._inference.planner, self._connection)
        self._ticks_per_snapshot = rates.control_hz // rates.telemetry_hz
        self._ended = asyncio.Event()

    async def run(self) -> None:
        """Runs until SIGTERM or SIGINT; opens the gap before it returns."""
        for number in (signal.SIGTERM, signal.SIGINT):
            self._loop.add_signal_handler(number, self._ended.set)
        self._loop.add_signal_handler(signal.SIGHUP, self._reload)
        self._connection.open(self._callbacks)
        freeze_garbage()
        sys.setswitchinterval(SWITCH_S)
        self._callbacks.add_reader(self._endpoint.fileno(), self._receive_setpoints)
        self._callbacks.add_reader(self._endpoint.control_fileno(), self._receive_requests)
        scene, solver = self._core.scene, self._core.solver
        log.info(
            "running scene %s (%s), without the terms: %s; with the %s solver at %g mT (%s)",
            scene.name,
            scene.fingerprint,
            ", ".join(terms_of(scene).left_out) or "none",
            solver.solver,
            solver.step_mT,
            solver.reason,
        )
        heartbeat = Heartbeat(NS // self._config.rates.control_hz)
        # not on one account: its parts have their own
        self._loop.add_reader(heartbeat.fileno(), self._beat, heartbeat)
        await self._ended.wait()
        notify.notify("STOPPING=1")
        await self._open_gap()
        self._profiles.look(None, is_driven=False)
        await self._profiles.finished()
        self._loop.remove_reader(heartbeat.fileno())
        self._callbacks.remove_reader(self._endpoint.fileno())
        self._callbacks.remove_reader(self._endpoint.control_fileno())
        self._connection.close()
        heartbeat.close()
        self._endpoint.close()
        self._box.close()
        if self._inference.beside is not None:
            self._inference.beside.close()
        log.info("ended")

    def _beat(self, heartbeat: Heartbeat) -> None:
        beats = heartbeat.beats()
        if not beats:
            return  # a spurious wake-up
        callbacks, control, timing = self._callbacks, self._control, self._control.timing
        start_ns = time.monotonic_ns()
        used = self._inference.planner.planned
        control.tick(heartbeat.due_ns, beats - 1, used)
        driven_ns = time.monotonic_ns()
        callbacks.ran(ControlLoop.tick.__qualname__, start_ns, driven_ns)
        if timing.delay_ns > timing.period_ns:
            self._causes.note_stall(control.stepper, callbacks.blame(driven_ns - timing.delay_ns, driven_ns))
        else:
            callbacks.forget()
        if self._endpoint.has_requests:
            self._telemetry.take_requests()
            callbacks.ran(TelemetryLoop.take_requests.__qualname__, driven_ns, time.monotonic_ns())
        if faults := control.new_faults():
            self._causes.tell(faults, control.stepper, control.measurement)
            with contextlib.suppress(RefusedError):  # where none is kept
                self._telemetry.keep(str(faults[0]), AFTER_FAULT_S)
        try:
            self._inference.after_tick(control.stepper.measured)
        finally:  # whatever becomes of planning, the daemon can be seen and stopped
            planned_ns = time.monotonic_ns()
            callbacks.ran(InferenceLoop.after_tick.__qualname__, driven_ns, planned_ns)
            self._telemetry.record(used)
            if (timing.runs + SERVED_AFTER) % self._ticks_per_snapshot == 0:
                self._telemetry.publish(heartbeat.due_ns)
                callbacks.ran(TelemetryLoop.publish.__qualname__, planned_ns, time.monotonic_ns())
            if timing.runs % self._ticks_per_snapshot == 0:
                begun_ns = time.monotonic_ns()
                self._telemetry.serve()
                callbacks.ran(TelemetryLoop.serve.__qualname__, begun_ns, time.monotonic_ns())

    def _receive_setpoints(self) -> None:
        self._inference.receive(self._control.stepper.measured, self._control.next_tick_ns)

    def _receive_requests(self) -> None:
        # shortly before a tick they wait for it, as setpoints do: it goes first, and sends what they ask for. A flood
        # waits for it anyway: it would leave the processor nothing else
        if self._endpoint.has_requests:
            return
        if time.monotonic_ns() + TAKEN_BEFORE_NS < self._control.next_tick_ns:
            self._telemetry.take_requests()
        else:
            self._endpoint.has_requests = True

    def _reload(self) -> None:
        self._endpoint.admission.reload()
        if self._read_again is not None:
            # in a thread: reading a file is nothing that a tick should wait for
            reading = self._loop.run_in_executor(None, self._read_again)
            reading.add_done_callback(self._take_over)

    def _take_over(self, reading: "asyncio.Future[Config]") -> None:
        try:
            read = reading.result()
        except ConfigError as error:
            log.error("the configuration stays as it was: %s", error)
            return
        again = reread(self._config, read)
        self._config = again.config
        self._telemetry.take_over(again.config)
        log.info(
            "configuration read again: %s", f"now in force: {', '.join(again.taken)}" if again.taken else "no news"
        )
        if again.waiting:
            log.warning("not before a restart (systemctl restart tormagd): %s", ", ".join(again.waiting))

    def _lose_link(self) -> None:
        self._control.lose_link()

    async def _open_gap(self) -> None:
        """Asks the device to open and waits until it has; what it cannot do in time it goes on doing without us."""
        if self._control.stepper.safety.operating_state is not OperatingState.FAULT and self._connection.measurement:
            self._control.command("disable", self._telemetry.conditions())
        until_s = time.monotonic() + LONGEST_RETRACT_S
        while self._telemetry.is_busy() and time.monotonic() < until_s:
            await asyncio.sleep(OPENING_LOOK_S)
        if self._telemetry.is_open() is False:
            await asyncio.sleep(NAMED_S)
