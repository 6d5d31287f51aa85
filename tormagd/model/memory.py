"""What an element remembers, as a model file carries it: its elastomer relaxes, and its field lags behind the gap's.

    F = D(B - h) - sum g_i q_i        q_i: D(B - h) behind a low-pass of time constant tau_i

D is the force without memory, which the network knows; h follows the field's changes towards +-h_max.
"""

from itertools import pairwise

import msgspec

from tormagd.physics.errors import DomainError, require

MOST_TERMS = 8
LONGEST_S = 1e5


class Memory(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The fractions g_i and times tau_i of relaxation, the shortest first, and the field's lag h: at most `lag_mT`,
    which is reached over changes of `turn_mT`. Without any of them an element remembers nothing. Raises `DomainError`.
    """

    fractions: tuple[float, ...] = ()
    times_s: tuple[float, ...] = ()
    lag_mT: float = 0.0
    turn_mT: float = 1.0

    def __post_init__(self) -> None:
        if len(self.times_s) != len(self.fractions) or len(self.fractions) > MOST_TERMS:
            raise DomainError("memory.times_s", self.times_s, f"one for each fraction, at most {MOST_TERMS}")
        for fraction in self.fractions:
            require("memory.fractions", fraction, 0.0, 1.0)
        if not sum(self.fractions, 0.0) < 1.0:
            raise DomainError("memory.fractions", self.fractions, "a sum below 1")
        for time_s in self.times_s:
            require("memory.times_s", time_s, 1e-3, LONGEST_S)
        if any(before >= after for before, after in pairwise(self.times_s)):
            raise DomainError("memory.times_s", self.times_s, "rising times")
        require("memory.turn_mT", self.turn_mT, 0.1, 1e5)
        # a gap that follows a greater lag might run after itself
        require("memory.lag_mT", self.lag_mT, 0.0, 0.25 * self.turn_mT)


NO_MEMORY = Memory()
