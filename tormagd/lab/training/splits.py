"""Which rows a model may learn from, and which judge it: at random as in the thesis, and by whole groups."""

from collections.abc import Iterator

import numpy as np

from tormagd.lab.arrays import Mask
from tormagd.lab.training.dataset import Dataset
from tormagd.model.features import FEATURES

TEST_SHARE = 0.3
"""Of the thesis: 70 : 30."""


def random_split(rows: int, seed: int, share: float = TEST_SHARE) -> Mask:
    """Mask (rows) of the rows held out: `share` of them, scattered.

    Rows of a time series are nearly copies of their neighbours: this split flatters, and is for comparison only.
    """
    held = np.zeros(rows, dtype=np.bool_)
    held[np.random.default_rng(seed).permutation(rows)[: round(share * rows)]] = True
    return held


def leave_one_out(dataset: Dataset, feature: str) -> Iterator[tuple[float, Mask]]:
    """Each value of `feature` (whole fields, whole classes) in turn, with the mask of the rows that have it."""
    column = dataset.features[:, FEATURES.index(feature)]
    for value in np.unique(column):
        yield float(value), column == value


def leave_cycles_out(dataset: Dataset, folds: int, seed: int) -> Iterator[tuple[int, Mask]]:
    """Each fold's number and the mask of its rows: whole cycles, every cycle in one fold; the data have cycles."""
    assert dataset.cycle is not None
    parts = np.array_split(np.random.default_rng(seed).permutation(np.unique(dataset.cycle)), folds)
    for fold, part in enumerate(parts):
        yield fold, np.isin(dataset.cycle, part)
