"""From H(z) to the gains of the position loop: the stiffest that stay robust.

Searches derivative time, filter and integral time on a grid. For each it takes the largest proportional gain whose
margins hold at every corner. Corners are +-30% in the motor's parameters and +-20% in the loop period. Stiffest means
the largest integral gain: how fast a disturbance of the carriage (drag, the magnets' pull) is taken away.
"""

import argparse
import itertools
import math
from pathlib import Path
from typing import NamedTuple

import msgspec
from tqdm import tqdm

from tormagd.config import Config, load_config
from tormagd.control.move.motor import margins
from tormagd.lab.errors import LabError
from tormagd.lab.main import Found

MIN_GAIN_MARGIN_DB = 6.0
MIN_PHASE_MARGIN_DEG = 45.0
DERIVATIVE_TIMES_S = (0.01, 0.015, 0.02, 0.025, 0.03, 0.04)
FILTER_TIMES_S = (0.002, 0.003, 0.004)
INTEGRAL_TIMES_S = (0.1, 0.15, 0.2, 0.4)
"A shorter integral time than 0.1 s fights stiction: the carriages begin to hunt by a count."
LARGEST_GAIN_PER_MM = 20.0
CORNER = 0.3
CORNER_PARAMETERS = ("resistance_ohm", "back_emf_V_s", "inertia_kg_m2", "inductance_mH")
PERIOD_CORNERS = (0.8, 1.0, 1.2)
TICK_S = 1e-3


class Tuning(NamedTuple):
    """One robust set of gains, and its smallest margins over the corners."""

    proportional_per_mm: float
    integral_time_s: float
    derivative_time_s: float
    derivative_filter_s: float
    gain_margin_dB: float
    phase_margin_deg: float


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `tormag-lab tune-position`."""
    parser.add_argument("--config", type=Path, help="whose [motor] is tuned for; the defaults otherwise")


def run(options: argparse.Namespace) -> Found:
    """Return the stiffest robust gains, for a person as a table of the configuration.

    Raises LabError where no gains are robust, ConfigError for a configuration that is refused.
    """
    tunings = search(load_config(options.config))
    if not tunings:
        raise LabError("no gain keeps the margins at every corner of these motor parameters")
    best = max(tunings, key=lambda tuning: tuning.proportional_per_mm / tuning.integral_time_s)
    margins = f"# smallest margins at the corners: {best.gain_margin_dB:.1f} dB, {best.phase_margin_deg:.0f} degrees"
    gains = [f"{name} = {getattr(best, name):g}" for name in best._fields[:4]]
    return Found(best._asdict(), [margins, "[position]", *gains])


def corner_margins(config: Config) -> dict[str, float]:
    """Return the smallest gain margin, dB, and phase margin, degrees, over every corner, and the number of corners.

    Corners are +-30% in each of CORNER_PARAMETERS, with 0.8, 1 and 1.2 times a loop period of 1 ms, whatever rate
    `config` has.
    """
    gain, phase = [], []
    for factors in itertools.product((1.0 - CORNER, 1.0 + CORNER), repeat=len(CORNER_PARAMETERS)):
        named = zip(CORNER_PARAMETERS, factors, strict=True)
        motor = msgspec.structs.replace(
            config.motor, **{name: getattr(config.motor, name) * factor for name, factor in named}
        )
        for period in PERIOD_CORNERS:
            found = margins(motor, config.position, TICK_S * period)
            gain.append(found.gain_margin_dB)
            phase.append(found.phase_margin_deg)
    return {"gain_margin_dB": min(gain), "phase_margin_deg": min(phase), "corners": float(len(gain))}


def search(config: Config) -> list[Tuning]:
    """Return the largest robust proportional gain for every point of the grid that has one, with its margins.

    The gain is rounded down to a tenth. The motor is that of `config`, which stays as it is; the loop runs at 1 kHz.
    """
    grid = list(itertools.product(DERIVATIVE_TIMES_S, FILTER_TIMES_S, INTEGRAL_TIMES_S))
    found = []
    for derivative_s, filter_s, integral_s in tqdm(grid, desc="gains", disable=None):
        position = msgspec.structs.replace(
            config.position,
            derivative_time_s=derivative_s,
            derivative_filter_s=filter_s,
            integral_time_s=integral_s,
        )
        low, high = 0.0, LARGEST_GAIN_PER_MM
        while high - low > 0.02:
            middle = (low + high) / 2.0
            low, high = (middle, high) if robust(config, position, middle) else (low, middle)
        gain = math.floor(low * 10) / 10
        if gain > 0.0 and (kept := robust(config, position, gain)):
            found.append(Tuning(gain, integral_s, derivative_s, filter_s, *kept))
    return found


def robust(config: Config, position: msgspec.Struct, gain: float) -> tuple[float, float] | None:
    """Return the smallest margins over the corners with this gain, dB and degrees; None where they are too small."""
    tried = msgspec.structs.replace(config, position=msgspec.structs.replace(position, proportional_per_mm=gain))
    found = corner_margins(tried)
    gain_dB, phase_deg = found["gain_margin_dB"], found["phase_margin_deg"]
    return (gain_dB, phase_deg) if gain_dB >= MIN_GAIN_MARGIN_DB and phase_deg >= MIN_PHASE_MARGIN_DEG else None
