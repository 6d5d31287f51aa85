"""How well a force can be followed at all: the error that is left to the ideal carriages of a device.

    bound.py FORCE.csv [--plant sample_1] [--held] [--json]

The CSV has the columns `t_s,force_N`. *Without delay* the carriages know the force asked now and how fast it changes;
*with foresight* all of it (`tormagd/lab/ideal_carriage.py`).
"""

import argparse
import json
import sys
from pathlib import Path

import numpy as np

from tormagd.force_file import ForceFileError, read_forces
from tormagd.lab.ideal_carriage import MOST_N, STEP_S, TURNED_MM_S, bound
from tormagd.lab.told import lines
from tormagd.physics.errors import DomainError
from tormagd.simulation.parameters import PlantError, load_plant


def main() -> int:
    """Prints the bound; 0, 1 where no optimum was found, or 2 for what cannot be used."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("force", type=Path, metavar="FORCE.csv", help="columns t_s,force_N")
    parser.add_argument("--plant", default="sample_1", help="plant file or the name of a committed sample (sample_1)")
    parser.add_argument("--held", action="store_true", help="each force holds until the next (linear in between)")
    parser.add_argument("--most-N", type=float, default=MOST_N, help=f"greatest force of the scene ({MOST_N:g})")
    parser.add_argument("--hand-mm-s", type=float, default=TURNED_MM_S, help=f"speed of the handle ({TURNED_MM_S:g})")
    parser.add_argument("--step-ms", type=float, default=STEP_S * 1e3, help=f"at most {STEP_S * 1e3:g}")
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args()
    try:
        table = read_forces(options.force)
        found = bound(
            load_plant(options.plant),
            np.array(table["t_s"]),
            np.array(table["force_N"]),
            is_held=options.held,
            most_N=options.most_N,
            hand_mm_s=options.hand_mm_s,
            step_s=options.step_ms * 1e-3,
        )
    except (DomainError, ForceFileError, PlantError, RuntimeError) as error:
        print(f"bound: {error}", file=sys.stderr)
        return 1 if isinstance(error, RuntimeError) else 2
    result = found.figures()
    print(json.dumps(result) if options.json else "\n".join(lines(result)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
