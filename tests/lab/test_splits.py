"""Splits by group hold out whole groups, once each."""

import numpy as np
import pytest

from tormagd.lab.training.dataset import Dataset
from tormagd.lab.training.metrics import leave_cycles_out, leave_one_out, random_split


@pytest.fixture
def data() -> Dataset:
    field, cip = np.repeat([0.0, 50.0, 99.0], 20), np.tile(np.repeat([25.0, 45.0], 10), 3)
    features = np.column_stack((np.linspace(0, 4, 60), np.ones(60), field, cip))
    return Dataset(features, np.linspace(0, 1, 60), np.arange(60) // 4)


def test_random_split_has_its_share_and_its_seed() -> None:
    held = random_split(1000, 3)
    assert held.sum() == 300
    assert (held == random_split(1000, 3)).all()
    assert (held != random_split(1000, 4)).any()


@pytest.mark.parametrize(("feature", "column", "values"), [("field_mT", 2, [0, 50, 99]), ("cip_percent", 3, [25, 45])])
def test_each_value_is_left_out_once(data: Dataset, feature: str, column: int, values: list[float]) -> None:
    folds = list(leave_one_out(data, feature))
    assert [value for value, _ in folds] == values
    for value, held in folds:
        assert set(data.features[held, column]) == {value}
        assert value not in data.features[~held, column]
    assert (np.sum([held for _, held in folds], axis=0) == 1).all()


def test_cycles_stay_whole(data: Dataset) -> None:
    folds = [held for _, held in leave_cycles_out(data, 4, seed=0)]
    assert (np.sum(folds, axis=0) == 1).all()
    assert data.cycle is not None
    assert not any(set(data.cycle[held]) & set(data.cycle[~held]) for held in folds)
