"""The elastomer inserts: a registry of data, the thesis's twelve (tables 2.3 and 2.4).

An insert MRE-xx-yy has an Ecoflex 00-xx matrix with yy % of carbonyl iron powder (CIP) by volume. `inserts.toml` beside
this module holds the data and says how a laboratory adds its own.
"""

from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta, Struct

from tormagd.element.physics.errors import DomainError, require, require_that
from tormagd.element.physics.force import Elastomer
from tormagd.ground.toml_file import toml_tables, toml_text

CIP_DENSITY_G_CC = 7.87
SLACKER_DENSITY_G_CC = 0.97
THINNER_DENSITY_G_CC = 0.97

_Fraction = Annotated[float, Meta(ge=0.0, le=0.6)]
_FrictionCoefficient = Annotated[float, Meta(ge=1e-3, le=10.0)]
_Hardness = Annotated[int, Meta(ge=0, le=100)]
_Force = Annotated[float, Meta(ge=0.0, le=1e3)]


def relative_permeability(cip_fraction: float) -> float:
    """Return mu_r at a volume fraction of iron (Eq. 5)."""
    require("cip_fraction", cip_fraction, 0.10, 0.40)
    return 2.0 + 2.0 * (cip_fraction - 0.10) / 0.30


class MeasuredForceRange(Struct, frozen=True, forbid_unknown_fields=True):
    """The force at a gap of 45 mm less that at 95 mm."""

    measured_N: Annotated[float, Meta(ge=1e-6, le=1e3)]
    deviation_N: _Force
    estimate_N: _Force | None = None

    @property
    def thesis_estimate_N(self) -> float:
        if self.estimate_N is None:
            raise DomainError("estimate_N", None, "stated for the thesis's inserts only")
        return self.estimate_N


class Matrix(Struct, frozen=True, forbid_unknown_fields=True):
    product: Annotated[str, Meta(min_length=1, max_length=100)]
    shore_hardness: _Hardness
    density_g_cc: Annotated[float, Meta(ge=0.1, le=25.0)]
    friction_coefficient: _FrictionCoefficient


class Insert(Struct, frozen=True, forbid_unknown_fields=True):
    name: Annotated[str, Meta(pattern=r"^[A-Za-z0-9._-]{1,64}$")]
    shore_hardness: _Hardness
    cip_fraction: _Fraction
    shear_modulus_kPa: Annotated[float, Meta(ge=1e-3, le=1e6)]
    slacker_fraction: _Fraction = 0.05
    thinner_fraction: _Fraction = 0.05
    friction_coefficient: _FrictionCoefficient | None = None
    relative_permeability: Annotated[float, Meta(ge=1.0, le=1e3)] | None = None
    measured: MeasuredForceRange | None = msgspec.field(default=None, name="force_range")

    @property
    def elastomer(self) -> Elastomer:
        mu_r, friction = self.relative_permeability, self.friction_coefficient
        return Elastomer(
            self.shear_modulus_Pa,
            relative_permeability(self.cip_fraction) if mu_r is None else mu_r,
            self.matrix.friction_coefficient if friction is None else friction,
        )

    @property
    def matrix(self) -> Matrix:
        known = ", ".join(map(str, MATRICES))
        allowed = f"one of a [[matrix]], {known}; or state friction_coefficient"
        require_that(self.shore_hardness in MATRICES, f"{self.name}: shore_hardness", self.shore_hardness, allowed)
        return MATRICES[self.shore_hardness]

    @property
    def shear_modulus_Pa(self) -> float:
        return self.shear_modulus_kPa * 1e3

    @property
    def force_range(self) -> MeasuredForceRange:
        if self.measured is None:
            raise DomainError("insert", repr(self.name), "one whose force range has been measured")
        return self.measured

    @property
    def masses_g(self) -> dict[str, float]:
        matrix_fraction = 1.0 - self.cip_fraction - self.slacker_fraction - self.thinner_fraction
        return {
            "matrix": 100.0 * matrix_fraction * self.matrix.density_g_cc,
            "cip": 100.0 * self.cip_fraction * CIP_DENSITY_G_CC,
            "slacker": 100.0 * self.slacker_fraction * SLACKER_DENSITY_G_CC,
            "thinner": 100.0 * self.thinner_fraction * THINNER_DENSITY_G_CC,
        }


class _File(Struct, frozen=True, forbid_unknown_fields=True):
    matrix: list[Matrix]
    insert: list[Insert]


_FILE = msgspec.convert(toml_tables(toml_text(Path(__file__).with_name("inserts.toml"))), _File)
MATRICES = {matrix.shore_hardness: matrix for matrix in _FILE.matrix}
INSERTS = {item.name: item for item in _FILE.insert}


def insert(name: str) -> Insert:
    require_that(name in INSERTS, "insert", repr(name), "one of " + ", ".join(INSERTS))
    return INSERTS[name]
