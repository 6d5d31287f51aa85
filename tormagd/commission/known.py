"""What a commissioning knows before it begins."""

from typing import NamedTuple

from tormagd.config import Config


class Known(NamedTuple):
    """The daemon's configuration, its control period, s, and the least and most force that it gives, N.

    `weight_N` is the weight that a person hangs up; None: none is at hand. No value is checked.
    """

    config: Config
    period_s: float
    least_N: float
    most_N: float
    weight_N: float | None = None

    def force_N(self, share: float) -> float:
        """Return the force at a share, 0 to 1, of the range, which begins CLEAR_N over the device's least force."""
        low_N = self.least_N + CLEAR_N
        return low_N + share * (self.most_N - low_N)


CLEAR_N = 0.1
"At the open end the firmware holds back a duty that would push on, and the least force grows with the device."
