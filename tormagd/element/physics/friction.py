"""Friction between elastomer and shaft: pre-sliding stiffness, Stribeck level, viscous part.

A LuGre model (Canudas de Wit et al. 1995) without micro-damping. Its state is the bristle deflection z, in mm at the
roller surface, positive when the handle last moved in the positive direction:

    dz/dt = v - sigma0 |v| z / g(v)              g(v) = F_kinetic (1 + (ratio - 1) exp(-(v / v_s)^2))
    F     = sigma0 z + sigma2 v

The force is that which resists positive motion of the handle; the hand does the work F v.
"""

import math
from typing import Final, final

from firmware_protocol.value import Value


@final
class Friction(Value):
    def __init__(
        self,
        presliding_stiffness_N_mm: float,
        viscous_N_s_mm: float,
        static_ratio: float,
        stribeck_speed_mm_s: float,
    ) -> None:
        self.presliding_stiffness_N_mm: Final = presliding_stiffness_N_mm
        self.viscous_N_s_mm: Final = viscous_N_s_mm
        self.static_ratio: Final = static_ratio
        self.stribeck_speed_mm_s: Final = stribeck_speed_mm_s

    def level_N(self, speed_mm_s: float, kinetic_N: float) -> float:
        ratio = speed_mm_s / self.stribeck_speed_mm_s
        return kinetic_N * (1.0 + (self.static_ratio - 1.0) * math.exp(-ratio * ratio))

    def advance(self, deflection_mm: float, speed_mm_s: float, kinetic_N: float, dt_s: float) -> tuple[float, float]:
        """Return force, N, and deflection, mm, after a step at constant speed."""
        viscous_N = self.viscous_N_s_mm * speed_mm_s
        reach_mm = self.level_N(speed_mm_s, kinetic_N) / self.presliding_stiffness_N_mm
        if reach_mm == 0.0:
            return viscous_N, 0.0
        if deflection_mm > reach_mm:
            deflection_mm = reach_mm
        elif deflection_mm < -reach_mm:
            deflection_mm = -reach_mm
        steady_mm = reach_mm if speed_mm_s >= 0.0 else -reach_mm
        deflection_mm -= (steady_mm - deflection_mm) * math.expm1(-abs(speed_mm_s) * dt_s / reach_mm)
        return self.presliding_stiffness_N_mm * deflection_mm + viscous_N, deflection_mm
