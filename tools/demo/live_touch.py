"""The first part of `make run`: a hand that feels the brake pushes into two walls, in real time.

The hand is the simulated device's own. Behind a network of 100 ms round trip one patient has a soft wall, the next a
stiff one; each sends it as a law once it is met. What carriages of this speed leave is from virtual time.
"""

import contextlib
import math
import signal
import subprocess
import time
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from judge.touching import MASS_KG, Case, Touch, ideal, reached_ms
from machines.host import HostWatch
from machines.own import own_machine
from machines.processes import end, first_line

from demo.show import PUBLISHER_FIFO, RUN_DIR, Rig, enabled, ended, raise_fault, start, status, told_truth, watch
from tormag_lab.arrays import Json
from tormagd.simulation.hand import PRESSES_AT_S

SCENE = Path(__file__).parents[2] / "examples" / "scenes" / "touch.toml"
ROUND_TRIP_MS, ROBOT_LAG_MS = 100.0, 20.0
HAND_N_MM, PUSH_MM_S, REACH_MM, REST_S = 0.3, 30.0, 26.0, 0.9
HAND = (
    f"felt=mass_kg={MASS_KG},stiffness_N_mm={HAND_N_MM},damping_N_s_mm=0.0134,push_mm_s={PUSH_MM_S},"
    f"reach_mm={REACH_MM},rest_s={REST_S}"
)
HALF_S = REACH_MM / PUSH_MM_S + REST_S
STAYS_S, READY_S = 0.15, 0.4
"A patient stays until the handle has been back for so long, and begins at least so long before a push."
TICKS_HZ = 1000
FELT_N = 1.2


class Wall(NamedTuple):
    """`place_mm` is from where the handle rests."""

    name: str
    stiffness_N_mm: float
    place_mm: float


WALLS = (Wall("soft", 0.1, 4.0), Wall("stiff", 0.5, 15.5))


def felt(watched: HostWatch) -> dict[Wall, Touch]:
    with contextlib.ExitStack() as stack:
        rig = enabled(stack, watched, str(SCENE), "--hand", HAND)
        # both are loaded before the first push: there is less than a second between two
        patients = [start(stack, "patient", *patient_of(wall), is_read=True) for wall in WALLS]
        pushes = [pushed(rig, *each) for each in zip(WALLS, patients, strict=True)]
        raise_fault(status(rig.client))
        rig.end()
    truth = told_truth()
    return {wall: touch_of(truth, push, wall) for push, wall in zip(pushes, WALLS, strict=True)}


def pushed(rig: Rig, wall: Wall, patient: "subprocess.Popen[str]") -> int:
    first_line(patient)
    now_s = time.monotonic() - rig.power_on_s
    push = next_push(now_s)
    if push > 0:  # one that was missed is no touch of this wall
        time.sleep(max(begins_s(push) - REST_S + STAYS_S - now_s, 0.0))
    patient.send_signal(signal.SIGUSR1)
    until_s = rig.power_on_s + begins_s(push + 1) - REST_S + STAYS_S
    print(f"a {wall.name} wall, {wall.stiffness_N_mm:g} N/mm, over a round trip of {ROUND_TRIP_MS:g} ms:")
    watch(lambda: time.monotonic() >= until_s, rig.daemon, rig.client, until_s - time.monotonic())
    if patient.poll() is not None:
        raise ended("patient")
    end(patient)
    return push


def patient_of(wall: Wall) -> list[str]:
    """Return the interpreter's arguments for the patient of this wall, who waits at first."""
    told = f"--mode=law --delay-ms={ROUND_TRIP_MS / 2.0} --wall-mm={wall.place_mm} --friction-N=0"
    options = [str(RUN_DIR), *told.split(), f"--stiffness-N-mm={wall.stiffness_N_mm}"]
    return own_machine(PUBLISHER_FIFO, "tormagd.simulation.patient", *options, waits=True)


def begins_s(push: int) -> float:
    return PRESSES_AT_S + 2.0 * HALF_S * push


def next_push(now_s: float) -> int:
    return max(math.ceil((now_s + READY_S - PRESSES_AT_S) / (2.0 * HALF_S)), 0)


def touch_of(truth: Any, push: int, wall: Wall) -> Touch:
    first = round(TICKS_HZ * begins_s(push))
    rows = truth[first : first + round(TICKS_HZ * 2.0 * HALF_S)]
    depth_mm = rows["handle_mm"] - rows["handle_mm"][0] - wall.place_mm
    time_s, force_N = np.arange(len(rows)) / TICKS_HZ, rows["force_N"]
    return Touch(time_s, depth_mm, rows["handle_mm_s"], rows["kinetic_N"], force_N, force_N, (), ())


def figures(wall: Wall, run: Touch) -> Json:
    """Return what was there and what was felt where the handle turns, and how much later it was felt."""
    turn = int((run.time_s < HALF_S).sum()) - 1
    return {
        "stiffness_N_mm": wall.stiffness_N_mm,
        "deepest_mm": float(run.depth_mm[turn]),
        "wall_N": wall.stiffness_N_mm * float(run.depth_mm[turn]),
        "felt_N": float(run.kinetic_N[turn]),
        "felt_later_ms": reached_ms(run, wall.stiffness_N_mm, FELT_N),
        "bound_later_ms": bound_ms(wall),
    }


@cache
def bound_ms(wall: Wall) -> float | None:
    """Return how much later carriages of this speed have it felt, apart from the robot's lag."""
    late_ms = ROUND_TRIP_MS + ROBOT_LAG_MS
    case = Case("sample_1", HAND_N_MM, wall.stiffness_N_mm, PUSH_MM_S, late_ms, "law_standby", is_known=False)
    return reached_ms(ideal(case), wall.stiffness_N_mm, FELT_N)


def lateness(later_ms: float | None) -> str:
    return "never" if later_ms is None else f"{abs(later_ms):.0f} ms {'late' if later_ms >= 0.0 else 'early'}"
