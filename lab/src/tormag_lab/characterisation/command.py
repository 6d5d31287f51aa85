"""Material constants from a laboratory's records: shear modulus from a compression or tension test, relaxation.

    tormag-lab characterise compression FILE.csv [--diameter-mm 30 --height-mm 12.5 --cycle 4]
    tormag-lab characterise tension FILE.csv [--strain COLUMN --stress-mpa COLUMN --delimiter ";" --to-strain 0.5]
    tormag-lab characterise relaxation FILE.csv [--branches 3]

Compression files hold time_s,displacement_mm,force_N; relaxation files time_s,driving,force_N, the first row at rest.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from tormag_lab.characterisation.compression import (
    CYCLES,
    Sample,
    StressStretch,
    deviations,
    evaluated_cycle,
    read_compression,
)
from tormag_lab.characterisation.elasticity import fit_neo_hookean, fit_ogden, fit_thesis_ogden
from tormag_lab.characterisation.relaxation import RelaxationRecord, fit_relaxation
from tormag_lab.main import Found
from tormag_lab.tables import read_columns


def add_options(parser: argparse.ArgumentParser) -> None:
    kinds = parser.add_subparsers(required=True)
    pressed, pulled, held = (kinds.add_parser(name) for name in ("compression", "tension", "relaxation"))
    for kind, handle in ((pressed, compression), (pulled, tension), (held, relaxation)):
        kind.add_argument("file", type=Path)
        kind.set_defaults(handle=handle)
    pressed.add_argument("--diameter-mm", type=float, default=30.0)
    pressed.add_argument("--height-mm", type=float, default=12.5)
    pressed.add_argument("--cycle", type=int, default=CYCLES, help="the cycle evaluated, counted from 1")
    pulled.add_argument("--strain", default="Engineering Strain", help="column of engineering strain")
    pulled.add_argument("--stress-mpa", default="Engineering Stress (MPa)", help="column of engineering stress")
    pulled.add_argument("--delimiter", default=",", choices=(",", ";", "\t", "|", " "))
    pulled.add_argument("--from-strain", type=float, default=0.05, help="leaves out the slack of the grips")
    pulled.add_argument("--to-strain", type=float, default=0.5)
    for kind in (pressed, pulled):
        kind.add_argument("--terms", type=int, default=1, help="terms of the Ogden law")
    held.add_argument("--branches", type=int, default=3)


def run(options: argparse.Namespace) -> Found:
    return Found(options.handle(options))


def compression(options: argparse.Namespace) -> dict[str, Any]:
    record, sample = read_compression(options.file), Sample(options.diameter_mm, options.height_mm)
    curve = evaluated_cycle(record, sample, options.cycle)
    return {"cycle": options.cycle, "deviations": deviations(record, sample), **moduli(curve, options.terms)}


def tension(options: argparse.Namespace) -> dict[str, Any]:
    names = (options.strain, options.stress_mpa)
    columns = read_columns(options.file, names, delimiter=options.delimiter)
    strain, stress_MPa = (columns[name] for name in names)
    chosen = (strain >= options.from_strain) & (strain <= options.to_strain)
    return moduli(StressStretch(1.0 + strain[chosen], 1e6 * stress_MPa[chosen]), options.terms)


def moduli(curve: StressStretch, terms: int) -> dict[str, Any]:
    """Fit three laws to a curve, and return the shear modulus and R2 of each."""
    neo_hookean, ogden = fit_neo_hookean(*curve), fit_ogden(*curve, terms=terms)
    thesis = fit_thesis_ogden(*curve)
    return {
        "points": len(curve.stretch),
        "stretch": [float(np.min(curve.stretch)), float(np.max(curve.stretch))],
        "neo_hookean": {"shear_modulus_kPa": 1e-3 * neo_hookean.shear_modulus_Pa, "r2": neo_hookean.r2},
        "ogden": {
            "shear_modulus_kPa": 1e-3 * ogden.shear_modulus_Pa,
            "moduli_kPa": [1e-3 * modulus_Pa for modulus_Pa in ogden.moduli_Pa],
            "exponents": list(ogden.exponents),
            "r2": ogden.r2,
        },
        "thesis_eq_3": {
            "shear_modulus_kPa": 1e-3 * thesis.shear_modulus_Pa,
            "G_o_kPa": 1e-3 * 2.0 * thesis.shear_modulus_Pa / thesis.exponents[0],
            "alpha": thesis.exponents[0],
            "r2": thesis.r2,
        },
    }


def relaxation(options: argparse.Namespace) -> dict[str, Any]:
    record = RelaxationRecord(**read_columns(options.file, RelaxationRecord._fields))
    fit = fit_relaxation(record, options.branches)
    return {
        "fractions": list(fit.series.fractions),
        "times_s": list(fit.series.times_s),
        "scale_N": fit.scale_N,
        "r2": fit.r2,
        "rms_N": fit.rms_N,
    }
