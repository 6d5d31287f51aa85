"""Whole runs of configurations at their ends.

A configuration is refused at the border, or it plans and steps the simulated device for a while.
"""

import math
import random
from collections import Counter
from collections.abc import Iterator
from typing import Any, NamedTuple, get_type_hints

import msgspec
from leaves import leaves

from judge.stages import UNNAMED
from tormagd.config import Config
from tormagd.control.assembly.build import Core, build_core
from tormagd.control.records import TimedSetpoint
from tormagd.control.safety.operating_state import RefusedError
from tormagd.scenes.scene import load_scene
from tormagd.simulation.closed_loop import ClosedLoop
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.hand import SteadyHand
from tormagd.simulation.parameters import PlantParameters, load_plant

SCENE, PLANT = "coronary", "sample_1"
SECTIONS = ("motor", "position", "trim", "limits", "rates", "device")
OF_PLANT = (("encoder_counts_per_rev", 16, 1_000_000), ("supply_V", 3.0, 25.0))
MAX_TOLD = 8
SENT_HZ = 137.3


class End(NamedTuple):
    """A key at one end of what is accepted, of the `config`, the scene's `insert`, or the `plant`'s electronics."""

    section: str
    key: str
    value: float

    def __str__(self) -> str:
        return f"{self.section}.{self.key} = {self.value:g}"


def ends() -> list[End]:
    """Return both ends of every number that shapes control, and of the device's own."""
    parts = {section: getattr(Config(), section) for section in SECTIONS} | {"insert": load_scene(SCENE).insert}
    found = [End(section, key, value) for section, part in parts.items() for key, value in _ends_of(type(part))]
    return found + [End("plant", key, value) for key, *both in OF_PLANT for value in both]


def _ends_of(struct: type) -> Iterator[tuple[str, float]]:
    for key, hint in get_type_hints(struct, include_extras=True).items():
        meta = next((each for each in getattr(hint, "__metadata__", ()) if isinstance(each, msgspec.Meta)), None)
        if meta is None or meta.le is None:
            continue
        least = meta.ge if meta.ge is not None else math.nextafter(meta.gt or 0.0, math.inf)
        yield from ((key, least), (key, meta.le))


class Became(NamedTuple):
    """The outcome of a configuration: `refused` at the border; `ran`; `stated` if it may not be enabled or a fault
    ended it; or `wrong`.
    """

    kind: str
    why: str


def drawn_ends(count: int, seed: int) -> list[tuple[End, ...]]:
    """Return every end by itself, then random pairs, `count` in all; or some at random if there are more."""
    rng, each = random.Random(seed), ends()
    if count < len(each):
        return [(one,) for one in rng.sample(each, count)]
    pairs = [tuple(rng.sample(each, 2)) for _ in range(count - len(each))]
    return [*((one,) for one in each), *pairs]


def became(case: tuple[End, ...], seconds: float) -> Became:
    name = ", ".join(map(str, case))
    try:
        core, plant = _built(case)
    except ValueError as error:  # a ConfigError, or the type's own
        return Became("refused", f"{name}: {error}")
    try:
        kind, why = _ran(core, plant, seconds)
    except UNNAMED as error:
        kind, why = "wrong", f"{type(error).__name__}: {error}"
    return Became(kind, f"{name}: {why}")


def _built(case: tuple[End, ...]) -> tuple[Core, PlantParameters]:
    config, plant = Config(scene=SCENE), load_plant(PLANT)
    scene = msgspec.structs.replace(load_scene(SCENE), signal=None)
    for section, key, value in case:
        if section == "plant":
            electronics = msgspec.structs.replace(plant.electronics, **{key: value})
            plant = msgspec.structs.replace(plant, electronics=electronics)
        elif section == "insert":
            scene = msgspec.structs.replace(scene, insert=msgspec.structs.replace(scene.insert, **{key: value}))
        else:
            part = msgspec.structs.replace(getattr(config, section), **{key: value})
            config = msgspec.structs.replace(config, **{section: part})
    return build_core(config, scene), plant


def _ran(core: Core, plant: PlantParameters, seconds: float) -> tuple[str, str]:
    if not all(map(math.isfinite, core.margins)):
        return "wrong", str(core.margins)
    loop = ClosedLoop(core.config, core.stepper(), core.planner(), VirtualDevice(plant, SteadyHand(), seed=1))
    try:
        loop.arm()
    except (RuntimeError, RefusedError) as error:
        return "stated", str(error)
    for sample in loop.run(seconds, _swinging):
        for path, value in leaves([sample.output, sample.plan, sample.measured]):
            if not math.isfinite(value) and not path.endswith("stamp_s"):
                return "wrong", f"{path} = {value}"
        if sample.safety.faults:
            return "stated", ", ".join(sample.safety.faults)
    return "ran", ""


def summed(found: list[Became]) -> dict[str, Any]:
    told = sorted((each for each in found if each.kind in ("wrong", "stated")), key=lambda each: each.kind != "wrong")
    counts = Counter(each.kind for each in found)
    return {
        "cases": len(found),
        **{kind: counts[kind] for kind in ("refused", "ran", "stated", "wrong")},
        "told": [f"{each.kind}: {each.why}" for each in told][:MAX_TOLD],
    }


def _swinging(now_s: float) -> TimedSetpoint:
    at_s = math.floor(now_s * SENT_HZ) / SENT_HZ
    return TimedSetpoint(1.3 + 0.4 * math.sin(3.0 * at_s), at_s, 0.1)
