"""Whole runs for `numerics.py`: configurations at their ends, counters through where they roll over.

A configuration is refused at the border, or it plans and steps the simulated device for a while. Times and counters are
shifted to just before a rollover, and the core gives the same duties as without.
"""

import math
import random
from collections import Counter
from collections.abc import Iterator
from typing import Any, NamedTuple, get_type_hints

import msgspec

from extremes.stages import UNNAMED, leaves
from tormagd.assembly.build import Core, build_core
from tormagd.closed_loop import ClosedLoop
from tormagd.config import Config
from tormagd.control.records import Duty, TimedSetpoint
from tormagd.daemon.inbox import SetpointInbox
from tormagd.hardware.measurement import Measurement
from tormagd.safety.operating_state import Conditions, RefusedError
from tormagd.scenes.scene import load_scene
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.hand import SteadyHand
from tormagd.simulation.parameters import PlantParameters, load_plant
from tormagd_client.messages import Setpoint, encode

SCENE, PLANT = "coronary", "sample_1"
SECTIONS = ("motor", "position", "trim", "limits", "rates", "device")
OF_PLANT = (("encoder_counts_per_rev", 16, 1_000_000), ("supply_V", 3.0, 25.0))
MAX_TOLD = 8
READY = Conditions(True, True, True, False, False, None, 0.5)
SHIFTED_S, BEFORE_S = 1.5, 0.7
"A run that is repeated, and how long before the rollover it begins."
SENT_HZ = 137.3
"Setpoints a second: not in step with the forecast's grid, where the last digit of a stamp would decide."
SAME_DUTY = 1e-4
"A step of the wire: what a clock of coarser floats may change."


class End(NamedTuple):
    """Some key at one end of what is accepted: of the `config`, the scene's `insert`, or the `plant`'s electronics."""

    section: str
    key: str
    value: float

    def __str__(self) -> str:
        return f"{self.section}.{self.key} = {self.value:g}"


def ends() -> list[End]:
    """Both ends of every number that shapes control, and of the device's own."""
    found = [
        End(section, key, value) for section in SECTIONS for key, value in _ends_of(type(getattr(Config(), section)))
    ]
    found += [End("insert", key, value) for key, value in _ends_of(type(load_scene(SCENE).insert))]
    return found + [End("plant", key, value) for key, *both in OF_PLANT for value in both]


def _ends_of(struct: type) -> Iterator[tuple[str, float]]:
    for key, hint in get_type_hints(struct, include_extras=True).items():
        meta = next((each for each in getattr(hint, "__metadata__", ()) if isinstance(each, msgspec.Meta)), None)
        if meta is None or meta.le is None:
            continue
        least = meta.ge if meta.ge is not None else math.nextafter(meta.gt or 0.0, math.inf)
        yield from ((key, least), (key, meta.le))


class Became(NamedTuple):
    """What became of a configuration: `refused` at the border; `ran`; `stated` where it may not be enabled or a fault
    ended it; or `wrong`. `why` has its ends and the text; the gain margin is of those that were not refused."""

    kind: str
    why: str
    gain_margin_dB: float | None = None


def drawn_ends(count: int, seed: int) -> list[tuple[End, ...]]:
    """Every end by itself, then pairs of them at random, `count` in all; of fewer than there are, some at random."""
    rng, each = random.Random(seed), ends()
    if count < len(each):
        return [(one,) for one in rng.sample(each, count)]
    pairs = [tuple(rng.sample(each, 2)) for _ in range(count - len(each))]
    return [*((one,) for one in each), *pairs]


def became(case: tuple[End, ...], seconds: float) -> Became:
    """Builds the core for these ends, arms the simulated device, and asks it for a force for so long."""
    name = ", ".join(map(str, case))
    try:
        core, plant = _built(case)
    except ValueError as error:  # a ConfigError, or the type's own
        return Became("refused", f"{name}: {error}")
    try:
        kind, why = _ran(core, plant, seconds)
    except UNNAMED as error:
        kind, why = "wrong", f"{type(error).__name__}: {error}"
    return Became(kind, f"{name}: {why}", core.margins.gain_margin_dB)


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
    loop = _loop(core, plant)
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


def _loop(core: Core, plant: PlantParameters) -> ClosedLoop:
    return ClosedLoop(core.config, core.stepper(), core.planner(), VirtualDevice(plant, SteadyHand(), seed=1))


def summed(found: list[Became]) -> dict[str, Any]:
    """Of all configurations: how many of each kind, the ends of their gain margins, and first what was wrong, then what
    was stated."""
    told = sorted((each for each in found if each.kind in ("wrong", "stated")), key=lambda each: each.kind != "wrong")
    counts = Counter(each.kind for each in found)
    margins_dB = [each.gain_margin_dB for each in found if each.gain_margin_dB is not None]
    return {
        "cases": len(found),
        **{kind: counts[kind] for kind in ("refused", "ran", "stated", "wrong")},
        "gain_margin_dB": [min(margins_dB, default=None), max(margins_dB, default=None)],
        "told": [f"{each.kind}: {each.why}" for each in told][:MAX_TOLD],
    }


def _swinging(now_s: float) -> TimedSetpoint:
    at_s = math.floor(now_s * SENT_HZ) / SENT_HZ
    return TimedSetpoint(1.3 + 0.4 * math.sin(3.0 * at_s), at_s, 0.1)


# -- counters ------------------------------------------------------------------------------------------------------

ROLLOVERS = {
    "device clock through 2^32 us": (2.0**32 * 1e-6, 0.0),
    "device clock through 2^32 ms": (2.0**32 * 1e-3, 0.0),
    "host clock through 2^32 us": (0.0, 2.0**32 * 1e-6),
    "host clock through 2^53 ns": (0.0, 2.0**53 * 1e-9),
    "both through 2^53 ns": (2.0**53 * 1e-9, 2.0**53 * 1e-9),
}
"Where the device's clock, s, and the host's roll over."
STAMPS_NS = (2**53, 2**62, 2**63 - 1)
"The last is the greatest that a setpoint may have."

Recorded = list[tuple[float, Measurement | None, TimedSetpoint]]


def counters() -> dict[str, Any]:
    """Of each rollover the greatest difference of a duty, and of a setpoint's time on the host's clock, s."""
    core = build_core(Config(scene=SCENE))
    recorded = _recorded(core)
    usual = _duties(core, recorded, 0.0, 0.0)
    differences = {
        name: max(
            abs(one - other)
            for ours, duty in zip(_duties(core, recorded, *_begin(*at)), usual, strict=True)
            for one, other in ((ours.left_duty, duty.left_duty), (ours.right_duty, duty.right_duty))
        )
        for name, at in ROLLOVERS.items()
    }
    stamps = {f"stamps about {at_ns} ns": _stamp_difference_s(at_ns) for at_ns in STAMPS_NS}
    is_same = max(differences.values()) <= SAME_DUTY and max(stamps.values()) <= 1e-9
    return {"duty": differences, "stamp_s": stamps, "passed": is_same}


def _begin(device_s: float, host_s: float) -> tuple[float, float]:
    return (max(device_s - BEFORE_S, 0.0), max(host_s - BEFORE_S, 0.0))


def _recorded(core: Core) -> Recorded:
    """What a core was given in a run of SHIFTED_S, armed and with a force that swings."""
    loop = _loop(core, load_plant(PLANT))
    loop.arm()
    return [(each.time_s, each.measurement, _swinging(each.time_s)) for each in loop.run(SHIFTED_S, _swinging)]


def _duties(core: Core, recorded: Recorded, device_s: float, host_s: float) -> list[Duty]:
    """The duties of a core that is given the same at another time of either clock."""
    first_s, *_ = recorded[0]
    stepper, planner = core.stepper(host_s + first_s), core.planner(host_s + first_s)
    found: list[Duty] = []
    for tick, (time_s, measurement, setpoint) in enumerate(recorded):
        now_s = host_s + time_s
        assert measurement is not None, "the device was armed"
        shifted = measurement.replaced(
            received_s=host_s + measurement.received_s,
            sensed_s=host_s + measurement.sensed_s,
            reported_s=host_s + measurement.reported_s,
            device_time_s=device_s + measurement.device_time_s,
        )
        found.append(stepper.step(now_s, shifted, planner.planned))
        if tick == 3 and stepper.measured is not None:
            stepper.command("enable", now_s, READY)
        if tick % 4 == 0:
            planner.plan(now_s, setpoint.replaced(stamp_s=host_s + setpoint.stamp_s), stepper.measured)
            planner.foresee()
    return found


def _stamp_difference_s(at_ns: int) -> float:
    """By how much a setpoint's time differs from the same one's with small stamps; its number is as large."""
    stamps_s = []
    for base_ns in (10**9, at_ns - 10**7):
        inbox = SetpointInbox()
        for number in range(4):
            ago_ns = 10**6 * (4 - number)
            message = Setpoint(
                v=1, source="a", seq=base_ns - ago_ns, stamp_ns=base_ns - ago_ns, servo_cf=1.0, valid_for_ms=100.0
            )
            inbox.take(encode(message), 5.0 - ago_ns * 1e-9 + 1e-3, base_ns - ago_ns + 10**6)
        assert inbox.newest is not None, inbox.last_refusal
        stamps_s.append(inbox.newest.stamp_s)
    return abs(stamps_s[0] - stamps_s[1])
