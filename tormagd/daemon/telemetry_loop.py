"""The telemetry loop, at 50 Hz: publishes snapshot and ticks."""

import time
from collections.abc import Iterator

from tormagd.config import Config
from tormagd.control.assembly.belief import beliefs
from tormagd.control.assembly.build import Core
from tormagd.control.safety.codes import Limit
from tormagd.daemon.beat import Beat
from tormagd.daemon.black_box import BlackBox
from tormagd.daemon.commands import Commands
from tormagd.daemon.control_loop import ControlLoop
from tormagd.daemon.endpoint import Endpoint
from tormagd.daemon.force_delay import ForceDelay
from tormagd.daemon.inference_loop import InferenceLoop
from tormagd.daemon.rate_group import Histogram, RateGroup
from tormagd.daemon.topics import Topics
from tormagd.record.force_following import Following
from tormagd.record.telemetry import Moment, snapshot
from tormagd.record.ticks import TOLD, encode_ticks
from tormagd_client.messages import Telemetry

REQUESTS = 16
"Answered in a telemetry period: a client that keeps asking must not keep a `stop` waiting."
FORGETS_S = 5.0
"After this time a tracking error counts 1/e."


class TelemetryLoop:
    def __init__(
        self,
        config: Config,
        core: Core,
        control: ControlLoop,
        inference: InferenceLoop,
        endpoint: Endpoint,
        box: BlackBox,
        commands: Commands,
    ) -> None:
        self._control, self._inference, self._endpoint = control, inference, endpoint
        self._box, self._commands = box, commands
        self._hz = config.rates.telemetry_hz
        self.timing = RateGroup("telemetry", 1_000_000_000 // self._hz)
        self.groups = [control.timing, inference.timing, self.timing]
        if inference.beside is not None:
            self.groups.append(inference.beside.timing)
        self.newest: Telemetry
        self._moment: Moment | None = None
        self.way = ForceDelay()
        self.topics = Topics(config, core, control, inference, endpoint)
        self._left, self._beats_per_snapshot = 0, config.rates.control_hz // self._hz
        self.waiting = 0
        "Requests that are answered with this snapshot."
        self.run_scene(core)

    def run_scene(self, core: Core) -> None:
        self.core, self.topics.core = core, core
        self.following = Following(1.0 / self._hz, FORGETS_S)

    def record(self, _beat: Beat) -> None:
        control = self._control
        if control.output is None or control.used is None:
            return
        self._left -= 1
        self.way.ticked(control.stepper.time_s, control.used, self._endpoint.inbox.sources.playout_ms * 1e-3)
        timing = control.timing
        self._moment = Moment(
            control.stepper,
            control.output,
            control.used,
            control.measurement,
            timing.lateness_us,
            timing.exec_us,
            timing.runs,
        )
        part = self._box.ticked(self._moment, control.stepper, self._inference.planner)
        if part is not None and self._box.is_heard:
            self._endpoint.publish_ticks(encode_ticks(part[1], core=part[0]))

    def publish(self, beat: Beat) -> bool:
        if self._left > 0 or self._moment is None:
            return False
        self._left = max(self._left + self._beats_per_snapshot, 1)
        start_ns = time.monotonic_ns()
        endpoint, connections = self._endpoint, self._endpoint.admission.connections()
        tick, box = self._moment.row(), self._box
        box.is_heard = connections["recording"] > 0
        self.following.look(
            tick.operating_state,
            tick.limits,
            tick.setpoint_cf,
            tick.measured_cf,
            tick.handle_mm,
            tick.handle_rate_mm_s,
        )
        # requests that wait now are answered with this snapshot, later ones with the next
        self.waiting = min(endpoint.requests.count, REQUESTS)
        is_kept = box.journal.is_kept and self.timing.runs % self._hz == 0  # once a second
        if connections["telemetry"] or self.waiting or is_kept:
            now_s, in_force = start_ns * 1e-9, endpoint.inbox.in_force
            self.newest = snapshot(
                tick,
                self.timing.runs,
                self._control.is_homed(),
                self._control.is_busy(),
                None if in_force is None else now_s - in_force.stamp_s,
                beliefs(self._inference.planner, self._control.stepper, now_s, self.core.scene.terms),
                self.topics.handle(),
                self.topics.verdict(),
                self._commands.mark,
                (Limit.NO_BLACK_BOX,) * box.is_missing,
            )
            endpoint.publish(self.newest)
        if is_kept:
            box.journal.note(TOLD, self.newest)
        self.timing.record(beat.due_ns, start_ns, time.monotonic_ns())
        return True

    def histograms(self) -> Iterator[Histogram]:
        for group in self.groups:
            yield from (group.lateness, group.exec)
        yield self.way.to_duty
