"""What the telemetry and the recording socket publish: a snapshot 50 times a second, the ticks, and topics.

A snapshot takes two beats: one makes the tick's row, the next the message. Topics are for their subscribers only: the
handle's motion, and the verdict on every setpoint.
"""

import time
from typing import Any

from tormagd.config import Config
from tormagd.control.assembly.build import Core
from tormagd.control.safety.codes import Limit
from tormagd.daemon.beat import Beat
from tormagd.daemon.black_box import BlackBox
from tormagd.daemon.commands import Commands
from tormagd.daemon.control_loop import ControlLoop
from tormagd.daemon.endpoint import Endpoint
from tormagd.daemon.inference_loop import InferenceLoop
from tormagd.daemon.rate_group import RateGroup
from tormagd.daemon.verdict import CANNOT, ForceDelay, Judged, judged
from tormagd.record.force_following import Following
from tormagd.record.stream import TOLD, Moment, beliefs, snapshot
from tormagd.record.ticks import encode_ticks
from tormagd_client.messages import MOTION_TOPIC, VERDICT_TOPIC, VERSION, Motion, Telemetry, Verdict

NS = 1_000_000_000
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
        self.timing = RateGroup("telemetry", NS // self._hz)
        self.groups = [control.timing, inference.timing, self.timing]
        if inference.beside is not None:
            self.groups.append(inference.beside.timing)
        self.newest: Telemetry
        self._moment: Moment | None = None
        self._row: Any = None
        "Of the tick whose message comes in the next beat."
        self.way = ForceDelay()
        self._left, self._beats_per_snapshot = 0, config.rates.control_hz // self._hz
        self.waiting = 0
        "Requests that are answered with this snapshot."
        self._push_sign = float(config.handle.push_sign)
        self._motion_ns = NS // min(config.rates.motion_hz, config.rates.control_hz)
        self._motion_due_ns, self._sensed_s = 0, 0.0
        self._judged: object = None
        self._passed_over: tuple[str, int] | None = None
        self.run_scene(core)

    def run_scene(self, core: Core) -> None:
        self.core = core
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
        """Publish the snapshot of the last beat's row, or make the next row where it is time."""
        row, self._row = self._row, None
        if row is not None:
            start_ns = time.monotonic_ns()
            self._publish(row, start_ns * 1e-9)
            self.timing.record(beat.due_ns, start_ns, time.monotonic_ns())
        moment = self._moment
        if moment is None or self._left > 0:
            return row is not None
        self._left = max(self._left + self._beats_per_snapshot, 1)
        self._row = tick = moment.row()
        self.following.look(
            tick.operating_state,
            tick.limits,
            tick.setpoint_cf,
            tick.measured_cf,
            tick.handle_mm,
            tick.handle_rate_mm_s,
        )
        # before the next plan learns from a new device
        self._commands.look_at_device()
        return True

    def _publish(self, tick: Any, now_s: float) -> None:
        endpoint, box, control = self._endpoint, self._box, self._control
        connections = endpoint.admission.connections()
        box.is_heard = connections["recording"] > 0
        # requests that wait now are answered with this snapshot, later ones with the next
        self.waiting = min(endpoint.requests.count, REQUESTS)
        # a recorder gets each snapshot, a black box one a second
        is_kept = box.journal.is_kept and (box.is_heard or self.timing.runs % self._hz == 0)
        if not (connections["telemetry"] or self.waiting or is_kept):
            return
        in_force, measured = endpoint.inbox.in_force, control.stepper.measured
        place_mm, rate_mm_s = (None, None) if measured is None else measured.along(self._push_sign)
        self.newest = snapshot(
            tick,
            seq=self.timing.runs,
            is_homed=control.is_homed(),
            is_busy=control.is_busy(),
            limits=tick.limits + (Limit.NO_BLACK_BOX,) * box.is_missing,
            setpoint_age_ms=None if in_force is None else (now_s - in_force.stamp_s) * 1e3,
            belief=beliefs(self._inference.planner, control.stepper, now_s, self.core.scene.terms),
            handle_mm=place_mm,
            handle_mm_s=rate_mm_s,
            verdict=None if in_force is None else self._verdict(*in_force[1:3], self._judge(), in_force.is_raised),
            mark=self._commands.mark,
        )
        endpoint.publish(self.newest)
        if is_kept:
            box.journal.note(TOLD, self.newest)

    def publish_topics(self, beat: Beat) -> bool:
        listeners = self._endpoint.listeners
        is_said = listeners.has(VERDICT_TOPIC) and self._publish_verdicts()
        return (listeners.has(MOTION_TOPIC) and self._publish_motion(beat)) or is_said

    def _publish_motion(self, beat: Beat) -> bool:
        measured, due_ns, period_ns = self._control.stepper.measured, self._motion_due_ns, self._motion_ns
        if beat.due_ns < due_ns or measured is None or measured.sensed_s == self._sensed_s:
            return False
        # missed ones are not made up for
        self._motion_due_ns = period_ns + (beat.due_ns if beat.due_ns - due_ns > period_ns else due_ns)
        self._sensed_s = measured.sensed_s
        heard_ns = time.time_ns() - round(NS * (time.monotonic() - measured.sensed_s))
        place_mm, rate_mm_s = measured.along(self._push_sign)
        message = Motion(
            v=VERSION, t_ns=heard_ns, device_s=measured.handle_time_s, handle_mm=place_mm, handle_mm_s=rate_mm_s
        )
        self._endpoint.publish(message, MOTION_TOPIC)
        return True

    def _publish_verdicts(self) -> bool:
        """Publish the verdict on the setpoint in force, and on one of another source that was passed over."""
        in_force, is_said = self._endpoint.inbox.in_force, False
        # by identity: a source may begin its numbers anew
        if in_force is not None and in_force is not self._judged:
            self._judged, is_said = in_force, True
            verdict = self._verdict(in_force.source, in_force.seq, self._judge(), in_force.is_raised)
            self._endpoint.publish(verdict, VERDICT_TOPIC)
        other = self._endpoint.inbox.passed_over()
        if other is not None and other != self._passed_over:
            self._passed_over, is_said = other, True
            refused = Judged(CANNOT, None, (str(Limit.OTHER_SOURCE),))
            self._endpoint.publish(self._verdict(*other, refused), VERDICT_TOPIC)
        return is_said

    def _judge(self) -> Judged:
        planner, stepper, core = self._inference.planner, self._control.stepper, self.core
        measured, believe, force = stepper.measured, planner.believe, core.scene.force
        return judged(
            planner.planned,
            stepper.safety.operating_state,
            measured.gap_mm if measured is not None and measured.is_homed else None,
            core.portrait,
            believe.device,
            gap_speed_mm_s=core.gap_speeds.opening_mm_s,
            lag_s=believe.carriages.lag_s,
            tolerance_N=force.tolerance_rms_N,
            release_N_s=force.release_N_s,
        )

    @staticmethod
    def _verdict(source: str, seq: int, found: Judged, is_raised: bool = False) -> Verdict:
        return Verdict(
            v=VERSION,
            t_ns=time.time_ns(),
            source=source,
            seq=seq,
            outcome=found.outcome,
            arrives_ms=found.arrives_ms,
            why=found.why,
            is_raised=is_raised,
        )
