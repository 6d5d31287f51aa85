"""What an element remembers, as a model file carries it: its elastomer relaxes, and its field lags behind the gap's.

    F = F0(B - h) less what has relaxed of it      h follows the field's changes towards +-h_max

F0 is the force without memory, which the network knows. What of it is there without field, and what the field adds,
relax each by a Prony series (`tormagd.physics.relaxation`); a brake's by the same, of a pad's they differ.
"""

from itertools import pairwise

import msgspec

from tormagd.physics.errors import require, require_that
from tormagd.physics.relaxation import PronySeries

MOST_TERMS = 8
LONGEST_S = 1e5


class Memory(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The fractions g_i and times tau_i of relaxation, the shortest first, `field_fractions` of what the field adds
    where those differ, and the field's lag h: at most `lag_mT`, which is reached over changes of `turn_mT`. Without any
    of them an element remembers nothing. Raises `DomainError`."""

    fractions: tuple[float, ...] = ()
    times_s: tuple[float, ...] = ()
    field_fractions: tuple[float, ...] | msgspec.UnsetType = msgspec.UNSET
    lag_mT: float = 0.0
    turn_mT: float = 1.0

    def __post_init__(self) -> None:
        for series in (self.free, self.added):  # these refuse what is no series at all
            require("memory.times_s, count", len(series.times_s), 0, MOST_TERMS)
        for time_s in self.times_s:
            require("memory.times_s", time_s, 1e-3, LONGEST_S)
        require_that(
            all(before < after for before, after in pairwise(self.times_s)),
            "memory.times_s",
            self.times_s,
            "rising times",
        )
        require("memory.turn_mT", self.turn_mT, 0.1, 1e5)
        # a gap that follows a greater lag might run after itself
        require("memory.lag_mT", self.lag_mT, 0.0, 0.25 * self.turn_mT)

    @property
    def free(self) -> PronySeries:
        """How the force without field relaxes."""
        return PronySeries(self.fractions, self.times_s)

    @property
    def added(self) -> PronySeries:
        """How what the field adds relaxes."""
        return PronySeries(self._field_fractions, self.times_s)

    @property
    def _field_fractions(self) -> tuple[float, ...]:
        return self.fractions if isinstance(self.field_fractions, msgspec.UnsetType) else self.field_fractions


NO_MEMORY = Memory()
