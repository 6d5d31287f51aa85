"""Train a force model from recorded data and write it as a model file.

tormag-lab train-model DATA.csv --element torque --insert MRE-50-40 --out FILE.safetensors

A network takes some hundreds of rows, and the package torch. The law of a brake (--law) takes fifty, and no torch.
"""

import argparse
import datetime
import sys
from pathlib import Path
from typing import Any

from tormag_lab.errors import LabError
from tormag_lab.main import SEED, Found
from tormag_lab.training.dataset import Dataset, read_csv
from tormag_lab.training.law import fit_law_model
from tormag_lab.training.unremembered import identify
from tormagd.element.model.features import Element
from tormagd.element.model.memory import NO_MEMORY
from tormagd.element.model.model_file import ForceModel, save_model
from tormagd.ground.terminal import write_line


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "data", type=Path, metavar="DATA.csv", help="training CSV; a `cycle` column keeps cycles together"
    )
    parser.add_argument("--element", type=Element, choices=list(Element), required=True, help="what was measured")
    parser.add_argument(
        "--insert", required=True, nargs="+", help="the insert it was measured on, such as MRE-50-40, or several"
    )
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.safetensors")
    parser.add_argument("--hidden", type=int, default=50, help="hidden units (default: 50)")
    parser.add_argument("--epochs", type=int, default=200, help="most steps of the training (default: 200)")
    parser.add_argument("--seed", type=SEED, default=0, help="decides the split and the initial weights (default: 0)")
    parser.add_argument("--validation-share", type=float, default=0.3, help="rows or cycles held out (default: 0.3)")
    parser.add_argument(
        "--without-memory", action="store_true", help="take out what relaxation and hysteresis did; needs time_s"
    )
    parser.add_argument(
        "--rising", action="store_true", help="train a force that rises with the field everywhere, whatever the data"
    )
    parser.add_argument(
        "--law",
        action="store_true",
        help="fit the law of a brake with one insert, which rises with the field",
    )
    parser.add_argument("--created", type=datetime.date.fromisoformat, help="date in the file (default: today)")


def run(options: argparse.Namespace) -> Found:
    if options.out.is_dir() or not options.out.parent.is_dir():
        raise LabError(f"cannot write {options.out}: allowed is a file in a folder that exists")
    if options.law and (options.element is not Element.TORQUE or len(options.insert) > 1):
        raise LabError("--law: allowed is --element torque with one --insert: the law is of a brake")
    model, told = fit(options, read_csv(options.data))
    save_model(options.out, model, options.data)
    report = {"out": str(options.out), "data_sha256": model.metadata.training_data_sha256, **model.metadata.metrics}
    return Found(report | told)


def fit(options: argparse.Namespace, data: Dataset) -> tuple[ForceModel, dict[str, str]]:
    if not options.law:
        from tormag_lab.training.fitting import fit_model  # loads torch, which a law does without
    data_sha256, memory = data.sha256(), NO_MEMORY
    if options.without_memory:
        memory, data = identify(data)
        terms = zip(memory.fractions, memory.times_s, strict=True)
        relaxing = ", ".join(f"{fraction:.1%} in {time_s:.0f} s" for fraction, time_s in terms)
        told = f"taken out: relaxation of {relaxing}; a field {memory.lag_mT:.1f} mT behind"
        write_line(told, sys.stderr)
    sides = data.split(options.validation_share, options.seed)
    created = options.created or datetime.date.today()
    steps: dict[str, Any] = {"hidden": options.hidden, "epochs": options.epochs, "seed": options.seed, "memory": memory}
    if options.law:
        [name] = options.insert
        return fit_law_model(*sides, insert_name=name, data_sha256=data_sha256, created=created, **steps), {}
    model, training = fit_model(
        *sides,
        element=options.element,
        inserts=options.insert,
        data_sha256=data_sha256,
        created=created,
        rising=options.rising,
        **steps,
    )
    return model, {"stopped_by": training.stopped_by}
