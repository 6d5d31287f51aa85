"""Forward models on the synthetic tactile pad: table 4.1, splits by whole groups, monotonicity, a comparison."""

import pickle
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from tqdm import tqdm

from tormagd.model.features import FEATURES, FIELD
from tormagd.model.model_file import ForceModel
from tormagd.model.rising import not_rising_share
from tormagd.simulation.pad import (
    PADS,
    RATES_MM_S,
    TOUCHING_MM,
    PadRecord,
    cyclic_records,
    holding_records,
    worked_pad,
)
from tormagd.simulation.parameters import PadParameters
from tormagd.simulation.tactile_pad import FULL_FIELD_MT, FULL_INDENTATION_MM
from tormagd.training.baselines import ForestForward, SupportVectorForward
from tormagd.training.dataset import Array, Dataset
from tormagd.training.forward import ForwardModel, NetworkForward
from tormagd.training.grey_box import GreyBox, GreyBoxForward
from tormagd.training.metrics import force_metrics
from tormagd.training.recurrent import RecurrentForward
from tormagd.training.splits import Mask, leave_cycles_out, leave_one_out, random_split

CIP = FEATURES.index("cip_percent")
SCORED_SLOPE_N_MT = 0.03
"""Where the force depends less on the field than this, a field says nothing: the force error counts there."""
SPLIT_SEED = 1
CYCLE_FOLDS = 4
UNSEEN_FIELDS_MT = (130.0, 230.0)
PAD_IN_USE = "MRE-C"
"""The class of the pulse experiment."""


@dataclass(frozen=True)
class Effort:
    """How much of everything. `thin`: every how many rows, of holds too, grouped splits and the comparison use."""

    samples_per_cycle: int
    hold_samples: int
    epochs: int
    pad_epochs: int
    settling_epochs: int
    thin: int
    group_epochs: int
    recurrent_epochs: int
    support_rows: int
    sizes: tuple[int, ...]
    hold_s: float
    pulse_every: int
    solves: int


FULL = Effort(175, 1500, 100, 100, 30, 3, 40, 30, 2500, (10, 25, 100), 3600.0, 1, 100_000)
QUICK = Effort(24, 280, 15, 12, 4, 4, 5, 1, 300, (10,), 60.0, 24, 200)


@dataclass(frozen=True)
class Trained:
    """What was trained on cycles with sensor noise `noise_N`: the thesis's network, and a model of the pad in use.

    `network` learned from the three classes. `grey`, the relaxation-aware model, learned from the cycles of one class
    and from relaxation tests of it, as a laboratory would do with the pad that it is about to use.
    """

    noise_N: float
    cycles: PadRecord
    network: NetworkForward
    model: ForceModel
    grey: GreyBox


def dataset(record: PadRecord, thin: int = 1) -> Dataset:
    """A record as a laboratory would have it: without the true force."""
    return Dataset(record.features[::thin], record.force_N[::thin], record.cycle[::thin], record.time_s[::thin])


def holds(pads: Iterable[PadParameters], noise_N: float, samples: int) -> Dataset:
    """Relaxation tests of the pads at five fields."""
    records = [holding_records(pad, noise_N, int(pad.cip_percent), samples=samples) for pad in pads]
    return dataset(PadRecord.join(records))


def train(noise_N: float, effort: Effort, seed: int = 0) -> Trained:
    """Train both models on the training part of the random split."""
    cycles = cyclic_records(noise_N, seed, samples_per_cycle=effort.samples_per_cycle)
    data = dataset(cycles)
    training = ~random_split(len(data), SPLIT_SEED)
    network = NetworkForward(epochs=effort.epochs)
    model = network.fit(data, training)
    pad = PADS[PAD_IN_USE]
    own = data.features[:, CIP] == pad.cip_percent
    grey = GreyBoxForward(
        holds([pad], noise_N, effort.hold_samples), epochs=effort.pad_epochs, settling_epochs=effort.settling_epochs
    )
    return Trained(noise_N, cycles, network, model, grey.fit(data.subset(own), training[own]))


def table_4_1(trained: Trained, effort: Effort) -> dict[str, Any]:
    """Table 4.1 per class on the random split, the noise floor, and what whole groups left out do to it."""
    data = dataset(trained.cycles)
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
            row[part] = {"mae_N": scores["mae_N"], "sd_N": deviation, "mae_percent": scores["mae_percent"]}
            row[part]["r2"] = scores["r2"]
        rows.append(row)
    noise_N = float(np.abs(trained.cycles.force_N - trained.cycles.true_force_N)[held].mean())
    thinned = dataset(trained.cycles, effort.thin)

    def network() -> NetworkForward:
        return NetworkForward(epochs=effort.group_epochs)

    fields = tqdm(list(leave_one_out(thinned, "field_mT")), desc="fields left out", disable=None, leave=False)
    test = rows[-1]["test"]
    return {
        "synthetic": True,
        "sensor_noise_N": trained.noise_N,
        "random": {"r2": test["r2"], "mae_N": test["mae_N"], "noise_mae_N": noise_N},
        "leave_one_field_out": left_out(network, thinned, fields),
        "leave_one_class_out": left_out(network, thinned, leave_one_out(thinned, "cip_percent")),
        "leave_cycles_out": left_out(network, thinned, leave_cycles_out(thinned, CYCLE_FOLDS, SPLIT_SEED)),
        "monotonicity": {
            "network": monotonicity(trained.model, PADS.values()),
            "relaxation_aware": monotonicity(trained.grey.model, [PADS[PAD_IN_USE]]),
        },
        "rows": rows,
    }


def left_out(make: Callable[[], ForwardModel], data: Dataset, folds: Iterable[tuple[float, Mask]]) -> dict[str, Any]:
    """Fit without each fold and judge on it: errors over all folds together, and each fold's own."""
    predicted = np.empty(len(data))
    judged = np.zeros(len(data), dtype=np.bool_)
    each = []
    for label, held in folds:
        model = make()
        model.fit(data, ~held)
        predicted[held] = model.predict(data)[held]
        judged |= held
        each.append({"left_out": label, "mae_N": float(np.abs(predicted[held] - data.force_N[held]).mean())})
    scores = force_metrics(predicted[judged], data.force_N[judged], float(np.ptp(data.force_N)))
    return {"r2": scores["r2"], "mae_N": scores["mae_N"], "folds": each}


def monotonicity(model: ForceModel, pads: Iterable[PadParameters]) -> dict[str, float]:
    """Where dF/dB <= 0: share of the model's training box, and of the places where the pads' own slope counts.

    The box spans from class to class, where there are no data; the second share is over a grid of displacement, rate
    and field at the classes themselves, as far as the pad rises by `SCORED_SLOPE_N_MT` or more.
    """
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
    """dF/dB (n) of a worked pad at (displacement, rate, field) (n x 3), without what it remembers."""
    pad = worked_pad(parameters)
    displacement, rate, field = places.T
    low, high = np.maximum(field - 0.5, 0.0), field + 0.5
    at_low, at_high = (plant_force_N(pad, np.column_stack((displacement, rate, end))) for end in (low, high))
    slope: Array = (at_high - at_low) / (high - low)
    return slope


def plant_force_N(pad: Any, places: Array) -> Array:
    """Force (n) of a `TactilePad` without what it remembers at (displacement, rate, field) (n x 3)."""
    return np.array([sum(pad.elastic_parts_N(*place)) for place in places.tolist()])


def comparison(cycles: PadRecord, effort: Effort, noise_N: float) -> list[dict[str, Any]]:
    """Every forward model on the same thinned rows: errors on four splits, a pad held for an hour, time, memory.

    The models with a memory also learn from relaxation tests, of which none has a field or a class that is left out.
    Networks of other sizes are judged on the random split only.
    """
    samples = effort.hold_samples // effort.thin
    data, tests = dataset(cycles, effort.thin), holds(PADS.values(), noise_N, samples)
    unseen = dataset(holding_records(PADS[PAD_IN_USE], 0.0, 0, fields_mT=UNSEEN_FIELDS_MT, samples=samples))
    epochs = effort.group_epochs
    makers: dict[str, Callable[[Dataset], ForwardModel]] = {
        "network, 50 units (thesis)": lambda known: NetworkForward(epochs=epochs),
        "support vectors": lambda known: SupportVectorForward(effort.support_rows),
        "forest": lambda known: ForestForward(),
        "GRU": lambda known: RecurrentForward(known, epochs=effort.recurrent_epochs),
        "grey box, 50 units": lambda known: GreyBoxForward(known, 50, epochs=epochs, settling_epochs=epochs // 4),
    }
    field_mT = float(np.unique(data.features[:, FIELD])[5])
    class_percent = PADS["MRE-B"].cip_percent
    all_tests = np.ones(len(tests), dtype=np.bool_)
    splits: dict[str, tuple[Mask, Mask]] = {
        "random": (random_split(len(data), SPLIT_SEED), all_tests),
        "field": (data.features[:, FIELD] == field_mT, tests.features[:, FIELD] != field_mT),
        "class": (data.features[:, CIP] == class_percent, tests.features[:, CIP] != class_percent),
        "cycles": (next(mask for _, mask in leave_cycles_out(data, CYCLE_FOLDS, SPLIT_SEED)), all_tests),
    }
    rows = []
    for name, make in tqdm(makers.items(), desc="models", disable=None, leave=False):
        row: dict[str, Any] = {"model": name}
        for split, (held, known) in splits.items():
            model = make(tests.subset(known))
            row |= _fitted_row(model, data, held, split, unseen if split == "random" else None)
        rows.append(row)
    for size in tqdm(effort.sizes, desc="sizes", disable=None, leave=False):
        model = NetworkForward(size, epochs=epochs)
        rows.append(
            {"model": f"network, {size} units"} | _fitted_row(model, data, splits["random"][0], "random", unseen)
        )
    for row in rows:
        row["pareto"] = not any(
            other["predict_us_per_row"] < row["predict_us_per_row"] and other["random_mae_N"] <= row["random_mae_N"]
            for other in rows
        )
    return rows


def _fitted_row(model: ForwardModel, data: Dataset, held: Mask, split: str, unseen: Dataset | None) -> dict[str, Any]:
    """Fit without `held` and judge on it; with `unseen`, what the model costs and its error there as well."""
    begun_s = time.perf_counter()
    fitted = model.fit(data, ~held)
    fit_s = time.perf_counter() - begun_s
    predicted = model.predict(data)
    row: dict[str, Any] = {f"{split}_mae_N": float(np.abs(predicted - data.force_N)[held].mean())}
    if unseen is not None:
        times_s = []
        for _ in range(3):
            begun_s = time.perf_counter()
            model.predict(data)
            times_s.append(time.perf_counter() - begun_s)
        row["hold_mae_N"] = float(np.abs(model.predict(unseen) - unseen.force_N).mean())
        row["fit_s"] = fit_s
        row["predict_us_per_row"] = 1e6 * min(times_s) / len(data)
        # what would have to be kept; pickled only to be weighed, never stored
        row["memory_kB"] = len(pickle.dumps(fitted)) / 1024
    return row
