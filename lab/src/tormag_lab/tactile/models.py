"""Forward models on the synthetic tactile pad: table 4.1, splits by whole groups, monotonicity."""

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from sklearn.ensemble import RandomForestRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.svm import SVR
from tqdm import tqdm

from tormag_lab.arrays import Array, Mask
from tormag_lab.tactile.pads import PADS, PadRecord, cyclic_records, holding_records
from tormag_lab.training.dataset import (
    Dataset,
    force_metrics,
    leave_cycles_out,
    leave_one_out,
    not_rising_share,
    random_split,
)
from tormag_lab.training.fitting import fit_network
from tormag_lab.training.grey_box import GreyBox, fit_grey_box
from tormagd.element.model.features import CIP
from tormagd.element.model.model_file import ForceModel
from tormagd.simulation.parameters import PadParameters
from tormagd.simulation.tactile_pad import FULL_FIELD_MT, FULL_INDENTATION_MM, RATES_MM_S, TOUCHING_MM, worked_pad

SCORED_SLOPE_N_MT = 0.03
"Least slope at which the field's error is scored; below it, the force's error is."
SPLIT_SEED = 1
CYCLE_FOLDS = 4
PAD_IN_USE = "MRE-C"
CURVE_FIELDS = 201
"An inverse by nearest neighbours takes a curve of so many fields."

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


@dataclass(frozen=True)
class Trained:
    """Models trained with sensor noise `noise_N`: the thesis's network on three classes, and a relaxation-aware model
    of the pad in use."""

    noise_N: float
    cycles: PadRecord
    model: ForceModel
    grey: GreyBox


def train(noise_N: float, effort: Effort) -> Trained:
    """Train the network on made cycles of the three pads, and the relaxation-aware model on those of the pad in use."""
    cycles = cyclic_records(noise_N, 0, samples_per_cycle=effort.samples_per_cycle)
    data = cycles.data
    known = ~random_split(len(data), SPLIT_SEED)
    model, _ = fit_network(data, known, epochs=effort.epochs)
    pad = PADS[PAD_IN_USE]
    own = data.features[:, CIP] == pad.cip_percent
    grey = fit_grey_box(
        data.subset(own),
        known[own],
        holding_records(pad, noise_N, int(pad.cip_percent), samples=effort.hold_samples).data,
        epochs=effort.pad_epochs,
        settling_epochs=effort.settling_epochs,
    )
    return Trained(noise_N, cycles, model, grey)


def table_4_1(trained: Trained, effort: Effort) -> dict[str, Any]:
    """Return table 4.1 by class, with the noise floor, whole groups left out, and monotonicity."""
    data = trained.cycles.data
    held = random_split(len(data), SPLIT_SEED)
    predicted = trained.model.predict(data.features)
    rows = []
    for name, pad in (*PADS.items(), ("All", None)):
        of_class = np.ones(len(data), dtype=np.bool_) if pad is None else data.features[:, CIP] == pad.cip_percent
        span_N = float(np.ptp(data.force_N[of_class]))
        row: dict[str, Any] = {"class": name}
        for part, mask in (("train", of_class & ~held), ("test", of_class & held)):
            scores = force_metrics(predicted[mask], data.force_N[mask], span_N)
            deviation = float(np.abs(predicted - data.force_N)[mask].std())
            row[part] = {
                "mae_N": scores["mae_N"],
                "sd_N": deviation,
                "mae_percent": scores["mae_percent"],
                "r2": scores["r2"],
            }
        rows.append(row)
    noise_N = float(np.abs(data.force_N - trained.cycles.true_force_N)[held].mean())
    test = rows[-1]["test"]
    return {
        "synthetic": True,
        "sensor_noise_N": trained.noise_N,
        "random": {"r2": test["r2"], "mae_N": test["mae_N"], "noise_mae_N": noise_N},
        **whole_groups(data.subset(np.arange(0, len(data), effort.thin)), effort.group_epochs, trained.noise_N),
        "monotonicity": {
            "network": monotonicity(trained.model, PADS.values()),
            "relaxation_aware": monotonicity(trained.grey.model, [PADS[PAD_IN_USE]]),
        },
        "rows": rows,
    }


def whole_groups(data: Dataset, epochs: int, noise_N: float) -> dict[str, Any]:
    """Return the errors on fields, classes and cycles that were left out; on cycles also the other learners'."""

    def network(data: Dataset, known: Mask) -> Callable[[Array], Array]:
        return fit_network(data, known, epochs=epochs)[0].predict

    learners: dict[str, Learner] = {
        "network": network,
        "support_vectors": of_scikit_learn(make_pipeline(StandardScaler(), SVR(C=1e3, epsilon=noise_N))),
        "forest": of_scikit_learn(RandomForestRegressor(min_samples_leaf=3, random_state=1)),
    }
    fields = tqdm(list(leave_one_out(data, "field_mT")), desc="fields left out", disable=None, leave=False)
    return {
        "leave_one_field_out": left_out(network, data, fields),
        "leave_one_class_out": left_out(network, data, leave_one_out(data, "cip_percent")),
        "leave_cycles_out": {
            name: left_out(learner, data, leave_cycles_out(data, CYCLE_FOLDS, SPLIT_SEED))
            for name, learner in learners.items()
        },
    }


def of_scikit_learn(regressor: Any) -> Learner:
    return lambda data, known: regressor.fit(data.features[known], data.force_N[known]).predict


def left_out(learn: Learner, data: Dataset, folds: Iterable[tuple[float, Mask]]) -> dict[str, Any]:
    """Learn without the rows of each fold; return the errors on them, and how long a curve of the last takes."""
    predicted = np.empty(len(data))
    judged = np.zeros(len(data), dtype=np.bool_)
    each = []
    for label, held in folds:
        predict = learn(data, ~held)
        predicted[held] = predict(data.features[held])
        judged |= held
        each.append({"left_out": label, "mae_N": float(np.abs(predicted[held] - data.force_N[held]).mean())})
    scores = force_metrics(predicted[judged], data.force_N[judged], float(np.ptp(data.force_N)))
    began_s = time.process_time()
    predict(data.features[:CURVE_FIELDS])
    curve_ms = (time.process_time() - began_s) * 1e3
    return {"r2": scores["r2"], "mae_N": scores["mae_N"], "folds": each, "curve_ms": curve_ms}


def monotonicity(model: ForceModel, pads: Iterable[PadParameters]) -> dict[str, float]:
    """Return the shares of the box, and of its scored places, where the model's dF/dB <= 0."""
    places = np.meshgrid(
        np.linspace(TOUCHING_MM, FULL_INDENTATION_MM, 18),
        np.sort([*RATES_MM_S, *(-rate for rate in RATES_MM_S)]),
        np.linspace(0.0, FULL_FIELD_MT, 25),
        indexing="ij",
    )
    grid = np.column_stack([axis.ravel() for axis in places])
    falling = counted = 0
    for pad in pads:
        scored = slope_N_per_mT(pad, grid) >= SCORED_SLOPE_N_MT
        rows = np.column_stack((grid, np.full(len(grid), pad.cip_percent)))[scored]
        falling += int((model.field_slope_N_per_mT(rows) <= 0).sum())
        counted += len(rows)
    return {"not_rising_share_of_box": not_rising_share(model), "not_rising_share_where_scored": falling / counted}


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
