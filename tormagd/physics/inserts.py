"""The elastomer inserts: a registry of data, the thesis's twelve (tables 2.3 and 2.4).

An insert MRE-xx-yy has an Ecoflex 00-xx matrix with yy % of carbonyl iron powder (CIP) by volume. `inserts.toml` beside
this module holds the data and says how a laboratory adds its own.
"""

from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta, Struct

from tormagd.physics.errors import DomainError, require, require_that
from tormagd.physics.force import Elastomer
from tormagd.toml_file import read_toml

CIP_DENSITY_G_CC = 7.87
SLACKER_DENSITY_G_CC = 0.97
THINNER_DENSITY_G_CC = 0.97

_Fraction = Annotated[float, Meta(ge=0.0, le=0.6)]
_FrictionCoefficient = Annotated[float, Meta(ge=1e-3, le=10.0)]
_Hardness = Annotated[int, Meta(ge=0, le=100)]
_Force = Annotated[float, Meta(ge=0.0, le=1e3)]


def relative_permeability(cip_fraction: float) -> float:
    """Relative permeability mu_r over the CIP volume fraction, 0.10..0.40 (Eq. 5); `DomainError` outside."""
    require("cip_fraction", cip_fraction, 0.10, 0.40)
    return 2.0 + 2.0 * (cip_fraction - 0.10) / 0.30


class MeasuredForceRange(Struct, frozen=True, forbid_unknown_fields=True):
    """Force at 45 mm less force at 95 mm, N: measured mean and deviation, and the estimate made beforehand, if any."""

    measured_N: Annotated[float, Meta(ge=1e-6, le=1e3)]
    deviation_N: _Force
    estimate_N: _Force | None = None

    @property
    def thesis_estimate_N(self) -> float:
        """The estimate; `DomainError` if there is none, as for inserts that are not the thesis's."""
        if self.estimate_N is None:
            raise DomainError("estimate_N", None, "stated for the thesis's inserts only")
        return self.estimate_N


class Matrix(Struct, frozen=True, forbid_unknown_fields=True):
    """The silicone that inserts of one Shore hardness are made of."""

    product: Annotated[str, Meta(min_length=1, max_length=100)]
    shore_hardness: _Hardness
    density_g_cc: Annotated[float, Meta(ge=0.1, le=25.0)]
    friction_coefficient: _FrictionCoefficient


class Insert(Struct, frozen=True, forbid_unknown_fields=True):
    """One fabricated insert. Fractions are of volume; the shear modulus is without field."""

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
        """Modulus, permeability and friction; of these, Eq. 5 and the matrix tell what the insert does not state."""
        mu_r, friction = self.relative_permeability, self.friction_coefficient
        return Elastomer(
            self.shear_modulus_Pa,
            relative_permeability(self.cip_fraction) if mu_r is None else mu_r,
            MATRICES[self.shore_hardness].friction_coefficient if friction is None else friction,
        )

    @property
    def shear_modulus_Pa(self) -> float:
        """G0, Pa."""
        return self.shear_modulus_kPa * 1e3

    @property
    def force_range(self) -> MeasuredForceRange:
        """The measured range; `DomainError` for an insert that has not been measured."""
        if self.measured is None:
            raise DomainError("insert", repr(self.name), "one whose force range has been measured")
        return self.measured

    @property
    def masses_g(self) -> dict[str, float]:
        """Mass in 100 cc of each content, g: matrix, cip, slacker, thinner; the matrix is what the others leave."""
        matrix_fraction = 1.0 - self.cip_fraction - self.slacker_fraction - self.thinner_fraction
        return {
            "matrix": 100.0 * matrix_fraction * MATRICES[self.shore_hardness].density_g_cc,
            "cip": 100.0 * self.cip_fraction * CIP_DENSITY_G_CC,
            "slacker": 100.0 * self.slacker_fraction * SLACKER_DENSITY_G_CC,
            "thinner": 100.0 * self.thinner_fraction * THINNER_DENSITY_G_CC,
        }


class _File(Struct, frozen=True, forbid_unknown_fields=True):
    matrix: list[Matrix]
    insert: list[Insert]


_FILE = msgspec.convert(read_toml(Path(__file__).with_name("inserts.toml")), _File)
MATRICES = {matrix.shore_hardness: matrix for matrix in _FILE.matrix}
INSERTS = {item.name: item for item in _FILE.insert}


def insert(name: str) -> Insert:
    """The insert of that name, such as "MRE-50-40"; `DomainError` listing the names if there is none."""
    require_that(name in INSERTS, "insert", repr(name), "one of " + ", ".join(INSERTS))
    return INSERTS[name]
