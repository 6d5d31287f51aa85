"""The magnetoelastic brake force: from the radial moment of the field to the friction force at the roller.

The thesis's chain (Eq. 29..34, with Gamma_1 and Gamma_2 as in its appendix), with units, over the dimensionless curve
of `tormagd.element.physics.brake_curve`:

    y = (mu_r a / 4)^2 / (4 mu0 mu_r G0 R_o R_i)                   magnetic over elastic stress
    F = 2 pi t R_i^2 mu_d G0 / R_w * curve(y)                      rises strictly with the moment a
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

from tormagd.element.physics.brake_curve import MAX_COMPRESSION, BrakeCurve
from tormagd.element.physics.errors import Real, require, require_that
from tormagd.element.physics.field import REFERENCE_PERMEABILITY

MU0_H_M = 4e-7 * math.pi


@dataclass(frozen=True, slots=True)
class Geometry:
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


@dataclass(frozen=True, slots=True)
class Elastomer:
    shear_modulus_Pa: float
    relative_permeability: float
    friction_coefficient: float

    def __post_init__(self) -> None:
        require("shear_modulus_Pa", self.shear_modulus_Pa, 1.0, 1e9)
        require("relative_permeability", self.relative_permeability, 1.0, 1e3)
        require("friction_coefficient", self.friction_coefficient, 1e-3, 10.0)


def max_radial_moment_Tm(elastomer: Elastomer, geometry: Geometry) -> float:
    """Return the moment that compresses the elastomer to lambda1 = 0.05."""
    return reduced(elastomer, geometry).max_moment_Tm


def brake_force_N(radial_moment_Tm: Real, elastomer: Elastomer, geometry: Geometry) -> Real:
    """Return the kinetic friction force at the roller. Raises `DomainError` for a moment out of range."""
    law = reduced(elastomer, geometry)
    require("radial_moment_Tm", radial_moment_Tm, 0.0, law.max_moment_Tm)
    return law.force(radial_moment_Tm)


class Reduced(NamedTuple):
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
