"""Viscoelastic memory: a generalised Maxwell element (Prony series) driven by a force.

    F = (1 - sum g_i) F0 + sum g_i h_i           dh_i/dt = dF0/dt - h_i / tau_i

F0 is the force without memory. A fall after a long rest at a high F0 can leave F below zero, where contact is lost: the
caller has to bound a brake's level at zero.
"""

import math
from typing import Final, TypeAlias, final

from firmware_protocol.value import Value
from tormagd.element.physics.errors import DomainError, require, require_that

PronyState: TypeAlias = tuple[float, ...]
"The last driving force, then the h_i."

MAX_FORCE_N: Final = 1e9
MAX_STEP_S: Final = 1e9


@final
class PronyStep(Value):
    """The exact update over one step, for a driving force that is linear in it."""

    __match_args__ = ("fractions", "decays", "gains")

    def __init__(self, fractions: tuple[float, ...], decays: tuple[float, ...], gains: tuple[float, ...]) -> None:
        relaxing = 0.0  # `sum` is a call, and a plan makes two of these
        for fraction in fractions:
            relaxing += fraction
        self.equilibrium_fraction: Final = 1.0 - relaxing
        self.fractions: Final = fractions
        self.decays: Final = decays
        self.gains: Final = gains

    def advance(self, state: PronyState, driving_N: float) -> tuple[float, PronyState]:
        if not -MAX_FORCE_N <= driving_N <= MAX_FORCE_N:
            require("driving_N", driving_N, -MAX_FORCE_N, MAX_FORCE_N)
        if len(state) != len(self.fractions) + 1:
            raise DomainError("state", state, f"1 + {len(self.fractions)} forces")
        change_N = driving_N - state[0]
        force_N = self.equilibrium_fraction * driving_N
        following = [driving_N]
        for index, fraction in enumerate(self.fractions):
            branch_N = state[index + 1] * self.decays[index] + change_N * self.gains[index]
            force_N += fraction * branch_N
            following.append(branch_N)
        return force_N, tuple(following)

    def of(self, fractions: tuple[float, ...]) -> "PronyStep":
        return PronyStep(fractions, self.decays, self.gains)


@final
class PronySeries(Value):
    """Fractions g_i (0..1, sum < 1), each with its time constant tau_i, 1e-6..1e9 s."""

    def __init__(self, fractions: tuple[float, ...], times_s: tuple[float, ...]) -> None:
        paired = f"one time for each of the {len(fractions)} fractions"
        require_that(len(fractions) == len(times_s), "times_s", times_s, paired)
        for fraction in fractions:
            require("fractions", fraction, 0.0, 1.0)
        for time_s in times_s:
            require("times_s", time_s, 1e-6, 1e9)
        require_that(sum(fractions) < 1.0, "fractions", fractions, "a sum below 1")
        self.fractions: Final = fractions
        self.times_s: Final = times_s

    def relaxed(self, driving_N: float) -> PronyState:
        require("driving_N", driving_N, -MAX_FORCE_N, MAX_FORCE_N)
        return (driving_N, *[0.0 for _ in self.fractions])

    def discretise(self, dt_s: float) -> PronyStep:
        """Return the update for steps of `dt_s`; 0 is a jump of the driving force."""
        if not 0.0 <= dt_s <= MAX_STEP_S:
            require("dt_s", dt_s, 0.0, MAX_STEP_S)
        ratios = [dt_s / time_s for time_s in self.times_s]
        return PronyStep(
            fractions=self.fractions,
            decays=tuple([math.exp(-ratio) for ratio in ratios]),
            # what is left of a ramp that rose by one over the step
            gains=tuple([-math.expm1(-ratio) / ratio if ratio > 0.0 else 1.0 for ratio in ratios]),
        )
