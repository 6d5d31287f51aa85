"""Recompute the thesis's tables and figures: thesis value, ours, error, note.

Where the thesis measured, its printed measurements are the reference. The step test runs on the simulated device, and
table 4.1 and the pulse on a simulated pad (synthetic).
"""

import argparse
import os
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np

from tormag_lab.arrays import Json
from tormag_lab.design.brake import CLOSED_MM, OPEN_MM, Brake, energy_at_shaft, stretch_minus_one
from tormag_lab.design.optimisation import Design, Problem, Run, coverage, sweep
from tormag_lab.design.phase_portrait import PhasePortrait
from tormag_lab.design.range_fit import RangeFit, fit_exponent, fit_friction, leave_one_out, mean_relative_error
from tormag_lab.human_pulse import pulse_profile
from tormag_lab.main import GAP_SPEED, SEED, WORKERS, Found
from tormag_lab.pages import write_page
from tormag_lab.thesis import page
from tormag_lab.thesis.errata import errata
from tormag_lab.thesis.step_test import StepTest, step_test
from tormag_lab.thesis.table_2_5 import table_2_5
from tormag_lab.thesis.values import (
    AS_BUILT,
    FIGURE_2_5_MEASURED_N,
    FIGURE_2_5_N,
    GAP_SPEED_MM_S,
    TABLE_2_3_MASSES_G,
    TABLE_2_4_MAX_PERCENT,
    TABLE_2_4_MEAN_PERCENT,
    USE_CASES,
)
from tormagd.element.physics.field import FieldLaw, PowerFieldLaw, ThesisFieldLaw
from tormagd.element.physics.force import TORMAG, Elastomer
from tormagd.element.physics.inserts import INSERTS, Insert, insert

CONTROLLER_SPEED_MM_S = 40.0
"Two carriages at 150 rpm on 8 mm screws; a measured speed goes in with --gap-speed."
STEP_INSERTS = ("MRE-50-40", "MRE-30-30", "MRE-10-20")
PULSE_N = (1.4, 1.7)
PULSE_S, PULSE_HZ = 20.0, 500


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=Path, metavar="DIR", help="write both pages and their pictures there")
    parser.add_argument("--gap-speed", type=GAP_SPEED, default=CONTROLLER_SPEED_MM_S, help="the controller's, mm/s")
    parser.add_argument("--workers", type=WORKERS, default=os.cpu_count() or 1)
    parser.add_argument("--seed", type=SEED, default=1)


def run(options: argparse.Namespace) -> Found:
    """Recompute all of it; what was stopped by Ctrl-C has the parts that were done."""
    result: Json = {
        "table_2_3": table_2_3(),
        "table_2_4": table_2_4(),
        "table_2_5": table_2_5(),
        "figure_2_5": figure_2_5(),
        "errata": errata(),
    }
    tests: list[StepTest] = []
    with ProcessPoolExecutor(options.workers) as pool:
        learned = pool.submit(chapter_4)
        steps = [pool.submit(step_test, insert(name), options.seed) for name in STEP_INSERTS]
        try:
            tests += [step.result() for step in steps]
            result["figure_2_7"] = figure_2_7(tests)
            result["phase_portrait"] = phase_portrait(GAP_SPEED_MM_S, tests[0].gap_speed_mm_s, options.gap_speed)
            runs = table_3_2_runs(options.gap_speed, options.seed)
            result["table_3_2"] = table_3_2(runs, sweep(runs.values(), pool), options.gap_speed)
            result |= learned.result()
        except KeyboardInterrupt:
            pool.shutdown(cancel_futures=True)
    if options.out is not None:
        from tormag_lab.thesis.plots import pictures

        folder = options.out / "reproduction"
        write_page(options.out / "reproduction.md", page.sections(result), folder, pictures(result, tests))
        if "pulse" in result:
            from tormag_lab.tactile import report  # loads torch

            write_page(options.out / "learned_inverse.md", report.sections(result), folder, {})
    return Found(result, page.sections(result), 0 if "pulse" in result else 130)


def chapter_4() -> Json:
    from tormag_lab.tactile import models, report  # load torch and scikit-learn

    return report.chapter_4(models.FULL)


def table_2_3() -> Json:
    """Return each insert's masses, g in 100 cc, from volume fractions, beside the printed ones."""
    rows: list[Json] = []
    for item in INSERTS.values():
        printed = TABLE_2_3_MASSES_G[round(100 * item.cip_fraction)]
        rows.append(
            {
                "insert": item.name,
                "thesis_g": printed,
                "ours_g": {name: round(mass, 3) for name, mass in item.masses_g.items()},
                "max_error_g": max(abs(item.masses_g[name] - mass) for name, mass in printed.items()),
                "G0_kPa": 1e-3 * item.shear_modulus_Pa,
            }
        )
    return {
        "rows": rows,
        "max_error_g": max(row["max_error_g"] for row in rows),
    }


def table_2_4() -> Json:
    """Return friction fitted to the measured ranges, with Eq. 7 and with the power law."""
    ours, beside = _range_fit(ThesisFieldLaw()), _range_fit(PowerFieldLaw())
    return {
        **ours,
        "power_field_law": {name: value for name, value in beside.items() if name != "rows"},
        "thesis": {"mean_rel_error": TABLE_2_4_MEAN_PERCENT / 100, "max_rel_error": TABLE_2_4_MAX_PERCENT / 100},
        "registry": _registry_errors(),
        "measure": "F(45 mm) - F(95 mm) against the measured range of table 2.4; one friction coefficient per matrix, "
        "chosen for the least mean relative error; field law Eq. 7",
    }


def _range_fit(law: FieldLaw) -> Json:
    known = list(INSERTS.values())
    fixed, free = fit_friction(known, law), fit_exponent(known, law)
    left_out = leave_one_out(known, law, free_exponent=False)
    left_out_free = leave_one_out(known, law, free_exponent=True)
    return {
        "mean_rel_error": mean_relative_error(fixed, known),
        "max_rel_error": max(fixed.relative_error(item) for item in known),
        "mean_rel_error_free_exponent": mean_relative_error(free, known),
        "max_rel_error_free_exponent": max(free.relative_error(item) for item in known),
        "leave_one_out_mean_rel_error": float(np.mean(list(left_out.values()))),
        "leave_one_out_mean_rel_error_free_exponent": float(np.mean(list(left_out_free.values()))),
        "friction": dict(fixed.friction),
        "exponent": free.exponent,
        "friction_free_exponent": dict(free.friction),
        "rows": [_range_row(item, fixed, free, left_out[item.name]) for item in known],
    }


def _registry_errors() -> Json:
    """Return the errors of range with the registry's friction, which the simulated device has."""
    known = list(INSERTS.values())
    friction = {item.shore_hardness: item.elastomer.friction_coefficient for item in known}
    used = RangeFit(ThesisFieldLaw(), friction, exponent=1.0)
    return {
        "friction": friction,
        "mean_rel_error": mean_relative_error(used, known),
        "max_rel_error": max(used.relative_error(item) for item in known),
    }


def _range_row(item: Insert, fixed: RangeFit, free: RangeFit, left_out: float) -> Json:
    ranges = item.force_range
    return {
        "insert": item.name,
        "measured_N": ranges.measured_N,
        "deviation_N": ranges.deviation_N,
        "thesis_N": ranges.thesis_estimate_N,
        "thesis_rel_error": abs(ranges.thesis_estimate_N / ranges.measured_N - 1.0),
        "ours_N": fixed.range_N(item),
        "rel_error": fixed.relative_error(item),
        "ours_free_exponent_N": free.range_N(item),
        "rel_error_free_exponent": free.relative_error(item),
        "leave_one_out_rel_error": left_out,
    }


def figure_2_5() -> Json:
    """Return the least and greatest force over permeability and shear modulus, by both field laws."""
    permeabilities = np.linspace(2.0, 4.0, 9)
    moduli_kPa = np.linspace(80.0, 280.0, 11)
    result: Json = {}
    laws: tuple[tuple[str, FieldLaw], ...] = (("eq_7", ThesisFieldLaw()), ("power", PowerFieldLaw()))
    elastomer = Elastomer(277e3, 4.0, 0.2)
    for name, law in laws:
        at_point, moment_Tm = Brake.as_built(elastomer, law), float(law.radial_moment_Tm(CLOSED_MM))
        stretch = 1.0 + float(stretch_minus_one(moment_Tm, elastomer, TORMAG))
        grid = [
            [Brake.as_built(Elastomer(1e3 * float(g0), float(mu_r), 0.2), law) for g0 in moduli_kPa]
            for mu_r in permeabilities
        ]
        result[name] = {
            "working_point_N": [at_point.least_N, at_point.most_N],
            "error_N": [at_point.least_N - FIGURE_2_5_N[0], at_point.most_N - FIGURE_2_5_N[1]],
            "closed": {
                "stretch": stretch,
                **energy_at_shaft(stretch, moment_Tm / TORMAG.inner_radius_m, elastomer),
            },
            "least_N": [[brake.least_N for brake in row] for row in grid],
            "most_N": [[brake.most_N for brake in row] for row in grid],
        }
    return {
        **result,
        "relative_permeability": permeabilities.tolist(),
        "shear_modulus_kPa": moduli_kPa.tolist(),
        "thesis_working_point_N": list(FIGURE_2_5_N),
        "measured_earlier_N": list(FIGURE_2_5_MEASURED_N),
        "note": "mu_r 4, G0 277 kPa, mu_d 0.2, 95 and 45 mm.",
    }


def figure_2_7(tests: list[StepTest]) -> Json:
    """Return the simulated device's settled forces beside the force law, and all inserts' ranges."""
    rows = []
    for test in tests:
        analytic_N = Brake.as_built(insert(test.insert).elastomer).force_N(test.level_gap_mm)
        rows.append(
            {
                "insert": test.insert,
                "gap_mm": test.level_gap_mm.tolist(),
                "simulated_N": test.level_force_N.tolist(),
                "analytic_N": analytic_N.tolist(),
                "rel_error": (test.level_force_N / analytic_N - 1.0).tolist(),
                "simulated_range_N": float(test.level_force_N[-1] - test.level_force_N[0]),
                "measured_range_N": insert(test.insert).force_range.measured_N,
            }
        )
    ranges = []
    for item in INSERTS.values():
        least_N, most_N = Brake.as_built(item.elastomer).force_N(np.array([OPEN_MM, CLOSED_MM]))
        ranges.append(
            {
                "insert": item.name,
                "matrix": item.name.rpartition("-")[0],
                "cip_percent": 100.0 * item.cip_fraction,
                "least_N": float(least_N),
                "most_N": float(most_N),
                "measured_range_N": item.force_range.measured_N,
            }
        )
    return {
        "rows": rows,
        "ranges": ranges,
        "rpm": 20.0,
        "note": "Simulated, sample 1 with each insert's values, 5 s a step, between 94.5 and 45.5 mm. The elastomer "
        "relaxes and warms, so it stays below the force law.",
    }


def phase_portrait(*gap_speeds_mm_s: float) -> Json:
    """Return how much of both use cases and of a measured pulse the device as built covers."""
    rows = []
    for number, case in USE_CASES.items():
        for speed in gap_speeds_mm_s:
            portrait = Problem(case.region, "true", speed).portrait(AS_BUILT)
            rows.append(
                {
                    "use_case": number,
                    "gap_speed_mm_s": speed,
                    "trapezoid": portrait.trapezoid_coverage(case.region),
                    "true": portrait.true_coverage(case.region),
                    "thesis": case.initial_percent / 100,
                }
            )
    return {
        "as_built": rows,
        "pulse": _pulse_cloud(gap_speeds_mm_s),
        "note": "Gap speeds: the thesis's, the simulated device's in a step of 10 mm, the fastest. R_o 11, t 20, "
        "s_max 95 mm, G0 300 kPa, mu_r 3.8, mu_d 0.2, power field law.",
    }


def _pulse_cloud(gap_speeds_mm_s: tuple[float, ...]) -> Json:
    """Return how many (force, rate) points of a measured pulse MRE-50-40 renders at each gap speed."""
    times_s, forces_N = pulse_profile(PULSE_S, *PULSE_N, PULSE_HZ)
    rates_N_s = np.gradient(forces_N, times_s)
    brake = Brake.as_built(insert("MRE-50-40").elastomer)
    rows = []
    for speed in gap_speeds_mm_s:
        portrait = PhasePortrait(brake, speed)
        true, trapezoid = (judge(forces_N, rates_N_s) for judge in (portrait.true_cloud, portrait.trapezoid_cloud))
        rows.append(
            {
                "gap_speed_mm_s": speed,
                "true": float(true.mean()),
                "trapezoid": float(trapezoid.mean()),
                "points": len(forces_N),
                "too_fast": int((~true).sum()),
            }
        )
    return {
        "insert": "MRE-50-40",
        "range_N": list(PULSE_N),
        "rows": rows,
        "note": "A measured photoplethysmogram (heartpy), scaled to newtons; not a measured force.",
    }


RunKey = tuple[int, int, str]
"""Use case, start, objective."""


def table_3_2_runs(gap_speed_mm_s: float, seed: int) -> dict[RunKey, Run]:
    return {
        (number, index, objective): Run(problem, line.start, seed)
        for number, case in USE_CASES.items()
        for objective, problem in _problems(number, gap_speed_mm_s).items()
        for index, line in enumerate(case.starts, start=1)
    }


def _problems(use_case: int, gap_speed_mm_s: float) -> dict[str, Problem]:
    region = USE_CASES[use_case].region
    return {
        "trapezoid": Problem(region, "trapezoid", GAP_SPEED_MM_S),
        "true": Problem(region, "true", gap_speed_mm_s),
        "true_thesis_speed": Problem(region, "true", GAP_SPEED_MM_S),
    }


def table_3_2(runs: dict[RunKey, Run], outcomes: dict[Run, Json], gap_speed_mm_s: float) -> Json:
    """Return the optima by each measure, beside the thesis's designs."""
    designs = []
    for number, case in USE_CASES.items():
        problems = _problems(number, gap_speed_mm_s)
        found = [
            (f"thesis, start {index}", each.thesis, each.thesis_percent) for index, each in enumerate(case.starts, 1)
        ]
        for name, design, percent in (("as built", AS_BUILT, case.initial_percent), *found):
            reached = {objective: coverage(problem, design) for objective, problem in problems.items()}
            designs.append(
                {"use_case": number, "name": name, "design": _design(design), "thesis": percent / 100, "ours": reached}
            )
    return {
        "starts": [
            {
                "use_case": use_case,
                "start": start,
                "objective": objective,
                "design": _design(outcomes[run]["design"]),
                "volume_cm3": 1e-3 * outcomes[run]["volume_mm3"],
                **{name: outcomes[run][name] for name in ("coverage", "seconds")},
            }
            for (use_case, start, objective), run in runs.items()
        ],
        "thesis_designs": designs,
        "gap_speed_mm_s": {"trapezoid": GAP_SPEED_MM_S, "true": gap_speed_mm_s, "true_thesis_speed": GAP_SPEED_MM_S},
        "note": "R_i 4 mm, bounds of Eq. 40-42, G0 300 kPa, mu_r 3.8, mu_d 0.2, power field law. Use case 1 starts at "
        "(0 N, 0 N/s).",
    }


def _design(design: Design) -> Json:
    return {"R_o_mm": design.outer_radius_mm, "t_mm": design.thickness_mm, "s_max_mm": design.open_mm}
