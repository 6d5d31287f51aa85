"""Model files: the same bytes again, the same force again, and a refusal of everything else."""

import json
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import torch
from hypothesis import given, strategies as st
from safetensors import safe_open

from tormagd.lab.training.dataset import Dataset
from tormagd.lab.training.metrics import fit_metrics, not_rising_share
from tormagd.model import model_file
from tormagd.model.features import FEATURES, LARGEST, UNITS, Element
from tormagd.model.memory import NO_MEMORY, Memory
from tormagd.model.model_file import ForceModel, ModelFileError, ModelMetadata, load_model, save_model
from tormagd.model.network import to_model, to_network
from tormagd.physics.errors import DomainError

POINT = (0.3, 12.0, 420.0, 40.0)


@pytest.fixture
def saved(tmp_path: Path, model: ForceModel) -> Path:
    path = tmp_path / "model.safetensors"
    save_model(path, model)
    return path


def rewritten(path: Path, change: Callable[[dict[str, Any]], object], *, sign: bool = True) -> Path:
    """Change the header of a model file; `sign` renews the checksum, as someone would who means it."""
    data = path.read_bytes()
    (length,) = struct.unpack_from("<Q", data)
    header = json.loads(data[8 : 8 + length])
    body = data[8 + length :]
    change(header)
    if sign:
        tensors = {
            name: np.frombuffer(body[slice(*entry["data_offsets"])], "<f8").reshape(entry["shape"])
            for name, entry in header.items()
            if name != "__metadata__"
        }
        fields = header["__metadata__"]
        fields.pop("checksum", None)
        fields["checksum"] = model_file._checksum(fields, tensors)
    encoded = json.dumps(header).encode()
    encoded += b" " * (-len(encoded) % 8)
    path.write_bytes(struct.pack("<Q", len(encoded)) + encoded + body)
    return path


def test_round_trip_is_exact_to_the_byte(saved: Path, tmp_path: Path, model: ForceModel) -> None:
    loaded = load_model(saved, element="torque", insert="MRE-50-40")
    again = tmp_path / "again.safetensors"
    save_model(again, loaded)
    assert again.read_bytes() == saved.read_bytes()
    assert loaded.metadata == model.metadata
    assert loaded.predict_one(*POINT) == model.predict_one(*POINT)
    assert sorted(tmp_path.iterdir()) == [again, saved]


def test_others_can_read_the_file(saved: Path) -> None:
    with safe_open(saved, framework="np") as file:
        header = file.metadata()
        assert header["element"] == "torque"
        assert json.loads(header["features"]) == list(FEATURES)
        assert json.loads(header["units"]) == UNITS
        assert json.loads(header["hidden"]) == 6
        assert header["created"] == "2024-02-29"
        assert file.get_tensor("hidden_weight").shape == (6, 4)


def test_every_truncation_is_refused(saved: Path) -> None:
    data = saved.read_bytes()
    for length in (0, 1, 7, 8, 9, 200, struct.unpack_from("<Q", data)[0] + 8, len(data) - 8, len(data) - 1):
        saved.write_bytes(data[:length])
        with pytest.raises(ModelFileError, match=r"model\.safetensors: "):
            load_model(saved, element="torque")
    saved.write_bytes(data + b"\0")
    with pytest.raises(ModelFileError):
        load_model(saved, element="torque")


def test_a_flipped_bit_anywhere_is_refused(saved: Path) -> None:
    data = saved.read_bytes()
    (length,) = struct.unpack_from("<Q", data)
    padding = len(data[8 : 8 + length]) - len(data[8 : 8 + length].rstrip())
    for index in range(len(data)):
        flipped = bytearray(data)
        flipped[index] ^= 1 << (index % 8)
        if 8 + length - padding <= index < 8 + length and not bytes([flipped[index]]).strip():
            continue  # one blank for another after the header: not part of the model
        saved.write_bytes(flipped)
        with pytest.raises(ModelFileError):
            load_model(saved, element="torque")


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("features", list(reversed(FEATURES)), "features"),
        ("features", FEATURES[:3], "features"),
        ("units", {**UNITS, "field_mT": "T"}, "units"),
        ("hidden", 7, "hidden_weight = shape"),
        ("hidden", 0, "hidden"),
        ("hidden", "6", "hidden"),
        ("ranges", {"field_mT": [100, 800]}, "ranges"),
        ("ranges", dict.fromkeys(UNITS, (1, 0)), "ranges"),
        ("ranges", dict.fromkeys(UNITS, (1, 1)), r"ranges\.force_N"),
        ("scaling", {"input_offset": [0, 0, 0, 0]}, "input_gain"),
        (
            "scaling",
            {"input_offset": [0] * 4, "input_gain": [1] * 4, "output_offset": 0, "output_gain": 0},
            "output_gain",
        ),
        ("metrics", {"r2": "good"}, "metrics"),
        ("memory", {"fractions": [0.5], "times_s": []}, r"times_s = .* at `\$\.memory"),
        ("memory", {"fractions": [0.5, 0.6], "times_s": [1.0, 2.0]}, r"fractions = .* at `\$\.memory"),
        ("memory", {"fractions": [0.1, 0.1], "times_s": [2.0, 1.0]}, r"memory\.times_s"),
        ("memory", {"lag_mT": 5.0, "turn_mT": 19.0}, r"memory\.lag_mT"),
        ("memory", {"lag_mT": -1.0}, r"memory\.lag_mT"),
        ("colour", "red", "colour"),
    ],
)
def test_a_signed_file_with_another_meaning_is_refused(saved: Path, field: str, value: object, message: str) -> None:
    rewritten(saved, lambda header: header["__metadata__"].update({field: json.dumps(value)}))
    with pytest.raises(ModelFileError, match=message):
        load_model(saved, element="torque")


def test_a_file_without_a_memory_is_of_an_element_that_remembers_nothing(saved: Path, tmp_path: Path) -> None:
    rewritten(saved, lambda header: header["__metadata__"].pop("memory"))
    without = load_model(saved, element="torque")
    assert without.metadata.memory == NO_MEMORY
    memory = Memory(fractions=(0.05, 0.04), times_s=(8.0, 90.0), lag_mT=7.5, turn_mT=75.0)
    with_memory = replace(without, metadata=msgspec.structs.replace(without.metadata, memory=memory))
    save_model(tmp_path / "with.safetensors", with_memory)
    assert load_model(tmp_path / "with.safetensors", element="torque").metadata.memory == memory
    assert with_memory.fingerprint != without.fingerprint


@pytest.mark.parametrize(
    ("field", "text", "message"),
    [
        ("element", "tactical", "element"),
        ("insert", "", "insert"),
        ("created", "yesterday", "created"),
        ("training_data_sha256", "AB" * 32, "training_data_sha256"),
        ("format", "tormagd-force-model-2", "format"),
        ("ranges", "[" * 100_000, "nested"),
        ("hidden", "9" * 5000, "hidden|range"),
        ("metrics", '{"r2": NaN}', "malformed"),
        ("metrics", '{"r2": 1e999}', "range"),
    ],
)
def test_a_signed_file_with_broken_text_is_refused(saved: Path, field: str, text: str, message: str) -> None:
    rewritten(saved, lambda header: header["__metadata__"].update({field: text}))
    with pytest.raises(ModelFileError, match=message):
        load_model(saved, element="torque")


def test_an_unsigned_change_and_a_missing_field_are_refused(saved: Path) -> None:
    rewritten(saved, lambda header: header["__metadata__"].update(insert="MRE-10-30"), sign=False)
    with pytest.raises(ModelFileError, match="altered since it was written"):
        load_model(saved, element="torque")
    rewritten(saved, lambda header: header["__metadata__"].pop("ranges"))
    with pytest.raises(ModelFileError, match="ranges"):
        load_model(saved, element="torque")
    rewritten(saved, lambda header: header.pop("__metadata__"), sign=False)
    with pytest.raises(ModelFileError, match="format is None"):
        load_model(saved, element="torque")


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 1e300])
def test_weights_that_are_not_finite_are_refused(saved: Path, value: float) -> None:
    data = bytearray(saved.read_bytes())
    data[-8:] = struct.pack("<d", value)
    saved.write_bytes(data)
    rewritten(saved, lambda header: None)
    with pytest.raises(ModelFileError, match=r"output_weight = .* finite"):
        load_model(saved, element="torque")


def test_tensors_of_another_type_shape_or_name_are_refused(saved: Path) -> None:
    data = saved.read_bytes()
    rewritten(saved, lambda header: header["hidden_weight"].update(shape=[4, 6]))
    with pytest.raises(ModelFileError, match=r"hidden_weight = shape \(4, 6\)"):
        load_model(saved, element="torque")
    saved.write_bytes(data)
    rewritten(saved, lambda header: header["hidden_weight"].update(dtype="I64"), sign=False)
    with pytest.raises(ModelFileError, match="hidden_weight is I64"):
        load_model(saved, element="torque")
    saved.write_bytes(data)
    rewritten(saved, lambda header: header.update(other=header.pop("hidden_bias")))
    with pytest.raises(ModelFileError, match="needed are"):
        load_model(saved, element="torque")


def test_a_model_for_something_else_is_refused(saved: Path) -> None:
    with pytest.raises(ModelFileError, match="trained on the torque element, but the tactile element is in use"):
        load_model(saved, element=Element.TACTILE)
    with pytest.raises(ModelFileError, match="trained on insert MRE-50-40, but MRE-10-30 is in use"):
        load_model(saved, element="torque", insert="MRE-10-30")


def test_what_is_no_model_file_is_refused(tmp_path: Path, model: ForceModel) -> None:
    with pytest.raises(ModelFileError, match="cannot be read: No such file"):
        load_model(tmp_path / "absent", element="torque")
    with pytest.raises(ModelFileError, match="cannot be read"):
        load_model(tmp_path, element="torque")
    pickled = tmp_path / "model.pt"
    torch.save({"weight": torch.zeros(3)}, pickled)
    with pytest.raises(ModelFileError):
        load_model(pickled, element="torque")
    pickled.write_bytes(b"\0" * (model_file.MAX_FILE_BYTES + 1))
    with pytest.raises(ModelFileError, match="at most 1048576 bytes; this has 1048577"):
        load_model(pickled, element="torque")


@given(st.binary(max_size=600))
def test_noise_is_refused(tmp_path_factory: pytest.TempPathFactory, data: bytes) -> None:
    path = tmp_path_factory.mktemp("noise") / "model.safetensors"
    path.write_bytes(data)
    with pytest.raises(ModelFileError):
        load_model(path, element="torque")


def test_a_model_is_checked_when_it_is_made(model: ForceModel, metadata: ModelMetadata) -> None:
    weights = (model.hidden_weight, model.hidden_bias, model.output_weight)
    for metrics in ({"r2": float("nan")}, {"r2": float("inf")}):
        with pytest.raises(DomainError, match=r"metrics\.r2"):
            ForceModel(msgspec.structs.replace(metadata, metrics=metrics), *weights, 0.0)
    feeble = msgspec.structs.replace(metadata, scaling=msgspec.structs.replace(metadata.scaling, output_gain=1e-300))
    with pytest.raises(DomainError, match="output_gain"):
        ForceModel(feeble, *weights, 1.0)
    for change in ({"insert": "two words"}, {"hidden": 0}, {"training_data_sha256": "none"}, {"features": ("x",)}):
        with pytest.raises(DomainError, match=next(iter(change))):
            msgspec.structs.replace(metadata, **change)
    with pytest.raises(DomainError, match="output_bias"):
        ForceModel(metadata, *weights, float("nan"))
    with pytest.raises(DomainError, match="floating-point"):
        ForceModel(metadata, weights[0].astype(int), *weights[1:], 0.0)
    with pytest.raises(ValueError, match="read-only"):
        model.hidden_weight[0, 0] = 1.0


def test_a_network_survives_freezing(model: ForceModel) -> None:
    again = to_model(to_network(model), model.metadata)
    np.testing.assert_array_equal(again.hidden_weight, model.hidden_weight)
    assert again.predict_one(*POINT) == model.predict_one(*POINT)


def test_the_slope_is_that_of_finite_differences(model: ForceModel) -> None:
    low, high = (0.3, 12.0, 419.99, 40.0), (0.3, 12.0, 420.01, 40.0)
    slope = (model.predict_one(*high) - model.predict_one(*low)) / 0.02
    assert model.field_slope_N_per_mT([POINT])[0] == pytest.approx(slope, rel=1e-6)


@pytest.mark.parametrize("position", range(4))
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 2 * LARGEST])
def test_inputs_that_are_no_numbers_are_refused(model: ForceModel, position: int, value: float) -> None:
    point = list(POINT)
    point[position] = value
    with pytest.raises(DomainError, match=FEATURES[position]):
        model.predict_one(*point)
    with pytest.raises(DomainError, match=rf"features\[1\], {FEATURES[position]}"):
        model.predict([POINT, point])


@pytest.mark.parametrize("shape", [(4,), (3, 3), (2, 4, 1), (0,)])
def test_features_of_another_shape_are_refused(model: ForceModel, shape: tuple[int, ...]) -> None:
    with pytest.raises(DomainError, match="n x 4"):
        model.predict(np.zeros(shape))


def test_metrics_of_a_known_error(model: ForceModel) -> None:
    rows = np.random.default_rng(3).uniform((0, 0, 100, 40), (1, 60, 800, 40.0001), (300, 4))
    signs = np.where(np.arange(300) % 2, 0.5, -0.5)
    data = Dataset(rows, model.predict(rows) + signs)
    metrics = fit_metrics(model, data)
    assert metrics["mae_N"] == pytest.approx(0.5)
    assert metrics["rmse_N"] == pytest.approx(0.5)
    assert metrics["max_N"] == pytest.approx(0.5)
    assert metrics["mae_percent"] == pytest.approx(50 / 5.6)
    assert metrics["r2"] == pytest.approx(1 - 0.25 / np.var(data.force_N))


def test_not_rising_counts_where_the_force_falls_with_the_field(metadata: ModelMetadata) -> None:
    def share(field_weights: list[float]) -> float:
        weight = np.zeros((6, 4))
        weight[:, 2] = field_weights
        return not_rising_share(ForceModel(metadata, weight, np.zeros(6), np.ones(6), 0.0))

    assert share([1.0] * 6) == 0
    assert share([-1.0] * 6) == 1
    hill = np.zeros((6, 4))
    hill[:2, 2] = 8.0, -8.0  # rises at -0.5, falls at +0.5 in scaled units
    bump = ForceModel(metadata, hill, np.array([4.0, 4, 0, 0, 0, 0]), np.array([1.0, 1, 0, 0, 0, 0]), 0.0)
    assert not_rising_share(bump, points=17) == pytest.approx(9 / 17)
