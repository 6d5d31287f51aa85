"""Arming on one word of a person: the commands that lead to a force that follows, each as soon as it can be given."""

from collections.abc import Callable

from tormagd.safety.codes import Fault
from tormagd.safety.operating_state import (
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
"So long a device that neither homes nor opens may take until the next command is taken."
MOVES_S = 15.0
"Longer than any homing or opening takes that is not a fault."
WAITS = frozenset({"busy", "device_latched", "not_homed", "not_fresh"})
"Refusals that go away by themselves once the command before has been carried out."


class Arming:
    """What one `arm` has done so far. It gives each command once, and ends at every fault that was not there when it
    was asked for: nothing is cleared or closed that the person has not seen. No clock."""

    def __init__(self, now_s: float, faults: tuple[Fault, ...]) -> None:
        """Begin at `now_s`, with the person's word for going on after these `faults`."""
        self.given: tuple[str, ...] = ()
        self.is_over = False
        self.refusal: RefusedError | None = None
        "Why it ended before the force follows."
        self._faults = faults
        self._given_s = self._moved_s = now_s

    def end(self, refusal: RefusedError | None = None) -> None:
        """End it; what it ended for first stays."""
        if not self.is_over:
            self.is_over, self.refusal = True, refusal

    def advance(self, now_s: float, safety: SafetyState, present: Conditions, give: Callable[[str], None]) -> None:
        """Give the next command by `give`, which raises RefusedError, if its time has come."""
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
