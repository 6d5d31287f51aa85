"""How exact the physics is at its extremes: the force law against 50 digits, float32 against float64, long time steps.

`--json` prints one object. `cases` inputs are evaluated as arrays in float64 and float32; `reference_cases` of them are
computed in 50 digits from the formulas as printed, and compared with the arrays' float64 and with plain floats.
float32 is compared with float64 at the same input, all cases.

Allowed relative error, for force, stretch, derivatives and the round trip gap -> force -> gap: float64 1e-12; float32
1e-5 for lambda1 >= 0.7 and 3e-4 down to 0.05; in both 8 eps kappa where that is more, with kappa the condition number
of the quantity there. Of the round trip, kappa is that of its worse half, since the radial moment between is rounded
too: at the flat end of Eq. 7 the gap hardly shows in the force. `worst_rel_error` is over the cases where the plain
bound holds; the others stand beside it.

Exit status 0 if every error is allowed, nothing is NaN or infinite, and every refusal is the typed error; 1 otherwise.
"""

import argparse
import json
import math
import multiprocessing
import sys
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from typing import Any

import mpmath as mp
import numpy as np
from extremes.cases import DIGITS, Batch, draw_batch, reference
from extremes.steps import worst_step_errors
from numpy.typing import NDArray
from tqdm import tqdm

from tormagd.physics.errors import DomainError, FloatArray
from tormagd.physics.field import PowerFieldLaw, ThesisFieldLaw
from tormagd.physics.force import (
    TORMAG,
    Elastomer,
    brake_force_masked_N,
    brake_force_N,
    d2_force_d_gap2,
    d_force_d_gap,
    d_force_d_moment,
    max_radial_moment_Tm,
    radial_moment_for_force_Tm,
    stretch_minus_one,
)

Array = NDArray[np.float64]

BATCH = 500
"""Inputs for each device."""
CHUNK = 20
"""Devices for each task of the pool."""
WORKERS = 2
FLOAT64_ALLOWED = 1e-12
FLOAT64_EPS, FLOAT32_EPS = sys.float_info.epsilon, float(np.finfo(np.float32).eps)
FLOAT32_ALLOWED = {"float32": 1e-5, "float32_soft": 3e-4}
STIFF = 0.7
"""lambda1 from which on float32 is held to the narrower bound."""


@dataclass
class Worst:
    """The largest errors of one quantity in one precision: where the plain bound holds, where the condition number
    widens it, and as a share of what is allowed.
    """

    error: float = 0.0
    ill_conditioned: float = 0.0
    over_allowed: float = 0.0
    condition: float = 0.0
    where: str = ""

    def take(self, errors: Array, plain: float, eps: float, conditions: Array, where: str) -> None:
        """Note the worst of some cases; allowed is `plain`, or 8 eps kappa if that is more."""
        if not errors.size:
            return
        allowed = np.maximum(plain, 8.0 * eps * conditions)
        well = allowed == plain
        self.error = max(self.error, float(errors[well].max(initial=0.0)))
        self.ill_conditioned = max(self.ill_conditioned, float(errors[~well].max(initial=0.0)))
        shares = errors / allowed
        index = int(shares.argmax())
        if shares[index] > self.over_allowed:
            self.over_allowed, self.condition = float(shares[index]), float(conditions[index])
            self.where = f"{where}, case {index}"


@dataclass
class Tally:
    """What one chunk, or all of them, came to."""

    cases: int = 0
    reference_cases: int = 0
    nonfinite: int = 0
    refused: int = 0
    untyped_refusals: int = 0
    misjudged: int = 0
    worst: dict[str, dict[str, Worst]] = field(default_factory=dict)

    def of(self, precision: str, quantity: str) -> Worst:
        """The worst case of that kind so far."""
        return self.worst.setdefault(precision, {}).setdefault(quantity, Worst())

    def add(self, other: "Tally") -> None:
        """Merge another tally into this one."""
        for name in ("cases", "reference_cases", "nonfinite", "refused", "untyped_refusals", "misjudged"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        for precision, quantities in other.worst.items():
            for quantity, theirs in quantities.items():
                mine = self.of(precision, quantity)
                mine.error = max(mine.error, theirs.error)
                mine.ill_conditioned = max(mine.ill_conditioned, theirs.ill_conditioned)
                if theirs.over_allowed > mine.over_allowed:
                    mine.over_allowed, mine.condition, mine.where = theirs.over_allowed, theirs.condition, theirs.where


def evaluate(batch: Batch, x: FloatArray) -> tuple[NDArray[np.bool_], dict[str, FloatArray]]:
    """(admissible, every quantity at the admissible x), in the precision of x."""
    law, elastomer, geometry = batch.field, batch.elastomer, batch.geometry
    moment_Tm = x if law is None else law.radial_moment_Tm(x)
    force_N, admissible = brake_force_masked_N(moment_Tm, elastomer, geometry)
    x, moment_Tm = x[admissible], moment_Tm[admissible]
    values = {"bounded force": force_N, "moment": moment_Tm}
    values["force"] = brake_force_N(moment_Tm, elastomer, geometry)
    values["stretch"] = stretch_minus_one(moment_Tm, elastomer, geometry)
    # at the edge of the domain the last digit of an array's force may lie above the largest force that has an inverse
    most_N = brake_force_N(max_radial_moment_Tm(elastomer, geometry), elastomer, geometry)
    back_Tm = radial_moment_for_force_Tm(np.minimum(values["force"], most_N), elastomer, geometry)
    if law is None:
        values["slope"] = d_force_d_moment(moment_Tm, elastomer, geometry)
        values["round trip"] = back_Tm
    else:
        values["slope"] = d_force_d_gap(x, law, elastomer, geometry)
        values["curvature"] = d2_force_d_gap2(x, law, elastomer, geometry)
        weakest_Tm = law.radial_moment_Tm(x.dtype.type(law.gap_range_mm[1]).reshape(1))
        # the last digit of the weakest moment may come back below it, where Eq. 7 has no gap
        values["round trip"] = law.gap_mm(np.maximum(back_Tm, weakest_Tm))
    return admissible, values


def check_chunk(seed: int, devices: int, references: int) -> Tally:
    """Draw `devices` batches and check them, `references` inputs of each in 50 digits."""
    rng = np.random.default_rng(seed)
    tally = Tally()
    for number in range(devices):
        batch = draw_batch(rng, BATCH)
        where = f"seed {seed}, device {number}"
        single = batch.x.astype(np.float32)
        single = single[_inside(batch, single)]
        admissible, values = evaluate(batch, batch.x)
        tally.cases += len(batch.x)
        tally.refused += int((~admissible).sum())
        tally.nonfinite += sum(int((~np.isfinite(value)).sum()) for value in values.values())
        tally.untyped_refusals += _untyped_refusals(batch, admissible)
        _compare_with_float32(tally, batch, single, where)
        _compare_with_reference(tally, batch, admissible, values, rng, references, where)
    return tally


def _inside(batch: Batch, x: FloatArray) -> NDArray[np.bool_]:
    """Rounding to float32 may carry a gap to 95 mm, where Eq. 7 has no second derivative."""
    return x < np.float32(95.0) if isinstance(batch.field, ThesisFieldLaw) else np.isfinite(x)


def _compare_with_float32(tally: Tally, batch: Batch, single: NDArray[np.float32], where: str) -> None:
    exact = single.astype(np.float64)
    admissible, _ = evaluate(batch, exact)
    also, _ = evaluate(batch, single)
    both = admissible & also
    _, low = evaluate(batch, single[both])
    _, high = evaluate(batch, exact[both])
    tally.nonfinite += sum(int((~np.isfinite(value)).sum()) for value in low.values())
    stretch = 1.0 + high["stretch"]
    x, force, slope = exact[both], high["force"], high["slope"]
    with np.errstate(divide="ignore", invalid="ignore"):
        conditions = {"round trip": abs(force / (x * slope))}
        if batch.field is not None:
            of_moment = abs(high["moment"] / (x * batch.field.d_radial_moment_d_gap(x)))
            conditions["round trip"] = np.maximum(conditions["round trip"], of_moment)
            conditions["slope"] = abs(x * high["curvature"] / slope)
    high["round trip"] = x
    for quantity in ("stretch", "force", "slope", "round trip"):
        with np.errstate(divide="ignore", invalid="ignore"):
            errors = abs(low[quantity].astype(np.float64) / high[quantity] - 1.0)
        kappa = conditions.get(quantity, np.ones_like(x))
        for precision, allowed in FLOAT32_ALLOWED.items():
            chosen = (stretch >= STIFF) if precision == "float32" else (stretch < STIFF)
            chosen &= (x > 0.0) & np.isfinite(errors)
            tally.of(precision, quantity).take(errors[chosen], allowed, FLOAT32_EPS, kappa[chosen], where)


def _compare_with_reference(
    tally: Tally,
    batch: Batch,
    admissible: NDArray[np.bool_],
    values: dict[str, FloatArray],
    rng: np.random.Generator,
    references: int,
    where: str,
) -> None:
    place_among_admissible = np.cumsum(admissible) - 1
    for index in rng.choice(len(batch.x), size=min(references, len(batch.x)), replace=False):
        x = float(batch.x[index])
        if not x > 0.0:
            continue
        truth = reference(batch, x)
        tally.reference_cases += 1
        # so close to the bound the last digits of x decide
        if truth.admissible != bool(admissible[index]):
            tally.misjudged += abs(truth.stretch - 0.05) > 1e-11
            continue
        if not truth.admissible:
            continue
        plain = _plain(batch, x)
        with mp.workdps(DIGITS):
            for quantity, value in truth.values.items():
                array_value = float(values[quantity][place_among_admissible[index]])
                error = max(float(abs(mp.mpf(computed) / value - 1)) for computed in (array_value, plain[quantity]))
                kappa = truth.conditions[quantity]
                tally.of("float64", quantity).take(
                    np.array([error]), FLOAT64_ALLOWED, FLOAT64_EPS, np.array([kappa]), f"{where}, x = {x!r}"
                )


def _plain(batch: Batch, x: float) -> dict[str, float]:
    """The same quantities through plain floats, as the control loop computes them."""
    law, device = batch.field, (batch.elastomer, batch.geometry)
    moment_Tm = x if law is None else law.radial_moment_Tm(x)
    values = {"force": brake_force_N(moment_Tm, *device), "stretch": stretch_minus_one(moment_Tm, *device)}
    back_Tm = radial_moment_for_force_Tm(values["force"], *device)
    if law is None:
        return {**values, "slope": d_force_d_moment(moment_Tm, *device), "round trip": back_Tm}
    return {
        **values,
        "slope": d_force_d_gap(x, law, *device),
        "curvature": d2_force_d_gap2(x, law, *device),
        "round trip": law.gap_mm(max(back_Tm, law.radial_moment_Tm(law.gap_range_mm[1]))),
    }


def _untyped_refusals(batch: Batch, admissible: NDArray[np.bool_]) -> int:
    """Outside the domain, and for what is no number: calls that do not raise the typed error naming the variable."""
    law, device = batch.field, (batch.elastomer, batch.geometry)
    calls: list[tuple[str, Any]] = []
    outside = batch.x[~admissible][:1]
    if outside.size:
        moment_Tm = outside if law is None else law.radial_moment_Tm(outside)
        calls += [("radial_moment_Tm", lambda f=f: f(moment_Tm, *device)) for f in (brake_force_N, stretch_minus_one)]
        calls += [("radial_moment_Tm", lambda: d_force_d_moment(float(moment_Tm[0]), *device))]
    for bad in (math.nan, math.inf, -1.0):
        calls += [("radial_moment_Tm", lambda bad=bad: brake_force_N(np.array([bad]), *device))]
        calls += [("force_N", lambda bad=bad: radial_moment_for_force_Tm(bad, *device))]
        if law is not None:
            calls += [("gap_mm", lambda bad=bad: law.radial_moment_Tm(bad))]
    if isinstance(law, ThesisFieldLaw):
        calls += [("gap_mm", lambda: law.d2_radial_moment_d_gap2(95.0)), ("gap_mm", lambda: law.radial_moment_Tm(95.1))]
    return sum(not _refuses(call, variable) for variable, call in calls)


def _refuses(call: Any, variable: str) -> bool:
    try:
        call()
    except DomainError as error:
        return error.variable == variable
    return False


def force_evaluations_per_s(seconds: float = 1.0) -> float:
    """Force law evaluations a second on this core: float64, an array of a million radial moments, median of runs."""
    elastomer = Elastomer(277.3e3, 4.0, 0.2)
    moments_Tm = PowerFieldLaw().radial_moment_Tm(np.linspace(45.0, 95.0, 1_000_000))
    durations: list[float] = []
    until = time.perf_counter() + seconds
    while time.perf_counter() < until or len(durations) < 3:
        start = time.perf_counter()
        brake_force_N(moments_Tm, elastomer, TORMAG)
        durations.append(time.perf_counter() - start)
    return len(moments_Tm) / float(np.median(durations))


def run(cases: int, references: int, seed: int, workers: int) -> dict[str, Any]:
    """All the checks; the object that `--json` prints."""
    started = time.perf_counter()
    devices = -(-cases // BATCH)
    chunks = [min(CHUNK, devices - first) for first in range(0, devices, CHUNK)]
    each = -(-references // devices)
    tally = Tally()
    # a fresh interpreter for each worker, so that the same seed gives the same cases everywhere
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context) as pool:
        steps = pool.submit(worst_step_errors, seed, max(50, references // 10))
        tasks = [pool.submit(check_chunk, seed + 1 + index, size, each) for index, size in enumerate(chunks)]
        for task in tqdm(as_completed(tasks), total=len(tasks), desc="devices", disable=not sys.stderr.isatty()):
            tally.add(task.result())
        time_steps = steps.result()
    tally.nonfinite += time_steps.nonfinite
    worst = {name: max((w.error for w in tally.worst.get(name, {}).values()), default=0.0) for name in PRECISIONS}
    shares = {
        name: max((w.over_allowed for w in tally.worst.get(name, {}).values()), default=0.0) for name in PRECISIONS
    }
    passed = (
        all(share <= 1.0 for share in (*shares.values(), *time_steps.over_allowed.values()))
        and tally.nonfinite == tally.untyped_refusals == tally.misjudged == 0
    )
    return {
        "cases": tally.cases,
        "reference_cases": tally.reference_cases,
        "worst_rel_error": worst,
        "worst_error_over_allowed": shares,
        "nonfinite": tally.nonfinite,
        "refused": tally.refused,
        "untyped_refusals": tally.untyped_refusals,
        "misjudged_domain": tally.misjudged,
        "quantities": {
            precision: {
                quantity: {
                    "worst_rel_error": found.error,
                    "worst_rel_error_ill_conditioned": found.ill_conditioned,
                    "over_allowed": found.over_allowed,
                    "condition_there": found.condition,
                    "where": found.where,
                }
                for quantity, found in sorted(quantities.items())
            }
            for precision, quantities in sorted(tally.worst.items())
        },
        "time_steps": time_steps.over_allowed,
        "time_step_cases": time_steps.cases,
        "passed": passed,
        "seconds": round(time.perf_counter() - started, 1),
    }


PRECISIONS = ("float64", "float32", "float32_soft")


def print_table(result: dict[str, Any]) -> None:
    """The result for people."""
    print(
        f"{result['cases']} cases, {result['reference_cases']} of them in {DIGITS} digits, {result['refused']} outside "
        f"the domain; not finite: {result['nonfinite']}, refused without a typed error: {result['untyped_refusals']}, "
        f"domain misjudged: {result['misjudged_domain']}"
    )
    columns = f"{'worst error':>12}{'ill-cond.':>12}{'of allowed':>12}{'kappa there':>13}"
    print(f"{'precision':14}{'quantity':14}{columns}")
    for precision in PRECISIONS:
        for quantity, found in result["quantities"].get(precision, {}).items():
            print(
                f"{precision:14}{quantity:14}{found['worst_rel_error']:12.2e}"
                f"{found['worst_rel_error_ill_conditioned']:12.2e}{found['over_allowed']:12.3f}"
                f"{found['condition_there']:13.3g}"
            )
    for name, share in result["time_steps"].items():
        print(f"{'time steps':14}{name:38}{share:12.3f}")
    print(f"{'passed' if result['passed'] else 'FAILED'} in {result['seconds']} s")


def main() -> int:
    """Runs the checks, or only the speed measurement; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--cases", type=int, default=1_000_000, help="inputs evaluated as arrays")
    parser.add_argument("--reference", type=int, default=12_000, help="of them, computed in 50 digits")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=WORKERS, help="processes")
    parser.add_argument("--speed", action="store_true", help="only measure evaluations of the force law a second")
    options = parser.parse_args()
    if options.cases < 1 or options.reference < 1 or options.workers < 1:
        parser.error("--cases, --reference and --workers are at least 1")
    if options.speed:
        result: dict[str, Any] = {"force_evaluations_per_s": round(force_evaluations_per_s())}
        print(json.dumps(result) if options.json else f"{result['force_evaluations_per_s'] / 1e6:.0f} million a second")
        return 0
    result = run(options.cases, options.reference, options.seed, options.workers)
    result["force_evaluations_per_s"] = round(force_evaluations_per_s())
    if options.json:
        print(json.dumps(result))
    else:
        print_table(result)
        print(f"force law: {result['force_evaluations_per_s'] / 1e6:.0f} million evaluations a second on one core")
    return 0 if result["passed"] else 1


if __name__ == "__main__":
    sys.exit(main())
