"""`benchmark black-box`: what the black box costs the control thread, in processor time.

A pulse is rendered in virtual time; its ticks, frames, setpoints and states are then written down by the daemon's own
black box in the pace of the control loop, with an idle millisecond after every part, and handed to the process that
keeps them.
The time is this thread's alone: what the kernel gives to others meanwhile does not count.
"""

import argparse
import math
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

from tormagd.closed_loop import ClosedLoop
from tormagd.config import Config
from tormagd.control.core import build_core
from tormagd.control.governor import TimedSetpoint
from tormagd.control.journal import Journal
from tormagd.control.plan import PlanState
from tormagd.control.step import StepState
from tormagd.daemon.black_box import PART_TICKS, BlackBox, header
from tormagd.daemon.telemetry import tick_record
from tormagd.hardware.connection import Connection
from tormagd.keeping import READ
from tormagd.recording.keeper import KEPT_S
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.hand import ReversingHand
from tormagd.simulation.parameters import load_plant
from tormagd_client.messages import TickRecord

PULSE_S = 3.0
PLANNED_EVERY, FORESEEN_EVERY = 2, 4
"Ticks: setpoints at 500 Hz, forecasts at 250."
ROUNDS = 7
IDLE_S = 0.001


class Kept(NamedTuple):
    """What one tick gives the black box."""

    passed: list[Any]
    "Read and written: a journal's entries."
    record: TickRecord
    setpoint: TimedSetpoint
    step: StepState
    plan: PlanState


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Has no options of its own."""


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """`tick_us`: processor time per tick, snapshots and hand-over in it, median and worst of some rounds;
    `bytes_per_tick` are kept, `ring_MB` of them in half a minute."""
    config = Config()
    core = build_core(config)
    ticks, connection = rendered(config)
    with tempfile.TemporaryDirectory() as folder:
        box = BlackBox(Path(folder), header(config, core), config.rates.control_hz)
        box.begin(ticks[0].step, ticks[0].plan, connection)
        rounds_us = [_round_us(box, ticks) for _ in range(ROUNDS + 1)][1:]
        dropped, size = box.report().dropped, box.handed_over / (len(ticks) * (ROUNDS + 1))
        box.close()
    return {
        "tick_us": round(statistics.median(rounds_us), 2),
        "worst_round_us": round(max(rounds_us), 2),
        "bytes_per_tick": round(size),
        "ring_MB": round(size * KEPT_S * config.rates.control_hz * 1e-6, 1),
        "dropped": dropped,
    }


def rendered(config: Config) -> tuple[list[Kept], Connection]:
    """The ticks of a pulse in virtual time, and the connection after them."""
    core = build_core(config)
    loop = ClosedLoop(config, core.stepper, core.planner, VirtualDevice(load_plant("sample_1"), ReversingHand(2.0)))
    loop.arm()
    journal = loop.connection.traffic = Journal()
    kept: list[Kept] = []
    while len(kept) < PULSE_S * config.rates.control_hz:
        stamp_s = math.floor(loop.now_s * 500.0) / 500.0
        setpoint = TimedSetpoint(1.3 + 0.3 * math.sin(math.tau * 1.2 * stamp_s), stamp_s, 0.1)
        sample = loop.tick(setpoint)
        assert loop.plan_state is not None
        record = tick_record(
            sample.time_s, sample.state, sample.output, sample.plan, sample.trim, sample.measurement, 0.0, 0.0
        )
        kept.append(Kept(journal.take(), record, setpoint, sample.state, loop.plan_state))
    return kept, loop.connection


def _round_us(box: BlackBox, ticks: list[Kept]) -> float:
    spent_ns = 0
    for start in range(0, len(ticks), PART_TICKS):
        begun_ns = time.thread_time_ns()
        for number, tick in enumerate(ticks[start : start + PART_TICKS]):
            for direction, *what in tick.passed:
                if direction == READ:
                    box.journal.read(*what)
                    box.journal.stepped()
                else:
                    box.journal.wrote(*what)
            if number % PLANNED_EVERY == 0:
                box.journal.planned(tick.record.monotonic_s, tick.setpoint)
            if number % FORESEEN_EVERY == 0:
                box.journal.foresaw()
            box.ticked(tick.record, tick.step, tick.plan)
        spent_ns += time.thread_time_ns() - begun_ns
        time.sleep(IDLE_S)
    return spent_ns * 1e-3 / len(ticks)


def print_table(result: dict[str, Any]) -> None:
    """For a person."""
    print(f"a tick takes {result['tick_us']:.1f} us more (worst round {result['worst_round_us']:.1f})")
    print(f"{result['bytes_per_tick']} bytes of it are kept, {result['ring_MB']} MB in half a minute")
    print(f"{result['dropped']} parts were dropped")
