"""The control loop, a phase of every beat: step on the newest measurement and plan, and drive.

Arming is one command: it clears, homes and enables, each as soon as the device allows.
"""

import logging
import time
from collections.abc import Callable

from tormagd.control.assembly.conditions import is_busy, is_homed
from tormagd.control.core import Stepper
from tormagd.control.move.routines import is_open
from tormagd.control.records import Duty, Plan
from tormagd.control.safety.codes import Fault
from tormagd.control.safety.operating_state import (
    CONNECTED,
    NOT_BUSY,
    Conditions,
    Event,
    OperatingState,
    RefusedError,
    SafetyState,
    next_commands,
    reason,
    require,
)
from tormagd.daemon.beat import Beat
from tormagd.daemon.rate_group import RateGroup
from tormagd.hardware.connection import Connection
from tormagd.hardware.measurement import Measurement
from tormagd.record.stream import COMMAND, LATCH, LOSE_LINK, STEP, Journal

PATIENCE_S = 2.0
"How long a device that neither homes nor opens may refuse the next command."
MOVES_S = 15.0
"Any homing or opening that takes longer is a fault."
WAITS = frozenset({"busy", "device_latched", "not_homed", "not_fresh"})
"Refusals that end by themselves once the previous command has been carried out."
REPEATED_S = 1.0

log = logging.getLogger(__name__)


class Arming:
    """Progress of one `arm`: gives each command that leads to ENABLED once. It ends with a refusal at every fault that
    was not latched when it began: a person clears only faults that they have seen."""

    def __init__(self, now_s: float, faults: tuple[Fault, ...]) -> None:
        self.given: tuple[str, ...] = ()
        self.is_over = False
        self.refusal: RefusedError | None = None
        self._faults = faults
        self._given_s = self._moved_s = now_s

    def end(self, refusal: RefusedError | None = None) -> None:
        if not self.is_over:
            self.is_over, self.refusal = True, refusal

    def advance(self, now_s: float, safety: SafetyState, present: Conditions, give: Callable[[str], None]) -> None:
        if self.is_over:
            return
        try:
            self._require_no_news(safety)
            require(CONNECTED, safety, present)
            if safety.operating_state is OperatingState.ENABLED:
                self.end()
            elif present.busy:
                self._moved_s = now_s
                if now_s - self._given_s > MOVES_S:
                    require(NOT_BUSY, safety, present)
            else:
                self._attempt(now_s, _next(safety, present), give)
        except RefusedError as error:
            self.end(error)

    def _require_no_news(self, safety: SafetyState) -> None:
        """Raise RefusedError for a latched fault that the person has not seen; after `clear-fault`, for any."""
        news = [fault for fault in safety.faults if fault not in self._faults or Event.CLEAR_FAULT in self.given]
        if news:
            raise RefusedError("fault", f"a fault came while arming: {', '.join(news)}", "tormagctl status")

    def _attempt(self, now_s: float, command: Event, give: Callable[[str], None]) -> None:
        try:
            if command in self.given:
                raise RefusedError("busy", f"{command} was taken, and has not come to its end", "tormagctl status")
            give(command)
        except RefusedError as error:
            if error.code not in WAITS or now_s - self._moved_s > PATIENCE_S:
                raise
        else:
            self.given = (*self.given, str(command))
            self._given_s = self._moved_s = now_s


def _next(safety: SafetyState, present: Conditions) -> Event:
    if present.device_latched and safety.operating_state is OperatingState.DISABLED:
        return Event.CLEAR_FAULT
    return next_commands(safety, present.homed)[0]


class ControlLoop:
    def __init__(self, stepper: Stepper, connection: Connection, period_ns: int, journal: Journal) -> None:
        self.stepper, self._connection, self._journal = stepper, connection, journal
        self.output: Duty | None = None
        self.used: Plan | None = None
        self.measurement: Measurement | None = None
        "What the last step was given, as is `used`."
        self.timing = RateGroup("control", period_ns)
        self.arming: Arming | None = None
        self._known_faults: tuple[Fault, ...] = ()
        self._told: dict[str, tuple[float, int]] = {}

    def drive(self, beat: Beat, plan: Plan) -> None:
        now_s = time.monotonic()  # not the beat's start: a stall within the beat counts, too
        self.used, self.measurement = plan, self._connection.measurement
        self._journal.note(STEP)
        output = self.output = self.stepper.step(now_s, self.measurement, plan)
        self._connection.exchange(
            now_s, output.left_duty, output.right_duty, output.mode, output.request, output.request_number
        )
        # from the beginning of the beat: what ran before the step is part of the tick
        self.timing.record(beat.due_ns, beat.start_ns, time.monotonic_ns(), beat.merged)

    def command(self, name: str, conditions: Conditions) -> None:
        """Carry out an operator's command, which ends an arming under way."""
        if self.arming is not None:
            self.arming.end(RefusedError("overtaken", f"{name} came before it was armed", "tormagctl arm"))
        self._give(name, conditions)

    def arm(self, conditions: Conditions) -> None:
        """Begin or continue an arming, and give its next command if its time has come."""
        if self.arming is None or self.arming.is_over:
            self.arming = Arming(time.monotonic(), self.stepper.safety.faults)
        self.go_on_arming(conditions)
        if self.arming.refusal is not None:
            raise self.arming.refusal

    def go_on_arming(self, conditions: Conditions) -> None:
        arming = self.arming
        if arming is None or arming.is_over:
            return
        arming.advance(time.monotonic(), self.stepper.safety, conditions, lambda name: self._give(name, conditions))
        if arming.refusal is not None:
            log.warning("arm: %s; next: %s", arming.refusal.message, arming.refusal.hint)

    def _give(self, name: str, conditions: Conditions) -> None:
        now_s, source = time.monotonic(), self.stepper.safety.operating_state
        try:
            self.stepper.command(name, now_s, conditions)
        except RefusedError:
            self._journal.note(COMMAND, name, now_s, True, conditions)
            raise
        self._journal.note(COMMAND, name, now_s, False, conditions)
        told_s, count = self._told.get(name, (-REPEATED_S, 0))
        if source is self.stepper.safety.operating_state and now_s - told_s < REPEATED_S:
            self._told[name] = told_s, count + 1
            return
        self._told[name] = now_s, 0
        log.info("%s: %s%s", name, reason(name, source), f"; {count} times more before" if count else "")

    def latch(self, fault: Fault) -> None:
        self._journal.note(LATCH, str(fault))
        self.stepper.latch(fault)

    def lose_link(self) -> None:
        self._journal.note(LOSE_LINK)
        self.stepper.lose_link()

    def is_busy(self) -> bool:
        """Tell whether the device homes or opens, or has been asked to."""
        connection = self._connection
        return is_busy(connection.measurement, connection.pending, self.stepper, self.output)

    def is_homed(self) -> bool:
        return is_homed(self._connection.measurement, self.stepper.measured)

    def is_open(self) -> bool | None:
        measurement = self._connection.measurement
        return None if measurement is None else is_open(measurement, self.is_homed())

    def new_faults(self) -> tuple[Fault, ...]:
        faults, known = self.stepper.safety.faults, self._known_faults
        self._known_faults = faults
        return tuple(fault for fault in faults if fault not in known)
