"""Recent skill of one guess at a force over another."""

from typing import Final, final

from firmware_protocol.value import Value

DOUBT_N: Final = 0.02
"Before an error is judged, the two guesses count as this far apart and equally good."
FORGIVEN_N: Final = 0.003
"Differences as small as this neither earn trust nor lose it."


@final
class Skill(Value):
    """Skill of one guess over another, as running means of squares, N²."""

    def __init__(self, gained: float, apart: float) -> None:
        self.gained: Final = gained
        self.apart: Final = apart

    def after(self, error_N: float, other_error_N: float, share: float) -> "Skill":
        """Return the skill after both guesses' newest errors, weighted by `share`."""
        gained = other_error_N * other_error_N - error_N * error_N
        difference_N = other_error_N - error_N
        apart = difference_N * difference_N
        return Skill(self.gained + share * (gained - self.gained), self.apart + share * (apart - self.apart))

    @property
    def score(self) -> float:
        return self.gained / (self.apart + FORGIVEN_N * FORGIVEN_N)


UNJUDGED: Final = Skill(0.0, DOUBT_N * DOUBT_N)
