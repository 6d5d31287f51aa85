"""The daemon put together: one thread, one event loop, one beat a period."""

import asyncio
import contextlib
import logging
import signal
import sys
import time
from collections.abc import Callable

import msgspec

from tormagd.config import Config
from tormagd.control.assembly.build import Core, build_core
from tormagd.control.safety.codes import Fault
from tormagd.control.safety.operating_state import OperatingState, RefusedError
from tormagd.daemon.answers import Answers
from tormagd.daemon.beat import Beat, Phases
from tormagd.daemon.black_box import AFTER_FAULT_S, BlackBox, header
from tormagd.daemon.causes import Causes
from tormagd.daemon.commands import Commands
from tormagd.daemon.configuration import Calibrations, SceneChange, reread
from tormagd.daemon.control_loop import ControlLoop
from tormagd.daemon.endpoint import Endpoint
from tormagd.daemon.inference_loop import InferenceLoop
from tormagd.daemon.profiles import ProfileFolder, Profiles, gains_of, state_folder
from tormagd.daemon.rate_group import ERROR_PERIODS
from tormagd.daemon.realtime import Heartbeat, freeze_garbage, priority_of_threads
from tormagd.daemon.search_process import SearchProcess
from tormagd.daemon.service import Service, notify
from tormagd.daemon.telemetry_loop import TelemetryLoop
from tormagd.ground.access_keys import KeyRing
from tormagd.hardware.backend import Backend
from tormagd.hardware.connection import Connection
from tormagd_client.endpoints import ConfigError

NS = 1_000_000_000
OPENING_LOOK_S = 0.02
SWITCH_S = 1e-4
"How long another thread may keep the interpreter's lock from this one; Python's own value is 5 ms."
LONGEST_RETRACT_S = 10.0
"The firmware needs 3 s for a full stroke; if it cannot retract, it reports that itself."
TELL_S = 0.1
NAMED_S = 0.5
"By then a gap that does not open is a fault, and in the log."

log = logging.getLogger(__name__)


class Daemon:
    """Runs one scene on one device until it is told to end. Create it inside the event loop."""

    def __init__(
        self,
        config: Config,
        core: Core,
        open_backend: Callable[[], Backend],
        refused: list[str],
        keys: KeyRing | None = None,
        box: BlackBox | None = None,
        read_again: Callable[[], Config] = Config,
        beside: SearchProcess | None = None,
        config_file: str | None = None,
    ) -> None:
        self._config, self._core, self._read_again, self._of_file = config, core, read_again, config
        self._loop = asyncio.get_running_loop()
        self._causes = Causes(config.device)
        self._connection = Connection(config.device, open_backend, self._lose_link, self._causes.host)
        self._endpoint = Endpoint(config.endpoints, priority_of_threads(), config.sources, keys)
        self._endpoint.inbox.begin_scene(core.scene)
        self._keys = keys
        rates = config.rates
        period_ns = NS // rates.control_hz
        self._phases = Phases(ERROR_PERIODS * period_ns)
        self._box = box or BlackBox(None, header(config, core), rates.control_hz)
        self._control = ControlLoop(core.stepper(time.monotonic()), self._connection, period_ns, self._box.journal)
        self._inference = InferenceLoop(
            core.planner(time.monotonic()),
            self._endpoint.inbox,
            NS // rates.inference_hz,
            journal=self._box.journal,
            on_failure=self._fail_plan,
            beside=beside,
        )
        self._calibrations = Calibrations(
            state_folder(config.device.calibrations, "calibrations"), config, self._run_core
        )
        control, inference, endpoint = self._control, self._inference, self._endpoint
        self._commands = Commands(
            config,
            control,
            inference,
            self._connection,
            endpoint.inbox,
            self._box,
            self._profiles_of(core),
            self._calibrations,
            SceneChange(self._build, self._require_disabled, self._run_scene),
        )
        self._telemetry = TelemetryLoop(config, core, control, inference, endpoint, self._box, self._commands)
        self._answers = Answers(
            control,
            inference,
            endpoint,
            self._telemetry,
            self._commands,
            self._phases,
            self._causes,
            refused,
            config_file,
        )
        self._service, self._told_s = Service(), 0.0
        self._box.begin(self._control.stepper, self._inference.planner, self._connection)
        telemetry = self._telemetry
        self._phases.begin(
            [
                ("receive", self._receive),
                ("requests", lambda _beat: self._endpoint.take_requests(self._answers.command)),
                ("plan", self._plan),
                ("drive", self._drive),
                ("record", telemetry.record),
                ("topics", telemetry.publish_topics),
                ("telemetry", telemetry.publish),
            ],
            [
                ("forecast", self._inference.foresee),
                ("tell", self._tell),
                ("answers", self._answers.serve),
                ("admission", lambda _beat: self._endpoint.admission.update()),
            ],
        )
        self._ended = asyncio.Event()

    def _profiles_of(self, core: Core) -> Profiles:
        folder, bounds = state_folder(core.config.device.profiles, "profiles"), core.config.trim
        known = core.scene.insert.name, core.model, bounds, gains_of(core.config)
        of_insert = None if folder is None else ProfileFolder(folder, *known)
        return Profiles(of_insert, self._inference.planner.believe, self._inference.teach)

    async def run(self) -> None:
        """Open the device and run until SIGTERM or SIGINT; then open the gap, keep the profile and close everything."""
        for number in (signal.SIGTERM, signal.SIGINT):
            self._loop.add_signal_handler(number, self._ended.set)
        self._loop.add_signal_handler(signal.SIGHUP, self._begin_reload)
        self._connection.open(time.monotonic())
        freeze_garbage()
        sys.setswitchinterval(SWITCH_S)
        scene, solver = self._core.scene, self._core.solver
        log.info(
            "running scene %s (%s), without the terms: %s; with the %s solver at %g mT (%s)",
            scene.name,
            scene.fingerprint,
            ", ".join(scene.terms.left_out) or "none",
            solver.solver,
            solver.step_mT,
            solver.reason,
        )
        heartbeat = Heartbeat(NS // self._config.rates.control_hz)
        self._loop.add_reader(heartbeat.fileno(), self._beat, heartbeat)
        await self._ended.wait()
        notify("STOPPING=1")
        await self._open_gap()
        self._commands.profiles.look(None, is_driven=False)
        await self._commands.profiles.finished()
        self._loop.remove_reader(heartbeat.fileno())
        self._connection.close()
        heartbeat.close()
        self._endpoint.close()
        self._box.close()
        if self._inference.beside is not None:
            self._inference.beside.close()
        log.info("tormagd has ended")

    def _beat(self, heartbeat: Heartbeat) -> None:
        if beats := heartbeat.beats():
            self._phases.run(heartbeat.due_ns, beats - 1)

    def _receive(self, beat: Beat) -> None:
        period_ns = self._control.timing.period_ns
        if (late_ns := beat.start_ns - beat.due_ns + beat.merged * period_ns) > period_ns:
            self._causes.note_wait(beat.start_ns * 1e-9, (late_ns - self._phases.ran_ns()) * 1e-9)
        self._connection.receive(time.monotonic())
        self._endpoint.arrivals.look()
        self._endpoint.hear()

    def _plan(self, beat: Beat) -> None:
        # before the step: a setpoint is driven in the beat that takes it
        is_every, stepper, has_come = self._config.rates.plan_every_setpoint, self._control.stepper, False
        try:
            # those that wait for a plan are cheaper together
            has_come = (is_every or self._inference.is_due(beat)) and self._endpoint.take_setpoints()
        finally:  # or nothing would age
            self._inference.plan(
                beat, stepper.measured, is_asked=is_every and has_come, is_followed=stepper.is_followed
            )

    def _lose_link(self) -> None:
        self._causes.note_loss(self._connection.cause, self._connection.remedy)
        self._control.lose_link()

    def _fail_plan(self, why: str) -> None:
        self._causes.plan_failure = why
        self._control.latch(Fault.PLAN_FAILED)

    def _drive(self, beat: Beat) -> None:
        control, timing = self._control, self._control.timing
        control.drive(beat, self._inference.planner.planned)
        if timing.delay_ns > timing.period_ns:
            # late since the first of the missed beats was due
            self._causes.note_stall(control.stepper, self._phases.blame(beat.due_ns - beat.merged * timing.period_ns))
        else:
            self._phases.on_time()
        if faults := control.new_faults():
            self._causes.tell(faults, control.stepper, control.measurement)
            with contextlib.suppress(RefusedError):
                self._commands.keep(str(faults[0]), AFTER_FAULT_S)

    def _tell(self, _beat: Beat) -> bool:
        """Feed log, systemd and black box, and continue an arming; return False if it is not time."""
        now_s = time.monotonic()
        if now_s - self._told_s < TELL_S:
            return False
        self._told_s = now_s
        self._endpoint.inbox.refresh(now_s)
        self._endpoint.inbox.tell(now_s)
        self._box.look()
        limit_s, plan = self._config.realtime.watchdog_ms * 1e-3, self._inference.planner.planned
        self._service.tell(now_s, limit_s, self._control, plan, self._connection, self._core.scene.name)
        self._control.go_on_arming(self._commands.conditions())
        self._endpoint.tell(now_s)
        self._phases.tell()
        return True

    async def _build(self, scene: str) -> Core:
        """Build the core of another scene at the running rates."""
        # in a thread, so that no beat waits
        core = await asyncio.to_thread(build_core, msgspec.structs.replace(self._config, scene=scene))
        if core.element.is_beside or self._inference.beside is not None:
            raise ConfigError(f"scene {core.scene.name}: a search beside the plans begins with the daemon: restart it")
        await self._commands.profiles.finished()
        return core

    def _require_disabled(self) -> None:
        self._control.command("use-scene", self._commands.conditions())

    def _run_scene(self, scene: str, core: Core) -> None:
        """Run `core`, made for `scene`; if model and insert are the same, keep what was learned."""
        before, learned = self._core, self._inference.planner.believe.learned()
        self._calibrations.configured = msgspec.structs.replace(self._calibrations.configured, scene=scene)
        self._run_core(msgspec.structs.replace(self._config, scene=scene), core)
        if (core.model, core.scene.insert.name) == (before.model, before.scene.insert.name):
            self._inference.teach(learned)

    def _run_core(self, config: Config, core: Core) -> None:
        control, inference, now_s = self._control, self._inference, time.monotonic()
        safety, stepper, planner = control.stepper.safety, core.stepper(now_s), core.planner(now_s)
        stepper.safety = safety
        stepper.opening.rest(safety.request_number)
        self._config, self._core = config, core
        control.stepper, inference.planner = stepper, planner
        self._endpoint.inbox.begin_scene(core.scene)
        self._commands.profiles.close()
        self._commands.config, self._commands.profiles = config, self._profiles_of(core)
        self._telemetry.run_scene(core)
        self._answers.reset()
        self._box.begin_scene(header(self._config, core), stepper, planner)

    def _begin_reload(self) -> None:
        self._reloading = self._loop.create_task(self._reload())
        # an unexpected error is reported at once, not when the task is collected
        self._reloading.add_done_callback(asyncio.Task.result)

    async def _reload(self) -> None:
        """Read keys and configuration again."""
        try:
            if self._keys is None:
                log.info("no list of keys to read again: there is no endpoints.curve")
            else:
                self._endpoint.admission.let_in(await asyncio.to_thread(self._keys.load_allowed))
        except ConfigError as error:
            log.error("the lists of keys stay as they were: %s; next: mend that and reload again", error)
        try:
            read = await asyncio.to_thread(self._read_again)
            # a scene that an operator chose since is no news of the file
            known = {"scene": read.scene} if read.scene == self._config.scene else {}
            of_file, taken, waiting = reread(msgspec.structs.replace(self._of_file, **known), read)
            configured, config = [reread(each, read)[0] for each in (self._calibrations.configured, self._config)]
        except ValueError as error:
            log.error("the configuration stays as it was: %s; next: mend that and reload again", error)
            return
        self._of_file, self._calibrations.configured, self._config = of_file, configured, config
        self._calibrations.read_again()
        self._commands.config = self._config
        self._endpoint.inbox.sources = configured.sources
        log.info("configuration read again: %s", f"now in force: {', '.join(taken)}" if taken else "no news")
        if waiting:
            log.warning("not before a restart (systemctl restart tormagd): %s", ", ".join(waiting))

    async def _open_gap(self) -> None:
        """Open the gap, and wait for it up to LONGEST_RETRACT_S while the beat goes on."""
        if self._control.stepper.safety.operating_state is not OperatingState.FAULT and self._connection.measurement:
            self._control.command("disable", self._commands.conditions())
        until_s = time.monotonic() + LONGEST_RETRACT_S
        while self._control.is_busy() and time.monotonic() < until_s:
            await asyncio.sleep(OPENING_LOOK_S)
        if self._control.is_open() is False:
            await asyncio.sleep(NAMED_S)
