"""Messages between the daemon and the process that keeps its black box, both ways: msgpack, one a packet."""

import msgspec

KEEPER = "tormagd.recording.keeper"
"Module that the keeper's process runs, with its socket's descriptor as the argument."
READ, WROTE = "read", "wrote"
"Entries of what passed between daemon and device: `[READ, time_s, raw, ...]`, raw as `hardware/backend.py` has it."


class Begin(msgspec.Struct, frozen=True, array_like=True, tag="begin"):
    """First message of the daemon: the folder for black boxes, and the header of each."""

    folder: str
    header: dict[str, str]


class Part(msgspec.Struct, frozen=True, array_like=True, tag="part"):
    """Some control periods, as entries that `assembly/journal.py` encoded. `time_s` and `t_ns` are those of the last
    period."""

    time_s: float
    t_ns: int
    entries: bytes


class Write(msgspec.Struct, frozen=True, array_like=True, tag="write"):
    """Request to write the kept entries, and what comes within `after_s` from now, to the file `name` in the folder."""

    name: str
    reason: str
    after_s: float
    details: dict[str, str]


class End(msgspec.Struct, frozen=True, array_like=True, tag="end"):
    """Last message of a daemon that ends as it should; a daemon that is gone without it leaves a black box."""


class Written(msgspec.Struct, frozen=True, array_like=True, tag="written"):
    """Answer of the keeper: the black box `name` is on the disk, unless `refusal` says why not."""

    name: str
    refusal: str = ""


Said = Begin | Part | Write | End
