"""Messages between the daemon and the process that keeps its black box: msgpack, one a packet."""

import msgspec

REQUEST = "REQUEST"
"Reason of a black box that somebody asked for; any other is a fault's."
READ, WROTE = "read", "wrote"
"Entries of what passed between daemon and device: `[READ, time_s, raw, ...]`."
MISSING = "missing"
"An entry where others were lost."


class Begin(msgspec.Struct, frozen=True, array_like=True, tag="begin"):
    """First message: the folder for black boxes, and the header of each; `is_again` where a keeper has ended before."""

    folder: str
    header: dict[str, str]
    is_again: bool = False


class Part(msgspec.Struct, frozen=True, array_like=True, tag="part"):
    """Some control periods, as entries of `journal.py`. Both times are the last period's."""

    time_s: float
    t_ns: int
    entries: bytes


class Write(msgspec.Struct, frozen=True, array_like=True, tag="write"):
    """Request to write the kept entries, and those of the next `after_s`, to the file `name`."""

    name: str
    reason: str
    after_s: float
    details: dict[str, str]


class End(msgspec.Struct, frozen=True, array_like=True, tag="end"):
    """Last message of a daemon that ends as it should; one that ends without it leaves a black box."""


class Written(msgspec.Struct, frozen=True, array_like=True, tag="written"):
    """Answer of the keeper: the black box `name` is on the disk, or a `refusal`."""

    name: str
    refusal: str = ""


Said = Begin | Part | Write | End
