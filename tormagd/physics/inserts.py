"""The twelve elastomer inserts: composition and shear modulus (table 2.3), measured force ranges (table 2.4).

An insert MRE-xx-yy has an Ecoflex 00-xx matrix with yy % of carbonyl iron powder (CIP) by volume.
"""

from dataclasses import dataclass
from types import MappingProxyType

from tormagd.physics.errors import DomainError, require
from tormagd.physics.force import Elastomer

MATRIX_DENSITY_G_CC = 1.04
CIP_DENSITY_G_CC = 7.87
SLACKER_DENSITY_G_CC = 0.97
THINNER_DENSITY_G_CC = 0.97

ADDITIVE_FRACTION = 0.05
"""Volume fraction of the Slacker, and of the thinner, in every insert."""

FRICTION_COEFFICIENT = MappingProxyType({10: 0.090, 30: 0.125, 50: 0.204})
"""Kinetic friction coefficient on the shaft by the matrix's Shore 00 hardness.

Fitted to table 2.4, not measured: with one coefficient for all twelve inserts the force law cannot give two inserts
of equal permeability and nearly equal modulus the forces, twofold apart, that were measured.
"""


def relative_permeability(cip_fraction: float) -> float:
    """Relative permeability mu_r over the CIP volume fraction, 0.10..0.40 (Eq. 5); `DomainError` outside."""
    require("cip_fraction", cip_fraction, 0.10, 0.40)
    return 2.0 + 2.0 * (cip_fraction - 0.10) / 0.30


@dataclass(frozen=True, slots=True)
class MeasuredForceRange:
    """Force at 45 mm less force at 95 mm, N, for one insert: experiment (mean, deviation) and the thesis's estimate."""

    measured_N: float
    deviation_N: float
    thesis_estimate_N: float


@dataclass(frozen=True, slots=True)
class Insert:
    """One fabricated insert. Fractions are of volume; `shear_modulus_Pa` is without field."""

    name: str
    shore_hardness: int
    cip_fraction: float
    shear_modulus_Pa: float
    force_range: MeasuredForceRange

    @property
    def matrix_fraction(self) -> float:
        """Volume fraction of the silicone matrix: what filler and additives leave."""
        return 1.0 - self.cip_fraction - 2.0 * ADDITIVE_FRACTION

    @property
    def masses_g(self) -> dict[str, float]:
        """Mass in 100 cc of each content, g: matrix, cip, slacker, thinner."""
        return {
            "matrix": 100.0 * self.matrix_fraction * MATRIX_DENSITY_G_CC,
            "cip": 100.0 * self.cip_fraction * CIP_DENSITY_G_CC,
            "slacker": 100.0 * ADDITIVE_FRACTION * SLACKER_DENSITY_G_CC,
            "thinner": 100.0 * ADDITIVE_FRACTION * THINNER_DENSITY_G_CC,
        }

    @property
    def elastomer(self) -> Elastomer:
        """The insert as the force law wants it: mu_r from Eq. 5, mu_d that of its matrix."""
        return Elastomer(
            shear_modulus_Pa=self.shear_modulus_Pa,
            relative_permeability=relative_permeability(self.cip_fraction),
            friction_coefficient=FRICTION_COEFFICIENT[self.shore_hardness],
        )


def _insert(
    shore: int, cip_percent: int, modulus_kPa: float, measured: tuple[float, float], estimate_N: float
) -> Insert:
    return Insert(
        name=f"MRE-{shore}-{cip_percent}",
        shore_hardness=shore,
        cip_fraction=cip_percent / 100,
        shear_modulus_Pa=modulus_kPa * 1e3,
        force_range=MeasuredForceRange(*measured, estimate_N),
    )


INSERTS = MappingProxyType(
    {
        item.name: item
        for item in (
            _insert(10, 10, 79.5, (1.06, 0.18), 1.11),
            _insert(10, 20, 106.4, (1.40, 0.11), 1.34),
            _insert(10, 30, 139.9, (2.19, 0.13), 2.07),
            _insert(10, 40, 175.0, (2.63, 0.23), 2.42),
            _insert(30, 10, 87.2, (1.34, 0.12), 1.46),
            _insert(30, 20, 120.1, (2.04, 0.22), 2.31),
            _insert(30, 30, 144.8, (2.73, 0.20), 2.98),
            _insert(30, 40, 188.5, (3.76, 0.15), 4.14),
            _insert(50, 10, 88.9, (2.77, 0.17), 3.10),
            _insert(50, 20, 137.6, (2.83, 0.09), 3.23),
            _insert(50, 30, 185.5, (3.55, 0.20), 4.16),
            _insert(50, 40, 277.3, (5.29, 0.14), 5.82),
        )
    }
)


def insert(name: str) -> Insert:
    """The insert of that name, such as "MRE-50-40"; `DomainError` listing the names if there is none."""
    try:
        return INSERTS[name]
    except KeyError:
        raise DomainError("insert", repr(name), "one of " + ", ".join(INSERTS)) from None
