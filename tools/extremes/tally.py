"""What the checks of `numerics.py` came to: counts, and the worst error of each quantity."""

from collections import Counter
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from tormagd.lab.arrays import Array

COUNTS = ("cases", "reference_cases", "nonfinite", "refused", "misjudged")


class Worst(NamedTuple):
    """The largest error where the plain bound holds, and the largest share of what is allowed anywhere."""

    error: float = 0.0
    over_allowed: float = 0.0


@dataclass
class Tally:
    """Of one chunk, or of all; `counts` by COUNTS, `worst` by precision and quantity."""

    counts: Counter[str] = field(default_factory=Counter)
    worst: dict[tuple[str, str], Worst] = field(default_factory=dict)

    def note(self, precision: str, quantity: str, errors: Array, plain: float, well: Array) -> None:
        """Errors of some cases; allowed is `plain`, or `well`, what rounding makes of the case, if that is more."""
        allowed = np.maximum(plain, well)
        worst = float(errors[allowed == plain].max(initial=0.0)), float((errors / allowed).max(initial=0.0))
        self._raise_to((precision, quantity), Worst(*worst))

    def add(self, other: "Tally") -> None:
        """Merge another tally into this one."""
        self.counts.update(other.counts)
        for kind, worst in other.worst.items():
            self._raise_to(kind, worst)

    def _raise_to(self, kind: tuple[str, str], worst: Worst) -> None:
        mine = self.worst.get(kind, Worst())
        self.worst[kind] = Worst(max(mine.error, worst.error), max(mine.over_allowed, worst.over_allowed))
