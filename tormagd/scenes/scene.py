"""A scene states what one task requires: forces over time, resolution, tolerance, handle, insert, geometry, rates.

The daemon runs one scene. Nothing that a scene does not ask for is modelled or computed.
"""

import hashlib
import unicodedata
from importlib import resources
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import UNSET, Meta, UnsetType

from tormagd.config import MIN_INFERENCE_HZ
from tormagd.ground.files import named, shipped
from tormagd.ground.toml_file import convert
from tormagd_client.endpoints import Strict
from tormagd_client.printable import require

AUTO = "auto"
MIN_SETPOINT_HZ = 12.0
"Setpoints a tenth of a second apart are no stream any more."
MIN_CONTROL_HZ = 500
"Safety is watched in every control tick."
LONGEST_RELEASE_S = 30.0
"By then a publisher that is lost has let go of the whole force."
AND_UNMET = "; and "
"Between what a device does not give of a scene."
ENDING = ".toml"
OF_BRAKE = "none where element is tactile"
_SHIPPED = resources.files(__package__)


class Force(Strict, frozen=True):
    least_N: Annotated[float, Meta(ge=0.0, le=1_000.0)]
    "Below the device's F_min the task gets F_min."
    most_N: Annotated[float, Meta(ge=0.001, le=1_000.0)]
    resolution_N: Annotated[float, Meta(gt=0.0, le=100.0)]
    "The smallest difference that matters."
    tolerance_rms_N: Annotated[float, Meta(gt=0.0, le=100.0)]
    least_variance_accounted_for: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0
    release_N_s: Annotated[float, Meta(gt=0.0, le=100.0)] = 2.0
    "How fast the force is let go, or passes to another publisher's."
    most_release_N_s: Annotated[float, Meta(gt=0.0, le=1_000.0)] = 20.0
    "The limit whatever fails."
    standby_N: Annotated[float, Meta(gt=0.0, le=1_000.0)] | UnsetType = UNSET
    "Where the brake waits while less is asked: nearer to the forces that come, and felt as drag."
    breakthrough: Literal["off", "decay"] | UnsetType = UNSET
    "How a force that gives way is felt while the hand pushes on: as sent (off), or at a quarter of `release_N_s`."

    @property
    def waiting_N(self) -> float:
        return self.least_N if self.standby_N is UNSET else max(self.least_N, self.standby_N)


class Bandwidth(Strict, frozen=True):
    """The rates below which the task is not served."""

    control_hz: Annotated[int, Meta(ge=MIN_INFERENCE_HZ, le=4_000)] = 1_000
    inference_hz: Annotated[int, Meta(ge=MIN_INFERENCE_HZ, le=4_000)] = MIN_INFERENCE_HZ


class Signal(Strict, frozen=True):
    """The force that the task asks for over time: a recording, or `force`'s range up and down."""

    file: str = ""
    "A CSV with the columns t_s,force_N, relative to the scene file; the force follows a smooth curve through its rows."
    bandwidth_hz: Annotated[float, Meta(ge=0.0001, le=100.0)] | UnsetType = UNSET
    "Each rise and each fall is half a period of a cosine of this frequency."
    step_N: Annotated[float, Meta(ge=0.001, le=1_000.0)] | UnsetType = UNSET
    "The height of each rise and fall; by default the whole range."
    hold_s: Annotated[float, Meta(ge=0.0, le=86_400.0)] | UnsetType = UNSET
    "The rest after each rise and fall."
    is_known_ahead: bool = False
    "The publisher sends what comes as a preview."
    setpoint_hz: Annotated[float, Meta(ge=MIN_SETPOINT_HZ, le=1_000.0)] | UnsetType = UNSET
    "By default as often as plans are made."

    def __post_init__(self) -> None:
        shaped = {key: getattr(self, key) for key in ("bandwidth_hz", "step_N", "hold_s")}
        stated = {key: value for key, value in shaped.items() if value is not UNSET}
        for key, value in stated.items():
            require(not self.file, f"signal.{key}", value, "none beside signal.file")
        if not self.file and self.bandwidth_hz is UNSET:
            raise ValueError("signal.bandwidth_hz is missing: allowed is that or signal.file")


class Handle(Strict, frozen=True):
    """How fast the brake's handle slides. The model must have been trained on it."""

    least_mm_s: Annotated[float, Meta(ge=0.5, le=1_000.0)] = 42.0
    most_mm_s: Annotated[float, Meta(ge=0.5, le=1_000.0)] = 42.0
    "The thesis's 20 rpm."


class Finger(Strict, frozen=True):
    """How a finger presses into the pad. The model must have been trained on it."""

    depth_mm: Annotated[float, Meta(gt=0.0, le=20.0)]
    "The forces are asked for at this depth; a finger that is less deep gets its gap."
    most_mm_s: Annotated[float, Meta(gt=0.0, le=1_000.0)] = 1.0


class Budget(Strict, frozen=True):
    """What the control of the scene may cost, as `tormagctl scene check` says."""

    core_share: Annotated[float, Meta(gt=0.0, le=1.0)] = 0.5
    delay_ms: Annotated[float, Meta(gt=0.0, le=1_000.0)] | UnsetType = UNSET
    "How old setpoints may be when they are followed (`SOURCE_LATE`): the budget of the whole way."


class Terms(Strict, frozen=True):
    """The parts of the controller's model. A part that is left out is not computed."""

    rate: bool = True
    creep: bool = True
    scale: bool = True
    offset: bool = True
    memory: bool = True
    forecast: bool = True
    motor: bool = True
    learning: bool = True
    "Whether `creep`, `scale`, `offset` and the carriages' lag go on being learned."

    @property
    def left_out(self) -> tuple[str, ...]:
        return tuple(name for name in TERMS if not getattr(self, name))

    def without(self, *names: str) -> "Terms":
        """Return these terms with `names` left out. Raises ValueError for an unknown name."""
        for name in names:
            if name not in TERMS:
                raise ValueError(f"term {name!r}: allowed is one of {', '.join(TERMS)}")
        return msgspec.structs.replace(self, **dict.fromkeys(names, False))


TERMS = tuple(name for name in Terms.__struct_fields__ if name != "learning")
EVERY_TERM = Terms()


class Insert(Strict, frozen=True):
    """Which elastomer is fitted, in which device, and the model learned from the two."""

    name: str
    model: str
    "A safetensors file (relative to the scene file), or the name of a shipped model."
    gap_closed_mm: Annotated[float, Meta(ge=20.0, le=300.0)] = 45.0
    gap_open_mm: Annotated[float, Meta(ge=20.0, le=300.0)] = 95.0
    inner_radius_mm: Annotated[float, Meta(ge=0.01, le=100.0)] = 4.0
    outer_radius_mm: Annotated[float, Meta(ge=0.01, le=100.0)] = 11.0
    thickness_mm: Annotated[float, Meta(ge=0.01, le=200.0)] = 20.0
    roller_radius_mm: Annotated[float, Meta(ge=0.01, le=200.0)] = 20.0
    gap_speed_mm_s: Annotated[float, Meta(ge=0.1, le=500.0)] | UnsetType = UNSET
    "The fastest that the task lets the gap move."


class Solver(Strict, frozen=True):
    """The field search. "auto" is none where the rate is no term, `nearest` where force falls, else Newton's method."""

    name: str = AUTO
    step_mT: Annotated[float, Meta(ge=0.001, le=50.0)] | UnsetType = UNSET
    "The step of the grid over the field."
    neighbours: Annotated[int, Meta(ge=1, le=64)] | UnsetType = UNSET
    "Points of the grid that compete for the answer."

    def __post_init__(self) -> None:
        for key in ("step_mT", "neighbours"):
            value = getattr(self, key)
            is_none = self.name != AUTO or value is UNSET
            require(is_none, f"solver.{key}", value, f"none where solver.name is {AUTO}")


def is_plain(text: str, besides: str) -> bool:
    return all(each in besides or unicodedata.category(each) not in ("Cc", "Cf") for each in text)


class Scene(Strict, frozen=True):
    """One task. Raises ValueError where its statements contradict each other."""

    name: str
    description: str
    force: Force
    insert: Insert
    element: Literal["torque", "tactile"] = "torque"
    "The brake on the handle's shaft, or a pad under a finger."
    signal: Signal | None = None
    "Without one nothing is refused for how fast the force changes."
    handle: Handle = msgspec.field(default_factory=Handle)
    finger: Finger | UnsetType = UNSET
    "Only in tactile scenes."
    budget: Budget = msgspec.field(default_factory=Budget)
    terms: Terms = EVERY_TERM
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
        require(is_plain(self.name, ""), "name", self.name, "text without control characters")
        require(is_plain(self.description, "\n\t"), "description", self.description, "text without control characters")
        least_N_s = self.force.most_N / LONGEST_RELEASE_S
        is_let_go = self.force.release_N_s >= least_N_s
        require(
            is_let_go,
            "force.release_N_s",
            self.force.release_N_s,
            f"at least force.most_N / {LONGEST_RELEASE_S:g} s, {least_N_s:.2g}",
        )
        for low_name, low, high_name, high in pairs:
            require(low < high, low_name, low, f"under {high_name} = {high:g}")
        is_brake = self.element == "torque"
        require(is_brake == (self.finger is UNSET), "element", self.element, "[finger] where it is tactile, only there")
        if not is_brake:
            self._require_no_brake()
        slowest, fastest = self.handle.least_mm_s, self.handle.most_mm_s
        require(slowest <= fastest, "handle.least_mm_s", slowest, f"at most handle.most_mm_s = {fastest:g}")

    def _require_no_brake(self) -> None:
        usual = Insert(self.insert.name, self.insert.model)
        for key in ("inner_radius_mm", "outer_radius_mm", "thickness_mm", "roller_radius_mm"):
            value = getattr(self.insert, key)
            require(value == getattr(usual, key), f"insert.{key}", value, OF_BRAKE)
        for key in ("standby_N", "breakthrough"):
            stated = getattr(self.force, key)
            require(stated is UNSET, f"force.{key}", stated, OF_BRAKE)
        require(self.handle == Handle(), "handle", self.handle, f"{OF_BRAKE}; [finger] tells how a pad is pressed")

    @property
    def roller_radius_mm(self) -> float | None:
        return self.insert.roller_radius_mm if self.element == "torque" else None

    @property
    def fingerprint(self) -> str:
        """A hash, 16 hex digits, of what the scene asks for, however it is served."""
        replace, signal, insert = msgspec.structs.replace, self.signal, self.insert
        task = replace(
            self,
            name="",
            description="",
            force=replace(self.force, standby_N=UNSET),
            signal=None if signal is None else replace(signal, file=Path(signal.file).name, is_known_ahead=False),
            insert=replace(insert, model=Path(insert.model).name, gap_speed_mm_s=UNSET),
            terms=EVERY_TERM,
            bandwidth=Bandwidth(),
            solver=Solver(),
            budget=Budget(),
        )
        return hashlib.sha256(msgspec.json.encode(task)).hexdigest()[:16]


def shipped_scenes() -> tuple[str, ...]:
    return shipped(_SHIPPED, ENDING)


def scene_path(name_or_path: str) -> Path:
    return named("scene", name_or_path, _SHIPPED, ENDING)


def load_scene(name_or_path: str) -> Scene:
    """Read and check a shipped scene by its name, or the scene in a file. Raises ConfigError."""
    return convert(scene_path(name_or_path), Scene)
