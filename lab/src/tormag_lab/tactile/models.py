"""Forward models on the synthetic tactile pad: table 4.1, and splits by whole groups."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from sklearn.ensemble import RandomForestRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.svm import SVR
from tqdm import tqdm

from tormag_lab.arrays import Array, Json, Mask
from tormag_lab.tactile.pads import PADS, PadRecord, cyclic_records, holding_records
from tormag_lab.training.dataset import (
    Dataset,
    force_metrics,
    leave_cycles_out,
    leave_one_out,
    random_split,
)
from tormag_lab.training.fitting import fit_network
from tormag_lab.training.grey_box import GreyBox, fit_grey_box
from tormagd.element.model.features import CIP
from tormagd.element.model.model_file import ForceModel
from tormagd.simulation.parameters import PadParameters
from tormagd.simulation.tactile_pad import worked_pad

SCORED_SLOPE_N_MT = 0.03
"Least slope at which the field's error is scored; below it, the force's error is."
SPLIT_SEED = 1
NOISE_N = 0.5
"Of the assumed force sensor."
CYCLE_FOLDS = 4
PAD_IN_USE = "MRE-C"

Learner = Callable[[Dataset, Mask], Callable[[Array], Array]]
"Learns from the rows of a mask, and returns what predicts forces."


@dataclass(frozen=True)
class Effort:
    """Size of an experiment; grouped splits use every `thin`-th row."""

    samples_per_cycle: int
    hold_samples: int
    epochs: int
    pad_epochs: int
    settling_epochs: int
    thin: int
    group_epochs: int
    hold_s: float
    pulse_every: int


FULL = Effort(175, 1500, 100, 100, 30, 3, 40, 3600.0, 1)
QUICK = Effort(24, 280, 15, 12, 4, 4, 5, 60.0, 24)


class Trained(NamedTuple):
    """Models trained with the sensor's noise: the thesis's network on three classes, and a relaxation-aware model of
    the pad in use."""

    cycles: PadRecord
    model: ForceModel
    grey: GreyBox


def train(effort: Effort) -> Trained:
    """Train the network on made cycles of the three pads, and the relaxation-aware model on those of the pad in use."""
    cycles = cyclic_records(NOISE_N, 0, samples_per_cycle=effort.samples_per_cycle)
    data = cycles.data
    known = ~random_split(len(data), SPLIT_SEED)
    model, _ = fit_network(data, known, epochs=effort.epochs)
    pad = PADS[PAD_IN_USE]
    own = data.features[:, CIP] == pad.cip_percent
    grey = fit_grey_box(
        data.subset(own),
        known[own],
        holding_records(pad, NOISE_N, int(pad.cip_percent), samples=effort.hold_samples).data,
        epochs=effort.pad_epochs,
        settling_epochs=effort.settling_epochs,
    )
    return Trained(cycles, model, grey)


def table_4_1(trained: Trained, effort: Effort) -> Json:
    """Return table 4.1 by class, on held-out rows, with the noise floor, and the errors on whole groups left out."""
    data = trained.cycles.data
    held = random_split(len(data), SPLIT_SEED)
    error_N = trained.model.predict(data.features) - data.force_N
    rows = []
    for name, pad in (*PADS.items(), ("All", None)):
        judged = held if pad is None else held & (data.features[:, CIP] == pad.cip_percent)
        size_N = np.abs(error_N[judged])
        r2 = 1.0 - float(np.mean(size_N**2) / np.var(data.force_N[judged]))
        rows.append({"class": name, "mae_N": float(size_N.mean()), "sd_N": float(size_N.std()), "r2": r2})
    noise_N = float(np.abs(data.force_N - trained.cycles.true_force_N)[held].mean())
    return {
        "synthetic": True,
        "sensor_noise_N": NOISE_N,
        "random": {"r2": rows[-1]["r2"], "mae_N": rows[-1]["mae_N"], "noise_mae_N": noise_N},
        **whole_groups(data.subset(np.arange(0, len(data), effort.thin)), effort.group_epochs),
        "rows": rows,
    }


def whole_groups(data: Dataset, epochs: int) -> Json:
    """Return the errors on fields and cycles that were left out; on cycles also the other learners'."""

    def network(data: Dataset, known: Mask) -> Callable[[Array], Array]:
        return fit_network(data, known, epochs=epochs)[0].predict

    learners: dict[str, Learner] = {
        "network": network,
        "support_vectors": of_scikit_learn(make_pipeline(StandardScaler(), SVR(C=1e3, epsilon=NOISE_N))),
        "forest": of_scikit_learn(RandomForestRegressor(min_samples_leaf=3, random_state=1)),
    }
    fields = tqdm(leave_one_out(data, "field_mT"), desc="fields left out", disable=None, leave=False)
    return {
        "leave_one_field_out": left_out(network, data, fields),
        "leave_cycles_out": {
            name: left_out(learner, data, leave_cycles_out(data, CYCLE_FOLDS, SPLIT_SEED))
            for name, learner in learners.items()
        },
    }


def of_scikit_learn(regressor: Any) -> Learner:
    return lambda data, known: regressor.fit(data.features[known], data.force_N[known]).predict


def left_out(learn: Learner, data: Dataset, folds: Iterable[Mask]) -> Json:
    """Learn without the rows of each fold, and return the errors on them."""
    predicted_N = np.empty(len(data))
    for held in folds:
        predicted_N[held] = learn(data, ~held)(data.features[held])
    scores = force_metrics(predicted_N, data.force_N, float(np.ptp(data.force_N)))
    return {"r2": scores["r2"], "mae_N": scores["mae_N"]}


def slope_N_per_mT(parameters: PadParameters, places: Array) -> Array:
    """Return dF/dB, N/mT (n), of a pad at places (n x 3) without relaxation, as a secant over +-0.5 mT."""
    pad = worked_pad(parameters)
    displacement, rate, field = places.T
    low, high = np.maximum(field - 0.5, 0.0), field + 0.5
    at_low, at_high = (plant_force_N(pad, np.column_stack((displacement, rate, end))) for end in (low, high))
    slope: Array = (at_high - at_low) / (high - low)
    return slope


def plant_force_N(pad: Any, places: Array) -> Array:
    return np.array([sum(pad.elastic_parts_N(*place)) for place in places.tolist()])
