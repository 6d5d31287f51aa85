"""Whether a model's force rises with the field, as the device's does: only then is the field for a force unique."""

import numpy as np

from tormagd.model.features import FIELD
from tormagd.model.model_file import ForceModel


def falling_at(
    model: ForceModel, fields_mT: tuple[float, float], displacement_mm: float, points: int = 33
) -> float | None:
    """Return the least rate of the handle at which the force does not rise everywhere with the field."""
    _, (slowest, fastest), _, (cip_percent, _) = model.feature_ranges
    fields = np.linspace(*fields_mT, points)
    for rate_mm_s in np.linspace(slowest, fastest, points).tolist():
        rows = np.column_stack([np.full(points, value) for value in (displacement_mm, rate_mm_s, 0.0, cip_percent)])
        rows[:, FIELD] = fields
        if not (model.field_slope_N_per_mT(rows) > 0.0).all():
            return float(rate_mm_s)
    return None
