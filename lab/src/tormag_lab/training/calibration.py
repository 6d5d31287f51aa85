"""From the sweeps of `tormagctl calibrate --insert` to a model file, fitted on some and judged on the others.

tormag-lab calibrate SWEEPS.csv --insert MRE-50-40 --out MODEL.safetensors

A sweep that teaches nothing, and a fit that is poor, are refused, and nothing is saved.
"""

import argparse
import datetime
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from tormag_lab.arrays import Array, read_columns
from tormag_lab.errors import LabError
from tormag_lab.main import Found
from tormag_lab.training.dataset import ALLOWED, Dataset, fit_metrics
from tormagd.element.model.displacement import MOBILISED_MM, MOVING_MM_S, Turn
from tormagd.element.model.features import FEATURES, FIELD, Element
from tormagd.element.model.model_file import ForceModel, save_model
from tormagd.element.physics.field import PowerFieldLaw, flux_density_T
from tormagd.element.physics.force import TORMAG
from tormagd.element.physics.inserts import Insert, insert

COLUMNS = ("time_s", "sweep", "gap_mm", "handle_mm", "rate_mm_s", "force_N")
"The handle's travel is at the roller; rate and force are positive in the direction of motion."

MIN_MOVING_SHARE = 0.3
"Turning to and fro with rests keeps over half of a sweep in motion."
MIN_FIELD_SPAN = 0.2
"Share of the greatest field."
MIN_SWEEPS = 3
JUDGING = (3, 1)
"Every third sweep, from the second on, judges the model instead of teaching it."
VALIDATION_SHARE = 0.3
STEADY_MM_S = 10.0
"A handle within this (5th to 95th percentile of its rate) teaches nothing about the rate."
RARE_SHARE = 0.01

MIN_R2 = 0.97
"R2 of the thesis's own network, table 4.1."
MAX_MAE_SHARE = 0.02
"Of the greatest force: relaxation and temperature, which the model lacks, take one to two percent."
MAX_MAE_OVER_NOISE = 3.0
MEAN_OVER_SIGMA = math.sqrt(2.0 / math.pi)
"Mean absolute value of Gaussian noise over its standard deviation."


class CalibrationError(LabError):
    """A sweep that gives no model: a stable code, what was found beside what is needed, and what to do."""

    def __init__(self, code: str, message: str, hint: str) -> None:
        super().__init__(f"{code}: {message}; {hint}")
        self.code = code


def training_rows(table: Array, fitted: Insert) -> Dataset:
    """Return the rows of sweeps (n x 6, as COLUMNS) in which the handle moves."""
    _, sweep, _, handle_mm, rate_mm_s, _ = table.T
    rate_mm_s = np.abs(rate_mm_s)
    is_moving = rate_mm_s >= MOVING_MM_S
    for number in np.unique(sweep):
        share = float(is_moving[sweep == number].mean())
        if share < MIN_MOVING_SHARE:
            raise CalibrationError(
                "handle_still",
                f"the handle moved for {share:.0%} of sweep {number + 1:.0f}: needed are {MIN_MOVING_SHARE:.0%} at "
                f"{MOVING_MM_S:g} mm/s or more at the roller",
                "turn the handle steadily for as long as the sweep runs",
            )
    displacement_mm = np.concatenate([displacement(handle_mm[sweep == number]) for number in np.unique(sweep)])
    kept = is_moving & np.isfinite(displacement_mm)
    if not kept.any():
        raise CalibrationError(
            "handle_still",
            f"in no sweep did the handle turn or go {MOBILISED_MM:g} mm at the roller: needed is either",
            "turn the handle to and fro for as long as the sweep runs",
        )
    displacement_mm, rate_mm_s, table = displacement_mm[kept], rate_mm_s[kept], table[kept]
    low, high = np.percentile(rate_mm_s, (5.0, 95.0))
    if high - low < STEADY_MM_S:
        rate_mm_s = np.full_like(rate_mm_s, np.median(rate_mm_s))
    if (displacement_mm < MOBILISED_MM).mean() < RARE_SHARE:
        displacement_mm = np.full_like(displacement_mm, MOBILISED_MM)
    time_s, sweep, gap_mm, _, _, force_N = table.T
    moment_Tm = np.asarray(PowerFieldLaw().radial_moment_Tm(gap_mm))
    field_mT = 1e3 * flux_density_T(moment_Tm, fitted.elastomer.relative_permeability, TORMAG.inner_radius_m)
    cip_percent = np.full_like(rate_mm_s, 100.0 * fitted.cip_fraction)
    features = np.column_stack((displacement_mm, rate_mm_s, field_mT, cip_percent))
    return Dataset(features, force_N, sweep.astype(np.int64), time_s)


def displacement(handle_mm: Array) -> Array:
    """Return the distance from the last turn (n), at most MOBILISED_MM, and NaN before the first."""
    found = np.full_like(handle_mm, np.nan)
    start_mm = float(handle_mm[0])
    turn, is_known = Turn(1.0, start_mm, start_mm), False
    for index, position_mm in enumerate(handle_mm.tolist()):
        last, turn = turn, turn.moved_to(position_mm)
        # at the first reversal the handle may have come this way all the time
        has_turned = turn.direction != last.direction and last.turned_mm != last.furthest_mm
        is_known = is_known or has_turned or abs(position_mm - start_mm) >= MOBILISED_MM
        if is_known:
            found[index] = turn.displacement_mm(position_mm)
    return found


def require_usable(data: Dataset) -> None:
    """Refuse data that no fit can make a model of."""
    assert data.cycle is not None  # training_rows sets it
    sweeps = len(np.unique(data.cycle))
    if sweeps < MIN_SWEEPS:
        raise CalibrationError(
            "few_sweeps", f"{sweeps} sweeps: needed are {MIN_SWEEPS}, one of them to judge by", "record more sweeps"
        )
    field_mT = data.features[:, FIELD]
    low, high = float(field_mT.min()), float(field_mT.max())
    if high - low < MIN_FIELD_SPAN * high:
        raise CalibrationError(
            "field_range",
            f"the field ran from {low:.0f} to {high:.0f} mT, {(high - low) / high:.0%} of the greatest: needed are "
            f"{MIN_FIELD_SPAN:.0%}",
            "sweep a wider range of force, with a scene that allows it",
        )
    ends = np.percentile(field_mT, (10.0, 90.0))
    weak, strong = data.force_N[field_mT <= ends[0]], data.force_N[field_mT >= ends[1]]
    rise, noise = float(np.median(strong) - np.median(weak)), noise_sd_N(data)
    if np.ptp(data.force_N) == 0.0 or rise < 3.0 * noise:
        raise CalibrationError(
            "force_dead",
            f"the measured force rose by {rise:.3f} N from the weakest field to the strongest: needed are three times "
            f"its noise, {3.0 * noise:.3f} N",
            "check the force sensor and its cable, and that the insert is fitted",
        )


def noise_sd_N(data: Dataset) -> float:
    """Return the force sensor's noise from third differences of neighbouring rows."""
    assert data.time_s is not None  # training_rows sets it
    steps = np.diff(data.time_s)
    third = np.diff(data.force_N, 3)
    together = np.convolve(steps < 2.0 * np.median(steps), np.ones(3), "valid") == 3.0
    # 1.4826 turns a Gaussian's median deviation into a standard one, sqrt(20) a third difference's into a row's
    return float(1.4826 * np.median(np.abs(third[together])) / math.sqrt(20.0)) if together.any() else 0.0


def fit(
    data: Dataset,
    insert_name: str,
    created: datetime.date,
    *,
    hidden: int = 50,
    epochs: int = 200,
    by_law: bool = False,
) -> ForceModel:
    """Train on all sweeps but the judging ones, and return the model with the judgement in its metrics."""
    assert data.cycle is not None  # training_rows sets it
    numbers = np.unique(data.cycle)
    is_judging = np.isin(data.cycle, numbers[JUDGING[1] :: JUDGING[0]])
    training, validation = data.subset(~is_judging).split(VALIDATION_SHARE, seed=0)
    shared: dict[str, Any] = {"created": created, "hidden": hidden, "epochs": epochs, "data_sha256": data.sha256()}
    if by_law:
        from tormag_lab.training.law import fit_law_model  # SciPy and torch take seconds to load

        model = fit_law_model(training, validation, insert_name=insert_name, **shared)
    else:
        from tormag_lab.training.fitting import fit_model

        model, _ = fit_model(training, validation, element=Element.TORQUE, inserts=(insert_name,), **shared)
    judging = data.subset(is_judging)
    found = fit_metrics(model, judging)
    noise_mae_N = MEAN_OVER_SIGMA * noise_sd_N(data)
    most_mae_N = max(MAX_MAE_OVER_NOISE * noise_mae_N, MAX_MAE_SHARE * float(np.percentile(data.force_N, 99.0)))
    r2, mae_N = found.get("r2", -math.inf), found["mae_N"]
    if not (r2 >= MIN_R2 and mae_N <= most_mae_N):
        raise CalibrationError(
            "poor_fit",
            f"on sweeps kept from the fit R2 is {r2:.4f} (needed: {MIN_R2:g}) and the mean error "
            f"{mae_N * 1e3:.1f} mN (allowed: {most_mae_N * 1e3:.1f} mN; the sensor's noise alone makes "
            f"{noise_mae_N * 1e3:.1f} mN)",
            "nothing was saved; turn the handle more steadily, look for a loose sensor or insert, and sweep again",
        )
    require_rising(model)
    metrics = model.metadata.metrics | {f"judged_{name}": value for name, value in found.items()}
    metrics |= {
        "noise_mae_N": noise_mae_N,
        "most_mae_N": most_mae_N,
        "judged_rows": float(len(judging)),
        "sweeps": float(len(numbers)),
    }
    return replace(model, metadata=msgspec.structs.replace(model.metadata, metrics=metrics))


def require_rising(model: ForceModel) -> None:
    """Refuse a model whose mobilised force falls with the field by over 1 % of its span."""
    ranges = dict(zip(FEATURES, model.feature_ranges, strict=True))
    rate_mm_s = sum(ranges["rate_mm_s"]) / 2.0
    rows = np.array(
        [
            (ranges["displacement_mm"][1], rate_mm_s, field_mT, ranges["cip_percent"][0])
            for field_mT in np.linspace(*ranges["field_mT"], 64)
        ]
    )
    force_N = model.predict(rows)
    largest_fall_N = float((np.maximum.accumulate(force_N) - force_N).max())
    if largest_fall_N > 0.01 * float(np.ptp(force_N)):
        raise CalibrationError(
            "not_rising",
            f"the fitted force falls by {largest_fall_N * 1e3:.1f} mN from the weakest field to the strongest: "
            "allowed is 1% of its span",
            "nothing was saved; sweep again, slower",
        )


def read_sweeps(path: Path) -> Array:
    return np.column_stack(list(read_columns(path, COLUMNS, allowed=ALLOWED).values()))


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("sweeps", type=Path, metavar="SWEEPS.csv", help=f"columns {','.join(COLUMNS)}")
    parser.add_argument("--insert", required=True, help="the insert that was swept, such as MRE-50-40")
    parser.add_argument("--out", type=Path, required=True, metavar="MODEL.safetensors")
    parser.add_argument("--law", action="store_true", help="fit the law of the brake, without torch")


def run(options: argparse.Namespace) -> Found:
    data = training_rows(read_sweeps(options.sweeps), insert(options.insert))
    require_usable(data)
    model = fit(data, options.insert, datetime.date.today(), by_law=options.law)
    save_model(options.out, model, options.sweeps)
    figures = {"model": str(options.out), "insert": options.insert, "rows": len(data), "ranges": data.ranges()}
    metrics = model.metadata.metrics
    told = (
        f"{options.out}: {options.insert}, {len(data)} rows. On sweeps kept from the fit: R2 {metrics['judged_r2']:.4f}"
        f", mean error {metrics['judged_mae_N'] * 1e3:.1f} mN (allowed {metrics['most_mae_N'] * 1e3:.1f}; the sensor's "
        f"noise alone {metrics['noise_mae_N'] * 1e3:.1f} mN)",
        "next: name the file as insert.model in a scene file of your own",
    )
    return Found(figures | {"metrics": metrics}, told)
