"""One profile on one simulated device in virtual time: what `make run` shows beside its real-time figures."""

from typing import NamedTuple

import msgspec
import numpy as np

from rendering.device_draws import device
from rendering.following import Array, Followed, armed, follow, publisher
from tormagd.config import Config
from tormagd.scenes.scene import load_scene
from tormagd.simulation.hand import parse_hand

LEAD_IN_S = 0.2
"Time between enabling and the first setpoint."
VALID_S = 0.1


class Case(NamedTuple):
    """What is rehearsed: a plant, a hand, and the gap speed the controller may use (None: the configured one)."""

    label: str
    plant: str = "sample_1"
    hand: str = "steady"
    gap_speed_mm_s: float | None = None


Rehearsals = dict[Case, Followed]


def rehearse(config: Config, case: Case, times_s: Array, forces_N: Array) -> Followed:
    """Homes, enables, plays the profile. Raises RuntimeError where the device does not get that far or faults."""
    if case.gap_speed_mm_s is not None:
        slow = msgspec.structs.replace(config.position, gap_speed_mm_s=case.gap_speed_mm_s)
        config = msgspec.structs.replace(config, position=slow)
    # what is played is not the scene's own signal, which the daemon refuses where the gap is too slow for it
    scene = msgspec.structs.replace(load_scene(config.scene), signal=None)
    loop = armed(config, device(case.plant), parse_hand(case.hand), scene)
    start_s = loop.now_s + LEAD_IN_S
    publish = publisher(times_s + start_s, forces_N, 0.0, VALID_S)
    found = follow(loop, publish, LEAD_IN_S + float(times_s[-1]), start_s)
    if found.faults:
        raise RuntimeError(f"{case.label}: {', '.join(found.faults)} at {loop.now_s:.3f} s")
    return found._replace(asked_N=np.interp(found.time_s, times_s, forces_N))
