"""One profile on one simulated device in virtual time: what `make run` shows beside its real-time figures."""

from dataclasses import dataclass, field

import msgspec
import numpy as np
import numpy.typing as npt

from tormagd.closed_loop import ClosedLoop, stream
from tormagd.config import Config
from tormagd.control.core import build_core
from tormagd.scenes.scene import load_scene
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.hand import parse_hand
from tormagd.simulation.parameters import load_plant

Array = npt.NDArray[np.float64]

LEAD_IN_S = 0.2
"Time between enabling and the first setpoint."


@dataclass(frozen=True)
class Case:
    """What is rehearsed: a plant, a hand, and the gap speed the controller may use (None: the configured one)."""

    label: str
    plant: str = "sample_1"
    hand: str = "steady"
    gap_speed_mm_s: float | None = None
    seed: int = 1


@dataclass(frozen=True)
class Rehearsal:
    """The profile asked for and what the plant rendered, on one time axis that starts with the profile."""

    case: Case
    time_s: Array
    asked_N: Array
    rendered_N: Array
    handle_mm_s: Array
    gap_mm: Array
    limits: dict[str, float] = field(default_factory=dict)
    "Share of time each limit was held."


def rehearse(config: Config, case: Case, times_s: Array, forces_N: Array) -> Rehearsal:
    """Homes, enables, plays the profile. Raises RuntimeError where the device does not get that far or faults."""
    if case.gap_speed_mm_s is not None:
        slow = msgspec.structs.replace(config.position, gap_speed_mm_s=case.gap_speed_mm_s)
        config = msgspec.structs.replace(config, position=slow)
    # what is played is not the scene's own signal, which the daemon refuses where the gap is too slow for it
    core = build_core(config, msgspec.structs.replace(load_scene(config.scene), signal=None))
    device = VirtualDevice(load_plant(case.plant), parse_hand(case.hand), seed=case.seed)
    loop = ClosedLoop(config, core.stepper, core.planner, device)
    loop.arm()
    start_s = loop.now_s + LEAD_IN_S
    publisher = stream(times_s + start_s, forces_N)
    time, rendered, handle, gap = [], [], [], []
    held: dict[str, int] = {}
    for sample in loop.run(LEAD_IN_S + float(times_s[-1]), publisher):
        if sample.state.safety.faults:
            raise RuntimeError(f"{case.label}: {', '.join(sample.state.safety.faults)} at {sample.time_s:.3f} s")
        if sample.time_s < start_s:
            continue
        time.append(sample.truth.time_s - start_s)
        rendered.append(sample.truth.force_N)
        handle.append(sample.truth.handle_mm_s)
        gap.append(sample.truth.gap_mm)
        for limit in dict.fromkeys((*sample.plan.limits, *sample.output.limits)):
            held[limit] = held.get(limit, 0) + 1
    axis = np.array(time)
    return Rehearsal(
        case,
        axis,
        np.interp(axis, times_s, forces_N),
        np.array(rendered),
        np.array(handle),
        np.array(gap),
        {limit: count / len(axis) for limit, count in held.items()},
    )
