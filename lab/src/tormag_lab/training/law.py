"""The device's law: the force of a brake with one insert, fitted by least squares, without torch.

    K = g(m K0(b) + F0)                K0: the thesis's force law (Eq. 33) of the insert, its modulus scaled, too
    b = tanh(q B_m (B / B_m)^n) / q    what of the field B acts: iron saturates
    L = K (1 + r exp(-(v / v_s)^2) + e ln((v + v_0) / (v_1 + v_0))) + c v
    F = L (1 - exp(-(k / L + p) x)) before mobilisation, then L

About fifty rows determine these eleven numbers. g, which is fitted to what they miss, rises in straight pieces: an
elastomer of another law needs some hundred rows. The law rises with the field whatever the rows. A network that rises
is fitted to it for the model file, whose metrics say how far the two differ.
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
from tormagd.element.physics.brake_curve import MAX_COMPRESSION
from tormagd.element.physics.errors import require_that
from tormagd.element.physics.field import REFERENCE_PERMEABILITY
from tormagd.element.physics.force import TORMAG, reduced
from tormagd.element.physics.inserts import Insert, insert

MIDDLE_MT = 450.0
REFERENCE_MM_S, SLOW_MM_S = 42.0, 0.1
"v_1 and v_0."
MIN_N = 1e-6
ROBUST_N = 0.05
"Larger errors count less: they are rows near a reversal."
FITTED_ROWS = 3000
PIECES, SLOPE_SD = 8, 0.3
"Of the curve that rises, and the spread of its slope's logarithm that needs no rows to show it."
DRAWN = 2048
"Points of the box at which the network is fitted."
SLIDING = 0.85
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
    preslide_1_mm: float
    "p: a share of the stiffness grows with the normal force."

    def forces_N(self, rows: Array, fitted: Insert, bend: "Bend | None" = None) -> Array:
        """Return the force (n) at `rows` (n x 4, order of `FEATURES`)."""
        displacement_mm, rate_mm_s, field_mT, _ = rows.T
        kinetic_N = self.kinetic_N(field_mT, fitted)
        if bend is not None:
            kinetic_N = bend.bent_N(kinetic_N)
        over = 1.0 + self.static * np.exp(-np.square(rate_mm_s / np.exp(self.log_stribeck_mm_s)))
        over += self.by_rate * np.log((rate_mm_s + SLOW_MM_S) / (REFERENCE_MM_S + SLOW_MM_S))
        level_N = np.maximum(kinetic_N * over + self.viscous_N_s_mm * rate_mm_s, MIN_N)
        stiffness_N_mm = np.exp(self.log_stiffness_N_mm) + self.preslide_1_mm * level_N
        return mobilised_N(level_N, displacement_mm, stiffness_N_mm)

    def kinetic_N(self, field_mT: Array, fitted: Insert) -> Array:
        """Return K (n) at fields (n)."""
        nominal = fitted.elastomer
        modulus_Pa = nominal.shear_modulus_Pa * float(np.exp(self.log_modulus))
        law = reduced(replace(nominal, shear_modulus_Pa=modulus_Pa), TORMAG)
        field_T = 1e-3 * MIDDLE_MT * (field_mT / MIDDLE_MT) ** self.exponent
        field_T = np.tanh(self.saturating_1_T * field_T) / self.saturating_1_T
        load = law.load(field_T * TORMAG.inner_radius_m * REFERENCE_PERMEABILITY / nominal.relative_permeability)
        compressed = np.minimum(law.curve.compression(load), MAX_COMPRESSION)
        kinetic_N: Array = np.exp(self.log_m) * law.force_scale_N * law.curve.force(compressed, load) + self.free_N
        return kinetic_N


class Bend(NamedTuple):
    """g, in pieces of equal width over `law_N`; beyond, it rises as the law does."""

    law_N: tuple[float, float]
    offset_N: float
    log_slopes: Array

    def bent_N(self, kinetic_N: Array) -> Array:
        knots_N, width_N = np.linspace(*self.law_N, len(self.log_slopes) + 1, retstep=True)
        more_N = np.append(0.0, np.cumsum(np.expm1(self.log_slopes)) * width_N)
        bent_N: Array = kinetic_N + self.offset_N + np.interp(kinetic_N, knots_N, more_N)
        return bent_N


def mobilised_N(level_N: Array, displacement_mm: Array, stiffness_N_mm: float | Array) -> Array:
    """Return the force (n) at displacements (n) with the friction level (n) above 0."""
    borne_N: Array = level_N * -np.expm1(-stiffness_N_mm * displacement_mm / level_N)
    return np.where(displacement_mm < MOBILISED_MM, borne_N, level_N)


START = Law(0.0, 0.0, 1.0, 0.0, 0.1, np.log(10.0), 0.0, 1e-4, np.log(5.0), 0.3, 0.5)
LEAST = Law(-3.0, -3.0, 0.5, -0.5, 0.0, np.log(0.5), -0.1, 0.0, np.log(0.5), 1e-3, 0.0)
MOST = Law(3.0, 3.0, 2.0, 1.0, 1.0, np.log(100.0), 0.1, 0.01, np.log(50.0), 5.0, 20.0)
SCALE = Law(0.1, 0.1, 0.1, 0.05, 0.1, 0.5, 0.01, 1e-3, 0.5, 0.3, 1.0)


def fit_law(data: Dataset, fitted: Insert) -> Law:
    """Fit the law of the insert by least squares in which rows far off count less."""
    kept = data.subset(np.arange(0, len(data), max(1, len(data) // FITTED_ROWS)))

    def residual(numbers: Array) -> Array:
        return Law(*numbers).forces_N(kept.features, fitted) - kept.force_N

    robust = {"loss": "soft_l1", "f_scale": ROBUST_N}
    found = least_squares(residual, START, bounds=(LEAST, MOST), x_scale=SCALE, **robust)
    return Law(*found.x.tolist())


def fit_bend(data: Dataset, fitted: Insert, law: Law) -> Bend:
    """Fit g: its slopes are 1 where no rows show another."""
    kinetic_N = law.kinetic_N(data.features[:, FIELD], fitted)
    ends_N = float(kinetic_N.min()), float(kinetic_N.max())

    def residual(numbers: Array) -> Array:
        bend = Bend(ends_N, numbers[0], numbers[1:])
        off_N = law.forces_N(data.features, fitted, bend) - data.force_N
        return np.concatenate((off_N / ROBUST_N, numbers[1:] / SLOPE_SD))

    offset_N, *log_slopes = least_squares(residual, np.zeros(1 + PIECES), loss="soft_l1").x
    return Bend(ends_N, offset_N, np.array(log_slopes))


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
    forces_N = law.forces_N(rows, fitted, fit_bend(training, fitted, law))
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
