"""What the daemon says to the process that keeps its black box, and what that answers: msgpack, one a packet."""

import msgspec

KEEPER = "tormagd.recording.keeper"
"The module that runs there; the descriptor of its socket is the argument."
READ, WROTE = "read", "wrote"
"Entries of what passed between daemon and device: `[READ, time_s, raw, ...]`, raw as `hardware/backend.py` has it."


class Begin(msgspec.Struct, frozen=True, array_like=True, tag="begin"):
    """The first: where black boxes go, and what stands in each."""

    folder: str
    header: dict[str, str]


class Part(msgspec.Struct, frozen=True, array_like=True, tag="part"):
    """Some control periods: entries as `assembly/journal.py` encodes them. `time_s` and `t_ns` are the last one's."""

    time_s: float
    t_ns: int
    entries: bytes


class Write(msgspec.Struct, frozen=True, array_like=True, tag="write"):
    """What is kept shall be written, with what has come `after_s` later, to this name in the folder."""

    name: str
    reason: str
    after_s: float
    details: dict[str, str]


class End(msgspec.Struct, frozen=True, array_like=True, tag="end"):
    """The daemon ends as it should: one that is gone without this leaves a black box."""


class Written(msgspec.Struct, frozen=True, array_like=True, tag="written"):
    """This one is on the disk; empty is `refusal`, or it says why it is not."""

    name: str
    refusal: str = ""


Said = Begin | Part | Write | End
