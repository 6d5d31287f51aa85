"""The types in which `layouts.py` states the schema of tormag.dbc."""

from typing import Any, NamedTuple


class Signal(NamedTuple):
    """One field of a payload: physical value = step * scale, with `step` the integer on the wire."""

    name: str
    type: type[float]  # the type system takes int and the enumerations for floats
    scale: float
    minimum: float
    maximum: float
    wraps: bool = False

    @property
    def lowest(self) -> int:
        return round(self.minimum / self.scale)

    @property
    def highest(self) -> int:
        return round(self.maximum / self.scale)

    @property
    def period(self) -> float:
        return (self.highest - self.lowest + 1) * self.scale


class Layout(NamedTuple):
    """One message: its function code and how its payload is laid out."""

    message: type[Any]
    function: int
    format: str
    protected: bool
    signals: tuple[Signal, ...]
