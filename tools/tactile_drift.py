"""Why the network alone misses the pulse's field by more on our pad than on the thesis's: how much the pad relaxes.

    tactile_drift.py [--quick] [--json]

The pulse experiment of section 4.3 with the network alone, on pads that relax by a share of what ours does: each has a
network of its own, of the thesis's size, trained on that pad's cycles. Beside each stand the error of the indentation
and of the hold apart, and what the force relaxes in the hold. Synthetic.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
import torch
from tactile.models import PAD_IN_USE, dataset
from tactile.pulse import HELD_S, RATE_HZ, course, nearest, pulse_shape, solve_all
from thesis.values import PULSE_MAE_MT

from tormagd.output import write_line
from tormagd.simulation.pad import PADS, cyclic_records, holding_records
from tormagd.simulation.parameters import PadParameters, Relaxation
from tormagd.simulation.tactile_pad import FULL_INDENTATION_MM
from tormagd.training.forward import NetworkForward

SHARES = (0.0, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
NOISE_N = 0.05
THIN, EPOCHS = 3, 60
SETTLED_S = 1.0
"After the indentation ends the rate's own part of the force dies away."


def relaxing_by(pad: PadParameters, share: float) -> PadParameters:
    """The pad with that share of its relaxation."""

    def of(series: Relaxation) -> Relaxation:
        return Relaxation(tuple(share * fraction for fraction in series.fractions), series.times_s)

    return msgspec.structs.replace(pad, relaxing=of(pad.relaxing), field_relaxing=of(pad.field_relaxing))


def drift(share: float, every: int, epochs: int) -> dict[str, Any]:
    """The network alone on the pad that relaxes by `share` of ours; fields in mT."""
    pad = relaxing_by(PADS[PAD_IN_USE], share)
    cycles = dataset(cyclic_records(NOISE_N, 0, pads=[pad]), THIN)
    model = NetworkForward(epochs=epochs).fit(cycles, np.ones(len(cycles), dtype=np.bool_))
    along = course(pad, pulse_shape(HELD_S, RATE_HZ)[0], every)
    fields_mT = solve_all(nearest(), model, along.features, along.force_N, None)[0]
    absolute = np.abs(fields_mT - along.features[:, 2])
    is_held = along.time_s > FULL_INDENTATION_MM + SETTLED_S
    held = holding_records(pad, 0.0, 0, fields_mT=(150.0,), duration_s=HELD_S, samples=200).true_force_N
    return {
        "relaxing_share": share,
        "force_lost_in_hold": float(1.0 - held[-1] / held.max()),
        "mae_mT": float(absolute[along.scored].mean()),
        "max_mT": float(absolute[along.scored].max()),
        "indentation_mae_mT": float(absolute[along.scored & ~is_held].mean()),
        "held_mae_mT": float(absolute[along.scored & is_held].mean()),
        "slope_N_mT": float(along.slope_N_mT[is_held].mean()),
        "held_N": float(along.force_N[is_held].mean()),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Measures and prints; 0."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="two pads, few rows and epochs: shows that it runs")
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    shares, every, epochs = ((0.0, 1.0), 24, 5) if options.quick else (SHARES, 2, EPOCHS)
    rows = [drift(share, every, epochs) for share in shares]
    if options.json:
        write_line(json.dumps({"synthetic": True, "thesis_mae_mT": PULSE_MAE_MT, "rows": rows}), sys.stdout)
        return 0
    for row in rows:
        write_line(
            f"{row['relaxing_share']:5.0%} of the relaxation, {row['force_lost_in_hold']:6.2%} of the force lost: "
            f"{row['mae_mT']:6.2f} mT, indentation {row['indentation_mae_mT']:6.2f}, hold {row['held_mae_mT']:6.2f} mT "
            f"({row['held_N']:.0f} N, {row['slope_N_mT']:.3f} N/mT)",
            sys.stdout,
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
