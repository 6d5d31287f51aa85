"""Models: their files, the same bytes again or a refusal, and the force that they give."""

import datetime
import json
import math
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import torch
from safetensors import safe_open

from tormagd.element.model import model_file
from tormagd.element.model.features import FEATURES, LARGEST, UNITS, Element, Scaling
from tormagd.element.model.force_curve import LARGEST_EXPONENT, Known, Network
from tormagd.element.model.memory import NO_MEMORY, Memory
from tormagd.element.model.model_file import (
    ForceModel,
    ModelFileError,
    ModelMetadata,
    load_model,
    model_path,
    save_model,
)
from tormagd.element.model.network import to_network
from tormagd.element.physics.errors import DomainError


@pytest.fixture(scope="session")
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


@pytest.fixture(scope="session")
def model(metadata: ModelMetadata) -> ForceModel:
    rng = np.random.default_rng(0)
    return ForceModel(metadata, rng.normal(size=(6, 4)), rng.normal(size=6), rng.normal(size=6), 0.25)


POINT = (0.3, 12.0, 420.0, 40.0)


@pytest.fixture
def saved(tmp_path: Path, model: ForceModel) -> Path:
    path = tmp_path / "model.safetensors"
    save_model(path, model)
    return path


Change = Callable[[dict[str, Any]], object]


def rewritten(path: Path, change: Change, *, sign: bool = True) -> Path:
    """Change the header of a model file; `sign` renews the checksum, as someone would who means it."""
    data = path.read_bytes()
    (length,) = struct.unpack_from("<Q", data)
    header, body = json.loads(data[8 : 8 + length]), data[8 + length :]
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


def refused(path: Path, message: str = r"model\.(safetensors|pt): ", **wanted: object) -> None:
    with pytest.raises(ModelFileError, match=message):
        load_model(path, **{"element": "torque", **wanted})


def test_round_trip_is_exact_to_the_byte(saved: Path, tmp_path: Path, model: ForceModel) -> None:
    loaded = load_model(saved, element="torque", insert="MRE-50-40")
    again = tmp_path / "again.safetensors"
    save_model(again, loaded)
    assert (again.read_bytes(), loaded.metadata, loaded.predict_one(*POINT)) == (
        saved.read_bytes(),
        model.metadata,
        model.predict_one(*POINT),
    )
    assert sorted(tmp_path.iterdir()) == [again, saved]


def test_others_can_read_the_file(saved: Path) -> None:
    with safe_open(saved, framework="np") as file:
        header = file.metadata()
        assert header["element"] == "torque"
        told = [json.loads(header[name]) for name in ("features", "units", "hidden")]
        assert (told, header["created"], file.get_tensor("hidden_weight").shape) == (
            [list(FEATURES), UNITS, 6],
            "2024-02-29",
            (6, 4),
        )


def test_every_truncation_is_refused(saved: Path) -> None:
    data = saved.read_bytes()
    header_ends = struct.unpack_from("<Q", data)[0] + 8
    for length in (0, 1, 7, 8, 9, 200, header_ends, len(data) - 8, len(data) - 1, len(data) + 1):
        saved.write_bytes((data + b"\0")[:length])
        refused(saved)


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
        refused(saved)


def test_a_file_without_a_memory_is_of_an_element_that_remembers_nothing(saved: Path, tmp_path: Path) -> None:
    rewritten(saved, lambda header: header["__metadata__"].pop("memory"))
    without = load_model(saved, element="torque")
    assert without.metadata.memory == NO_MEMORY
    memory = Memory(fractions=(0.05, 0.04), times_s=(8.0, 90.0), lag_mT=7.5, turn_mT=75.0)
    with_memory = replace(without, metadata=msgspec.structs.replace(without.metadata, memory=memory))
    save_model(tmp_path / "with.safetensors", with_memory)
    again = load_model(tmp_path / "with.safetensors", element="torque")
    assert (again.metadata, again.fingerprint) == (with_memory.metadata, with_memory.fingerprint)
    assert with_memory.fingerprint != without.fingerprint


def said(field: str, text: str) -> Change:
    return lambda header: header["__metadata__"].update({field: text})


MEANINGS: list[tuple[str, Any, str]] = [
    ("features", list(reversed(FEATURES)), "features"),
    ("features", FEATURES[:3], "features"),
    ("units", {**UNITS, "field_mT": "T"}, "units"),
    ("hidden", 7, "hidden_weight = shape"),
    ("hidden", 0, "hidden"),
    ("hidden", "6", "hidden"),
    ("ranges", {"field_mT": [100, 800]}, "ranges"),
    ("ranges", dict.fromkeys(UNITS, (1, 0)), "ranges"),
    ("ranges", dict.fromkeys(UNITS, (1, 1)), r"ranges\.force_N"),
    ("ranges", {**dict.fromkeys(UNITS, (1, 2)), "field_mT": (0, 0)}, r"ranges\.field_mT"),
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
    *(
        ("memory", {"times_s": [1.0, 10.0], "fractions": [0.1, 0.1], which: fractions}, "memory")
        for which in ("fractions", "field_fractions")
        for fractions in ([0.6, 0.6], [0.1], [-0.1, 0.1])
    ),
    ("memory", {"lag_mT": 5.0, "turn_mT": 19.0}, r"memory\.lag_mT"),
    ("memory", {"lag_mT": -1.0}, r"memory\.lag_mT"),
    ("colour", "red", "colour"),
]

BROKEN = [
    ("element", "tactical", "element"),
    ("insert", "", "insert"),
    ("created", "yesterday", "created"),
    ("training_data_sha256", "AB" * 32, "training_data_sha256"),
    ("format", "tormagd-force-model-2", "format"),
    ("ranges", "[" * 100_000, "nested"),
    ("hidden", "9" * 5000, "hidden|range"),
    ("metrics", '{"r2": NaN}', "malformed"),
    ("metrics", '{"r2": 1e999}', "range"),
]
SIGNED: list[tuple[Change, str]] = [
    *((said(field, json.dumps(value)), message) for field, value, message in MEANINGS),
    *((said(field, text), message) for field, text, message in BROKEN),
    (lambda header: header["__metadata__"].pop("ranges"), "ranges"),
    (lambda header: header["hidden_weight"].update(shape=[4, 6]), r"hidden_weight = shape \(4, 6\)"),
    (lambda header: header.update(other=header.pop("hidden_bias")), "needed are"),
]
UNSIGNED: list[tuple[Change, str]] = [
    (said("insert", "MRE-10-30"), "altered since it was written"),
    (lambda header: header.pop("__metadata__"), "format is None"),
    (lambda header: header["hidden_weight"].update(dtype="I64"), "hidden_weight is I64"),
]


@pytest.mark.parametrize(
    ("change", "message", "sign"), [*((*row, True) for row in SIGNED), *((*row, False) for row in UNSIGNED)]
)
def test_a_file_with_another_header_is_refused(saved: Path, change: Change, message: str, sign: bool) -> None:
    rewritten(saved, change, sign=sign)
    refused(saved, message)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 1e300])
def test_weights_that_are_not_finite_are_refused(saved: Path, value: float) -> None:
    data = bytearray(saved.read_bytes())
    data[-8:] = struct.pack("<d", value)
    saved.write_bytes(data)
    rewritten(saved, lambda header: None)
    refused(saved, r"output_weight = .* finite")


def test_a_model_for_something_else_is_refused(saved: Path) -> None:
    refused(saved, "insert.name = 'MRE-10-30': allowed is MRE-50-40, on which", insert="MRE-10-30")
    refused(model_path("tactile_mre_c", Path()), "element = 'torque': allowed is tactile, on which")


def test_what_is_no_model_file_is_refused(tmp_path: Path, model: ForceModel) -> None:
    refused(tmp_path / "absent", "cannot be read: No such file")
    pickled = tmp_path / "model.pt"
    torch.save({"weight": torch.zeros(3)}, pickled)
    refused(pickled)
    pickled.write_bytes(b"\0" * (model_file.MAX_FILE_BYTES + 1))
    refused(pickled, "at most 1048576 bytes; this has 1048577")


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"metrics": {"r2": math.nan}}, r"metrics\.r2"),
        ({"metrics": {"r2": math.inf}}, r"metrics\.r2"),
        ({"scaling": Scaling((0.5, 30.0, 450.0, 40.0), (2.0, 1 / 30, 1 / 350, 0.0), 2.9, 1e-300)}, "output_gain"),
        ({"insert": "two words"}, "insert"),
        ({"hidden": 0}, "hidden"),
        ({"training_data_sha256": "none"}, "training_data_sha256"),
        ({"features": ("x",)}, "features"),
    ],
)
def test_what_a_model_says_of_itself_is_checked_when_it_is_made(
    model: ForceModel, changes: dict[str, Any], name: str
) -> None:
    with pytest.raises(DomainError, match=name):
        replace(model, metadata=msgspec.structs.replace(model.metadata, **changes), output_bias=1.0)


def test_its_weights_are_checked_too_and_stay_what_they_are(model: ForceModel) -> None:
    for changes, name in (
        ({"output_bias": math.nan}, "output_bias"),
        ({"hidden_weight": model.hidden_weight.astype(int)}, "floating-point"),
    ):
        with pytest.raises(DomainError, match=name):
            replace(model, **changes)
    with pytest.raises(ValueError, match="read-only"):
        model.hidden_weight[0, 0] = 1.0


def test_the_slope_is_that_of_finite_differences(model: ForceModel) -> None:
    low, high = (0.3, 12.0, 419.99, 40.0), (0.3, 12.0, 420.01, 40.0)
    slope = (model.predict_one(*high) - model.predict_one(*low)) / 0.02
    assert model.field_slope_N_per_mT([POINT])[0] == pytest.approx(slope, rel=1e-6)


def test_a_saturated_unit_that_rises_still_rises(model: ForceModel) -> None:
    steep = replace(model, hidden_weight=60.0 * np.abs(model.hidden_weight), output_weight=np.abs(model.output_weight))
    rows = [(*POINT[:2], field_mT, POINT[3]) for field_mT in np.linspace(*model.field_range_mT, 9)]
    assert steep.field_slope_N_per_mT(rows).min() > 0.0


@pytest.mark.parametrize("position", range(4))
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 2 * LARGEST])
def test_inputs_that_are_no_numbers_are_refused(model: ForceModel, position: int, value: float) -> None:
    point = [*POINT[:position], value, *POINT[position + 1 :]]
    with pytest.raises(DomainError, match=FEATURES[position]):
        model.predict_one(*point)
    with pytest.raises(DomainError, match=rf"features\[1\], {FEATURES[position]}"):
        model.predict([POINT, point])


@pytest.mark.parametrize("shape", [(4,), (3, 3), (2, 4, 1), (0,)])
def test_features_of_another_shape_are_refused(model: ForceModel, shape: tuple[int, ...]) -> None:
    with pytest.raises(DomainError, match="n x 4"):
        model.predict(np.zeros(shape))


@pytest.fixture
def of_two(model: ForceModel) -> ForceModel:
    whole = model.metadata.ranges | {"cip_percent": (20.0, 40.0)}
    boxes = {
        f"MRE-50-{iron:g}": whole | {"field_mT": fields_mT, "cip_percent": (iron, iron)}
        for iron, fields_mT in ((20.0, (100.0, 400.0)), (40.0, (200.0, 800.0)))
    }
    memory = Memory(fractions=(0.05,), times_s=(8.0,), lag_mT=8.0, turn_mT=80.0)
    changes = {"insert": "MRE-50", "ranges": whole, "boxes": boxes, "memory": memory}
    return replace(model, metadata=msgspec.structs.replace(model.metadata, **changes))


def test_a_model_of_several_inserts_is_loaded_in_the_box_of_the_one_that_is_asked_for(
    tmp_path: Path, of_two: ForceModel
) -> None:
    path = tmp_path / "model.safetensors"
    save_model(path, of_two)
    assert load_model(path, element="torque").metadata == of_two.metadata
    weak = load_model(path, element="torque", insert="MRE-50-20")
    assert (weak.metadata.insert, weak.feature_ranges) == (
        "MRE-50-20",
        ((0.0, 1.0), (0.0, 60.0), (100.0, 400.0), (20.0, 20.0)),
    )
    assert weak.metadata.memory == Memory(fractions=(0.05,), times_s=(8.0,), lag_mT=4.0, turn_mT=40.0)
    assert weak.predict_one(0.3, 12.0, 300.0, 20.0) == of_two.predict_one(0.3, 12.0, 300.0, 20.0)
    assert (
        weak.curve(0.3, 12.0, 20.0).confidence(700.0, 0.0)
        < 0.1
        < 0.9
        < of_two.curve(0.3, 12.0, 20.0).confidence(700.0, 0.0)
    )
    refused(path, "insert.name = 'MRE-50-30': allowed is MRE-50, on which", insert="MRE-50-30")


def test_a_box_that_is_none_is_refused(of_two: ForceModel) -> None:
    for box, message in (
        ({"rate_mm_s": (0.0, 60.0)}, r"boxes.MRE-50-20 = \['rate_mm_s'\]"),
        (of_two.metadata.ranges | {"rate_mm_s": (2.0, 1.0)}, "boxes.MRE-50-20.rate_mm_s"),
        (of_two.metadata.ranges | {"force_N": (1.0, 1.0)}, "boxes.MRE-50-20.force_N"),
    ):
        with pytest.raises(DomainError, match=message):
            msgspec.structs.replace(of_two.metadata, boxes={"MRE-50-20": box})


BOX = ((0.0, 0.0, 100.0, 40.0), (1.0, 60.0, 800.0, 40.0))
Array = np.ndarray


@pytest.fixture(scope="module")
def shipped() -> ForceModel:
    return load_model(model_path("torque_mre_50_40", Path()), element="torque")


def states(count: int) -> Array:
    rng = np.random.default_rng(11)
    rows = rng.uniform(*BOX, (count, 4))
    rows[::3] += rng.normal(size=(len(rows[::3]), 4)) * (3.0, 200.0, 2000.0, 10.0)
    return rows


@pytest.fixture(params=["model", "shipped"])
def either(request: pytest.FixtureRequest) -> ForceModel:
    return request.getfixturevalue(request.param)


def test_the_force_is_that_of_the_model(either: ForceModel) -> None:
    model = either
    rows = states(300)
    with torch.inference_mode():
        by_torch = to_network(model)(torch.from_numpy(rows)).numpy()
    forces = [model.curve(row[0], row[1], row[3]).force_N(row[2]) for row in rows.tolist()]
    for others in (model.predict(rows), by_torch, [model.predict_one(*row) for row in rows.tolist()]):
        assert forces == pytest.approx(others, rel=0, abs=1e-12 * model.curve(0.5, 10.0, 40.0).magnitude_N)


def test_the_slope_is_that_of_the_model(either: ForceModel) -> None:
    rows = states(300)
    curves = [either.curve(row[0], row[1], row[3]) for row in rows.tolist()]
    told = [curve.force_and_slope(row[2]) for curve, row in zip(curves, rows.tolist(), strict=True)]
    assert [force_N for force_N, _ in told] == [
        curve.force_N(row[2]) for curve, row in zip(curves, rows.tolist(), strict=True)
    ]
    steepest = float(np.abs(either.physical.output_weight) @ np.abs(either.physical.hidden_weight[:, 2]))
    assert [slope for _, slope in told] == pytest.approx(either.field_slope_N_per_mT(rows), rel=0, abs=1e-12 * steepest)


@pytest.mark.parametrize(("dtype", "accuracy"), [(np.float64, 1e-13), (np.float32, 1e-5)])
def test_a_grid_of_fields_has_the_forces_of_its_fields(
    shipped: ForceModel, dtype: type[np.floating], accuracy: float
) -> None:
    curve = shipped.curve(2.0, 20.0, 40.0)
    fields = np.linspace(250.0, 850.0, 61)
    forces = curve.forces_N(fields.astype(dtype))
    assert forces.dtype == dtype
    assert forces == pytest.approx(
        [curve.force_N(field) for field in fields.tolist()], rel=0, abs=accuracy * curve.magnitude_N
    )


@pytest.mark.parametrize("exponent", [LARGEST_EXPONENT, 709.7, 710.0, 1e4, 1e18])
@pytest.mark.parametrize("side", [1, -1])
def test_a_unit_far_from_its_step_is_shut_or_open(exponent: float, side: int) -> None:
    known = Known(((0.0, 1.0), (0.0, 60.0), (100.0, 800.0), (40.0, 40.0)), 6.0)
    weight = np.array([[0.0, 0.0, side * exponent / 400.0, 0.0]])
    curve = Network(weight, np.zeros(1), np.array([3.0]), 0.25, known).curve(0.5, 10.0, 40.0)
    expected = 3.25 if side > 0 else 0.25
    assert (curve.force_N(400.0), curve.force_and_slope(400.0)) == (
        expected,
        (expected, pytest.approx(0.0, abs=1e-300)),
    )
    assert curve.forces_N(np.array([400.0])) == pytest.approx([expected], abs=1e-15)


@pytest.mark.parametrize(
    ("place", "error_N", "expected"),
    [
        ((0.5, 10.0, 400.0, 40.0), 0.0, 1.0),
        ((0.5, 10.0, 400.0, 40.0), 0.3, pytest.approx(math.exp(-20 * 0.3 / 5.6))),
        ((1.25, 10.0, 400.0, 40.0), 0.0, pytest.approx(math.exp(-1))),
        ((-0.25, 75.0, 400.0, 40.0), 0.0, pytest.approx(math.exp(-2))),
        ((0.5, 10.0, 975.0, 40.0), 0.0, pytest.approx(math.exp(-1))),
        ((0.5, 10.0, -75.0, 40.0), 0.0, pytest.approx(math.exp(-1))),
        ((0.5, 10.0, 400.0, 50.0), 0.0, pytest.approx(math.exp(-1))),
        ((LARGEST, 10.0, 400.0, 40.0), LARGEST, 0.0),
    ],
)
def test_confidence_follows_its_formula(
    model: ForceModel, place: tuple[float, float, float, float], error_N: float, expected: float
) -> None:
    displacement, rate, field, cip = place
    curve = model.curve(displacement, rate, cip)
    assert (curve.confidence(field, error_N), curve.confidence(field, -error_N)) == (
        expected,
        curve.confidence(field, error_N),
    )
