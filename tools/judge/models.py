"""How near each insert's shipped model is to devices: the brake's force over gaps and handle speeds, mobilised.

Samples 2 and 3 and draws 100 to 119 judge; there is no loop.
"""

import argparse
from pathlib import Path

import numpy as np
from devices import SAMPLES, device

from tormag_lab.arrays import Array, Json
from tormag_lab.pages import table
from tormag_lab.training.dataset import force_metrics, not_rising_share
from tormagd.control.nominal import FieldOfGap
from tormagd.element.model.displacement import MOBILISED_MM
from tormagd.element.model.model_file import ForceModel, load_model, model_path
from tormagd.element.physics.field import PowerFieldLaw
from tormagd.element.physics.force import TORMAG, brake_force_N
from tormagd.element.physics.inserts import Insert, insert
from tormagd.simulation.parameters import PlantParameters, with_insert
from tormagd.simulation.static_laws import radial_moment_Tm

JUDGING = ("sample_2", "sample_3", *(f"draw {number}" for number in range(100, 120)))
"Never trained on, and of the draws none that was looked at."
FILES = sorted(model_path("torque_mre_50_40", Path()).parent.glob("torque_*.safetensors"))
GAPS_MM, RATES_MM_S = np.linspace(45.0, 95.0, 101), np.geomspace(1.0, 300.0, 61)


def measure(_options: argparse.Namespace) -> Json:
    rows = [row for path in FILES for row in of_file(path)]
    return {"rows": rows, "passed": all(row["not_rising_share"] == 0.0 for row in rows)}


def of_file(path: Path) -> list[Json]:
    model = load_model(path, element="torque")
    return [_row(path, model.of(name)) for name in model.metadata.boxes or (model.metadata.insert,)]


def _row(path: Path, model: ForceModel) -> Json:
    fitted = insert(model.metadata.insert)
    own, *others = (errors(model, fitted, device(name)) for name in (SAMPLES[0], *JUDGING))
    return {
        "insert": fitted.name,
        "model": path.stem,
        "hidden": model.metadata.hidden,
        "full_N": own["full_N"],
        "sample_1": own,
        "mean_N": float(np.mean([found["mean_N"] for found in others])),
        "worst_N": max(found["worst_N"] for found in others),
        "bias_N": float(np.mean([found["bias_N"] for found in others])),
        "not_rising_share": not_rising_share(model),
        "devices": dict(zip(JUDGING, others, strict=True)),
    }


def shown(figures: Json) -> list[str]:
    columns = ("insert", "full force, N", "model", "sample 1: mean", "judging: mean")
    rows = [
        [
            row["insert"],
            f"{row['full_N']:.2f}",
            f"`{row['model']}`",
            f"{1e3 * row['sample_1']['mean_N']:.0f}",
            f"{1e3 * row['mean_N']:.0f} ({100.0 * row['mean_N'] / row['full_N']:.1f}%)",
        ]
        for row in figures["rows"]
    ]
    return table(columns, rows).splitlines()


def errors(model: ForceModel, fitted: Insert, plant: PlantParameters, rates_mm_s: Array = RATES_MM_S) -> Json:
    """Return the model less the fresh, cool device at the same gaps and speeds; `full_N` is its most."""
    true_N = brake_N(with_insert(plant, fitted.name), rates_mm_s, GAPS_MM)
    field = FieldOfGap(PowerFieldLaw(), fitted.elastomer.relative_permeability, TORMAG.inner_radius_m)
    rates, fields = np.meshgrid(rates_mm_s, [field.field_mT(gap) for gap in GAPS_MM.tolist()], indexing="ij")
    ones = np.ones(rates.size)
    rows = np.column_stack((MOBILISED_MM * ones, rates.ravel(), fields.ravel(), 100.0 * fitted.cip_fraction * ones))
    error_N = model.predict(rows) - true_N.ravel()
    found = force_metrics(error_N, np.zeros_like(error_N), float(true_N.max()))
    return {
        "mean_N": found["mae_N"],
        "worst_N": found["max_N"],
        "bias_N": float(error_N.mean()),
        "full_N": float(true_N.max()),
    }


def brake_N(plant: PlantParameters, rates_mm_s: Array, gaps_mm: Array) -> Array:
    friction, rates = plant.friction, rates_mm_s[:, np.newaxis]
    stribeck = (friction.static_to_kinetic - 1.0) * np.exp(-np.square(rates / friction.stribeck_speed_mm_s))
    kinetic_N = brake_force_N(radial_moment_Tm(gaps_mm, plant), plant.elastomer.law, TORMAG)
    return kinetic_N * (1.0 + stribeck) + friction.viscous_N_s_mm * rates
