"""Rate-independent memory of the field: the force while the gap closes is not quite the force while it opens.

Prandtl-Ishlinskii: the radial moment u passes through play operators of half-width r_i, which follow it at the end of a
slack, and a share w_i of each takes the place of the undelayed moment:

    u_h = u + sum w_i (p_i - u)             p_i(u) = min(max(p_i, u - r_i), u + r_i)

So u_h rises with u, closes its loops, never lags by more than sum w_i r_i, and does not depend on speed or step length.
"""

from dataclasses import dataclass
from typing import TypeAlias

from tormagd.physics.errors import DomainError, require

PlayState: TypeAlias = tuple[float, ...]
"""Position of each play operator, T m."""

MAX_MOMENT_TM = 1e6


@dataclass(frozen=True, slots=True)
class Hysteresis:
    """Shares w_i (each >= 0, sum < 1) and half-widths r_i, T m; raises `DomainError` otherwise."""

    shares: tuple[float, ...]
    half_widths_Tm: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.shares) != len(self.half_widths_Tm):
            raise DomainError("half_widths_Tm", self.half_widths_Tm, f"one for each of the {len(self.shares)} shares")
        for share in self.shares:
            require("shares", share, 0.0, 1.0)
        for half_width in self.half_widths_Tm:
            require("half_widths_Tm", half_width, 0.0, MAX_MOMENT_TM)
        if not sum(self.shares) < 1.0:
            raise DomainError("shares", self.shares, "a sum below 1")

    def demagnetised(self, moment_Tm: float) -> PlayState:
        """State with every operator in the middle of its slack: no lag at that moment."""
        require("moment_Tm", moment_Tm, -MAX_MOMENT_TM, MAX_MOMENT_TM)
        return tuple(moment_Tm for _ in self.shares)

    def advance(self, state: PlayState, moment_Tm: float) -> tuple[float, PlayState]:
        """(lagged moment, T m, next state) once the moment has moved to `moment_Tm`.

        Raises `DomainError` if `moment_Tm` is not finite or the state does not fit.
        """
        if not -MAX_MOMENT_TM <= moment_Tm <= MAX_MOMENT_TM:
            require("moment_Tm", moment_Tm, -MAX_MOMENT_TM, MAX_MOMENT_TM)
        if len(state) != len(self.shares):
            raise DomainError("state", state, f"{len(self.shares)} positions")
        lagged = moment_Tm
        following = []
        for share, half_width, position in zip(self.shares, self.half_widths_Tm, state, strict=True):
            moved = min(max(position, moment_Tm - half_width), moment_Tm + half_width)
            lagged += share * (moved - moment_Tm)
            following.append(moved)
        return lagged, tuple(following)
