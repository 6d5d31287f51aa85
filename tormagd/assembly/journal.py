"""What the core was given, in the order in which it was given that: with it and a beginning, all can be run again.

`plan` and `step` are deterministic, so nothing that they gave has to be kept: it stands in the tick's record, to
compare with. So is the conversation with the device, once it is known what was read and when: what was written is kept
to compare.
"""

import struct
from collections.abc import Sequence
from typing import Any

import msgspec

from firmware_protocol.codec import DeviceMode, Switches
from tormagd.control.ask.forecast import Guess
from tormagd.control.ask.skill import Skill
from tormagd.control.believe.believe import Learned
from tormagd.control.believe.sensor_zero import Level
from tormagd.control.believe.strength import DeviceFit
from tormagd.control.core import Planner, Stepper
from tormagd.control.move.reference import Reference
from tormagd.control.plausible import Leap
from tormagd.control.records import Handle, Measured, Outside, Plan, TimedSetpoint, Travel, Wall
from tormagd.exact import kinds, plain
from tormagd.hardware.backend import Received, Sent
from tormagd.inverse.solution import Answer, FieldSolution, Question, Reach
from tormagd.keeping import READ, WROTE
from tormagd.model.displacement import Turn
from tormagd.safety.codes import Fault, Limit
from tormagd.safety.operating_state import Conditions, DeviceRequest, OperatingState, SafetyState
from tormagd_client.messages import TickRecord

FORMAT = 7
"Of the entries and of the states in them: raised when one comes, is removed or changes its meaning. No other is rerun."
KNOWN = kinds(
    *(SafetyState, OperatingState, DeviceRequest, Fault, Limit, Conditions, DeviceMode, Switches),
    *(Measured, Handle, Travel, Turn, Wall, Leap, Reference, Plan, Outside),
    *(DeviceFit, Level, Learned, Skill, Guess, Question, Answer, FieldSolution, Reach),
)
"All records that stages keep, or that were given to them: what `exact` reads back."
STEP = "step"
"The step ran here; what it was given stands in the next record."
PLAN, FORESEE, AFRESH, TEACH, ANSWER, CONFIRM = "plan", "foresee", "afresh", "teach", "answer", "confirm"
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
    """Entries that wait to be taken. Writing one is a reference in a list: records do not change, and stages are
    written out at once. A journal that is not kept takes no note of anything."""

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
        """A plan begins, with what was measured last. Whether it can be made is found out again."""
        self._add((PLAN, now_s, setpoint))

    def foresaw(self) -> None:
        """What comes was looked for, and found anew."""
        self._add((FORESEE,))

    def began_afresh(self, now_s: float) -> None:
        """The plan could not be made: planning began anew."""
        self._add((AFRESH, now_s))

    def taught(self, learned: Learned) -> None:
        """What is known of the device from another day was put in the place of what was believed."""
        self._add((TEACH, learned))

    def confirmed(self, what: str) -> None:
        """The operator said who is right, the device or its sensor."""
        self._add((CONFIRM, what))

    def answered(self, answer: Answer) -> None:
        """The search beside the plans has found something, for the next plan."""
        self._add((ANSWER, answer))

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

    def snapshot(self, stepper: Stepper, planner: Planner, connection: Any) -> None:
        """All that the core and the conversation remember now: a replay may begin here."""
        if self.is_kept:
            self._add((STATE, plain(stepper), plain(planner), connection))

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
