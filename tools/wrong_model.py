"""Wrong on purpose: what a wrong model costs a scene, as `required_terms.py --store` predicts it, and as measured.

    wrong_model.py [--json]

The cheapest model, without any term, costs a held force its error: predicted is the sum of what each term alone adds,
measured are HOLD with every term out and with none, for LONG_S. The fullest costs a pulse processor time: every term at
the usual rates, over what was chosen for PULSE. Predicted is the ratio of the stored costs, which are of single calls;
measured is what the core takes for PULSE_S, the two models in turn in ROUNDS, and of the ratios the median. What the
terms that PULSE does not require do to its error stands beside. Learning is frozen, the device is sample 1, and
synthetic. 1 where a prediction is off by more than ALLOWED.
"""

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

from rendering.scene_runs import Case, core_run, run

from tormagd.scenes.measured import MeasuredScene, measured
from tormagd.scenes.scene import TERMS

HOLD = "brain"
"The scene that holds its force the longest."
PULSE = "pulse"
LONG_S, PULSE_S = 60.0, 10.0
ROUNDS = 15
ALLOWED = 0.2

Json = dict[str, Any]


def main() -> int:
    """Prints both penalties; 0, or 1 for a prediction that does not hold."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args()
    scenes = {scene.name: scene for scene in measured().scenes}
    hold, pulse = cheapest(scenes[HOLD]), fullest(scenes[PULSE])
    if options.json:
        print(json.dumps({"cheapest": hold, "fullest": pulse}))
    else:
        print(
            f"{HOLD} without any term misses more: predicted {1e3 * hold['predicted_N']:.1f} mN, measured "
            f"{1e3 * hold['measured_N']:.1f} mN, off by {hold['off']:.0%}\n"
            f"{PULSE} with every term takes more time: predicted {pulse['predicted']:.2f} times the chosen model's, "
            f"measured {pulse['measured']:.2f}, off by {pulse['off']:.0%}\n"
            f"and misses {1e3 * pulse['full_N']:.1f} instead of {1e3 * pulse['chosen_N']:.1f} mN"
        )
    return 0 if max(hold["off"], pulse["off"]) <= ALLOWED else 1


def cheapest(scene: MeasuredScene) -> Json:
    """What no term at all adds to the error, N."""
    full_N, none_N = (run(Case(scene.name, "sample_1", out, "", False, *scene.hz, LONG_S)) for out in ((), TERMS))
    predicted_N, measured_N = sum(item.frozen_added_N for item in scene.terms), none_N - full_N
    off = abs(predicted_N / measured_N - 1.0)
    return {"scene": scene.name, "predicted_N": predicted_N, "measured_N": measured_N, "off": off}


def fullest(scene: MeasuredScene) -> Json:
    """What every term at the usual rates takes more, as a multiple of what the chosen model takes."""
    cases = (
        Case(scene.name, "sample_1", (), "", False, *scene.rates[0].hz, PULSE_S),
        Case(scene.name, "sample_1", scene.left_out, "", False, *scene.hz, PULSE_S),
    )
    full, chosen = (core_run(case) for case in cases)
    predicted = scene.cost_full_us_s / scene.cost_us_s - 1.0
    found = statistics.median(_taken_s(full) / _taken_s(chosen) for _ in range(ROUNDS)) - 1.0
    full_N, chosen_N = (run(case) for case in cases)
    return {
        "scene": scene.name,
        "predicted": predicted,
        "measured": found,
        "off": abs(predicted / found - 1.0),
        "full_N": full_N,
        "chosen_N": chosen_N,
    }


def _taken_s(call: Callable[[], object]) -> float:
    start_ns = time.thread_time_ns()
    call()
    return (time.thread_time_ns() - start_ns) * 1e-9


if __name__ == "__main__":
    sys.exit(main())
