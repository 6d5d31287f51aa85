"""Numbers at their extremes: the force law against 50 digits, hostile inputs to every stage.

Part `stages` feeds each stage of the core with NaN, infinities, denormals, largest floats, time that stands or goes
back, and tables that do not rise. Steps are `refused` by name, or `stated`: a limit or a fault was told after them.
`travelled` must be 0: numbers that came out `nonfinite`, `swallowed` steps with NaN of which nothing was said, and
errors that are `unnamed`.

`cases` inputs are evaluated as arrays in float64 and float32, and `reference_cases` of them in 50 digits. The allowed
relative error is 1e-12 in float64, in float32 1e-5 for lambda1 >= 0.7 and 3e-4 down to 0.05; 8 eps kappa if that is
more, with kappa the condition number. `worst_rel_error` is over the cases of the plain bound. `passed`: every
error is allowed, nothing travelled, and the domain ends where it should.
"""

import argparse
import sys
from collections import Counter
from functools import partial
from typing import Any

import mpmath as mp
import numpy as np
from digits import DIGITS, Batch, draw_batch, reference
from numpy.typing import NDArray

from judge.frame import each
from judge.stage_table import stages
from judge.stages import tried
from tormag_lab.arrays import Array, Json, Mask
from tormag_lab.design.brake import d_force_d_gap, d_force_d_moment, stretch_minus_one
from tormagd.element.physics.errors import FloatArray
from tormagd.element.physics.field import ThesisFieldLaw
from tormagd.element.physics.force import brake_force_N, max_radial_moment_Tm
from tormagd.ground.command_line import Within

BATCH = 500
CHUNK = 20
FLOAT64_ALLOWED = 1e-12
FLOAT64_EPS, FLOAT32_EPS = sys.float_info.epsilon, float(np.finfo(np.float32).eps)
FLOAT32_ALLOWED = {"float32": 1e-5, "float32_soft": 3e-4}
PRECISIONS = ("float64", *FLOAT32_ALLOWED)
STIFF = 0.7
"""lambda1 from which on float32 has the narrower bound."""


COUNTS = ("cases", "reference_cases", "nonfinite", "refused", "misjudged")


class Tally:
    """Counts of one chunk or of all. `worst` is by precision and quantity: the largest error where the plain bound
    holds, and the largest share of what is allowed anywhere.
    """

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.worst: dict[tuple[str, str], Array] = {}

    def note(self, precision: str, quantity: str, errors: Array, plain: float, well: Array) -> None:
        """Note errors; allowed is `plain`, or `well`, the rounding of the case, if that is more."""
        allowed = np.maximum(plain, well)
        self.raise_to(
            (precision, quantity),
            np.array([errors[allowed == plain].max(initial=0.0), (errors / allowed).max(initial=0.0)]),
        )

    def raise_to(self, kind: tuple[str, str], worst: Array) -> None:
        self.worst[kind] = np.maximum(self.worst.get(kind, 0.0), worst)


def evaluate(batch: Batch, x: FloatArray) -> tuple[Mask, dict[str, FloatArray]]:
    """Return the admissible mask and every quantity at the admissible x, in the precision of x."""
    moment_Tm = x if batch.field is None else batch.field.radial_moment_Tm(x)
    admissible = moment_Tm <= max_radial_moment_Tm(batch.elastomer, batch.geometry)
    return admissible, quantities(batch, x[admissible])


def quantities(batch: Batch, x: Any) -> Json:
    """Return every quantity at an array of admissible x, or at a plain float, as the control loop computes it."""
    law, device = batch.field, (batch.elastomer, batch.geometry)
    moment_Tm = x if law is None else law.radial_moment_Tm(x)
    values = {"moment": moment_Tm, "force": brake_force_N(moment_Tm, *device)}
    values["stretch"] = stretch_minus_one(moment_Tm, *device)
    slope = d_force_d_moment(moment_Tm, *device) if law is None else d_force_d_gap(x, law, *device)
    return {**values, "slope": slope}


def check_chunk(seed: int, devices: int, references: int) -> Tally:
    rng = np.random.default_rng(seed)
    tally = Tally()
    for _ in range(devices):
        batch = draw_batch(rng, BATCH)
        single = batch.x.astype(np.float32)
        # Eq. 7 ends at 95 mm, also where rounding puts a gap there
        inside = single < np.float32(95.0) if isinstance(batch.field, ThesisFieldLaw) else np.isfinite(single)
        admissible, values = evaluate(batch, batch.x)
        tally.counts["cases"] += len(batch.x)
        tally.counts["refused"] += int((~admissible).sum())
        tally.counts["nonfinite"] += nonfinite(values)
        _compare_with_float32(tally, batch, single[inside])
        _compare_with_reference(tally, batch, admissible, values, rng, references)
    return tally


def nonfinite(values: dict[str, FloatArray]) -> int:
    return sum(int((~np.isfinite(value)).sum()) for value in values.values())


def _compare_with_float32(tally: Tally, batch: Batch, single: NDArray[np.float32]) -> None:
    exact = single.astype(np.float64)
    admissible, _ = evaluate(batch, exact)
    also, _ = evaluate(batch, single)
    both = admissible & also
    _, low = evaluate(batch, single[both])
    _, high = evaluate(batch, exact[both])
    tally.counts["nonfinite"] += nonfinite(low)
    stretch = 1.0 + high["stretch"]
    x, slope, conditions = exact[both], high["slope"], dict[str, Array]()
    if batch.field is not None:
        # outward, where the force is admissible, too; of Eq. 7, which is flat at 95 mm, a share of the way there
        ahead = x + 1e-4 * (95.0 - x if isinstance(batch.field, ThesisFieldLaw) else x)
        rise = d_force_d_gap(ahead, batch.field, batch.elastomer, batch.geometry) - slope
        with np.errstate(divide="ignore", invalid="ignore"):
            conditions["slope"] = abs(x * rise / ((ahead - x) * slope))
    for quantity in ("stretch", "force", "slope"):
        with np.errstate(divide="ignore", invalid="ignore"):
            errors = abs(low[quantity].astype(np.float64) / high[quantity] - 1.0)
        kappa = conditions.get(quantity, np.ones_like(x))
        for precision, allowed in FLOAT32_ALLOWED.items():
            chosen = (stretch >= STIFF) if precision == "float32" else (stretch < STIFF)
            chosen &= (x > 0.0) & np.isfinite(errors)
            tally.note(precision, quantity, errors[chosen], allowed, 8.0 * FLOAT32_EPS * kappa[chosen])


def _compare_with_reference(
    tally: Tally,
    batch: Batch,
    admissible: Mask,
    values: dict[str, FloatArray],
    rng: np.random.Generator,
    references: int,
) -> None:
    place_among_admissible = np.cumsum(admissible) - 1
    for index in rng.choice(len(batch.x), size=min(references, len(batch.x)), replace=False):
        x = float(batch.x[index])
        if not x > 0.0:
            continue
        truth = reference(batch, x)
        tally.counts["reference_cases"] += 1
        if truth.admissible != bool(admissible[index]):
            # so close to the bound the last digits of x decide
            tally.counts["misjudged"] += abs(truth.stretch - 0.05) > 1e-11
        if not (truth.admissible and admissible[index]):
            continue
        plain = quantities(batch, x)
        with mp.workdps(DIGITS):
            for quantity, value in truth.values.items():
                array_value = float(values[quantity][place_among_admissible[index]])
                error = max(float(abs(mp.mpf(computed) / value - 1)) for computed in (array_value, plain[quantity]))
                well = np.array([8.0 * FLOAT64_EPS * truth.conditions[quantity]])
                tally.note("float64", quantity, np.array([error]), FLOAT64_ALLOWED, well)


def stage_row(place: int, episodes: int, seed: int) -> Json:
    return tried(stages()[place], episodes, seed)


def measure(options: argparse.Namespace) -> Json:
    physics, core = of_physics(options), of_core(options)
    return physics | core | {"passed": physics["passed"] and core["passed"]}


def of_core(options: argparse.Namespace) -> Json:
    row = partial(stage_row, episodes=options.episodes, seed=options.seed)
    told = each(row, "stages", range(len(stages())), workers=options.workers)
    travelled = sum(row["nonfinite"] + row["swallowed"] + row["unnamed"] for row in told)
    return {
        "stage_cases": sum(row["cases"] for row in told),
        "travelled": travelled,
        "stages": told,
        "passed": travelled == 0,
    }


def of_physics(options: argparse.Namespace) -> Json:
    devices = -(-options.cases // BATCH)
    chunks = [min(CHUNK, devices - first) for first in range(0, devices, CHUNK)]
    seeds = range(options.seed + 1, options.seed + 1 + len(chunks))
    check = partial(check_chunk, references=-(-options.reference // devices))
    tally = Tally()
    for found in each(check, "physics", seeds, chunks, workers=options.workers):
        tally.counts.update(found.counts)
        for kind, errors in found.worst.items():
            tally.raise_to(kind, errors)
    worst = {name: [errors for (kind, _), errors in tally.worst.items() if kind == name] for name in PRECISIONS}
    return {name: tally.counts[name] for name in COUNTS} | {
        "worst_rel_error": {name: max((float(of[0]) for of in found), default=0.0) for name, found in worst.items()},
        "over_allowed": {", ".join(kind): float(share) for kind, (_, share) in tally.worst.items()},
        "passed": all(share <= 1.0 for _, share in tally.worst.values())
        and tally.counts["nonfinite"] == tally.counts["misjudged"] == 0,
    }


OPTIONS = {
    f"--{name}": {"type": Within(1, 10**9, is_whole=True), "default": default, "help": f"{says} (%(default)s)"}
    for name, default, says in (
        ("cases", 1_000_000, "inputs of the physics, as arrays"),
        ("reference", 12_000, "of them, computed in 50 digits"),
        ("episodes", 1_000, "of hostile inputs to each stage"),
        ("seed", 1, "of what is drawn"),
        ("workers", 2, "processes"),
    )
}
