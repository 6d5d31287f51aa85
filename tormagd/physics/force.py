"""The magnetoelastic brake force: from the radial moment of the field to the friction force at the roller.

This is the thesis's chain (Eq. 29..34, with Gamma_1 and Gamma_2 as its appendix has them) with units. The dimensionless
curve under it, and why it is written so, is in `tormagd.physics.brake_curve`:

    y = (mu_r a / 4)^2 / (4 mu0 mu_r G0 R_o R_i)                   magnetic over elastic stress
    F = 2 pi t R_i^2 mu_d G0 / R_w * curve(y)                      Eq. 33 and 34

The radial moment a (`radial_moment_Tm`) is that of `tormagd.physics.field`, without mu_r / 4. F rises strictly with a,
so the inverse is unique; `tormagd.lab.design.force_law` has it. The model is used for a stretch lambda1 >= 0.05 only.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

from tormagd.physics.brake_curve import MAX_COMPRESSION, BrakeCurve
from tormagd.physics.errors import Real, require, require_that
from tormagd.physics.field import REFERENCE_PERMEABILITY

MU0_H_M = 4e-7 * math.pi


@dataclass(frozen=True, slots=True)
class Geometry:
    """The elastomer's cylinder around its shaft, and the roller."""

    inner_radius_m: float
    outer_radius_m: float
    thickness_m: float
    roller_radius_m: float

    def __post_init__(self) -> None:
        for name in ("inner_radius_m", "outer_radius_m", "thickness_m", "roller_radius_m"):
            require(name, getattr(self, name), 1e-5, 1.0)
        require_that(
            self.inner_radius_m < self.outer_radius_m,
            "outer_radius_m",
            self.outer_radius_m,
            f"above inner_radius_m, {self.inner_radius_m}",
        )


TORMAG = Geometry(inner_radius_m=0.004, outer_radius_m=0.011, thickness_m=0.020, roller_radius_m=0.020)
"The thesis's device (table 2.2)."


@dataclass(frozen=True, slots=True)
class Elastomer:
    """What of one insert makes its force: G0, mu_r and the kinetic friction coefficient mu_d."""

    shear_modulus_Pa: float
    relative_permeability: float
    friction_coefficient: float

    def __post_init__(self) -> None:
        require("shear_modulus_Pa", self.shear_modulus_Pa, 1.0, 1e9)
        require("relative_permeability", self.relative_permeability, 1.0, 1e3)
        require("friction_coefficient", self.friction_coefficient, 1e-3, 10.0)


def max_radial_moment_Tm(elastomer: Elastomer, geometry: Geometry) -> float:
    """Return the largest admissible radial moment, which compresses the elastomer to lambda1 = 0.05."""
    return reduced(elastomer, geometry).max_moment_Tm


def brake_force_N(radial_moment_Tm: Real, elastomer: Elastomer, geometry: Geometry) -> Real:
    """Return the kinetic friction force at the roller (Eq. 33 and 34). Raises `DomainError` for a moment beyond
    `max_radial_moment_Tm`.
    """
    law = reduced(elastomer, geometry)
    require("radial_moment_Tm", radial_moment_Tm, 0.0, law.max_moment_Tm)
    return law.force(radial_moment_Tm)


class Reduced(NamedTuple):
    """The force law of one elastomer in one geometry: the dimensionless curve and its two scales."""

    curve: BrakeCurve
    load_root_per_Tm: float
    force_scale_N: float
    max_moment_Tm: float

    def load(self, moment_Tm: Real) -> Real:
        root = self.load_root_per_Tm * moment_Tm
        return root * root

    def force(self, moment_Tm: Real) -> Real:
        load = self.load(moment_Tm)
        return self.force_scale_N * self.curve.force(self.curve.compression(load), load)


@lru_cache(maxsize=64)
def reduced(elastomer: Elastomer, geometry: Geometry) -> Reduced:
    g0, mu_r = elastomer.shear_modulus_Pa, elastomer.relative_permeability
    inner, outer, thickness = geometry.inner_radius_m, geometry.outer_radius_m, geometry.thickness_m
    curve = BrakeCurve.of(wall=(outer - inner) / inner, body_force=thickness * (mu_r - 1.0))
    # b R = (mu_r / 4) a, and y = (b R)^2 / (4 mu0 mu_r G0 R_o R_i)
    root = math.sqrt(mu_r / (4.0 * MU0_H_M * g0 * outer * inner)) / REFERENCE_PERMEABILITY
    scale_N = 2.0 * math.pi * thickness * inner * inner * elastomer.friction_coefficient * g0 / geometry.roller_radius_m
    max_moment_Tm = math.sqrt(curve.load(MAX_COMPRESSION)) / root
    return Reduced(curve, root, scale_N, max_moment_Tm)
