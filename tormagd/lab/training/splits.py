"""Which rows a model may learn from, and which judge it: at random as in the thesis, and by whole groups."""

from collections.abc import Iterator

import numpy as np

from tormagd.lab.arrays import Mask
from tormagd.lab.errors import LabError
from tormagd.lab.training.dataset import Dataset
from tormagd.model.features import FEATURES

TEST_SHARE = 0.3
"""Of the thesis: 70 : 30."""


def random_split(rows: int, seed: int, share: float = TEST_SHARE) -> Mask:
    """Mask (rows) of the rows held out: `share` of them, scattered.

    Rows of a time series are nearly copies of their neighbours: this split flatters, and is for comparison only.
    Raises `LabError` when nothing would be held out, or nothing left.
    """
    count = round(share * rows)
    if not 0 < count < rows:
        raise LabError(f"share = {share} of {rows} rows is not allowed: it holds out nothing or leaves nothing")
    held = np.zeros(rows, dtype=np.bool_)
    held[np.random.default_rng(seed).permutation(rows)[:count]] = True
    return held


def leave_one_out(dataset: Dataset, feature: str) -> Iterator[tuple[float, Mask]]:
    """Each value of `feature` (whole fields, whole classes) in turn, with the mask of the rows that have it.

    Raises `LabError` for a feature with one value only: nothing would be left to learn from.
    """
    column = dataset.features[:, FEATURES.index(feature)]
    values = np.unique(column)
    if len(values) < 2:
        raise LabError(f"{feature} has one value only, {values[0]:g}: it cannot be left out")
    for value in values:
        yield float(value), column == value


def leave_cycles_out(dataset: Dataset, folds: int, seed: int) -> Iterator[tuple[int, Mask]]:
    """Each fold's number and the mask of its rows: whole cycles, every cycle in one fold.

    Raises `LabError` without cycle labels, or with fewer cycles than folds.
    """
    if dataset.cycle is None:
        raise LabError("cycle: needed to leave cycles out, and the data have none")
    labels = np.unique(dataset.cycle)
    if not 2 <= folds <= len(labels):
        raise LabError(f"folds = {folds} is not allowed, only 2 to the number of cycles, {len(labels)}")
    parts = np.array_split(np.random.default_rng(seed).permutation(labels), folds)
    for fold, part in enumerate(parts):
        yield fold, np.isin(dataset.cycle, part)
