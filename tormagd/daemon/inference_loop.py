"""The inference loop, a phase of every beat: plans at its own rate, and when it is asked."""

import logging
import time
from collections.abc import Callable
from typing import Final

from tormagd.control.believe.believe import Learned
from tormagd.control.believe.sensor import Disputed
from tormagd.control.core import PLAN_ERRORS, Planner
from tormagd.control.records import Measured
from tormagd.daemon.beat import Beat
from tormagd.daemon.inbox import SetpointInbox
from tormagd.daemon.rate_group import RateGroup
from tormagd.daemon.search_process import SearchProcess
from tormagd.record.stream import AFRESH, ANSWER, CONFIRM, FORESEE, PLAN, TEACH, Journal

log = logging.getLogger(__name__)


class InferenceLoop:
    """Plans for the inbox's newest setpoint, and calls `on_failure` with the reason if a plan failed."""

    def __init__(
        self,
        planner: Planner,
        inbox: SetpointInbox,
        period_ns: int,
        *,
        journal: Journal,
        on_failure: Callable[[str], None],
        clock_ns: Callable[[], int] = time.monotonic_ns,
        beside: SearchProcess | None = None,
    ) -> None:
        self.planner, self._inbox, self._clock_ns, self._journal = planner, inbox, clock_ns, journal
        self._on_failure, self._failure = on_failure, ""
        self.beside: Final = beside
        self.timing = RateGroup("inference", period_ns)
        self._due_ns = 0

    def teach(self, learned: Learned) -> None:
        self._journal.note(TEACH, learned)
        self.planner.believe.teach(learned)

    def confirm(self, wrong: Disputed) -> None:
        self._journal.note(CONFIRM, wrong)
        self.planner.believe.confirm(wrong)

    def is_due(self, beat: Beat) -> bool:
        # counted from when beats are due, not when they begin: lateness does not lower the rate
        return beat.due_ns >= self._due_ns

    def plan(self, beat: Beat, measured: Measured | None, *, is_asked: bool, is_followed: bool) -> None:
        period_ns = self.timing.period_ns
        if not is_asked and not self.is_due(beat):
            return
        start_ns = self._clock_ns()
        now_s, setpoint, beside = start_ns * 1e-9, self._inbox.newest, self.beside
        answer = None if beside is None else beside.answer()
        if answer is not None:
            self._journal.note(ANSWER, answer)
            self.planner.aim.answer = answer
        self._journal.note(PLAN, now_s, setpoint)
        try:
            self.planner.plan(now_s, setpoint, measured, is_followed)
        except PLAN_ERRORS as error:
            self._begin_afresh(now_s, error)
        if beside is not None:
            beside.ask(self.planner.aim.question)
        self.timing.record(beat.due_ns, start_ns, self._clock_ns())
        # missed plans are not made up for
        is_regular = not is_asked and beat.due_ns - self._due_ns < period_ns
        self._due_ns = period_ns + (self._due_ns if is_regular else beat.due_ns)

    def foresee(self, _beat: Beat) -> bool:
        """Make a forecast for the next plans; return False if none is due."""
        try:
            is_made = self.planner.governor.foresee()
        except PLAN_ERRORS as error:
            self._begin_afresh(self._clock_ns() * 1e-9, error)
            return True
        if is_made:
            self._journal.note(FORESEE)
        return is_made

    def _begin_afresh(self, now_s: float, error: Exception) -> None:
        before, self._failure = self._failure, f"no gap could be planned: {error}"
        if self._failure != before:  # only the first of equal failures is news
            log.error(
                "the gap opens: none could be planned for %s; report the trace", self._inbox.newest, exc_info=error
            )
        self._inbox.withdraw(self._failure)
        self._on_failure(self._failure)
        self._journal.note(AFRESH, now_s)
        self.planner.afresh(now_s)
