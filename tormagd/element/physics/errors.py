"""The one error of this room, and the checks that raise it."""

from typing import Any, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.floating[Any]]
Real = TypeVar("Real", float, FloatArray)
"A Python float, or an array of float32 or float64 whose type the result keeps."


class DomainError(ValueError):
    """A value outside the range in which a model holds."""

    def __init__(self, variable: str, value: object, allowed: str) -> None:
        super().__init__(f"{variable} = {value} is not allowed: {allowed}")
        self.variable = variable
        self.value = value
        self.allowed = allowed

    def __reduce__(self) -> tuple[type["DomainError"], tuple[str, object, str]]:
        # an error rebuilt from its text would break a process pool
        return type(self), (self.variable, self.value, self.allowed)


def require_that(condition: bool, variable: str, value: object, allowed: str) -> None:
    if not condition:
        raise DomainError(variable, value, allowed)


def require(variable: str, value: float | FloatArray, low: float, high: float) -> None:
    """Raise `DomainError` unless every element of `value` is in [low, high]."""
    if isinstance(value, float | int):
        if low <= value <= high:
            return
        culprit: object = value
    else:
        if not (isinstance(value, np.ndarray | np.floating) and value.dtype in (np.float32, np.float64)):
            kind = getattr(value, "dtype", type(value).__name__)
            raise DomainError(variable, kind, "a float, or an array of float32 or float64")
        outside = ~((value >= low) & (value <= high))
        if not outside.any():
            return
        culprit = value[outside][0] if value.ndim else value
    raise DomainError(variable, culprit, f"a number from {low:g} to {high:g}")
