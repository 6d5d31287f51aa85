"""Arming by a single command: clears, homes and enables in turn, each as soon as the device allows it."""

from collections.abc import Callable

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
    require,
)

PATIENCE_S = 2.0
"How long a device that neither homes nor opens may refuse the next command."
MOVES_S = 15.0
"Any homing or opening that takes longer is a fault."
WAITS = frozenset({"busy", "device_latched", "not_homed", "not_fresh"})
"Refusals that end by themselves once the previous command has been carried out."


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
