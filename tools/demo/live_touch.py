"""The first part of `make run`: a hand that feels the brake meets one stiff wall three times, in real time.

The hand is the simulated device's own, the patient behind a network of 100 ms round trip. It sends the tip's forces at
first, then the wall that the client's estimator found in them; the third time the scene has its standby. Beside each
are carriages that are limited by their motors alone, in virtual time, for the same patient and scene.
"""

import contextlib
import math
import signal
import subprocess
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from devices import device
from judge.following import armed
from judge.touching import MASS_KG, Bound, Touch, core_with, reached_ms
from machines.host import HostWatch
from machines.own import own_machine

from demo.show import (
    PUBLISHER_FIFO,
    RUN_DIR,
    Rig,
    ShowError,
    arm,
    enabled,
    ended,
    raise_fault,
    start,
    status,
    told_truth,
    watch,
)
from tormag_lab.arrays import Json
from tormagd.control.assembly.build import Core
from tormagd.control.records import TimedSetpoint, Wall
from tormagd.ctl.operate import open_gap
from tormagd.ctl.processes import first_line
from tormagd.ctl.scene import use_scene
from tormagd.scenes.scene import load_scene
from tormagd.simulation.hand import PRESSES_AT_S, parse_hand
from tormagd.simulation.patient import FOUND, PERIOD_S, VALID_MS, Patient, Unit
from tormagd.simulation.plant import Plant
from tormagd_client import ClientError

SCENE = Path(__file__).parents[2] / "examples" / "scenes" / "touch.toml"
ROUND_TRIP_MS = 100.0
WALL_N_MM, WALL_MM = 0.5, 15.5
"Its place is from where the handle rests before the first touch."
HAND_N_MM, PUSH_MM_S, REACH_MM, REST_S = 0.3, 30.0, 26.0, 0.9
HAND = (
    f"felt=mass_kg={MASS_KG},stiffness_N_mm={HAND_N_MM},damping_N_s_mm=0.0134,push_mm_s={PUSH_MM_S},"
    f"reach_mm={REACH_MM},rest_s={REST_S}"
)
PATIENT = [
    *(str(RUN_DIR), f"--mode={FOUND}", f"--delay-ms={ROUND_TRIP_MS / 2.0}", "--friction-N=0"),
    *(f"--wall-mm={WALL_MM}", f"--stiffness-N-mm={WALL_N_MM}"),
]
HALF_S = REACH_MM / PUSH_MM_S + REST_S
STAYS_S, READY_S = 0.15, 0.4
"A push is over once the handle has been back for so long; what is ready so long before one is in time for it."
TICK_S = 1e-3
FELT_N = 1.2
TOUCHES = ("first, by forces", "second, by the wall found", "third, with standby")


def felt(watched: HostWatch) -> list[Touch]:
    without = RUN_DIR / "no_standby.toml"
    without.write_text("".join(line for line in SCENE.open() if not line.startswith("standby_N")))
    with contextlib.ExitStack() as stack:
        rig = enabled(stack, watched, str(without), "--hand", HAND)
        words = own_machine(PUBLISHER_FIFO, "tormagd.simulation.patient", *PATIENT, waits=True)
        patient = start(stack, "patient", *words, is_read=True)
        first_line(patient)
        now_s = time.monotonic() - rig.power_on_s
        first = next_push(now_s)
        if first > 0:  # the patient meets the handle where it rests
            time.sleep(max(begins_s(first) - REST_S + STAYS_S - now_s, 0.0))
        patient.send_signal(signal.SIGUSR1)
        print(f"a wall of {WALL_N_MM:g} N/mm over a round trip of {ROUND_TRIP_MS:g} ms, met twice:")
        pushed(rig, first + 1, patient)
        try:
            open_gap(rig.client, "disable")
            use_scene(rig.client, str(SCENE))
        except ClientError as error:
            raise ShowError(error.message, error.hint, is_of_time=True) from error
        arm(rig.client)
        third = next_push(time.monotonic() - rig.power_on_s)
        print("the same wall once more, with the scene's standby:")
        pushed(rig, third, patient)
        raise_fault(status(rig.client))
        rig.end()
    return touches(told_truth(), (first, first + 1, third))


def pushed(rig: Rig, push: int, patient: "subprocess.Popen[str]") -> None:
    """Show what happens until this push is over."""
    until_s = rig.power_on_s + begins_s(push + 1) - REST_S + STAYS_S
    watch(lambda: time.monotonic() >= until_s, rig.daemon, rig.client, until_s - time.monotonic())
    if patient.poll() is not None:
        raise ended("patient")


def begins_s(push: int) -> float:
    return PRESSES_AT_S + 2.0 * HALF_S * push


def next_push(now_s: float) -> int:
    return max(math.ceil((now_s + READY_S - PRESSES_AT_S) / (2.0 * HALF_S)), 0)


def touches(truth: Any, pushes: tuple[int, ...]) -> list[Touch]:
    """Return these pushes of a truth with a row for each millisecond since the device has power."""
    firsts = [round(begins_s(push) / TICK_S) for push in pushes]
    wall_mm, found = truth["handle_mm"][firsts[0]] + WALL_MM, []
    for first in firsts:
        rows = truth[first : first + round(2.0 * HALF_S / TICK_S)]
        time_s, force_N = np.linspace(0.0, TICK_S * (len(rows) - 1), len(rows)), rows["force_N"]
        depth_mm = rows["handle_mm"] - wall_mm
        found.append(Touch(time_s, depth_mm, rows["handle_mm_s"], rows["kinetic_N"], force_N, force_N, (), ()))
    return found


def figures(run: Touch, bound: Touch) -> Json:
    """Return what was there and what was felt where the handle turns, and how much later it was felt."""
    turn = round(HALF_S / TICK_S) - 1
    return {
        "deepest_mm": float(run.depth_mm[turn]),
        "wall_N": WALL_N_MM * float(run.depth_mm[turn]),
        "felt_N": float(run.kinetic_N[turn]),
        "felt_later_ms": reached_ms(run, WALL_N_MM, FELT_N),
        "bound_later_ms": reached_ms(bound, WALL_N_MM, FELT_N),
    }


@cache
def bounds() -> list[Touch]:
    return in_virtual_time(carriages)


def in_virtual_time(begun: Callable[[Core], tuple[Plant, Callable[[TimedSetpoint | None], object]]]) -> list[Touch]:
    """Return the touches of what `begun` makes of a scene's core: a plant, and what a setpoint does for a tick."""
    name = str(SCENE)
    cores = core_with(name=name), core_with(load_scene(name).force.standby_N, name)
    first, second = (played(*begun(core)) for core in cores)
    return [*touches(first, (0, 1)), touches(second, (0, 1))[1]]


def played(plant: Plant, advance: Callable[[TimedSetpoint | None], object]) -> Any:
    """Return the truth of two pushes for a patient that begins before the first."""
    unit = Unit(
        Patient(friction_N=0.0, wall_mm=WALL_MM, stiffness_N_mm=WALL_N_MM), FOUND, (5e-4 * ROUND_TRIP_MS, 0.0, 0.0, 1.0)
    )
    told = [plant.truth] * round(plant.time_s / TICK_S)
    setpoint: TimedSetpoint | None = None
    while len(told) < round(begins_s(2) / TICK_S):
        now_s = plant.time_s
        if len(told) % round(PERIOD_S / TICK_S) == 0:
            for sent_s, fields in unit.update(now_s, [plant.truth.handle_mm]):
                wall = fields.get("contact")
                wall = wall and Wall(*msgspec.structs.astuple(wall))
                setpoint = TimedSetpoint(fields["servo_cf"], sent_s, 1e-3 * VALID_MS, wall=wall)
        advance(setpoint)
        told.append(plant.truth)
    names = ("handle_mm", "handle_mm_s", "kinetic_N", "force_N")
    rows = [tuple(getattr(truth, name) for name in names) for truth in told]
    return np.array(rows, [(name, float) for name in names])


def carriages(core: Core) -> tuple[Plant, Callable[[TimedSetpoint | None], object]]:
    bound = Bound(core, device("sample_1"), parse_hand(HAND))
    return bound.plant, bound.tick


def controller(core: Core) -> tuple[Plant, Callable[[TimedSetpoint | None], object]]:
    loop = armed(core, device("sample_1"), parse_hand(HAND))
    return loop.simulated.plant, loop.tick


def lateness(later_ms: float | None) -> str:
    return "never" if later_ms is None else f"{abs(later_ms):.0f} ms {'late' if later_ms >= 0.0 else 'early'}"
