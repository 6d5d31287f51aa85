"""The elastomer inserts: a registry read from data files, the thesis's twelve (tables 2.3 and 2.4) among them.

An insert MRE-xx-yy has an Ecoflex 00-xx matrix with yy % of carbonyl iron powder (CIP) by volume. `inserts.toml` beside
this module holds the data and says how a laboratory adds its own.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Annotated

import msgspec
from msgspec import Meta, Struct

from tormagd.physics.errors import DomainError, require
from tormagd.physics.force import Elastomer
from tormagd.toml_file import TomlError, read_toml

CIP_DENSITY_G_CC = 7.87
SLACKER_DENSITY_G_CC = 0.97
THINNER_DENSITY_G_CC = 0.97

SHIPPED = Path(__file__).with_name("inserts.toml")


class InsertFileError(ValueError):
    """A file of inserts that was refused: names the file, the place in it and what is allowed."""


def relative_permeability(cip_fraction: float) -> float:
    """Relative permeability mu_r over the CIP volume fraction, 0.10..0.40 (Eq. 5); `DomainError` outside."""
    require("cip_fraction", cip_fraction, 0.10, 0.40)
    return 2.0 + 2.0 * (cip_fraction - 0.10) / 0.30


@dataclass(frozen=True, slots=True)
class MeasuredForceRange:
    """Force at 45 mm less force at 95 mm, N: measured mean and deviation, and the estimate made beforehand, if any.

    Raises `DomainError` unless all are from 0 to 1000 N and the mean is at least 1e-6 N.
    """

    measured_N: float
    deviation_N: float
    estimate_N: float | None = None

    def __post_init__(self) -> None:
        require("measured_N", self.measured_N, 1e-6, 1e3)
        require("deviation_N", self.deviation_N, 0.0, 1e3)
        if self.estimate_N is not None:
            require("estimate_N", self.estimate_N, 0.0, 1e3)

    @property
    def thesis_estimate_N(self) -> float:
        """The estimate; `DomainError` if there is none, as for inserts that are not the thesis's."""
        if self.estimate_N is None:
            raise DomainError("estimate_N", None, "stated for the thesis's inserts only")
        return self.estimate_N


@dataclass(frozen=True, slots=True)
class Insert:
    """One fabricated insert. Fractions are of volume; `shear_modulus_Pa` is without field."""

    name: str
    shore_hardness: int
    cip_fraction: float
    slacker_fraction: float
    thinner_fraction: float
    matrix_density_g_cc: float
    elastomer: Elastomer
    measured: MeasuredForceRange | None

    @property
    def shear_modulus_Pa(self) -> float:
        """G0, Pa."""
        return self.elastomer.shear_modulus_Pa

    @property
    def force_range(self) -> MeasuredForceRange:
        """The measured range; `DomainError` for an insert that has not been measured."""
        if self.measured is None:
            raise DomainError("insert", repr(self.name), "one whose force range has been measured")
        return self.measured

    @property
    def matrix_fraction(self) -> float:
        """Volume fraction of the silicone matrix: what filler and additives leave."""
        return 1.0 - self.cip_fraction - self.slacker_fraction - self.thinner_fraction

    @property
    def masses_g(self) -> dict[str, float]:
        """Mass in 100 cc of each content, g: matrix, cip, slacker, thinner."""
        return {
            "matrix": 100.0 * self.matrix_fraction * self.matrix_density_g_cc,
            "cip": 100.0 * self.cip_fraction * CIP_DENSITY_G_CC,
            "slacker": 100.0 * self.slacker_fraction * SLACKER_DENSITY_G_CC,
            "thinner": 100.0 * self.thinner_fraction * THINNER_DENSITY_G_CC,
        }


_Fraction = Annotated[float, Meta(ge=0.0, le=0.6)]
_Density = Annotated[float, Meta(ge=0.1, le=25.0)]
_FrictionCoefficient = Annotated[float, Meta(ge=1e-3, le=10.0)]
_Hardness = Annotated[int, Meta(ge=0, le=100)]


class _Matrix(Struct, frozen=True, forbid_unknown_fields=True):
    product: Annotated[str, Meta(min_length=1, max_length=100)]
    shore_hardness: _Hardness
    density_g_cc: _Density
    friction_coefficient: _FrictionCoefficient


class _Row(Struct, frozen=True, forbid_unknown_fields=True):
    name: Annotated[str, Meta(pattern=r"^[A-Za-z0-9._-]{1,64}$")]
    shore_hardness: _Hardness
    cip_fraction: _Fraction
    shear_modulus_kPa: Annotated[float, Meta(ge=1e-3, le=1e6)]
    slacker_fraction: _Fraction = 0.05
    thinner_fraction: _Fraction = 0.05
    friction_coefficient: _FrictionCoefficient | None = None
    relative_permeability: Annotated[float, Meta(ge=1.0, le=1e3)] | None = None
    force_range: MeasuredForceRange | None = None


class _File(Struct, frozen=True, forbid_unknown_fields=True):
    matrix: list[_Matrix] = msgspec.field(default_factory=list)
    insert: list[_Row] = msgspec.field(default_factory=list)


def load_inserts(*paths: Path) -> Mapping[str, Insert]:
    """The shipped inserts and those of further files, by name.

    Raises `InsertFileError`: unreadable, not TOML, an unknown or mistyped key, a value that is not allowed, an insert
    without its matrix, a name or a matrix hardness stated twice.
    """
    matrices: dict[int, _Matrix] = {}
    inserts: dict[str, Insert] = {}
    for path in (SHIPPED, *paths):
        contents = _read(path)
        for matrix in contents.matrix:
            if matrix.shore_hardness in matrices:
                raise InsertFileError(f"{path}: matrix shore_hardness = {matrix.shore_hardness} is stated twice")
            matrices[matrix.shore_hardness] = matrix
        for row in contents.insert:
            if row.name in inserts:
                raise InsertFileError(f"{path}: insert {row.name} is stated twice")
            if row.shore_hardness not in matrices:
                known = ", ".join(map(str, sorted(matrices)))
                raise InsertFileError(
                    f"{path}: {row.name}: shore_hardness = {row.shore_hardness}: allowed are those of the "
                    f"matrices, {known}"
                )
            try:
                inserts[row.name] = _insert(row, matrices[row.shore_hardness])
            except DomainError as error:
                raise InsertFileError(f"{path}: {row.name}: {error}") from error
    return MappingProxyType(inserts)


def _read(path: Path) -> _File:
    try:
        return msgspec.convert(read_toml(path), _File)
    except OSError as error:
        raise InsertFileError(f"{path}: {error.strerror}") from error
    except (TomlError, msgspec.ValidationError) as error:
        raise InsertFileError(f"{path}: {error}") from error


def _insert(row: _Row, matrix: _Matrix) -> Insert:
    mu_r = row.relative_permeability
    if mu_r is None:
        mu_r = relative_permeability(row.cip_fraction)
    friction = row.friction_coefficient
    if friction is None:
        friction = matrix.friction_coefficient
    item = Insert(
        name=row.name,
        shore_hardness=row.shore_hardness,
        cip_fraction=row.cip_fraction,
        slacker_fraction=row.slacker_fraction,
        thinner_fraction=row.thinner_fraction,
        matrix_density_g_cc=matrix.density_g_cc,
        elastomer=Elastomer(row.shear_modulus_kPa * 1e3, mu_r, friction),
        measured=row.force_range,
    )
    require("matrix_fraction", item.matrix_fraction, 0.0, 1.0)
    return item


INSERTS = load_inserts()
"""The inserts that ship with this package."""


def insert(name: str, inserts: Mapping[str, Insert] = INSERTS) -> Insert:
    """The insert of that name, such as "MRE-50-40"; `DomainError` listing the names if there is none."""
    try:
        return inserts[name]
    except KeyError:
        raise DomainError("insert", repr(name), "one of " + ", ".join(inserts)) from None
