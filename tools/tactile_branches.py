"""What the neighbours of the k-nearest search decide: on the tactile pad, whose force falls somewhere, and the brake.

    tactile_branches.py [--json]

Contacts are drawn from the model's box, of the pad those at which its force falls with the field somewhere. At each the
field goes smoothly up and down again, and the search is asked for the model's force there, answer by answer. A *jump*
is an answer further than JUMP_MT from the last; *travel* is the answers' way over the field's own. Where the force
rises everywhere there are none, however few neighbours.
"""

import argparse
import json
import sys
import time
from typing import Any, NamedTuple

import numpy as np

from tormagd.inverse.bracketed import BracketedSearch, newton
from tormagd.inverse.nearest import NearestFieldSearch
from tormagd.inverse.solution import FieldSolver
from tormagd.model.model_file import ForceModel, load_model
from tormagd.model.rising import not_rising_share
from tormagd.model.shipped import model_path
from tormagd.output import write_line
from tormagd.scenes.scene import scene_path

NEIGHBOURS = (1, 2, 4, 8, 16, 64)
SHALLOW_MM = 1.0
"Deeper the pad's force rises but for fractions of a millinewton."
CONTACTS, STEPS, SEED = 60, 400, 3
JUMP_MT = 20.0
MODELS = {"pad": ("tactile_mre_c", "tactile", (0.0, 365.0)), "brake": ("torque_mre_50_40", "torque", (330.0, 740.0))}


class Way(NamedTuple):
    """A search, and whether it is told the last field."""

    name: str
    search: FieldSolver
    is_continuous: bool = True


def ways(range_mT: tuple[float, float]) -> list[Way]:
    """k-nearest with each number of neighbours, without the last field, and the search that looks at brackets."""
    made = [
        Way(f"nearest, {count} neighbours", NearestFieldSearch(field_range_mT=range_mT, neighbours=count))
        for count in NEIGHBOURS
    ]
    forgetful = Way("nearest, 16 neighbours, last field unknown", made[NEIGHBOURS.index(16)].search, False)
    bracketed = BracketedSearch(field_range_mT=range_mT, refine=newton, step_mT=20.0, dtype=np.float64)
    return [*made, forgetful, Way("newton in the brackets of a grid of 20 mT", bracketed)]


def contacts(model: ForceModel, range_mT: tuple[float, float], shallow_mm: float | None) -> list[tuple[float, float]]:
    """Displacements, mm, and rates, mm/s; with `shallow_mm` those up to there at which the force falls somewhere."""
    draw, fields = np.random.default_rng(SEED), np.linspace(*range_mT, 366)
    (low_mm, high_mm), rates, _, (cip_percent, _) = model.feature_ranges
    found: list[tuple[float, float]] = []
    while len(found) < CONTACTS:
        displacement_mm, rate_mm_s = draw.uniform(low_mm, shallow_mm or high_mm), draw.uniform(*rates)
        forces_N = model.curve(displacement_mm, rate_mm_s, cip_percent).forces_N(fields)
        if shallow_mm is None or (np.diff(forces_N) <= 0.0).any():
            found.append((displacement_mm, rate_mm_s))
    return found


def followed(way: Way, model: ForceModel, at: list[tuple[float, float]], path_mT: list[float]) -> dict[str, Any]:
    """How a search follows the path at all contacts."""
    cip_percent = model.feature_ranges[3][0]
    jumps, travel_mT, worst_N, answers, spent_us = 0, 0.0, 0.0, [], []
    for contact in at:
        curve, last_mT = model.curve(*contact, cip_percent), path_mT[0]
        for field_mT in path_mT[1:]:
            force_N, begun_ns = curve.force_N(field_mT), time.thread_time_ns()
            answer = way.search.solve(curve, force_N, last_mT if way.is_continuous else None)
            spent_us.append((time.thread_time_ns() - begun_ns) * 1e-3)
            jumps += abs(answer.field_mT - last_mT) > JUMP_MT
            travel_mT += abs(answer.field_mT - last_mT)
            worst_N = max(worst_N, abs(answer.predicted_force_N - force_N))
            last_mT = answer.field_mT
            answers.append(last_mT)
    own_mT = len(at) * float(np.abs(np.diff(path_mT)).sum())
    return {
        "search": way.name,
        "jump_share": jumps / len(answers),
        "travel": travel_mT / own_mT,
        "worst_force_error_N": worst_N,
        "p50_us": float(np.median(spent_us)),
        "answers": answers,
    }


def measured(name: str) -> dict[str, Any]:
    """Every way on one shipped model."""
    model_name, element, range_mT = MODELS[name]
    model = load_model(model_path(model_name, scene_path("pulse").parent), element=element)
    low_mT, high_mT = range_mT
    middle_mT, swing_mT = (low_mT + high_mT) / 2.0, 0.48 * (high_mT - low_mT)
    path_mT = (middle_mT + swing_mT * np.sin(np.linspace(0.0, 2.0 * np.pi, STEPS))).tolist()
    at = contacts(model, range_mT, SHALLOW_MM if element == "tactile" else None)
    rows = [followed(way, model, at, path_mT) for way in ways(range_mT)]
    most = np.array(rows[len(NEIGHBOURS) - 1]["answers"])
    for row in rows:
        row["other_answers"] = float(np.mean(np.abs(np.array(row.pop("answers")) - most) > 1e-6))
    return {"model": model_name, "not_rising_share_of_box": not_rising_share(model), "rows": rows}


def main() -> int:
    """Measures and prints; 0."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args()
    found = {name: measured(name) for name in MODELS}
    if options.json:
        write_line(json.dumps({"synthetic": True, "jump_mT": JUMP_MT, **found}), sys.stdout)
        return 0
    for name, model in found.items():
        write_line(f"{name}: dF/dB <= 0 on {model['not_rising_share_of_box']:.1%} of the model's box", sys.stdout)
        for row in model["rows"]:
            write_line(
                f"  {row['search']:42} jumps {row['jump_share']:7.3%}, travel {row['travel']:5.2f}, "
                f"other answers than 64 neighbours {row['other_answers']:6.2%}, {row['p50_us']:4.0f} us",
                sys.stdout,
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
