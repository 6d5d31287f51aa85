"""Who holds the brake: one source at a time, until it is stale, gives way to one that goes before it, or is relieved.

Pure: what is decided on is handed in.
"""

from typing import NamedTuple


class Hold(NamedTuple):
    """The source that holds the brake; "" before the first. `number` grows with every change of the publisher behind
    it, so that the force goes from one to the other along a ramp. With `is_given`, an operator has chosen it."""

    source: str = ""
    number: int = 0
    is_given: bool = False


def is_passed(hold: Hold, source: str, priority: tuple[str, ...], *, is_stale: bool) -> bool:
    """Whether a message of another source makes it the holder. `is_stale`: the holder's newest setpoint is too old."""
    # an operator's choice goes before the configured order, and what is not listed comes after all that is
    ranks = {name: place for place, name in enumerate(priority)}
    goes_before = ranks.get(source, len(ranks)) < ranks.get(hold.source, len(ranks))
    return is_stale or (not hold.is_given and goes_before)
