"""The force model as data: a frozen network with its provenance, and the file that carries it.

A model file is safetensors, which cannot carry code. Its header says what the numbers mean, and a SHA-256 over header
and tensors makes every changed bit a refusal instead of a different force.
"""

import datetime
import hashlib
import json
import math
import re
import struct
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import msgspec
import numpy as np
import safetensors
import safetensors.numpy
from numpy.typing import ArrayLike, NDArray

from tormagd.element.model.features import (
    FEATURES,
    FIELD,
    LARGEST,
    UNITS,
    Element,
    Scaling,
    feature_rows,
    require_number,
)
from tormagd.element.model.force_curve import ForceCurve, Known, Network
from tormagd.element.model.memory import NO_MEMORY, Memory
from tormagd.element.physics.errors import DomainError, require_that
from tormagd.element.physics.inserts import INSERTS
from tormagd.ground.files import in_place_of, named, read_bounded, shipped

Array: TypeAlias = NDArray[np.float64]
Ranges: TypeAlias = dict[str, tuple[float, float]]
"The range of each feature and of `force_N`, by name."

FORMAT = "tormagd-force-model-1"
MAX_HIDDEN = 4096
MAX_FILE_BYTES = 1 << 20
"A wrong file is refused before it costs memory."

TEXT_FIELDS = frozenset({"element", "insert", "training_data_sha256", "created"})
"Written as they are; the others are JSON."


class ModelFileError(ValueError):
    """A model file that is missing, damaged, or meant for another element or insert."""


class ModelMetadata(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    element: Element
    insert: str
    hidden: int
    ranges: Ranges
    scaling: Scaling
    training_data_sha256: str
    metrics: dict[str, float]
    created: datetime.date
    features: tuple[str, ...] = FEATURES
    units: dict[str, str] = msgspec.field(default_factory=lambda: dict(UNITS))
    memory: Memory = NO_MEMORY
    boxes: dict[str, Ranges] | msgspec.UnsetType = msgspec.UNSET

    def __post_init__(self) -> None:
        require_that(
            re.fullmatch(r"[\x21-\x7e]{1,64}", self.insert) is not None,
            "insert",
            repr(self.insert[:80]),
            "1 to 64 printable characters without blanks",
        )
        require_that(
            re.fullmatch(r"[0-9a-f]{64}", self.training_data_sha256) is not None,
            "training_data_sha256",
            repr(self.training_data_sha256[:80]),
            "64 hexadecimal digits",
        )
        require_that(1 <= self.hidden <= MAX_HIDDEN, "hidden", self.hidden, f"1 to {MAX_HIDDEN}")
        require_that(self.features == FEATURES, "features", self.features, f"{FEATURES}, in this order")
        require_that(self.units == UNITS, "units", self.units, str(UNITS))
        _require_ranges("ranges", self.ranges)
        for name, box in (self.boxes or {}).items():
            _require_ranges(f"boxes.{name}", box)
        scaling = self.scaling
        numbers = (*scaling.input_offset, *scaling.input_gain, scaling.output_offset, scaling.output_gain)
        is_finite = all(abs(number) <= LARGEST for number in numbers)
        require_that(is_finite, "scaling", scaling, f"finite numbers within +-{LARGEST:g}")
        require_that(scaling.output_gain > 0, "scaling.output_gain", scaling.output_gain, "above 0")
        for name, value in self.metrics.items():
            require_that(math.isfinite(value), f"metrics.{name}", value, "a finite number")


def _require_ranges(key: str, ranges: Ranges) -> None:
    require_that(set(ranges) == set(UNITS), key, sorted(ranges), f"one range for each of {', '.join(UNITS)}")
    for name, (low, high) in ranges.items():
        is_range = -LARGEST <= low <= high <= LARGEST
        require_that(is_range, f"{key}.{name}", (low, high), f"[least, greatest], finite, within +-{LARGEST:g}")
    low, high = ranges["force_N"]
    require_that(low < high, f"{key}.force_N", (low, high), "a greatest force above the least")
    low, high = ranges["field_mT"]
    require_that(
        0.0 <= low < high, f"{key}.field_mT", (low, high), "a least field of 0 mT or more, a greatest above it"
    )


class PhysicalLayers(NamedTuple):
    """The weights with the scaling folded in."""

    hidden_weight: Array
    hidden_bias: Array
    output_weight: Array
    output_bias: float


@dataclass(frozen=True, eq=False)
class ForceModel:
    metadata: ModelMetadata
    hidden_weight: Array
    hidden_bias: Array
    output_weight: Array
    output_bias: float
    physical: PhysicalLayers = field(init=False, repr=False)
    network: Network = field(init=False, repr=False)
    "On lists of floats: its curves are what plans ask."

    def __post_init__(self) -> None:
        hidden = self.metadata.hidden
        for name, shape in (("hidden_weight", (hidden, 4)), ("hidden_bias", (hidden,)), ("output_weight", (hidden,))):
            object.__setattr__(self, name, _weights(name, getattr(self, name), shape))
        require_number("output_bias", self.output_bias)
        object.__setattr__(self, "physical", self._fold())
        object.__setattr__(self, "network", Network(*self.physical, Known(self.feature_ranges, self.force_span_N)))

    def _fold(self) -> PhysicalLayers:
        scaling = self.metadata.scaling
        gain, offset = np.array(scaling.input_gain), np.array(scaling.input_offset)
        weight = self.hidden_weight * gain
        constant = self.output_bias / scaling.output_gain + scaling.output_offset
        require_number("output_bias / output_gain + output_offset", constant)
        return PhysicalLayers(
            _weights("hidden_weight * input_gain", weight, weight.shape),
            _weights("hidden_bias, unscaled", self.hidden_bias - weight @ offset, self.hidden_bias.shape),
            _weights("output_weight / output_gain", self.output_weight / scaling.output_gain, self.output_weight.shape),
            constant,
        )

    @property
    def feature_ranges(self) -> tuple[tuple[float, float], ...]:
        return tuple(self.metadata.ranges[name] for name in FEATURES)

    @property
    def field_range_mT(self) -> tuple[float, float]:
        return self.metadata.ranges["field_mT"]

    @property
    def force_span_N(self) -> float:
        low, high = self.metadata.ranges["force_N"]
        return high - low

    @cached_property
    def fingerprint(self) -> str:
        return _checksum(_header(self.metadata), _tensors(self))

    def of(self, insert: str) -> "ForceModel":
        """Return the model of one of its inserts, with that insert's ranges."""
        whole, memory = self.metadata, self.metadata.memory
        ranges = (whole.boxes or {}).get(insert)
        if ranges is None:
            return self
        share = ranges["field_mT"][1] / whole.ranges["field_mT"][1]
        memory = msgspec.structs.replace(memory, lag_mT=share * memory.lag_mT, turn_mT=share * memory.turn_mT)
        own = msgspec.structs.replace(whole, insert=insert, ranges=ranges, memory=memory, boxes=msgspec.UNSET)
        return replace(self, metadata=own)

    def curve(self, displacement_mm: float, rate_mm_s: float, cip_percent: float) -> ForceCurve:
        return self.network.curve(displacement_mm, rate_mm_s, cip_percent)

    def predict(self, features: ArrayLike) -> Array:
        """Return the force, N (n), at `features` (n x 4, order of `FEATURES`)."""
        rows = feature_rows(features)
        weight, bias, output, constant = self.physical
        # (1 + tanh(z/2)) / 2 is the sigmoid, and cannot overflow
        forces_N = np.tanh((rows @ weight.T + bias) / 2) @ (output / 2) + (constant + float(output.sum()) / 2)
        return np.asarray(forces_N, dtype=np.float64)

    def predict_one(self, displacement_mm: float, rate_mm_s: float, field_mT: float, cip_percent: float) -> float:
        """Return the force at one point, by the curve that plans use."""
        require_number("field_mT", field_mT)
        return self.curve(displacement_mm, rate_mm_s, cip_percent).force_N(field_mT)

    def field_slope_N_per_mT(self, features: ArrayLike) -> Array:
        """Return dF/dB (n) at `features` (n x 4)."""
        rows = feature_rows(features)
        weight, bias, output, _ = self.physical
        # without 1 - tanh^2, which is 0 by rounding where a unit is saturated
        falls = np.exp(-np.abs(rows @ weight.T + bias))
        return np.asarray(falls / (1.0 + falls) ** 2 @ (output * weight[:, FIELD]), dtype=np.float64)


def save_model(path: Path | str, model: ForceModel, *sources: Path) -> None:
    """Write `model` to `path`, which is none of `sources`; equal models give equal bytes."""
    tensors = _tensors(model)
    header = _header(model.metadata)
    header["checksum"] = _checksum(header, tensors)
    with in_place_of(Path(path), *sources) as unfinished:
        unfinished.write_bytes(_canonical(safetensors.numpy.save(tensors, header)))


def load_model(path: Path | str, *, element: Element | str, insert: str | None = None) -> ForceModel:
    """Read a model file for `element` and `insert`; None accepts any insert. Raises ModelFileError."""
    source = Path(path)
    try:
        model = _decode(read_bounded(source, MAX_FILE_BYTES)).of(insert or "")
    except OSError as error:
        raise ModelFileError(f"{source}: cannot be read: {error.strerror}") from error
    except safetensors.SafetensorError as error:
        raise ModelFileError(f"{source}: damaged or not a model file ({error}); train or copy it again") from error
    except RecursionError as error:
        raise ModelFileError(f"{source}: the header is nested without end, which no model file is") from error
    except (DomainError, msgspec.DecodeError, ModelFileError) as error:
        raise ModelFileError(f"{source}: {error}") from error
    found = model.metadata
    if found.element != element:
        raise ModelFileError(f"element = {str(element)!r}: allowed is {found.element}, on which {source} was trained")
    if insert is not None and found.insert != insert:
        raise ModelFileError(f"insert.name = {insert!r}: allowed is {found.insert}, on which {source} was trained")
    return model


def _decode(data: bytes) -> ForceModel:
    # the library proves that header and tensors are whole
    tensors = {name: _tensor(name, content) for name, content in safetensors.deserialize(data)}  # type: ignore[no-untyped-call]
    header = _json_header(data).get("__metadata__", {})
    if header.get("format") != FORMAT:
        raise ModelFileError(f"format is {header.get('format')!r}, not {FORMAT!r}")
    checksum = header.pop("checksum", None)
    if checksum != _checksum(header, tensors):
        raise ModelFileError("altered since it was written (the checksum does not match); train or copy it again")
    names = {"hidden_weight", "hidden_bias", "output_weight", "output_bias"}
    if set(tensors) != names:
        raise ModelFileError(f"tensors are {sorted(tensors)}; needed are {sorted(names)}")
    del header["format"]
    fields = {name: text if name in TEXT_FIELDS else msgspec.json.decode(text) for name, text in header.items()}
    return ForceModel(
        metadata=msgspec.convert(fields, ModelMetadata),
        hidden_weight=tensors["hidden_weight"],
        hidden_bias=tensors["hidden_bias"],
        output_weight=tensors["output_weight"],
        output_bias=float(_weights("output_bias", tensors["output_bias"], (1,))[0]),
    )


def _tensor(name: str, content: dict[str, Any]) -> Array:
    if content["dtype"] not in ("F64", "float64"):
        raise ModelFileError(f"tensor {name} is {content['dtype']}; needed is F64")
    return np.frombuffer(content["data"], dtype="<f8").reshape(content["shape"])


def _weights(name: str, value: ArrayLike, shape: tuple[int, ...]) -> Array:
    source = np.asarray(value)
    require_that(source.dtype.kind == "f", name, source.dtype, "floating-point numbers")
    array = source.astype(np.float64)
    require_that(array.shape == shape, name, f"shape {array.shape}", f"shape {shape}")
    refused = array[~(np.abs(array) <= LARGEST)]
    if refused.size:
        raise DomainError(name, refused.flat[0], f"finite numbers within +-{LARGEST:g}")
    array.setflags(write=False)
    return array


def _tensors(model: ForceModel) -> dict[str, Array]:
    return {
        "hidden_weight": model.hidden_weight,
        "hidden_bias": model.hidden_bias,
        "output_weight": model.output_weight,
        "output_bias": np.array([model.output_bias]),
    }


def _header(metadata: ModelMetadata) -> dict[str, str]:
    fields = msgspec.to_builtins(metadata)
    texts = {name: value if name in TEXT_FIELDS else json.dumps(value) for name, value in fields.items()}
    return {"format": FORMAT, **texts}


def _checksum(header: dict[str, str], tensors: dict[str, Array]) -> str:
    digest = hashlib.sha256(json.dumps(header, sort_keys=True).encode())
    for name in sorted(tensors):
        tensor = tensors[name]
        digest.update(f"{name} {tensor.dtype} {tensor.shape}".encode())
        digest.update(tensor.tobytes())
    return digest.hexdigest()


def _json_header(data: bytes) -> dict[str, dict[str, Any]]:
    (length,) = struct.unpack_from("<Q", data)
    return msgspec.json.decode(data[8 : 8 + length], type=dict[str, dict[str, Any]])


def _canonical(data: bytes) -> bytes:
    """Sort the header's keys, which the library writes in random order."""
    (length,) = struct.unpack_from("<Q", data)
    header = json.dumps(_json_header(data), sort_keys=True, separators=(",", ":")).encode()
    header += b" " * (-len(header) % 8)
    return struct.pack("<Q", len(header)) + header + data[8 + length :]


def falling_at(
    model: ForceModel, fields_mT: tuple[float, float], displacement_mm: float, points: int = 33
) -> float | None:
    """Return the least rate of the handle at which the force does not rise everywhere with the field."""
    _, (slowest, fastest), _, (cip_percent, _) = model.feature_ranges
    fields = np.linspace(*fields_mT, points)
    for rate_mm_s in np.linspace(slowest, fastest, points).tolist():
        rows = np.column_stack([np.full(points, value) for value in (displacement_mm, rate_mm_s, 0.0, cip_percent)])
        rows[:, FIELD] = fields
        if not (model.field_slope_N_per_mT(rows) > 0.0).all():
            return float(rate_mm_s)
    return None


AUTO = "auto"
"A scene gets the model of its insert, or else of its matrix."
_FOLDER, _ENDING = resources.files(__package__) / "models", ".safetensors"


def model_path(name_or_path: str, beside: Path, insert: str = "") -> Path:
    """Return the path of a shipped model by its name, else of a file relative to `beside`."""
    if name_or_path == AUTO:
        own = f"torque_{insert.lower().replace('-', '_')}"
        name_or_path = own if own in shipped(_FOLDER, _ENDING) else own.rpartition("_")[0]
        allowed = f"with insert.model = 'auto' one of {', '.join(INSERTS)}"
        require_that(name_or_path in shipped(_FOLDER, _ENDING), "insert.name", repr(insert), allowed)
    return named("insert.model", name_or_path, _FOLDER, _ENDING, beside)
