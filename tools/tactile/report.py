"""docs/learned_inverse.md from the figures of `tactile_experiment.py`."""

import textwrap
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from pictures.stamp import tables
from thesis.values import PULSE_MAE_MT, PULSE_MAX_MT, PULSE_SD_MT, TABLE_4_1

from tactile.plots import Material, draw_all

Json = dict[str, Any]

WAYS = {
    "mlp": "network alone, nearest",
    "mlp_thesis_search": "network alone, the thesis's search (epsilon 1.26 N)",
    "relaxation_aware": "with relaxation, force without noise",
    "relaxation_aware_noisy": "with relaxation, force with noise",
}


def write_report(folder: Path, figures: Json, material: Material) -> None:
    """Write learned_inverse.md into `folder`, and its pictures into `folder`/images."""
    pulse = figures["pulse"]
    parts = [
        _head(),
        _table_4_1(figures["table_4_1"]),
        _comparison(figures["comparison"]),
        _relaxation(figures["relaxation"]),
        _pulse(pulse),
        _hold(pulse["hold"]),
        _times(figures["solve_times"]),
    ]
    page = "\n".join(part.rstrip() + "\n" for part in parts)
    images = folder / "images"
    images.mkdir(exist_ok=True)
    draw_all(images, material, figures["comparison"], tables(page))
    (folder / "learned_inverse.md").write_text(page, encoding="utf-8")


def _head() -> str:
    return (
        "# The learned force model and its inverse\n\n"
        + _text(
            "Written by `python tools/tactile_experiment.py --out docs`; do not edit. **All data on this page are "
            "synthetic**: the thesis's measurements are not public. They come from `tormagd/simulation/pad.py`: a pad "
            "with hyperelasticity, stiffening by field that saturates and breaks down with strain, stiffening with "
            "rate, relaxation, conditioning, and plates that cannot pull. Moduli, sizes and full scales are the "
            "thesis's. Relaxing fractions and times are assumptions, so the figures compare models with each other, "
            "not with a laboratory."
        )
        + _text(
            "No model fitted here knows these laws. The relaxation-aware model knows that there are two parts that "
            "relax by themselves, which favours it; but it has four times for both, where the pad has four for each."
        )
        + "## Data\n\n"
        + _text(
            "3 classes x 11 fields x 2,100 samples = 69,300 rows: after a rest and three unrecorded passes, twelve "
            "triangular cycles between 0.2 and 4.5 mm at 1, 0.5, 4 and 2 mm/s. As in the thesis no holds are among "
            "them. Models with a memory learn from relaxation tests besides: a pad held for an hour at each of five "
            "fields, 1,500 samples each."
        )
    )


def _table_4_1(table: Json) -> str:
    chance = table["random"]
    rows = []
    for row in table["rows"]:
        cells = [
            cell
            for part in (row["train"], row["test"])
            for cell in (f"{part['mae_N']:.3f} ± {part['sd_N']:.3f}", f"{part['mae_percent']:.2f}", f"{part['r2']:.4f}")
        ]
        thesis = TABLE_4_1[row["class"]].test
        rows.append((row["class"], *cells, f"{thesis.mae_N:g} ± {thesis.sd_N:g}; {thesis.percent:g}; {thesis.r2:g}"))
    groups = [
        (
            name,
            f"{table[key]['r2']:.4f}",
            f"{table[key]['mae_N']:.3f}",
            ", ".join(f"{fold['left_out']:.4g}: {fold['mae_N']:.2f}" for fold in table[key]["folds"]),
        )
        for name, key in (
            ("one field, mT", "leave_one_field_out"),
            ("one class, %", "leave_one_class_out"),
            ("a quarter of the cycles", "leave_cycles_out"),
        )
    ]
    over = chance["mae_N"] / chance["noise_mae_N"] - 1
    network, aware = table["monotonicity"]["network"], table["monotonicity"]["relaxation_aware"]
    return (
        "## Table 4.1\n\n"
        f"4-50-1 network, Levenberg-Marquardt, random 70 : 30 split, sensor noise {table['sensor_noise_N']} N.\n\n"
        + _markdown(
            (
                "class",
                "train MAE, N",
                "MAE %",
                "R2",
                "test MAE, N",
                "MAE %",
                "R2",
                "thesis, test, measured data: MAE, N; %; R2",
            ),
            rows,
        )
        + "\n"
        + _text(
            f"The sensor's noise alone has a mean of {chance['noise_mae_N']:.3f} N: the network is {over:+.1%} from "
            "that floor. Random splits of a time series flatter. Whole groups left out (every third row, fewer "
            "epochs):"
        )
        + _markdown(("left out", "R2", "MAE, N", "MAE of each fold, N"), groups)
        + "\n"
        + _text(
            "The least and the greatest field, and classes A and C, are extrapolations; with three classes even the "
            "middle one is a guess. A class has to be measured before it is used: a network trained on three contents "
            "knows nothing between them."
        )
        + _text(
            "Monotonicity: the inverse needs a force that rises with the field. dF/dB <= 0 on "
            f"{network['not_rising_share_of_box']:.1%} of the network's training box, contents between the classes "
            f"included, and on {network['not_rising_share_where_scored']:.2%} of the places at the classes where the "
            "pad itself rises by 0.03 N/mT or more; the relaxation-aware model (one class): "
            f"{aware['not_rising_share_of_box']:.1%} and {aware['not_rising_share_where_scored']:.2%}. Where the force "
            "does not rise, at no field first of all, the searches answer by continuity."
        )
        + "![data and network](images/tactile_fit.png)\n![training](images/tactile_training.png)\n"
    )


def _comparison(comparison: list[Json]) -> str:
    def cell(row: Json, key: str) -> str:
        return f"{row[key]:.3f}" if key in row else ""

    rows = [
        (
            row["model"],
            *(cell(row, f"{split}_mae_N") for split in ("random", "field", "class", "cycles", "hold")),
            f"{row['fit_s']:.1f}",
            f"{row['predict_us_per_row']:.2f}",
            f"{row['memory_kB']:.0f}",
            "*" if row["pareto"] else "",
        )
        for row in comparison
    ]
    columns = (
        "model",
        "random",
        "one field",
        "class B",
        "a quarter of the cycles",
        "held 1 h",
        "fit, s",
        "µs a row",
        "memory, kB",
        "Pareto",
    )
    return (
        "## Forward models compared\n\n"
        + _text(
            "One interface (`tormagd.training.forward.ForwardModel`), the same third of the rows of all classes, MAE "
            "in N on rows left out. The noise floor is that of table 4.1. *Held*: an hour at 4.5 mm, MRE-C, at two "
            "fields that no model has seen; only the models with a memory have seen holds at all. Memory is what a "
            "prediction needs. Pareto: no other is faster and as good on the random split. Times hold whatever else "
            "the machine did."
        )
        + _markdown(columns, rows)
        + "\n![forward models](images/tactile_models.png)\n\n"
        + _text(
            "Support vectors learn from 2,500 rows, because their cost grows with the square. A forest is piecewise "
            "constant and gives an inverse no slope. The GRU learns over 350 rows at a time and is not told what a pad "
            "went through before a record."
        )
    )


def _relaxation(series: Json) -> str:
    rows = [
        ("time, s", *(f"{value:.4g}" for value in series["times_s"])),
        ("elastomer", *(f"{value:.4f}" for value in series["fractions"])),
        ("what the field adds", *(f"{value:.4f}" for value in series["field_fractions"])),
    ]
    return (
        "## The relaxation-aware model\n\n"
        + _text(
            "`tormagd.training.grey_box`: a 4-30-1 network for the force without memory and a Prony series for each "
            "of its parts, the elastomer's and the field's. Fitted to the pad in use, MRE-C alone: its cycles and its "
            "five holds. Fractions found:"
        )
        + _markdown(("", "1", "2", "3", "4"), rows)
    )


def _pulse(pulse: Json) -> str:
    rows = []
    for noise, scores in pulse["by_noise"].items():
        named = [(label, scores[way]) for way, label in WAYS.items()]
        named += [
            (f"with relaxation, other pad {index}", part) for index, part in enumerate(scores["other_pads"], start=1)
        ]
        named += [(f"with relaxation, arterial pressure {name}", part) for name, part in scores["other_pulses"].items()]
        rows += [
            (
                noise,
                label,
                f"{part['mae_mT']:.2f} ± {part['sd_mT']:.2f}",
                f"{part['max_mT']:.2f}",
                f"{part['elsewhere_force_mae_N']:.3f}",
            )
            for label, part in named
        ]
        rows.append((noise, "noise alone, 0.8 sigma / (dF/dB)", f"{scores['noise_bound_mae_mT']:.2f}", "", ""))
    return (
        "## The pulse experiment of section 4.3\n\n"
        + _text(
            "MRE-C, 4,322 samples at 160 Hz: to 4.5 mm at 1 mm/s, then held while the field follows a pulse between "
            f"100 and 200 mT: {pulse['shape']}. Rate by the two-point difference. The field is sought from the force. "
            f"Scored where |dF/dB| >= 0.03 N/mT: {pulse['scored_share']:.1%} of the samples. Elsewhere the force that "
            "the wrong field would cost counts. Models are trained and questioned with the same sensor."
        )
        + _markdown(("sensor noise, N", "way", "MAE, mT", "max, mT", "elsewhere, N"), rows)
        + "\n"
        + _text(
            f"Thesis, on its measured pulse: {PULSE_MAE_MT} ± {PULSE_SD_MT} mT, at most {PULSE_MAX_MT} mT. The network "
            "alone drifts as the thesis saw, and more. Its greatest error is early in the indentation: a rested pad "
            "is stiffer there than the cycled one of the training data, and the force depends little on the field. "
            "The other pads (constants drawn 3 to 15 % off, not trained on) show what a model is worth on a pad that "
            "it was not made for: a pad has to be measured itself."
        )
        + _text(
            "Why 17 mT and not 1.14: `tools/tactile_drift.py` repeats the experiment on pads that relax by a share of "
            "what ours does, each with a network of its own; see [the pad](tactile.md)."
        )
        + "![the pulse experiment](images/tactile_pulse.png)\n"
    )


def _hold(hold: Json) -> str:
    rows = [
        (
            label,
            f"{hold[key]['force_error_10min']:.2%}",
            f"{hold[key]['force_error_1h']:.2%}",
            f"{hold[key]['mean_force_error']:.3%}",
        )
        for key, label in (("without", "network alone"), ("with", "with relaxation"))
    ]
    return (
        "## Held for ten minutes and for an hour\n\n"
        "Pulses between 148 and 154 N rendered by feed-forward alone at 10 Hz, virtual time; greatest force error.\n\n"
        + _markdown(("model", "10 min", "1 h", "mean over 1 h"), rows)
        + "\n![hold](images/tactile_hold.png)\n"
    )


def _times(times: Json) -> str:
    def quantiles(row: Json) -> tuple[str, ...]:
        return f"{row['solves']}", *(f"{row[f'{name}_us']:.1f}" for name in ("p50", "p99", "p999"))

    rows = [
        (
            row["name"],
            *quantiles(row),
            f"{row['solver_mae_mT']:.2g}",
            f"{row['solver_max_mT']:.2g}",
            f"{row['plant_mae_mT']:.3f}",
            f"{row['plant_max_mT']:.2f}",
        )
        for row in times["searches"]
    ]
    rows.append(("nearest 2 mT, and the memory before and after", *quantiles(times["with_memory"]), "", "", "", ""))
    ratios = ", ".join(f"{name} {ratio:.1f}" for name, ratio in times["times_faster_than"].items())
    environment = ", ".join(f"{name} {value}" for name, value in times["environment"].items())
    return (
        "## Solve time at that accuracy\n\n"
        + _text(
            f"The searches on the relaxation-aware model ({times['hidden']} units) along the pulse experiment, "
            "noise-free force freed of memory; one thread, garbage collector frozen. The *solver error* is the "
            "distance to the network's own root, the *plant error* that to the reference field. The baselines are the "
            "thesis's search: row by row in torch, stopping within 1.26 N or seeing every row, and as one array; 1 "
            f"mT. ({environment})"
        )
        + _markdown(
            (
                "search",
                "solves",
                "p50, us",
                "p99, us",
                "p99.9, us",
                "solver MAE, mT",
                "max, mT",
                "plant MAE, mT",
                "max, mT",
            ),
            rows,
        )
        + f"\nTimes faster (p50) than: {ratios}.\n"
    )


def _markdown(columns: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    head = list(columns)
    lines = [head, ["---"] * len(head), *(list(row) for row in rows)]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _text(text: str) -> str:
    return textwrap.fill(text, 120, break_long_words=False, break_on_hyphens=False) + "\n\n"
