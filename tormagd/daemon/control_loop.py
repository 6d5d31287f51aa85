"""The control loop: on every beat of the heartbeat measure, step, drive."""

import logging
import time

from tormagd.assembly.journal import Journal
from tormagd.control.core import Stepper
from tormagd.control.records import Duty, Plan
from tormagd.daemon.rate_group import RateGroup
from tormagd.hardware.connection import Connection
from tormagd.hardware.measurement import Measurement
from tormagd.safety.codes import Fault
from tormagd.safety.operating_state import Conditions, RefusedError, reason

TICK_SHARE, BEFORE_SHARE = 0.3, 0.1
"Of the period: what a tick is given, and what is kept clear before it."

log = logging.getLogger(__name__)


class ControlLoop:
    """Carries the newest measurement through `step` to the device, once a period."""

    def __init__(self, stepper: Stepper, connection: Connection, period_ns: int, journal: Journal) -> None:
        self.stepper, self._connection, self._journal = stepper, connection, journal
        self.output: Duty | None = None
        self.measurement: Measurement | None = None
        "What the last step was given; the connection may have a newer one by now."
        self.timing = RateGroup("control", period_ns)
        self.next_tick_ns = 0
        self._known_faults: tuple[Fault, ...] = ()

    def tick(self, due_ns: int, merged: int, plan: Plan) -> None:
        """The control period that was due at `due_ns` and stands for `merged` missed ones too."""
        self.next_tick_ns = due_ns + self.timing.period_ns
        start_ns = time.monotonic_ns()
        now_s = start_ns * 1e-9
        if merged:
            self._connection.receive()  # what came before or during the pause is not to be taken for an answer after it
        self.measurement = self._connection.measurement
        self._journal.stepped()
        output = self.stepper.step(now_s, self.measurement, plan)
        self._connection.exchange(
            output.left_duty, output.right_duty, output.mode, output.request, output.request_number
        )
        self.output = output
        end_ns = time.monotonic_ns()
        self.timing.record(due_ns, start_ns, end_ns, merged)

    def command(self, name: str, conditions: Conditions) -> None:
        """An operator's command. Raises RefusedError."""
        now_s, source = time.monotonic(), self.stepper.safety.operating_state
        try:
            self.stepper.command(name, now_s, conditions)
        except RefusedError:
            self._journal.commanded(name, now_s, conditions, is_refused=True)
            raise
        self._journal.commanded(name, now_s, conditions, is_refused=False)
        log.info("%s: %s", name, reason(name, source))

    def until_slack_s(self) -> float:
        """How long another thread should wait so as not to hold the interpreter's lock when a tick needs it, s; 0 in
        the slack. To be asked from any thread."""
        period_ns = self.timing.period_ns
        since_due_ns = (time.monotonic_ns() - self.next_tick_ns) % period_ns
        if since_due_ns > (1.0 - BEFORE_SHARE) * period_ns:
            since_due_ns -= period_ns
        return max(0.0, TICK_SHARE * period_ns - since_due_ns) * 1e-9

    def latch(self, fault: Fault) -> None:
        """Latches a fault that was found outside the step."""
        self._journal.latched(fault)
        self.stepper.latch(fault)

    def lose_link(self) -> None:
        """Tells the core that the device is gone."""
        self._journal.lost_link()
        self.stepper.lose_link()

    def new_faults(self) -> tuple[Fault, ...]:
        """The faults that were latched since this was last asked."""
        faults, known = self.stepper.safety.faults, self._known_faults
        if faults == known:
            return ()
        self._known_faults = faults
        return tuple(fault for fault in faults if fault not in known)
