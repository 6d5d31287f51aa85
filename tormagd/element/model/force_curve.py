"""Force curves: the force over the field at one state of the handle. Searches know no more of a model.

Behind a curve may stand a network, a grey box with memory, or a closed form.
"""

import math
from typing import Final, Protocol, TypeAlias, final

import numpy as np
from numpy.typing import NDArray

from tormagd.element.model.features import FEATURES, FIELD, LARGEST, require_number

EXTRAPOLATION_RATE: Final = 4.0
"Falls to 1/e a quarter of the training range outside it, features summed."

RESIDUAL_RATE: Final = 20.0
"Falls to 1/e with 5% of the training force span between force asked and force predicted."

LARGEST_EXPONENT: Final = 700.0
"exp() of a little more overflows; so far from its step a unit adds nothing."

# compiled, a constant of this module is a plain float
_LARGEST: Final[float] = LARGEST
Floats: TypeAlias = NDArray[np.floating]


class ForceCurve(Protocol):
    """The force over the field at one state of the handle and share of iron."""

    @property
    def displacement_mm(self) -> float:
        """The handle's displacement."""

    @property
    def rate_mm_s(self) -> float:
        """The handle's rate."""

    @property
    def cip_percent(self) -> float:
        """The share of carbonyl iron, by volume."""

    @property
    def magnitude_N(self) -> float:
        """The sum of the magnitudes of a force's terms, which bounds its rounding error."""

    def force_N(self, field_mT: float) -> float:
        """Return the force at one field."""

    def force_and_slope(self, field_mT: float) -> tuple[float, float]:
        """Return the force, N, and its slope dF/dB, N/mT."""

    def forces_N(self, fields_mT: Floats) -> Floats:
        """Return the force at each field (n), in the fields' precision."""

    def confidence(self, field_mT: float, error_N: float) -> float:
        """Return the trust, 0..1, in a field whose force misses the force asked by `error_N`."""


def within(value: float, ends: tuple[float, float]) -> float:
    return min(max(value, ends[0]), ends[1])


@final
class Known:
    """The ranges of features and forces that a model was trained on."""

    def __init__(self, ranges: tuple[tuple[float, float], ...], span_N: float) -> None:
        self.lows: Final = [low for low, _ in ranges]
        self.highs: Final = [high for _, high in ranges]
        self.scales: Final = [(high - low) or max(abs(low), 1.0) for low, high in ranges]
        self.span_N: Final = span_N

    def excess(self, place: int, value: float) -> float:
        outside = max(self.lows[place] - value, value - self.highs[place])
        return outside / self.scales[place] if outside > 0.0 else 0.0


@final
class Network:
    """The 4-h-1 sigmoid network in physical units: F = constant + output . sigmoid(weight x + bias)."""

    def __init__(
        self,
        weight: NDArray[np.float64],
        bias: NDArray[np.float64],
        output: NDArray[np.float64],
        constant_N: float,
        known: Known,
    ) -> None:
        # 1 / (1 + exp(-z)): the weights are kept with the minus sign
        columns: list[list[float]] = [(-weight[:, FEATURES.index(name)]).tolist() for name in FEATURES]
        self.displacement: Final = columns[0]
        self.rate: Final = columns[1]
        self.field: Final = columns[2]
        self.cip: Final = columns[3]
        negated: list[float] = (-bias).tolist()
        self.bias: Final = negated
        outputs: list[float] = output.tolist()
        self.output: Final = outputs
        self.constant_N: Final = constant_N
        # the same sigmoid by tanh, which takes arrays and cannot overflow
        self.field_half: Final = weight[:, FIELD] / 2
        self.output_half: Final = output / 2
        self.middle_N: Final = constant_N + math.fsum(outputs) / 2
        self.magnitude_N: Final = math.fsum([abs(value) for value in outputs]) + abs(constant_N)
        self.known: Final = known

    def curve(self, displacement_mm: float, rate_mm_s: float, cip_percent: float) -> "NetworkCurve":
        """Return the force curve at a state of the handle. Raises `DomainError` beyond `LARGEST`."""
        # written out because it stands before every prediction of the control loop
        if not (
            -_LARGEST <= displacement_mm <= _LARGEST
            and -_LARGEST <= rate_mm_s <= _LARGEST
            and -_LARGEST <= cip_percent <= _LARGEST
        ):
            for name, value in zip(FEATURES, (displacement_mm, rate_mm_s, 0.0, cip_percent), strict=True):
                require_number(name, value)
        shift = [
            bias + by_mm * displacement_mm + by_mm_s * rate_mm_s + by_percent * cip_percent
            for bias, by_mm, by_mm_s, by_percent in zip(self.bias, self.displacement, self.rate, self.cip)  # noqa: B905
        ]
        return NetworkCurve(self, shift, displacement_mm, rate_mm_s, cip_percent)


@final
class NetworkCurve:
    def __init__(
        self, network: Network, shift: list[float], displacement_mm: float, rate_mm_s: float, cip_percent: float
    ) -> None:
        self._network = network
        self._shift = shift
        self.displacement_mm: Final = displacement_mm
        self.rate_mm_s: Final = rate_mm_s
        self.cip_percent: Final = cip_percent

    @property
    def magnitude_N(self) -> float:
        return self._network.magnitude_N

    def force_N(self, field_mT: float) -> float:
        network, total_N = self._network, 0.0
        for shift, by_mT, output in zip(self._shift, network.field, network.output):  # noqa: B905
            exponent = shift + by_mT * field_mT
            if exponent < LARGEST_EXPONENT:
                total_N += output / (1.0 + math.exp(exponent))
        return total_N + network.constant_N

    def force_and_slope(self, field_mT: float) -> tuple[float, float]:
        network, total_N, slope = self._network, 0.0, 0.0
        for shift, by_mT, output in zip(self._shift, network.field, network.output):  # noqa: B905
            exponent = shift + by_mT * field_mT
            if exponent < LARGEST_EXPONENT:
                grown = math.exp(exponent)
                whole = 1.0 + grown
                part_N = output / whole
                total_N += part_N
                slope -= by_mT * part_N * (grown / whole)
        return total_N + network.constant_N, slope

    def forces_N(self, fields_mT: Floats) -> Floats:
        network, kind = self._network, fields_mT.dtype
        hidden = np.multiply.outer(fields_mT, network.field_half.astype(kind, copy=False))
        hidden -= np.array(self._shift, dtype=kind) / 2
        forces: Floats = np.tanh(hidden, hidden).dot(network.output_half.astype(kind, copy=False))
        forces += kind.type(network.middle_N)
        return forces

    def confidence(self, field_mT: float, error_N: float) -> float:
        known = self._network.known
        excess = (
            known.excess(0, self.displacement_mm)
            + known.excess(1, self.rate_mm_s)
            + known.excess(FIELD, field_mT)
            + known.excess(3, self.cip_percent)
        )
        return math.exp(-EXTRAPOLATION_RATE * excess - RESIDUAL_RATE * abs(error_N) / known.span_N)
