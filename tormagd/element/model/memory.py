"""An element's memory, as a model file carries it: the elastomer relaxes, and its field lags behind the gap's.

    F = F0(B - h) less what has relaxed of it      h follows the field's changes towards +-h_max

F0 is the force without memory. Its part without field and the part that the field adds each relax by a Prony series
(`tormagd.element.physics.relaxation`). A brake has one series for both, a pad may have two.
"""

from itertools import pairwise

import msgspec

from tormagd.element.physics.errors import require, require_that
from tormagd.element.physics.relaxation import PronySeries

MAX_TERMS = 8
LONGEST_S = 1e5


class Memory(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    fractions: tuple[float, ...] = ()
    times_s: tuple[float, ...] = ()
    field_fractions: tuple[float, ...] | msgspec.UnsetType = msgspec.UNSET
    lag_mT: float = 0.0
    turn_mT: float = 1.0

    def __post_init__(self) -> None:
        for series in (self.free, self.added):  # PronySeries refuses fractions and times that make no series
            require("memory.times_s, count", len(series.times_s), 0, MAX_TERMS)
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
        return PronySeries(self.fractions, self.times_s)

    @property
    def added(self) -> PronySeries:
        own = self.field_fractions
        return PronySeries(self.fractions if isinstance(own, msgspec.UnsetType) else own, self.times_s)


NO_MEMORY = Memory()
