"""Which model of the brake's force is nearest to devices: networks, the device's law, law with residual, SVR, forest.

    model_comparison.py DATA.csv [DATA.csv ...] [--second SECOND.csv] [--seeds 3] [--json FILE]

`DATA.csv` are bench sweeps of sample 1, one of each matrix, `SECOND.csv` one of the second plant's MRE-50-40, as
`tormag-lab bench-sweep` writes them. Their memory is taken out first. Judged are sliding forces (1 to 300 mm/s, 45 to
95 mm) of fresh, cool devices; all are synthetic. Needs scikit-learn, which tormagd does not.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from rendering.device_draws import SAMPLES, SECOND, device
from rendering.models import GAPS_MM, JUDGING, RATES_MM_S, brake_N
from scipy.optimize import least_squares

from tormagd.control.field_of_gap import FieldOfGap
from tormagd.lab.arrays import Array, Json
from tormagd.lab.training.dataset import Dataset, read_csv
from tormagd.lab.training.fitting import scaling_of
from tormagd.lab.training.levenberg_marquardt import train
from tormagd.lab.training.metrics import random_split
from tormagd.lab.training.unremembered import identify
from tormagd.model.displacement import MOBILISED_MM
from tormagd.model.features import CIP, FIELD
from tormagd.model.model_file import load_model
from tormagd.model.network import ForceNetwork
from tormagd.model.shipped import AUTO, model_path
from tormagd.physics.brake_curve import BrakeCurve
from tormagd.physics.field import PowerFieldLaw
from tormagd.physics.force import MU0_H_M, TORMAG
from tormagd.physics.inserts import INSERTS, Insert, insert
from tormagd.simulation.parameters import with_insert
from tormagd.simulation.second_element import fresh_N, rate_factor, shaft_field_mT

Predict = Callable[[Array], Array]
SHARE = 0.8
"Of the law's force that the residual's network is added to: what it learns may take a fifth of the slope away."
RESIDUAL_UNITS, THESIS_UNITS = 10, 50
MIDDLE_MT, REFERENCE_MM_S, SLOW_MM_S = 450.0, 42.0, 0.1
ROWS = (50, 200, 1000)
FEWER = ("MRE-10-10", "MRE-30-20", "MRE-50-40")


class Fitted(NamedTuple):
    """A trained model, and how many numbers it has."""

    predict: Predict
    size: int


# the law: logarithms of modulus and friction over the registry's, the field's exponent, force without field, static
# share, logarithm of the Stribeck speed, viscous N s/mm, share of a factor e of speed, logarithm of the stiffness N/mm,
# and 1 T over the field at which the iron saturates
START = np.array([0.0, 0.0, 1.0, 0.0, 0.1, np.log(10.0), 1e-4, 0.0, np.log(5.0), 0.3])
LOW = np.array([-3.0, -3.0, 0.5, -0.5, 0.0, np.log(0.5), 0.0, -0.1, np.log(0.5), 0.0])
HIGH = np.array([3.0, 3.0, 2.0, 1.0, 1.0, np.log(100.0), 0.01, 0.1, np.log(50.0), 5.0])
SCALE = np.array([0.1, 0.1, 0.1, 0.05, 0.1, 0.5, 1e-3, 0.01, 0.5, 0.3])
OF_CIP = {(item.shore_hardness, round(100 * item.cip_fraction)): item for item in INSERTS.values()}


def law_N(parameters: Array, rows: Array, hardness: int) -> Array:
    """The device's law at the rows (n x 4)."""
    forces = np.empty(len(rows))
    for cip in np.unique(rows[:, CIP]):
        own = rows[:, CIP] == cip
        forces[own] = _law_of_insert_N(parameters, rows[own], OF_CIP[hardness, round(cip)])
    return forces


def _law_of_insert_N(parameters: Array, rows: Array, fitted: Insert) -> Array:
    modulus, friction, exponent, free_N, static, stribeck, viscous, by_rate, stiffness, saturating = parameters
    displacement_mm, rate_mm_s, field_mT, _ = rows.T
    nominal = fitted.elastomer
    modulus_Pa = nominal.shear_modulus_Pa * np.exp(modulus)
    inner_m, outer_m = TORMAG.inner_radius_m, TORMAG.outer_radius_m
    curve = BrakeCurve.of((outer_m - inner_m) / inner_m, TORMAG.thickness_m * (nominal.relative_permeability - 1.0))
    field_T = 1e-3 * MIDDLE_MT * (field_mT / MIDDLE_MT) ** exponent
    field_T = np.tanh(saturating * field_T) / saturating if saturating > 0.0 else field_T
    load = field_T**2 * inner_m / (4.0 * MU0_H_M * nominal.relative_permeability * modulus_Pa * outer_m)
    scale_N = 2.0 * np.pi * TORMAG.thickness_m * inner_m**2 / TORMAG.roller_radius_m
    scale_N *= nominal.friction_coefficient * np.exp(friction) * modulus_Pa
    kinetic_N = scale_N * curve.force(np.minimum(curve.compression(load), 0.95), load) + free_N
    over = 1.0 + static * np.exp(-np.square(rate_mm_s / np.exp(stribeck)))
    over += by_rate * np.log((rate_mm_s + SLOW_MM_S) / (REFERENCE_MM_S + SLOW_MM_S))
    level_N = np.maximum(kinetic_N * over + viscous * rate_mm_s, 1e-6)
    borne_N: Array = level_N * -np.expm1(-np.exp(stiffness) * displacement_mm / level_N)
    return np.where(displacement_mm < MOBILISED_MM, borne_N, level_N)


def fit_law(data: Dataset, hardness: int) -> Array:
    """The law's parameters, by least squares."""
    bounds, robust = (LOW, HIGH), {"loss": "soft_l1", "f_scale": 0.05}

    def residual(parameters: Array) -> Array:
        return law_N(parameters, data.features, hardness) - data.force_N

    found: Array = least_squares(residual, START, bounds=bounds, x_scale=SCALE, **robust).x
    return found


def law(data: Dataset, hardness: int, seed: int) -> Fitted:
    """The law alone."""
    parameters = fit_law(data, hardness)
    return Fitted(lambda rows: law_N(parameters, rows, hardness), len(parameters))


def law_and_residual(data: Dataset, hardness: int, seed: int) -> Fitted:
    """SHARE of the law, and a network over displacement, rate and the law's force that rises with that force."""
    parameters = fit_law(data, hardness)

    def over_law(rows: Array) -> tuple[Array, Array]:
        law_forces_N, features = law_N(parameters, rows, hardness), rows.copy()
        features[:, FIELD], features[:, CIP] = law_forces_N, 0.0
        return features, law_forces_N

    features, law_forces_N = over_law(data.features)
    rest = _network(Dataset(features, data.force_N - SHARE * law_forces_N), RESIDUAL_UNITS, seed, rising=True)

    def predict(rows: Array) -> Array:
        features, law_forces_N = over_law(rows)
        return SHARE * law_forces_N + rest.predict(features)

    return Fitted(predict, len(parameters) + rest.size)


def thesis_network(data: Dataset, hardness: int, seed: int) -> Fitted:
    """The thesis's network, 4-50-1."""
    return _network(data, THESIS_UNITS, seed, rising=False)


def rising_network(data: Dataset, hardness: int, seed: int) -> Fitted:
    """The same as it is trained for what ships: rising with the field."""
    return _network(data, THESIS_UNITS, seed, rising=True)


def _network(data: Dataset, hidden: int, seed: int, rising: bool) -> Fitted:
    stop = random_split(len(data), seed, 0.2)
    network = ForceNetwork(scaling_of(data), hidden, seed=seed)
    train(network, data.subset(~stop), data.subset(stop), epochs=200, rising=rising)

    @torch.no_grad()
    def predict(rows: Array) -> Array:
        return network(torch.tensor(rows)).numpy()

    return Fitted(predict, sum(each.numel() for each in network.parameters()))


def svr(data: Dataset, hardness: int, seed: int) -> Fitted:
    """Support vector regression with a Gaussian kernel."""
    from sklearn.svm import SVR  # type: ignore[import-not-found]

    scaling = scaling_of(data)
    wanted = (data.force_N - scaling.output_offset) * scaling.output_gain
    found = SVR(C=30.0, gamma=1.0, epsilon=5e-3, max_iter=100_000).fit(scaling.scaled(data.features), wanted)

    def predict(rows: Array) -> Array:
        forces: Array = found.predict(scaling.scaled(rows)) / scaling.output_gain + scaling.output_offset
        return forces

    return Fitted(predict, 5 * len(found.support_))


def forest(data: Dataset, hardness: int, seed: int) -> Fitted:
    """A random forest of 200 trees."""
    from sklearn.ensemble import RandomForestRegressor  # type: ignore[import-not-found]

    found = RandomForestRegressor(200, min_samples_leaf=2, random_state=seed).fit(data.features, data.force_N)
    return Fitted(found.predict, 3 * sum(tree.tree_.node_count for tree in found.estimators_))


KINDS: dict[str, Callable[[Dataset, int, int], Fitted]] = {
    "law": law,
    "law and residual": law_and_residual,
    "thesis's network": thesis_network,
    "rising network": rising_network,
    "SVR": svr,
    "forest": forest,
}


def grid(fitted: Insert) -> Array:
    """The judged rows of an insert (n x 4)."""
    field = FieldOfGap(PowerFieldLaw(), fitted.elastomer.relative_permeability, TORMAG.inner_radius_m)
    rates, fields = np.meshgrid(RATES_MM_S, [field.field_mT(gap) for gap in GAPS_MM.tolist()], indexing="ij")
    ones = np.ones(rates.size)
    return np.column_stack((MOBILISED_MM * ones, rates.ravel(), fields.ravel(), 100.0 * fitted.cip_fraction * ones))


def true_N(name: str, fitted: Insert) -> Array:
    """What the device `name` gives at the judged rows (n)."""
    plant = device(name)
    if plant.second is None:
        return brake_N(with_insert(plant, fitted.name), RATES_MM_S, GAPS_MM).ravel()
    second = plant.second
    fresh = [fresh_N(shaft_field_mT(gap, plant, second.concentration), second) for gap in GAPS_MM.tolist()]
    rates = [rate_factor(rate, second.renewed_mm / rate, second) for rate in RATES_MM_S.tolist()]
    return np.outer(rates, fresh).ravel()


def errors(predicted_N: Array, wanted_N: Array) -> Json:
    """Mean, worst and bias of the forces, mN, and mean and worst left when scale and offset are those of the device."""
    error_N = predicted_N - wanted_N
    basis = np.column_stack((predicted_N, np.ones_like(predicted_N)))
    left_N = basis @ np.linalg.lstsq(basis, wanted_N)[0] - wanted_N
    figures = np.abs(error_N).mean(), np.abs(error_N).max(), error_N.mean(), np.abs(left_N).mean(), np.abs(left_N).max()
    return dict(zip(("mean", "worst", "bias", "shape", "shape_worst"), (1e3 * np.array(figures)).tolist(), strict=True))


def falling_share(predict: Predict, data: Dataset) -> float:
    """The share of steps of the field in the data's box in which the force falls."""
    low, high = data.features.min(axis=0), data.features.max(axis=0)
    fields = np.linspace(low[FIELD], high[FIELD], 33)
    falls = []
    for displacement_mm in np.linspace(max(low[0], 0.1), high[0], 5):
        for rate_mm_s in np.geomspace(max(low[1], 0.5), high[1], 9):
            rows = np.column_stack([np.full(33, each) for each in (displacement_mm, rate_mm_s, 0.0, high[CIP])])
            rows[:, FIELD] = fields
            falls.append(np.diff(predict(rows)) < -1e-9)
    return float(np.mean(falls))


def judge(predict: Predict, fitted: Insert) -> Json:
    """The errors on sample 1, on the devices that judge, and, of the insert that it is, on the second plant."""
    predicted_N = predict(grid(fitted))
    others = [errors(predicted_N, true_N(name, fitted)) for name in JUDGING]
    found: Json = {"sample_1": errors(predicted_N, true_N(SAMPLES[0], fitted))}
    found["judging"] = {key: float(np.mean([each[key] for each in others])) for key in others[0]}
    found["judging"]["worst"] = max(each["worst"] for each in others)
    if fitted.name == "MRE-50-40":
        found["second"] = errors(predicted_N, true_N(SECOND, fitted))
    return found


def fewer(data: Dataset, rows: int, seed: int) -> Dataset:
    """So many rows, drawn."""
    chosen = np.random.default_rng(seed).permutation(len(data))[:rows]
    return data.subset(np.sort(chosen))


def own_rows(data: Dataset, fitted: Insert) -> Dataset:
    """The rows of one insert."""
    return data.subset(np.isclose(data.features[:, CIP], 100.0 * fitted.cip_fraction))


def trained(kind: str, data: Dataset, hardness: int, seed: int) -> tuple[Fitted, float]:
    """A model, and how long its training took, s."""
    began = time.perf_counter()
    fitted = KINDS[kind](data, hardness, seed)
    return fitted, time.perf_counter() - began


def rows_of(matrix: Dataset, inserts: list[Insert], seeds: int) -> Iterator[Json]:
    """Each insert, kind, number of rows and seed; what ships first."""
    for fitted in inserts:
        shipped = load_model(model_path(AUTO, Path(), fitted.name), element="torque", insert=fitted.name)
        of_insert = own_rows(matrix, fitted)
        base = {"insert": fitted.name, "rows": len(of_insert), "seed": 0}
        yield {**base, "kind": "ships", "falling": 0.0, "size": 5 * shipped.metadata.hidden} | judge(
            shipped.predict, fitted
        )
        whole = load_model(
            model_path(f"torque_mre_{fitted.shore_hardness}", Path()), element="torque", insert=fitted.name
        )
        yield {**base, "kind": "ships, matrix", "falling": 0.0, "size": 301} | judge(whole.predict, fitted)
        for rows in ROWS if fitted.name in FEWER else ROWS[-1:]:
            for seed in range(seeds):
                data = fewer(of_insert, rows, seed)
                for kind in KINDS:
                    found, lasted_s = trained(kind, data, fitted.shore_hardness, seed)
                    row = {"insert": fitted.name, "rows": rows, "seed": seed, "kind": kind, "seconds": lasted_s}
                    yield (
                        row
                        | {"size": found.size, "falling": falling_share(found.predict, data)}
                        | judge(found.predict, fitted)
                    )


def left_out(matrix: Dataset, inserts: list[Insert], seeds: int) -> Iterator[Json]:
    """Each insert predicted from the three others of its matrix."""
    for fitted in inserts:
        others = matrix.subset(~np.isclose(matrix.features[:, CIP], 100.0 * fitted.cip_fraction))
        for seed in range(seeds):
            for kind in KINDS:
                found, _ = trained(kind, fewer(others, ROWS[-1], seed), fitted.shore_hardness, seed)
                row = {"left_out": fitted.name, "seed": seed, "kind": kind}
                yield row | judge(found.predict, fitted)


def of_second(data: Dataset, seeds: int) -> Iterator[Json]:
    """Each kind trained on the second plant's own rows: what it makes of a law that is not its own."""
    fitted = insert("MRE-50-40")
    wanted_N = true_N(SECOND, fitted)
    for rows in ROWS:
        for seed in range(seeds):
            for kind in KINDS:
                found, lasted_s = trained(kind, fewer(data, rows, seed), fitted.shore_hardness, seed)
                row = {"trained_on": SECOND, "rows": rows, "seed": seed, "kind": kind, "seconds": lasted_s}
                yield row | errors(found.predict(grid(fitted)), wanted_N)


def compared(paths: list[Path], second: Path | None, seeds: int) -> Iterator[Json]:
    """Everything, a row at a time."""
    if second is not None:
        memory, data = identify(read_csv(second))
        yield {"memory_of": second.stem, "lag_mT": memory.lag_mT, "fractions": memory.fractions}
        yield from of_second(data, seeds)
    for path in paths:
        memory, data = identify(read_csv(path))
        hardness = int(path.stem.rpartition("_")[2])
        inserts = [item for item in INSERTS.values() if item.shore_hardness == hardness]
        yield from rows_of(data, inserts, seeds)
        yield from left_out(data, inserts, 1)


def main() -> int:
    """Compares and prints a row at a time."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("data", type=Path, nargs="*", help="sweeps, one file a matrix, named like mre_50.csv")
    parser.add_argument("--second", type=Path, help="a sweep of the second plant")
    parser.add_argument("--seeds", type=int, default=3)
    options = parser.parse_args()
    torch.set_num_threads(1)
    for row in compared(options.data, options.second, options.seeds):
        print(json.dumps(row), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
