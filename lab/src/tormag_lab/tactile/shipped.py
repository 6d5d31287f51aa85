"""Train the shipped tactile model: a pad is cycled and held on the bench, its relaxation-aware model becomes a file.

The bench gives the plant's pad eleven fields, twelve cycles each at four rates, and an hour's hold at each of five
fields. Synthetic, with the noise of the plant's force sensor.
"""

import argparse
import dataclasses
import datetime
from pathlib import Path

import msgspec
import numpy as np
import torch

from tormag_lab.main import Found
from tormag_lab.tactile.models import FULL, Effort
from tormag_lab.tactile.pads import cyclic_records, holding_records
from tormag_lab.training.dataset import force_metrics, not_rising_share, random_split
from tormag_lab.training.grey_box import fit_grey_box
from tormagd.element.model.memory import Memory
from tormagd.element.model.model_file import ForceModel, save_model
from tormagd.simulation.parameters import PlantError, load_plant

INSERT = "MRE-C"
SEED = 1
UNSEEN_FIELDS_MT = (130.0, 230.0)


def trained(plant_name: str, effort: Effort, created: datetime.date) -> ForceModel:
    """Train the model of a plant's pad, judged on unseen rows of the cycles and on two unseen holds."""
    plant = load_plant(plant_name)
    if plant.pad is None:
        raise PlantError(f"plant {plant_name}: allowed is one with a [pad]")
    noise_N = 1e-3 * plant.force_sensor.noise_mN
    cycles = cyclic_records(noise_N, SEED, samples_per_cycle=effort.samples_per_cycle, pads=[plant.pad]).data
    holds = holding_records(plant.pad, noise_N, SEED, samples=effort.hold_samples).data
    held_out = random_split(len(cycles), SEED)
    epochs, settling_epochs = effort.pad_epochs, effort.settling_epochs
    grey = fit_grey_box(cycles, ~held_out, holds, epochs=epochs, settling_epochs=settling_epochs)
    unseen = holding_records(plant.pad, 0.0, SEED, fields_mT=UNSEEN_FIELDS_MT, samples=effort.hold_samples).data
    is_pressed = unseen.features[:, 0] > 1.0
    predicted_N = grey.predict(cycles)[held_out]
    scores = force_metrics(predicted_N, cycles.force_N[held_out], grey.model.force_span_N)
    metrics = {f"validation_{name}": value for name, value in scores.items()} | {
        "noise_N": noise_N,
        "unseen_holds_share": float(np.abs(grey.predict(unseen)[is_pressed] / unseen.force_N[is_pressed] - 1.0).max()),
        "not_rising_share": not_rising_share(grey.model),
    }
    metadata = msgspec.structs.replace(
        grey.model.metadata,
        insert=INSERT,
        metrics=metrics,
        created=created,
        training_data_sha256=cycles.sha256(),
        memory=Memory(
            fractions=grey.series.fractions, times_s=grey.series.times_s, field_fractions=grey.field_series.fractions
        ),
    )
    return dataclasses.replace(grey.model, metadata=metadata)


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.safetensors")
    parser.add_argument("--plant", default="pad_1", help="whose pad is on the bench (default: pad_1)")
    parser.add_argument("--created", type=datetime.date.fromisoformat, help="date in the file (default: today)")


def run(options: argparse.Namespace) -> Found:
    torch.set_num_threads(1)
    model = trained(options.plant, FULL, options.created or datetime.date.today())
    save_model(options.out, model)
    return Found({"out": str(options.out), **model.metadata.metrics})
