"""What the number of neighbours in the k-nearest search decides, on the tactile pad and on the brake.

Contacts are drawn from the model's box, and on the pad only where its force falls with the field somewhere. At each,
the field goes smoothly up and down, and the search is asked for the model's force, answer by answer. A *jump* is an
answer further than JUMP_MT from the last; *travel* is the answers' way over the field's own.
"""

from typing import Any

import numpy as np

from tormag_lab.errors import LabError
from tormag_lab.training.dataset import not_rising_share
from tormagd.element.inverse.nearest import NearestFieldSearch, field_grid
from tormagd.element.model.model_file import ForceModel, load_model, model_path
from tormagd.scenes.scene import scene_path

NEIGHBOURS = (1, 2, 4, 8, 16, 64)
SHALLOW_MM = 1.0
"Deeper than this, the pad's force rises with the field but for fractions of a millinewton."
CONTACTS, STEPS, SEED = 60, 400, 3
MAX_DRAWS = 6_000
"Contacts drawn before a model's force counts as rising everywhere."
JUMP_MT = 20.0
MODELS = {"pad": ("tactile_mre_c", "tactile", (0.0, 365.0)), "brake": ("torque_mre_50_40", "torque", (330.0, 740.0))}


def contacts(model: ForceModel, range_mT: tuple[float, float], shallow_mm: float | None) -> list[tuple[float, float]]:
    """Draw CONTACTS contacts, displacement, mm, and rate, mm/s, from the model's box, always the same."""
    draw, fields = np.random.default_rng(SEED), np.linspace(*range_mT, 366)
    (low_mm, high_mm), rates, _, (cip_percent, _) = model.feature_ranges
    found: list[tuple[float, float]] = []
    for _ in range(MAX_DRAWS):
        displacement_mm, rate_mm_s = draw.uniform(low_mm, shallow_mm or high_mm), draw.uniform(*rates)
        forces_N = model.curve(displacement_mm, rate_mm_s, cip_percent).forces_N(fields)
        if shallow_mm is None or (np.diff(forces_N) <= 0.0).any():
            found.append((displacement_mm, rate_mm_s))
        if len(found) == CONTACTS:
            return found
    raise LabError(f"the force falls with the field at {len(found)} of {MAX_DRAWS} contacts: needed are {CONTACTS}")


def followed(
    search: NearestFieldSearch, model: ForceModel, at: list[tuple[float, float]], path_mT: list[float]
) -> dict[str, Any]:
    """Let `search` follow the fields `path_mT` at every contact, and return its jumps, travel and errors."""
    cip_percent = model.feature_ranges[3][0]
    travels_mT, worst_N, answers = [], 0.0, []
    for contact in at:
        curve, last_mT = model.curve(*contact, cip_percent), path_mT[0]
        for field_mT in path_mT[1:]:
            force_N = curve.force_N(field_mT)
            answer = search.solve(curve, force_N, last_mT)
            worst_N = max(worst_N, abs(answer.predicted_force_N - force_N))
            travels_mT.append(abs(answer.field_mT - last_mT))
            last_mT = answer.field_mT
            answers.append(last_mT)
    own_mT = len(at) * float(np.abs(np.diff(path_mT)).sum())
    return {
        "jump_share": float(np.mean(np.array(travels_mT) > JUMP_MT)),
        "travel": sum(travels_mT) / own_mT,
        "worst_force_error_N": worst_N,
        "answers": answers,
    }


def measured() -> dict[str, Any]:
    return {"synthetic": True, "jump_mT": JUMP_MT} | {name: measured_on(*MODELS[name]) for name in MODELS}


def measured_on(model_name: str, element: str, range_mT: tuple[float, float]) -> dict[str, Any]:
    """Return what every number of NEIGHBOURS decides on one shipped model."""
    model = load_model(model_path(model_name, scene_path("pulse").parent), element=element)
    low_mT, high_mT = range_mT
    middle_mT, swing_mT = (low_mT + high_mT) / 2.0, 0.48 * (high_mT - low_mT)
    path_mT = (middle_mT + swing_mT * np.sin(np.linspace(0.0, 2.0 * np.pi, STEPS))).tolist()
    at = contacts(model, range_mT, SHALLOW_MM if element == "tactile" else None)
    rows = [
        {"neighbours": count} | followed(NearestFieldSearch(field_grid(range_mT, 2.0), count), model, at, path_mT)
        for count in NEIGHBOURS
    ]
    most = np.array(rows[-1]["answers"])
    for row in rows:
        row["other_answers"] = float(np.mean(np.abs(np.array(row.pop("answers")) - most) > 1e-6))
    return {"model": model_name, "not_rising_share_of_box": not_rising_share(model), "rows": rows}
