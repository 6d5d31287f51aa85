"""Whether a model's force rises with the field, as the device's does: only then is the field for a force unique."""

import numpy as np

from tormagd.model.features import FEATURES, FIELD
from tormagd.model.model_file import ForceModel


def not_rising_share(model: ForceModel, points: int = 17) -> float:
    """Return the share of a grid over the training box (`points` per feature that varies) where dF/dB <= 0.

    There the field for a force is not unique, or the force does not depend on the field.
    """
    axes = [np.linspace(low, high, points if high > low else 1) for low, high in model.feature_ranges]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(FEATURES))
    return float((model.field_slope_N_per_mT(grid) <= 0).mean())


def falling_at(
    model: ForceModel, fields_mT: tuple[float, float], displacement_mm: float, points: int = 33
) -> float | None:
    """The first rate, mm/s, of a grid over the rates seen in training at which the force at this displacement does not
    rise with the field, somewhere between two fields; None where it rises everywhere."""
    _, (slowest, fastest), _, (cip_percent, _) = model.feature_ranges
    fields = np.linspace(*fields_mT, points)
    for rate_mm_s in np.linspace(slowest, fastest, points).tolist():
        rows = np.column_stack([np.full(points, value) for value in (displacement_mm, rate_mm_s, 0.0, cip_percent)])
        rows[:, FIELD] = fields
        if not (model.field_slope_N_per_mT(rows) > 0.0).all():
            return float(rate_mm_s)
    return None
