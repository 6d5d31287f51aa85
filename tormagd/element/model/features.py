"""The network's input: the four features of Eq. 43, their units, their scaling, and the check of their values."""

from enum import StrEnum
from typing import Final

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tormagd.element.physics.errors import DomainError

FEATURES = ("displacement_mm", "rate_mm_s", "field_mT", "cip_percent")
UNITS = {"displacement_mm": "mm", "rate_mm_s": "mm/s", "field_mT": "mT", "cip_percent": "%", "force_N": "N"}
RATE: Final = FEATURES.index("rate_mm_s")
FIELD: Final = FEATURES.index("field_mT")
CIP: Final = FEATURES.index("cip_percent")

LARGEST: Final = 1e9
"No device comes near this, and the product of two does not overflow float32."


class Element(StrEnum):
    """A model serves one element only."""

    TORQUE = "torque"
    TACTILE = "tactile"


class Scaling(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Affine map to the network's -1..1: scaled = (value - offset) * gain."""

    input_offset: tuple[float, float, float, float]
    input_gain: tuple[float, float, float, float]
    output_offset: float
    output_gain: float

    def scaled(self, features: NDArray[np.float64]) -> NDArray[np.float64]:
        scaled: NDArray[np.float64] = (features - np.array(self.input_offset)) * np.array(self.input_gain)
        return scaled


def require_number(name: str, value: float) -> None:
    # asked several times in every plan: the text is made only where it is needed
    if not -LARGEST <= value <= LARGEST:
        raise DomainError(name, value, f"a finite number within +-{LARGEST:g}")


def feature_rows(features: ArrayLike) -> NDArray[np.float64]:
    """Return `features` as float64, n x 4 in the order of `FEATURES`. Raises `DomainError`."""
    rows = np.asarray(features, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] != len(FEATURES):
        raise DomainError("features", f"an array of shape {rows.shape}", f"n x 4 in the order {', '.join(FEATURES)}")
    refused = ~(np.abs(rows) <= LARGEST)
    if refused.any():
        row, column = np.argwhere(refused)[0]
        where = f"features[{row}], {FEATURES[column]}"
        raise DomainError(where, rows[row, column], f"a finite number within +-{LARGEST:g}")
    return rows
