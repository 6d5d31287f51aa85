"""From H(z) to the gains of the position loop: the stiffest that stay robust.

For each derivative time, filter and integral time of a grid this takes the largest proportional gain whose margins hold
at every corner: the motor's parameters up and down by a share, at several loop periods. Stiffest means the largest
integral gain, which takes disturbances of the carriage (drag, the magnets' pull) away fastest.
"""

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import msgspec

from tormagd.config import Config, Position
from tormagd.control.move.motor import margins

MIN_GAIN_MARGIN_DB = 6.0
MIN_PHASE_MARGIN_DEG = 45.0
LARGEST_GAIN_PER_MM = 20.0
TICK_S = 1e-3


class Corners(NamedTuple):
    """How far the motor's parameters may be off, as a share, and the loop's periods."""

    share: float = 0.3
    periods_s: Sequence[float] = (0.8 * TICK_S, TICK_S, 1.2 * TICK_S)
    parameters: Sequence[str] = ("resistance_ohm", "back_emf_V_s", "inertia_kg_m2", "inductance_mH")


class Tuning(NamedTuple):
    """One robust set of gains, with its least margins over the corners."""

    proportional_per_mm: float
    integral_time_s: float
    derivative_time_s: float
    derivative_filter_s: float
    gain_margin_dB: float
    phase_margin_deg: float


def corner_margins(config: Config, corners: Corners = Corners()) -> dict[str, float]:  # noqa: B008  # immutable
    """Return the least gain margin, dB, and phase margin, degrees, over all corners, and their number."""
    gain, phase = [], []
    factors = (1.0 - corners.share, 1.0 + corners.share)
    for chosen in itertools.product(factors, repeat=len(corners.parameters)):
        named = zip(corners.parameters, chosen, strict=True)
        motor = msgspec.structs.replace(
            config.motor, **{name: getattr(config.motor, name) * factor for name, factor in named}
        )
        for period_s in corners.periods_s:
            found = margins(motor, config.position, period_s)
            gain.append(found.gain_margin_dB)
            phase.append(found.phase_margin_deg)
    return {"gain_margin_dB": min(gain), "phase_margin_deg": min(phase), "corners": float(len(gain))}


def tunings(
    config: Config,
    grid: Iterable[tuple[float, float, float]],
    corners: Corners = Corners(),  # noqa: B008  # immutable
) -> Iterator[Tuning]:
    """Yield the largest robust proportional gain of each grid point."""
    for derivative_s, filter_s, integral_s in grid:
        position = msgspec.structs.replace(
            config.position,
            derivative_time_s=derivative_s,
            derivative_filter_s=filter_s,
            integral_time_s=integral_s,
        )
        low, high = 0.0, LARGEST_GAIN_PER_MM
        while high - low > 0.02:
            middle = (low + high) / 2.0
            low, high = (middle, high) if _robust(config, position, middle, corners) else (low, middle)
        gain = math.floor(low * 10) / 10
        if gain > 0.0 and (kept := _robust(config, position, gain, corners)):
            yield Tuning(gain, integral_s, derivative_s, filter_s, *kept)


def stiffest(found: Iterable[Tuning]) -> Tuning | None:
    return max(found, key=lambda tuning: tuning.proportional_per_mm / tuning.integral_time_s, default=None)


def _robust(config: Config, position: Position, gain: float, corners: Corners) -> tuple[float, float] | None:
    tried = msgspec.structs.replace(config, position=msgspec.structs.replace(position, proportional_per_mm=gain))
    found = corner_margins(tried, corners)
    gain_dB, phase_deg = found["gain_margin_dB"], found["phase_margin_deg"]
    return (gain_dB, phase_deg) if gain_dB >= MIN_GAIN_MARGIN_DB and phase_deg >= MIN_PHASE_MARGIN_DEG else None
