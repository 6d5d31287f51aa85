"""The device's law: the force of a brake with one insert in ten numbers, fitted by least squares, without torch.

    K = m K0(b) + F0                   K0: the thesis's force law (Eq. 33) of the insert, its modulus scaled, too
    b = tanh(q B_m (B / B_m)^n) / q    what of the field B acts: iron saturates
    L = K (1 + r exp(-(v / v_s)^2) + e ln((v + v_0) / (v_1 + v_0))) + c v
    F = L (1 - exp(-k x / L)) before mobilisation, then L

The law rises with the field whatever the rows, and about fifty of them determine it. A network that rises with the
field is fitted to it for the model file, whose metrics say how far the two differ.
"""

import datetime
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import msgspec
import numpy as np
from scipy.optimize import least_squares, minimize
from scipy.special import expit
from scipy.stats.qmc import Halton

from tormag_lab.arrays import Array
from tormag_lab.training.dataset import Dataset, trained_metrics
from tormagd.element.model.displacement import MOBILISED_MM
from tormagd.element.model.features import FEATURES, FIELD, RATE, Element
from tormagd.element.model.memory import NO_MEMORY, Memory
from tormagd.element.model.model_file import ForceModel, ModelMetadata
from tormagd.element.physics.brake_curve import MAX_COMPRESSION, BrakeCurve
from tormagd.element.physics.errors import require_that
from tormagd.element.physics.force import MU0_H_M, TORMAG
from tormagd.element.physics.inserts import Insert, insert

MIDDLE_MT = 450.0
REFERENCE_MM_S, SLOW_MM_S = 42.0, 0.1
"v_1 and v_0."
MIN_N = 1e-6
ROBUST_N = 0.05
"Larger errors count less: they are rows near a reversal."
FITTED_ROWS = 3000
DRAWN = 2048
"Points of the box at which the network is fitted."
SLIDING = 0.7
"Share of these points at full displacement, which plans ask for."
EDGE = 0.05
"Share of these points at each end of a range."

STEEP, MIN_WEIGHT, MIN_TURN_MM_S = 3.0, 1e-2, 3.0
"Start of the network's fit: steepness of its units, least weight of the field, least width over the rate."


class Law(NamedTuple):
    """The numbers of one insert's law, as in the module's docstring; factors are logarithms."""

    log_modulus: float
    log_m: float
    exponent: float
    free_N: float
    static: float
    log_stribeck_mm_s: float
    by_rate: float
    viscous_N_s_mm: float
    log_stiffness_N_mm: float
    saturating_1_T: float

    def forces_N(self, rows: Array, fitted: Insert) -> Array:
        """Return the force (n) at `rows` (n x 4, order of `FEATURES`)."""
        displacement_mm, rate_mm_s, field_mT, _ = rows.T
        nominal, thickness_m = fitted.elastomer, TORMAG.thickness_m
        inner_m, outer_m = TORMAG.inner_radius_m, TORMAG.outer_radius_m
        modulus_Pa = nominal.shear_modulus_Pa * np.exp(self.log_modulus)
        curve = BrakeCurve.of((outer_m - inner_m) / inner_m, thickness_m * (nominal.relative_permeability - 1.0))
        field_T = 1e-3 * MIDDLE_MT * (field_mT / MIDDLE_MT) ** self.exponent
        field_T = np.tanh(self.saturating_1_T * field_T) / self.saturating_1_T
        load = field_T**2 * inner_m / (4.0 * MU0_H_M * nominal.relative_permeability * modulus_Pa * outer_m)
        scale_N = (
            2.0 * np.pi * thickness_m * inner_m**2 / TORMAG.roller_radius_m * nominal.friction_coefficient * modulus_Pa
        )
        compressed = np.minimum(curve.compression(load), MAX_COMPRESSION)
        kinetic_N = np.exp(self.log_m) * scale_N * curve.force(compressed, load) + self.free_N
        over = 1.0 + self.static * np.exp(-np.square(rate_mm_s / np.exp(self.log_stribeck_mm_s)))
        over += self.by_rate * np.log((rate_mm_s + SLOW_MM_S) / (REFERENCE_MM_S + SLOW_MM_S))
        level_N = np.maximum(kinetic_N * over + self.viscous_N_s_mm * rate_mm_s, MIN_N)
        return mobilised_N(level_N, displacement_mm, np.exp(self.log_stiffness_N_mm))


def mobilised_N(level_N: Array, displacement_mm: Array, stiffness_N_mm: float) -> Array:
    """Return the force (n) at displacements (n) with the friction level (n) above 0."""
    borne_N: Array = level_N * -np.expm1(-stiffness_N_mm * displacement_mm / level_N)
    return np.where(displacement_mm < MOBILISED_MM, borne_N, level_N)


START = Law(0.0, 0.0, 1.0, 0.0, 0.1, np.log(10.0), 0.0, 1e-4, np.log(5.0), 0.3)
LEAST = Law(-3.0, -3.0, 0.5, -0.5, 0.0, np.log(0.5), -0.1, 0.0, np.log(0.5), 1e-3)
MOST = Law(3.0, 3.0, 2.0, 1.0, 1.0, np.log(100.0), 0.1, 0.01, np.log(50.0), 5.0)
SCALE = Law(0.1, 0.1, 0.1, 0.05, 0.1, 0.5, 0.01, 1e-3, 0.5, 0.3)


def fit_law(data: Dataset, fitted: Insert) -> Law:
    """Fit the law of the insert by least squares in which rows far off count less."""
    kept = data.subset(np.arange(0, len(data), max(1, len(data) // FITTED_ROWS)))

    def residual(numbers: Array) -> Array:
        return Law(*numbers).forces_N(kept.features, fitted) - kept.force_N

    robust = {"loss": "soft_l1", "f_scale": ROBUST_N}
    found = least_squares(residual, START, bounds=(LEAST, MOST), x_scale=SCALE, **robust)
    return Law(*found.x.tolist())


def fit_law_model(
    training: Dataset,
    validation: Dataset,
    *,
    insert_name: str,
    data_sha256: str,
    created: datetime.date,
    memory: Memory = NO_MEMORY,
    hidden: int = 50,
    epochs: int = 200,
    seed: int = 0,
) -> ForceModel:
    fitted, (low_mT, high_mT) = insert(insert_name), training.ranges()["field_mT"]
    require_that(low_mT < high_mT, "field_mT", low_mT, "fields that differ: a law is of the force over the field")
    slowest_mm_s = min(float(side.features[:, RATE].min()) for side in (training, validation))
    require_that(slowest_mm_s >= 0.0, "rate_mm_s", slowest_mm_s, "magnitudes: the force is against the motion")
    metadata = ModelMetadata(
        element=Element.TORQUE,
        insert=insert_name,
        hidden=hidden,
        ranges=training.ranges(),
        scaling=training.scaling(),
        training_data_sha256=data_sha256,
        metrics={},
        created=created,
        memory=memory,
    )
    law = fit_law(training, fitted)
    rows = _drawn(training)
    forces_N = law.forces_N(rows, fitted)
    model = _as_network(metadata, rows, forces_N, epochs, seed)
    off_N = np.abs(model.predict(rows) - forces_N)
    metrics = {
        **trained_metrics(model, training, validation),
        "law_mae_N": float(off_N.mean()),
        "law_max_N": float(off_N.max()),
        **{f"law_{name}": value for name, value in law._asdict().items()},
    }
    return replace(model, metadata=msgspec.structs.replace(metadata, metrics=metrics))


def _drawn(data: Dataset) -> Array:
    """Return DRAWN rows (n x 4) over the box of `data`, edges included, with rates spread by logarithm."""
    low, high = data.features.min(axis=0), data.features.max(axis=0)
    share = Halton(len(FEATURES), scramble=False).random(DRAWN)
    share = np.clip((1.0 + 2.0 * EDGE) * share - EDGE, 0.0, 1.0)
    share[: round(SLIDING * DRAWN), 0] = 1.0
    rows: Array = low + share * (high - low)
    slow, fast = np.log(low[RATE] + SLOW_MM_S), np.log(high[RATE] + SLOW_MM_S)
    rows[:, RATE] = np.exp(slow + share[:, RATE] * (fast - slow)) - SLOW_MM_S
    return rows


def _as_network(metadata: ModelMetadata, rows: Array, forces_N: Array, epochs: int, seed: int) -> ForceModel:
    """Return a network that rises with the field everywhere, fitted to forces (n) at `rows` (n x 4)."""
    scaling, hidden = metadata.scaling, metadata.hidden
    inputs = scaling.scaled(rows)
    targets = (forces_N - scaling.output_offset) * scaling.output_gain
    weights = len(FEATURES) * hidden

    def split(numbers: Array) -> tuple[Array, Array, Array]:
        weight = numbers[:weights].reshape(hidden, -1).copy()
        weight[:, FIELD] = np.exp(weight[:, FIELD])
        return weight, numbers[weights : weights + hidden], np.exp(numbers[weights + hidden : -1])

    @lru_cache(maxsize=1)  # the curvature is asked for where the cost was
    def jacobian(packed: bytes) -> tuple[Array, Array]:
        numbers = np.frombuffer(packed)
        weight, bias, output = split(numbers)
        units = expit(inputs @ weight.T + bias)
        by_bias = units * (1.0 - units) * output
        by_weight = by_bias[:, :, np.newaxis] * inputs[:, np.newaxis, :]
        by_weight[:, :, FIELD] *= weight[:, FIELD]
        slopes = (by_weight.reshape(len(rows), -1), by_bias, units * output, np.ones((len(rows), 1)))
        return units @ output + numbers[-1] - targets, np.concatenate(slopes, axis=1)

    def cost(numbers: Array) -> tuple[float, Array]:
        error, slopes = jacobian(numbers.tobytes())
        return 0.5 * float(error @ error), slopes.T @ error

    def curvature(numbers: Array) -> Array:
        slopes = jacobian(numbers.tobytes())[1]
        return slopes.T @ slopes

    found = minimize(
        cost, _first(metadata, rows, seed), jac=True, hess=curvature, method="trust-exact", options={"maxiter": epochs}
    )
    weight, bias, output = split(found.x)
    return ForceModel(metadata, weight, bias, output, float(found.x[-1]))


def _first(metadata: ModelMetadata, rows: Array, seed: int) -> Array:
    random = np.random.default_rng(seed)
    scaling, hidden = metadata.scaling, metadata.hidden
    turns = rows[random.integers(len(rows), size=hidden)]
    width = np.ones((hidden, len(FEATURES)))
    if scaling.input_gain[RATE] > 0.0:
        width[:, RATE] = np.maximum(turns[:, RATE], MIN_TURN_MM_S) * scaling.input_gain[RATE]
    direction = random.normal(size=(hidden, len(FEATURES)))
    weight = STEEP * direction / np.linalg.norm(direction, axis=1, keepdims=True) / width
    weight[:, FIELD] = np.maximum(np.abs(weight[:, FIELD]), MIN_WEIGHT)
    weight *= np.array(scaling.input_gain) != 0.0
    bias = -(weight * scaling.scaled(turns)).sum(axis=1)
    weight[:, FIELD] = np.log(weight[:, FIELD])
    return np.concatenate((weight.ravel(), bias, np.full(hidden, np.log(2.0 / hidden)), [-1.0]))
