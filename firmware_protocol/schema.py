"""The types in which `layouts.py` states the schema of tormag.dbc."""

from typing import Any, NamedTuple


class Signal(NamedTuple):
    """One field of a payload: physical value = step * scale, with `step` the integer on the wire.

    `minimum` and `maximum` are physical and inclusive. A signal that `wraps` is a counter of steps modulo its span.
    Every finite value has a step then, and a value that was read is known only modulo `period`.
    `type` is the type of the Python field: float, int, or an enumeration.
    """

    name: str
    type: type[float]  # int and the enumerations are, to the type system, floats
    scale: float
    minimum: float
    maximum: float
    wraps: bool = False

    @property
    def lowest(self) -> int:
        """The smallest step."""
        return round(self.minimum / self.scale)

    @property
    def highest(self) -> int:
        """The largest step."""
        return round(self.maximum / self.scale)

    @property
    def period(self) -> float:
        """The period of a wrapping signal, in its unit."""
        return (self.highest - self.lowest + 1) * self.scale


class Layout(NamedTuple):
    """One message: its function code and how its payload is laid out.

    `format` is the `struct` format of the whole payload. In a `protected` message its last byte is the CRC-8, which is
    not among `signals`.
    """

    message: type[Any]
    function: int
    format: str
    protected: bool
    signals: tuple[Signal, ...]
