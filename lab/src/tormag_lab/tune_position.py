"""From H(z) to the gains of the position loop: the stiffest that stay robust.

Margins hold with +-30% in the motor's parameters and +-20% in the loop period of 1 ms. `tormagd.commission.gains` has
the search.
"""

import argparse
import itertools
from pathlib import Path

from tqdm import tqdm

from tormag_lab.errors import LabError
from tormag_lab.main import Found
from tormagd.commission.gains import stiffest, tunings
from tormagd.config import load_config

DERIVATIVE_TIMES_S = (0.01, 0.015, 0.02, 0.025, 0.03, 0.04)
FILTER_TIMES_S = (0.002, 0.003, 0.004)
INTEGRAL_TIMES_S = (0.1, 0.15, 0.2, 0.4)
"A shorter integral time than 0.1 s fights stiction, and the carriages begin to hunt by a count."


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--config", type=Path, help="whose [motor] is tuned for; the defaults otherwise")


def run(options: argparse.Namespace) -> Found:
    grid = list(itertools.product(DERIVATIVE_TIMES_S, FILTER_TIMES_S, INTEGRAL_TIMES_S))
    best = stiffest(tunings(load_config(options.config), tqdm(grid, desc="gains", disable=None)))
    if best is None:
        raise LabError("no gain keeps the margins at every corner of these motor parameters")
    margins = f"# smallest margins at the corners: {best.gain_margin_dB:.1f} dB, {best.phase_margin_deg:.0f} degrees"
    gains = [f"{name} = {getattr(best, name):g}" for name in best._fields[:4]]
    return Found(best._asdict(), [margins, "[position]", *gains])
