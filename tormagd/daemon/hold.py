"""Which source holds the brake: one at a time, until it is stale, a source of higher priority sends, or it is relieved.

Pure functions of their arguments.
"""

from typing import NamedTuple


class Hold(NamedTuple):
    """Which source holds the brake; "" before the first."""

    source: str = ""
    number: int = 0
    is_given: bool = False


def is_passed(hold: Hold, source: str, priority: tuple[str, ...], *, is_stale: bool) -> bool:
    """Tell whether a message of `source`, which does not hold the brake, makes it the holder."""
    # an operator's choice goes before the configured order, and what is not listed comes after all that is
    ranks = {name: place for place, name in enumerate(priority)}
    goes_before = ranks.get(source, len(ranks)) < ranks.get(hold.source, len(ranks))
    return is_stale or (not hold.is_given and goes_before)
