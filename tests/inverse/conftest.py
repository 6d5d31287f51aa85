"""Synthetic models whose shape over the field is known."""

import datetime

import numpy as np
import pytest
import torch

from tormagd.model.features import UNITS, Element, Scaling
from tormagd.model.model_file import ForceModel, ModelMetadata

torch.set_num_threads(1)  # a second thread costs more than it saves at this size, and waits for a busy processor

RANGES = {
    "displacement_mm": (0.0, 1.0),
    "rate_mm_s": (0.0, 60.0),
    "field_mT": (100.0, 800.0),
    "cip_percent": (40.0, 40.0),
    "force_N": (0.0, 6.0),
}


def make_model(weight: np.ndarray, bias: np.ndarray, output: np.ndarray, constant: float) -> ForceModel:
    """Build a model of scaled weights over the ranges of a torque element."""
    metadata = ModelMetadata(
        element=Element.TORQUE,
        insert="synthetic",
        hidden=len(bias),
        ranges={name: RANGES[name] for name in UNITS},
        scaling=Scaling((0.5, 30.0, 450.0, 40.0), (2.0, 1 / 30, 1 / 350, 0.0), 3.0, 1 / 3),
        training_data_sha256="0" * 64,
        metrics={},
        created=datetime.date(2024, 1, 1),
    )
    return ForceModel(metadata, weight, bias, output, constant)


@pytest.fixture(scope="session")
def rising() -> ForceModel:
    """Force that rises with the field everywhere, 50 units."""
    rng = np.random.default_rng(7)
    weight = rng.normal(size=(50, 4))
    weight[:, 2] = np.abs(weight[:, 2]) + 0.1
    return make_model(weight, rng.normal(size=50), np.abs(rng.normal(size=50)) / 20, -1.0)


@pytest.fixture(scope="session")
def bump() -> ForceModel:
    """Force that rises to a greatest value near 450 mT and falls again, the same on both sides."""
    weight = np.zeros((2, 4))
    weight[:, 2] = 8.0, -8.0
    return make_model(weight, np.array([4.0, 4.0]), np.array([1.5, 1.5]), -2.0)


@pytest.fixture(scope="session")
def lopsided() -> ForceModel:
    """Force that rises steeply to its greatest value near 450 mT and falls gently."""
    weight = np.zeros((2, 4))
    weight[:, 2] = 40.0, -4.0
    return make_model(weight, np.array([4.0, 4.0]), np.array([1.5, 1.5]), -2.0)


@pytest.fixture(scope="session")
def plateau() -> ForceModel:
    """Force that climbs steeply at 450 mT and is flat to the last bit on both sides."""
    weight = np.zeros((1, 4))
    weight[:, 2] = 500.0
    return make_model(weight, np.zeros(1), np.array([1.0]), 0.0)


@pytest.fixture(scope="session")
def creeping() -> ForceModel:
    """The plateau, with a rise of 8 units of rounding across it."""
    weight = np.zeros((2, 4))
    weight[:, 2] = 500.0, 1.0
    return make_model(weight, np.zeros(2), np.array([1.0, 1e-14]), -0.9)
