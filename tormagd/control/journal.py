"""What the core was given, in the order it was given: with it and a state to begin with, all that it did can be rerun.

`plan` and `step` are pure, so nothing that they gave has to be kept: it stands in the tick's record, to compare with.
So is the conversation with the device, once it is known what was read and when: what was written is kept to compare.
"""

import struct
from collections.abc import Sequence
from typing import Any

import msgspec

from tormagd.control.governor import TimedSetpoint
from tormagd.control.plan import PlanState, Shown
from tormagd.control.step import StepState
from tormagd.exact import plain
from tormagd.hardware.backend import Received, Sent
from tormagd.keeping import READ, WROTE
from tormagd.safety.codes import Fault
from tormagd.safety.operating_state import Conditions
from tormagd_client.messages import TickRecord

FORMAT = 3
"Of the entries and of the states in them: raised when one comes, is removed or changes its meaning. No other is rerun."
STEP = "step"
"The step ran here; what it was given stands in the next record."
PLAN, FORESEE, AFRESH, TEACH = "plan", "foresee", "afresh", "teach"
COMMAND, LATCH, LOSE_LINK = "command", "latch", "lose_link"
CONNECTED = "connected"
"Besides READ and WROTE, which the process that keeps them knows, too."
STATE, MISSING = "state", "missing"
MOST_ENTRIES = 4_096
"That nobody took: then the journal begins anew, and says that something is missing."

_LENGTH = struct.Struct(">I")
_NONE = b"\xdd" + _LENGTH.pack(0)
"An array of none, in msgpack's form whose length has four bytes."

Entry = str | TickRecord | tuple[Any, ...]


class Journal:
    """Entries that wait to be taken. Writing one is a reference in a list: values do not change. One that is not kept
    takes no note of anything."""

    def __init__(self, *, is_kept: bool = True) -> None:
        self.is_kept = is_kept
        self._entries: list[Entry] = []

    def stepped(self) -> None:
        """A step ran."""
        self._add(STEP)

    def ticked(self, record: TickRecord) -> None:
        """The control period is over in which the last step ran: its record."""
        self._add(record)

    def planned(self, now_s: float, setpoint: TimedSetpoint | None) -> None:
        """A plan was made, with the newest estimate."""
        self._add((PLAN, now_s, setpoint))

    def foresaw(self) -> None:
        """What comes was looked for, and found anew."""
        self._add((FORESEE,))

    def began_afresh(self, now_s: float) -> None:
        """No plan could be made: planning began anew."""
        self._add((AFRESH, now_s))

    def taught(self, shown: Shown) -> None:
        """What the device has shown was put in the place of what was known of it."""
        self._add((TEACH, shown))

    def commanded(self, name: str, now_s: float, conditions: Conditions, *, is_refused: bool) -> None:
        """An operator's command was given, and taken or refused."""
        self._add((COMMAND, name, now_s, is_refused, conditions))

    def latched(self, fault: Fault) -> None:
        """A fault was latched that was found outside the step."""
        self._add((LATCH, str(fault)))

    def lost_link(self) -> None:
        """The link to the device broke."""
        self._add((LOSE_LINK,))

    def read(self, now_s: float, raw: Received) -> None:
        """This was read from the device, and taken in at this time."""
        self._add((READ, now_s, raw))

    def wrote(self, now_s: float, raw: list[Sent], unsent: int) -> None:
        """This was written to it in one period, after a step; what the port did not take at once is counted."""
        self._add((WROTE, now_s, raw, unsent))

    def connected(self, memory: Any) -> None:
        """A conversation with the device begins, which remembers this; None: it has ended."""
        self._add((CONNECTED, memory))

    def snapshot(self, step: StepState, plan: PlanState, connection: Any) -> None:
        """All that the core and the conversation remember now: a replay may begin here."""
        self._add((STATE, step, plan, connection))

    def missed(self) -> None:
        """Entries before this were lost."""
        self._add((MISSING,))

    def take(self) -> list[Entry]:
        """The entries since the last time."""
        entries, self._entries = self._entries, []
        return entries

    def _add(self, entry: Entry) -> None:
        if not self.is_kept:
            return
        if len(self._entries) >= MOST_ENTRIES:
            self._entries = [(MISSING,)]
        self._entries.append(entry)


class Packer:
    """msgpack: an array of entries, which grows tick by tick. Values in it are as `exact` writes them; a setpoint is
    its fields alone, in the order of its constructor."""

    def __init__(self) -> None:
        self._bytes, self._count = bytearray(_NONE), 0

    def add(self, entries: Sequence[Entry]) -> None:
        """Writes some more. Raises TypeError, ValueError or OverflowError for what cannot be written."""
        for entry in entries:
            _ENCODER.encode_into(entry, self._bytes, -1)
            self._count += 1

    def take(self) -> bytes:
        """The array, and begins a new one."""
        _LENGTH.pack_into(self._bytes, 1, self._count)
        packed = bytes(self._bytes)
        self._bytes, self._count = bytearray(_NONE), 0
        return packed


def _of_value(thing: Any) -> Any:
    if type(thing) is TimedSetpoint:
        return [getattr(thing, name) for name in thing.__match_args__]
    return plain(thing)


_ENCODER = msgspec.msgpack.Encoder(enc_hook=_of_value)
