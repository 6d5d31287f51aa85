"""A small synthetic model to store, load and question."""

import datetime

import numpy as np
import pytest

from tormagd.model.features import Element, Scaling
from tormagd.model.model_file import ForceModel, ModelMetadata


@pytest.fixture
def metadata() -> ModelMetadata:
    return ModelMetadata(
        element=Element.TORQUE,
        insert="MRE-50-40",
        hidden=6,
        ranges={
            "displacement_mm": (0.0, 1.0),
            "rate_mm_s": (0.0, 60.0),
            "field_mT": (100.0, 800.0),
            "cip_percent": (40.0, 40.0),
            "force_N": (0.1, 5.7),
        },
        scaling=Scaling((0.5, 30.0, 450.0, 40.0), (2.0, 1 / 30, 1 / 350, 0.0), 2.9, 1 / 2.8),
        training_data_sha256="ab" * 32,
        metrics={"validation_r2": 0.99},
        created=datetime.date(2024, 2, 29),
    )


@pytest.fixture
def model(metadata: ModelMetadata) -> ForceModel:
    rng = np.random.default_rng(0)
    return ForceModel(metadata, rng.normal(size=(6, 4)), rng.normal(size=6), rng.normal(size=6), 0.25)
