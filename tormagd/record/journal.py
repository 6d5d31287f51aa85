"""The journal: all inputs of the core, in their order. A replay runs the core again from them and a snapshot.

`plan` and `step` are deterministic, and so is the conversation with the device, given what was read and when. Their
results stand in the journal for comparison only.
"""

import hashlib
from typing import Any

import msgspec

from firmware_protocol.codec import DeviceMode, Switches
from tormagd.config import Config
from tormagd.control.ask.forecast import Skill
from tormagd.control.believe.believe import Learned
from tormagd.control.believe.sensor_zero import Level
from tormagd.control.believe.strength import DeviceFit
from tormagd.control.core import Planner, Stepper
from tormagd.control.measure import Leap
from tormagd.control.move.actuator import Reference
from tormagd.control.records import Handle, Measured, Outside, Plan, TimedSetpoint, Travel, Wall
from tormagd.control.safety.codes import Fault, Limit
from tormagd.control.safety.operating_state import Conditions, OperatingState, SafetyState
from tormagd.element.inverse.solution import Answer, FieldSolution, Question, Reach
from tormagd.element.model.displacement import Turn
from tormagd.ground.plain_values import kinds, plain
from tormagd.hardware.backend import Received, Sent
from tormagd.hardware.measurement import DeviceRequest
from tormagd.scenes.scene import Scene

FORMAT = 24
"Version of entries, states and times: raised when one comes, goes or changes its meaning. No other is rerun."
KNOWN = kinds(
    *(SafetyState, OperatingState, DeviceRequest, Fault, Limit, Conditions, DeviceMode, Switches),
    *(Measured, Handle, Travel, Turn, TimedSetpoint, Wall, Leap, Reference, Plan, Outside),
    *(DeviceFit, Level, Learned, Skill, Question, Answer, FieldSolution, Reach),
)
"All types that `plain_values` reads back."
STEP = "step"
"A step is about to run; its inputs are in the tick that follows."
PLAN, FORESEE, AFRESH = "plan", "foresee", "afresh"
"`[PLAN, now_s, setpoint]`, `[FORESEE]`; `[AFRESH, now_s]` where one of them failed, and planning began anew."
TEACH, CONFIRM, ANSWER = "teach", "confirm", "answer"
"What is known from another day, an operator's word in a dispute, and what a search beside the plans found."
COMMAND, LATCH, LOSE_LINK = "command", "latch", "lose_link"
"`[COMMAND, name, now_s, is_refused, conditions]`, `[LATCH, fault]`, `[LOSE_LINK]`."
CONNECTED = "connected"
"`[CONNECTED, memory]`: a conversation began, or with None is over."
READ, WROTE, TOLD, MISSING = "read", "wrote", "told", "missing"
"""No inputs of the core: what passed between daemon and device, as `[READ, time_s, raw]`, a snapshot as published, and
that other entries were lost."""
STATE = "state"
MAX_ENTRIES = 4_096
"When this many entries were not taken, MISSING takes their place."

Entry = Any


def core_hash(config: Config, scene: Scene, model: str) -> str:
    """Return what tells one core from another."""
    return hashlib.sha256(msgspec.json.encode((config, scene, model))).hexdigest()


class Journal:
    """The core's inputs since the last `take`, as entries: a tick, or a name and what belongs to it."""

    def __init__(self, *, is_kept: bool = True) -> None:
        self.is_kept = is_kept
        self._entries: list[Entry] = []

    def note(self, name: str, *what: Any) -> None:
        self.add((name, *what))

    def read(self, now_s: float, raw: Received) -> None:
        self.add((READ, now_s, raw))

    def wrote(self, now_s: float, raw: list[Sent], unsent: int) -> None:
        self.add((WROTE, now_s, raw, unsent))

    def connected(self, memory: Any) -> None:
        """Note that a conversation begins from the state `memory`, or with None that it is over."""
        self.add((CONNECTED, memory))

    def snapshot(self, stepper: Stepper, planner: Planner, connection: Any, core: str) -> None:
        """Note the whole state of the core, whose hash is `core`, and of the conversation: a replay may begin here."""
        self.add((STATE, plain(stepper), plain(planner), connection, core))

    def take(self) -> list[Entry]:
        """Return and remove all entries."""
        entries, self._entries = self._entries, []
        return entries

    def add(self, entry: Entry) -> None:
        if not self.is_kept:
            return
        if len(self._entries) >= MAX_ENTRIES:
            self._entries = [(MISSING,)]
        self._entries.append(entry)


def _of_value(thing: Any) -> Any:
    if type(thing) is TimedSetpoint:
        return [getattr(thing, name) for name in thing.__match_args__]
    return plain(thing)


packed = msgspec.msgpack.Encoder(enc_hook=_of_value).encode
