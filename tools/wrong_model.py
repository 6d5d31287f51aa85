"""Wrong on purpose: what a model without any term adds to the error of a held force, as predicted and as measured.

    wrong_model.py [--json]

Predicted is the sum of what each term alone adds (`required_terms.py --store`), frozen. Measured here are HOLD with
every term out and with none, frozen, for LONG_S on sample 1. All devices are synthetic.
"""

import argparse
import json
import sys

from rendering.scene_runs import Case, run

from tormagd.scenes.measured import measured
from tormagd.scenes.scene import TERMS

HOLD = "brain"
"The scene that holds its force the longest."
LONG_S = 60.0


def main() -> int:
    """Prints the penalty; 0."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args()
    scene = next(each for each in measured().scenes if each.name == HOLD)
    hz = scene.control_hz, scene.inference_hz
    full_N, none_N = (run(Case(HOLD, "sample_1", out, "", False, *hz, LONG_S)) for out in ((), TERMS))
    predicted_N, penalty_N = sum(item.frozen_added_N for item in scene.terms), none_N - full_N
    off = abs(predicted_N / penalty_N - 1.0)
    if options.json:
        print(json.dumps({"scene": HOLD, "predicted_N": predicted_N, "measured_N": penalty_N, "off": off}))
    else:
        print(f"{HOLD}: predicted {1e3 * predicted_N:.1f} mN, measured {1e3 * penalty_N:.1f} mN, off by {off:.0%}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
