"""The torque element in time: the static force law, and the terms that depart from it, each of which can be left out.

    gap -> radial moment -> [hysteresis] -> static force -> [rate] -> [relaxation] -> kinetic level -> [pre-sliding]

With all of them left out this is `brake_force_N`, with the sign of the handle's speed.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

from tormagd.physics.errors import require
from tormagd.physics.field import FieldLaw
from tormagd.physics.force import Elastomer, Geometry, brake_force_N
from tormagd.physics.friction import MAX_SPEED_MM_S, Friction
from tormagd.physics.hysteresis import Hysteresis, PlayState
from tormagd.physics.relaxation import PronySeries, PronyState, PronyStep


@dataclass(frozen=True, slots=True)
class RateStrengthening:
    """An elastomer sheared faster is stronger: factor 1 + strength asinh(|speed| / reference_speed_mm_s).

    Linear far below the reference speed, logarithmic far above it, as thermally activated slip is.
    Raises `DomainError` unless the strength is 0..1 and the reference speed 1e-6..1e6 mm/s.
    """

    strength: float
    reference_speed_mm_s: float

    def __post_init__(self) -> None:
        require("strength", self.strength, 0.0, 1.0)
        require("reference_speed_mm_s", self.reference_speed_mm_s, 1e-6, 1e6)

    def factor(self, speed_mm_s: float) -> float:
        """Force at that speed over force at rest, >= 1."""
        require("speed_mm_s", speed_mm_s, -MAX_SPEED_MM_S, MAX_SPEED_MM_S)
        return 1.0 + self.strength * math.asinh(abs(speed_mm_s) / self.reference_speed_mm_s)


class ElementState(NamedTuple):
    """Memory of the terms that have any: field, elastomer, bristle deflection (mm)."""

    field: PlayState | None
    elastomer: PronyState | None
    deflection_mm: float


@dataclass(frozen=True, slots=True)
class TorqueElement:
    """The element as a chain of terms; `None` leaves a term out. Immutable: the state is the caller's."""

    field: FieldLaw
    elastomer: Elastomer
    geometry: Geometry
    hysteresis: Hysteresis | None = None
    rate: RateStrengthening | None = None
    relaxation: PronySeries | None = None
    friction: Friction | None = None

    def rested(self, gap_mm: float) -> ElementState:
        """State after a long rest at that gap."""
        moment_Tm = self.field.radial_moment_Tm(gap_mm)
        driving_N = brake_force_N(moment_Tm, self.elastomer, self.geometry)
        return ElementState(
            self.hysteresis.demagnetised(moment_Tm) if self.hysteresis is not None else None,
            self.relaxation.relaxed(driving_N) if self.relaxation is not None else None,
            0.0,
        )

    def discretise(self, dt_s: float) -> "ElementStep":
        """The element in steps of `dt_s`, 0..1e6 s; keep it where the step is constant."""
        require("dt_s", dt_s, 0.0, 1e6)
        return ElementStep(self, dt_s, self.relaxation.discretise(dt_s) if self.relaxation is not None else None)


@dataclass(frozen=True, slots=True)
class ElementStep:
    """One `TorqueElement` at one step length; made by `TorqueElement.discretise`."""

    element: TorqueElement
    dt_s: float
    relaxation: PronyStep | None

    def advance(self, state: ElementState, gap_mm: float, speed_mm_s: float) -> tuple[float, ElementState]:
        """(force_N, next state) at the end of a step that ends at that gap, with the handle at that mean speed.

        The force resists positive motion where it is positive. Without the friction term it is the kinetic level with
        the speed's sign, and zero at rest. Raises `DomainError` for what a term's own range does not admit.
        """
        element = self.element
        require("speed_mm_s", speed_mm_s, -MAX_SPEED_MM_S, MAX_SPEED_MM_S)
        moment_Tm = element.field.radial_moment_Tm(gap_mm)
        field, elastomer, deflection_mm = state
        if element.hysteresis is not None and field is not None:
            moment_Tm, field = element.hysteresis.advance(field, moment_Tm)
        level_N = brake_force_N(moment_Tm, element.elastomer, element.geometry)
        if element.rate is not None:
            level_N *= element.rate.factor(speed_mm_s)
        if self.relaxation is not None and elastomer is not None:
            relaxed_N, elastomer = self.relaxation.advance(elastomer, level_N)
            # relaxing from a high force may pull the insert off the shaft, but never push the handle on
            level_N = max(relaxed_N, 0.0)
        if element.friction is not None:
            force_N, deflection_mm = element.friction.advance(deflection_mm, speed_mm_s, level_N, self.dt_s)
        else:
            force_N = math.copysign(level_N, speed_mm_s) if speed_mm_s != 0.0 else 0.0
        return force_N, ElementState(field, elastomer, deflection_mm)
