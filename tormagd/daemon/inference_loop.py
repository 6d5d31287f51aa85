"""The inference loop: plans at once when a setpoint arrived, and at least `inference_hz` times a second otherwise."""

import time

from tormagd.control.estimate import Estimate
from tormagd.control.plan import Planner, PlanState
from tormagd.daemon.endpoint import Endpoint
from tormagd.daemon.rate_group import RateGroup

MARGIN = 1.5
"A plan is begun only where the slack before the next control tick is this many times the usual plan."


class InferenceLoop:
    """Plans in the slack of the control loop, which always goes first."""

    def __init__(self, planner: Planner, endpoint: Endpoint, period_ns: int, now_s: float) -> None:
        self._planner, self._endpoint = planner, endpoint
        self.state: PlanState = planner.start(now_s)
        self.timing = RateGroup("inference", period_ns)
        self._due_ns = time.monotonic_ns() + period_ns
        self._setpoint_ns = 0
        self._usual_ns = 200_000.0

    def receive(self, estimate: Estimate | None, next_tick_ns: int) -> None:
        """Reads setpoints; plans on a new one if the next control tick leaves the time."""
        now_ns = time.monotonic_ns()
        if self._endpoint.drain_setpoints(now_ns * 1e-9) and not self._setpoint_ns:
            self._setpoint_ns = now_ns
        if self._setpoint_ns and time.monotonic_ns() + MARGIN * self._usual_ns < next_tick_ns:
            self._plan(estimate, self._setpoint_ns)

    def after_tick(self, estimate: Estimate | None) -> None:
        """Plans if a setpoint is waiting or a plan is due; called in the slack after a control tick."""
        now_ns = time.monotonic_ns()
        # reading here too makes the edge-triggered descriptor harmless: nothing waits longer than a tick
        if self._endpoint.drain_setpoints(now_ns * 1e-9) and not self._setpoint_ns:
            self._setpoint_ns = now_ns
        if self._setpoint_ns:
            self._plan(estimate, self._setpoint_ns)
        elif now_ns >= self._due_ns:
            self._plan(estimate, self._due_ns)

    def _plan(self, estimate: Estimate | None, due_ns: int) -> None:
        start_ns = time.monotonic_ns()
        self.state = self._planner.plan(self.state, start_ns * 1e-9, self._endpoint.inbox.newest, estimate)
        end_ns = time.monotonic_ns()
        self.timing.record(due_ns, start_ns, end_ns)
        self._usual_ns += 0.1 * (end_ns - start_ns - self._usual_ns)
        self._setpoint_ns = 0
        # due again one period after this plan; never an instant in the past, so that a late plan is not chased
        self._due_ns = start_ns + self.timing.period_ns
