"""Which messages of a publisher are newer than the last one taken, and which come from a publisher that has restarted.

No number keeps a publisher out. A message that does not follow the newest may be old, repeated, wrong, or the first of
a new run. A new run shows itself in a few messages. No I/O and no clock.
"""

from enum import Enum
from typing import final

LONGEST_JUMP = 1_000
"Steps by which `seq` may run ahead at once: more of them missing is no loss, it is another run, or a wrong number."
RUN = 3
"So many messages in a row, each newer than the one before, are a run of their own."
STRAYS_S = 1.0
"RUN strays within this time, with messages of the run between them, are a second publisher of the same name."


class Order(Enum):
    """How a message stands to those taken before it."""

    NEWER = "newer"
    RESTARTED = "restarted"
    "The first of a new run: the publisher says so by a `session` above every earlier one."
    REPLACED = "replaced"
    "The first of a new run that does not say so."
    STRAY = "stray"
    "Old, repeated, of a run that is over, or of one that has not shown itself yet."


@final
class Sequence:
    """Follows a publisher's count `seq` through restarts. `session` is None where the publisher states none."""

    def __init__(self, session: int | None, seq: int) -> None:
        self.session, self.seq = session, seq
        self.lost = 0
        "Messages missing in `seq`, counted where the publisher counts by ones."
        self.restarts = 0
        self._latest_session = session
        self._step = 0
        self._stray_session, self._stray_seq, self._in_row = session, seq, 0
        self._strays, self._strays_since_s = 0, 0.0

    def order(self, now_s: float, session: int | None, seq: int, *, is_over: bool) -> Order:
        """Judge one message by its numbers, and follow it unless it is a stray."""
        if session == self.session and seq > self.seq:
            step = seq - self.seq
            known = self._step
            if known == 0 or step <= LONGEST_JUMP * known or is_over:
                if known == 1:
                    self.lost += min(step, LONGEST_JUMP) - 1
                if known == 0 or step < known:
                    self._step = step
                self.seq, self._in_row = seq, 0
                return Order.NEWER
        if session is not None and (self._latest_session is None or session > self._latest_session):
            self._latest_session = session
            return self._begin(session, seq, Order.RESTARTED)
        is_in_row = self._in_row > 0 and session == self._stray_session and seq > self._stray_seq
        self._in_row = self._in_row + 1 if is_in_row else 1
        self._stray_session, self._stray_seq = session, seq
        is_repeated = session == self.session and seq == self.seq
        if self._in_row >= RUN or (is_over and not is_repeated):
            return self._begin(session, seq, Order.REPLACED)
        if now_s - self._strays_since_s > STRAYS_S:
            self._strays, self._strays_since_s = 0, now_s
        self._strays += 1
        return Order.STRAY

    def is_doubled(self, now_s: float) -> bool:
        """Tell whether two publishers seem to use this name at once: RUN strays or more within STRAYS_S."""
        return self._strays >= RUN and now_s - self._strays_since_s <= STRAYS_S

    def _begin(self, session: int | None, seq: int, order: Order) -> Order:
        """Follow a new run from this message, count a restart, and return `order`."""
        self.session, self.seq, self._step = session, seq, 0
        self._in_row = self._strays = 0
        self.restarts += 1
        return order
