"""The inference loop: plans at once when a setpoint arrived, and at least `inference_hz` times a second otherwise."""

import logging
import time
from collections.abc import Callable
from typing import Final

from tormagd.assembly.journal import Journal
from tormagd.control.believe.believe import Learned
from tormagd.control.believe.sensor import Disputed
from tormagd.control.core import Planner
from tormagd.control.records import Measured
from tormagd.daemon.endpoint import Endpoint
from tormagd.daemon.rate_group import RateGroup
from tormagd.daemon.search_process import SearchProcess

LEARNT_SHARE = 0.01
"By how much of itself one plan moves the slack, however long it was interrupted."
MOST_SLACK_NS = 400_000.0
"Plans that take longer run into the tick, rather than let setpoints wait for one tick after another."

PLAN_ERRORS = (ValueError, ArithmeticError, RuntimeError)
"A DomainError; what NumPy raises."

log = logging.getLogger(__name__)


class InferenceLoop:
    """Plans in the slack of the control loop, which always goes first. `on_failure` hears of a plan that failed."""

    def __init__(
        self,
        planner: Planner,
        endpoint: Endpoint,
        period_ns: int,
        clock_ns: Callable[[], int] = time.monotonic_ns,
        *,
        journal: Journal,
        on_failure: Callable[[], None],
        beside: SearchProcess | None = None,
    ) -> None:
        """`beside` is the search for the field where it is not part of the plans."""
        self.planner, self._endpoint, self._clock_ns, self._journal = planner, endpoint, clock_ns, journal
        self._on_failure, self._failure = on_failure, ""
        self.beside: Final = beside
        self.timing = RateGroup("inference", period_ns)
        self._due_ns = 0  # the first is due with the first tick: what the daemon does before that is no stall
        self._waiting_ns = 0
        self._slack_ns = 200_000.0

    def teach(self, learned: Learned) -> None:
        """Plans from now on for a device of which this is known."""
        self._journal.taught(learned)
        self.planner.teach(learned)

    def confirm(self, wrong: Disputed) -> None:
        """The operator says that the device has changed, or that its sensor is wrong."""
        self._journal.confirmed(wrong)
        self.planner.confirm(wrong)

    def receive(self, measured: Measured | None, next_tick_ns: int) -> None:
        """Something has arrived: reads it, and plans on a new setpoint, if the next control tick leaves the time."""
        start_ns = self._clock_ns()
        if start_ns + self._slack_ns >= next_tick_ns:
            # not even reading: the tick would wait for that, and the plan come no sooner. The descriptor stays
            # readable, so this is asked again and again until the tick: at 500 setpoints a second 1 % of the time
            self._waiting_ns = self._waiting_ns or start_ns
        elif self._endpoint.is_flooded:
            pass  # it goes on once a tick: between ticks a flood would leave the processor nothing else
        elif self._endpoint.drain_setpoints():
            self._plan(measured, start_ns)
            self._learn_slack(start_ns)

    def after_tick(self, measured: Measured | None) -> None:
        """Plans if a setpoint is waiting or a plan is due; called in the slack after a control tick."""
        now_ns = self._clock_ns()
        # reading here too makes the edge-triggered descriptor harmless: nothing waits longer than a tick
        if self._endpoint.drain_setpoints():
            self._plan(measured, self._waiting_ns or now_ns)
            self._learn_slack(now_ns)
        elif now_ns >= self._due_ns:
            self._plan(measured, self._due_ns or now_ns)
        self._waiting_ns = 0
        # here the next tick is farthest: a plan for a setpoint that comes just before it has not that time
        self._foresee(now_ns * 1e-9)

    def _plan(self, measured: Measured | None, due_ns: int) -> None:
        start_ns = self._clock_ns()
        self._make_plan(start_ns * 1e-9, measured)
        self.timing.record(due_ns, start_ns, self._clock_ns())
        # a period after this one was due, or the rate would fall by what each waits for its tick; but what was missed
        # is not made up for
        period_ns = self.timing.period_ns
        self._due_ns = period_ns + (due_ns if start_ns - due_ns < period_ns else start_ns)

    def _learn_slack(self, start_ns: int) -> None:
        """From reading, which began then, to the plan, which is done."""
        took_ns = self._clock_ns() - start_ns
        # to the median: half of the setpoints that just have the time make the tick wait, by what plans vary; with a
        # longer slack more of them would wait, and for a whole period
        moved_ns = self._slack_ns * (1.0 + (LEARNT_SHARE if took_ns > self._slack_ns else -LEARNT_SHARE))
        self._slack_ns = min(moved_ns, MOST_SLACK_NS)

    def _make_plan(self, now_s: float, measured: Measured | None) -> None:
        setpoint, beside = self._endpoint.inbox.newest, self.beside
        answer = None if beside is None else beside.answer()
        if answer is not None:
            self._journal.answered(answer)
            self.planner.answered(answer)
        self._journal.planned(now_s, setpoint)
        try:
            self.planner.plan(now_s, setpoint, measured)
        except PLAN_ERRORS as error:
            self._begin_afresh(now_s, error)
        if beside is not None:
            beside.ask(self.planner.question)

    def _foresee(self, now_s: float) -> None:
        try:
            if self.planner.foresee():
                self._journal.foresaw()
        except PLAN_ERRORS as error:
            self._begin_afresh(now_s, error)

    def _begin_afresh(self, now_s: float, error: Exception) -> None:
        """Goes on without what could not be planned for."""
        inbox = self._endpoint.inbox
        if str(error) != self._failure:  # the first failure is news, the same one again is not
            self._failure = str(error)
            log.error("no gap could be planned for %s", inbox.newest, exc_info=error)
        inbox.withdraw(f"no gap could be planned: {error}")
        self._on_failure()
        self._journal.began_afresh(now_s)
        self.planner.afresh(now_s)
