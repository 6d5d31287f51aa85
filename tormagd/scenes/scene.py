"""A scene states what one task requires: force range, tolerance, insert, geometry, rates.

The daemon runs one scene. Nothing that a scene does not ask for is modelled or computed.
"""

from importlib import resources
from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import UNSET, Meta, UnsetType

from tormagd.config import LEAST_INFERENCE_HZ, ConfigError, Strict, convert

AUTO = "auto"
LONGEST_SHOWN = 200  # characters of a refused name
_SHIPPED = resources.files(__package__)


class Force(Strict, frozen=True):
    """The forces the task asks for, N, and how closely they must be rendered."""

    least_N: Annotated[float, Meta(ge=0.0, le=1_000.0)]
    "What the task would like as its lowest force; below the device's F_min it gets F_min, and the limit F_MIN shows."
    most_N: Annotated[float, Meta(gt=0.0, le=1_000.0)]
    resolution_N: Annotated[float, Meta(gt=0.0, le=100.0)]
    tolerance_rms_N: Annotated[float, Meta(gt=0.0, le=100.0)]
    least_variance_accounted_for: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0
    release_N_s: Annotated[float, Meta(gt=0.0, le=100.0)] = 2.0
    "How fast the force is let go when its publisher is gone, and how fast it goes to another publisher's."
    most_release_N_s: Annotated[float, Meta(gt=0.0, le=1_000.0)] = 20.0
    "How fast it may be lost at most, whatever fails. A device that opens faster than that is refused."


class Bandwidth(Strict, frozen=True):
    """The rates below which the task is not served, Hz."""

    control_hz: Annotated[int, Meta(ge=LEAST_INFERENCE_HZ, le=4_000)] = 1_000
    inference_hz: Annotated[int, Meta(ge=LEAST_INFERENCE_HZ, le=4_000)] = LEAST_INFERENCE_HZ


class Insert(Strict, frozen=True):
    """Which elastomer is fitted, which device it is in, and the model learned from the two."""

    name: str
    model: str
    "A safetensors file (relative to the scene file), or the name of a shipped model."
    gap_closed_mm: Annotated[float, Meta(ge=20.0, le=300.0)] = 45.0
    gap_open_mm: Annotated[float, Meta(ge=20.0, le=300.0)] = 95.0
    inner_radius_mm: Annotated[float, Meta(gt=0.0, le=100.0)] = 4.0
    outer_radius_mm: Annotated[float, Meta(gt=0.0, le=100.0)] = 11.0
    thickness_mm: Annotated[float, Meta(gt=0.0, le=200.0)] = 20.0
    roller_radius_mm: Annotated[float, Meta(gt=0.0, le=200.0)] = 20.0


class Solver(Strict, frozen=True):
    """The field search. "auto": the cheapest that the scene's force tolerance allows, by the measured table."""

    name: str = AUTO
    step_mT: Annotated[float, Meta(gt=0.0, le=50.0)] | UnsetType = UNSET
    "Of the grid over the field. Only beside a named search."
    neighbours: Annotated[int, Meta(ge=1, le=64)] | UnsetType = UNSET
    'Points of the grid that compete for the answer of the search "nearest". Only beside a named search.'

    def __post_init__(self) -> None:
        for key in ("step_mT", "neighbours"):
            value = getattr(self, key)
            if self.name == AUTO and value is not UNSET:
                raise ValueError(f"solver.{key} = {value}: allowed only beside a solver.name other than {AUTO}")


class Scene(Strict, frozen=True):
    """One task. Raises ConfigError, through `load_scene`, where its statements contradict each other."""

    name: str
    description: str
    force: Force
    insert: Insert
    bandwidth: Bandwidth = msgspec.field(default_factory=Bandwidth)
    solver: Solver = msgspec.field(default_factory=Solver)

    def __post_init__(self) -> None:
        pairs = (
            ("force.release_N_s", self.force.release_N_s, "force.most_release_N_s", self.force.most_release_N_s),
            ("force.least_N", self.force.least_N, "force.most_N", self.force.most_N),
            ("insert.gap_closed_mm", self.insert.gap_closed_mm, "insert.gap_open_mm", self.insert.gap_open_mm),
            (
                "insert.inner_radius_mm",
                self.insert.inner_radius_mm,
                "insert.outer_radius_mm",
                self.insert.outer_radius_mm,
            ),
        )
        for low_name, low, high_name, high in pairs:
            if not low < high:
                raise ValueError(f"{low_name} = {low:g}: allowed is under {high_name} = {high:g}")


def shipped_scenes() -> tuple[str, ...]:
    """The names of the scenes that come with the package."""
    return tuple(
        sorted(entry.name.removesuffix(".toml") for entry in _SHIPPED.iterdir() if entry.name.endswith(".toml"))
    )


def scene_path(name_or_path: str) -> Path:
    """The file of a shipped scene's name, or the path itself. Raises ConfigError naming the shipped scenes."""
    if name_or_path in shipped_scenes():
        return Path(str(_SHIPPED / f"{name_or_path}.toml"))
    path, allowed = Path(name_or_path), f"allowed is a scene file or one of {', '.join(shipped_scenes())}"
    try:
        if path.exists():
            return path
    except OSError as error:  # a name that no file can have, or a directory that may not be entered
        raise ConfigError(f"scene = {name_or_path[:LONGEST_SHOWN]!r}: {error.strerror}; {allowed}") from error
    raise ConfigError(f"scene = {name_or_path[:LONGEST_SHOWN]!r}: {allowed}")


def load_scene(name_or_path: str) -> Scene:
    """The scene in a file or of a shipped name. Raises ConfigError naming file, key, value and what is allowed."""
    return convert(scene_path(name_or_path), Scene)
