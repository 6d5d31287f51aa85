"""Topics of the telemetry socket, for their subscribers: the handle's motion, and the verdict on every setpoint."""

import time

from tormagd.config import Config
from tormagd.control.ask.way import place_and_rate
from tormagd.control.assembly.build import Core
from tormagd.control.safety.codes import Limit
from tormagd.daemon.beat import Beat
from tormagd.daemon.control_loop import ControlLoop
from tormagd.daemon.endpoint import Endpoint
from tormagd.daemon.inference_loop import InferenceLoop
from tormagd.daemon.verdict import CANNOT, Judged, judged
from tormagd_client.messages import MOTION_TOPIC, VERDICT_TOPIC, VERSION, Motion, Verdict

NS = 1_000_000_000


class Topics:
    def __init__(
        self, config: Config, core: Core, control: ControlLoop, inference: InferenceLoop, endpoint: Endpoint
    ) -> None:
        self._control, self._inference, self._endpoint = control, inference, endpoint
        self.core = core
        self._push_sign = float(config.handle.push_sign)
        self._period_ns = NS // min(config.rates.motion_hz, config.rates.control_hz)
        self._due_ns, self._sensed_s = 0, 0.0
        self._judged: object = None
        self._passed_over: tuple[str, int] | None = None

    def publish(self, beat: Beat) -> bool:
        listeners = self._endpoint.listeners
        is_said = listeners.has(VERDICT_TOPIC) and self._publish_verdicts()
        return (listeners.has(MOTION_TOPIC) and self._publish_motion(beat)) or is_said

    def handle(self) -> tuple[float, float] | None:
        """Return the handle's place, mm, and rate, mm/s, positive pushing on."""
        measured = self._control.stepper.measured
        return None if measured is None else place_and_rate(measured, self._push_sign)

    def verdict(self) -> Verdict | None:
        in_force = self._endpoint.inbox.in_force
        return None if in_force is None else self._verdict(*in_force[1:3], self._judge(), in_force.is_raised)

    def _publish_motion(self, beat: Beat) -> bool:
        measured = self._control.stepper.measured
        if beat.due_ns < self._due_ns or measured is None or measured.sensed_s == self._sensed_s:
            return False
        # missed ones are not made up for
        self._due_ns = self._period_ns + (beat.due_ns if beat.due_ns - self._due_ns > self._period_ns else self._due_ns)
        self._sensed_s = measured.sensed_s
        heard_ns = time.time_ns() - round(NS * (time.monotonic() - measured.sensed_s))
        place_mm, rate_mm_s = place_and_rate(measured, self._push_sign)
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
