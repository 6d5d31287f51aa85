"""A random walk of the core: hostile measurements, plans and commands, and what must hold in every step.

Three things, whatever comes in: duties are within the limit and finite, nothing is driven while not ENABLED or PAUSED,
and the operating state changes only along a row of the table.
"""

import math
import random
from collections import Counter
from collections.abc import Callable
from typing import Any

from tqdm import tqdm

from firmware_protocol.codec import DeviceFault, DeviceMode, DriveMode, Switches
from tormagd.assembly.build import build_core
from tormagd.config import Config
from tormagd.control.core import Stepper
from tormagd.control.records import Plan
from tormagd.hardware.link_quality import LinkQuality
from tormagd.hardware.measurement import Measurement
from tormagd.safety.codes import Fault
from tormagd.safety.operating_state import (
    COMMANDS,
    ROWS,
    Conditions,
    Event,
    OperatingState,
    RefusedError,
    SafetyState,
    Transition,
)

EPISODE = 2_000
"Steps between two starts from nothing."
STRANGE = (math.nan, math.inf, -math.inf, 1e300, -1e300, 0.0, -0.0)
NEXT = {OperatingState.DISABLED: "enable", OperatingState.FAULT: "clear-fault", OperatingState.PAUSED: "resume"}
"What leads back to where something is driven."
DRIVEN = (OperatingState.ENABLED, OperatingState.PAUSED)
ALLOWED = {(row.event, row.source): row.target for row in ROWS if isinstance(row, Transition)}


class BrokenRuleError(Exception):
    """A step did what none may."""


class Walk:
    """One walk. `seed` draws all of it; the same seed walks the same way."""

    def __init__(self, begun: Callable[[float], Stepper], duty_limit: float, seed: int) -> None:
        """`begun` gives steps that begin at a time."""
        self._begun, self._limit, self._random = begun, duty_limit, random.Random(seed)
        self.steps = self.driven = 0
        self.ways: Counter[str] = Counter()
        self.begin()

    def begin(self) -> None:
        """Starts from nothing: another process, another device."""
        draw = self._random
        self.now_s, self._number, self._at_mm = draw.uniform(0.0, 1e5), 0, draw.uniform(-25.0, 0.0)
        self._strangeness = draw.choice((0.0, 0.0, 0.0, 0.003, 0.1))
        self._gap_mm = draw.uniform(40.0, 100.0)
        self.stepper = self._begun(self.now_s)

    def go(self, steps: int) -> None:
        """Walks on. Raises BrokenRuleError."""
        draw = self._random
        for _ in range(steps):
            self.steps += 1
            if self.steps % EPISODE == 0:
                self.begin()
            self.now_s += 1e-3 if draw.random() > 0.01 else draw.choice((0.0, 2e-3, 0.02, 0.09, -1e-3))
            measured = None if draw.random() < 1e-4 else self._measured()
            if draw.random() < 0.02:
                self._gap_mm = draw.choice(STRANGE) if draw.random() < self._strangeness else draw.uniform(40.0, 100.0)
            plan = Plan(1, self.now_s, None, None, 0.0, None, 0.0, self._gap_mm, draw.uniform(-40.0, 40.0), 1.0, ())
            before = self.stepper.safety
            output = self.stepper.step(self.now_s, measured, plan)
            after = self.stepper.safety
            is_driven = after.operating_state in DRIVEN
            duties = (output.left_duty, output.right_duty)
            if not (abs(duties[0]) <= self._limit and abs(duties[1]) <= self._limit):  # NaN is no duty either
                raise BrokenRuleError(f"duties = {duties} in {after}: allowed is -{self._limit:g}..{self._limit:g}")
            if not is_driven and (output.mode is not DriveMode.OFF or duties != (0.0, 0.0)):
                raise BrokenRuleError(f"{output} in {after}: allowed is OFF")
            self.driven += is_driven
            self._check(Event.FAULT, before, after)
            if draw.random() < 0.02:
                self._command()

    def _command(self) -> None:
        draw = self._random
        likely = NEXT.get(self.stepper.safety.operating_state, "resume")
        self.operate(draw.choice(COMMANDS) if draw.random() < 0.1 else likely)

    def operate(self, name: str) -> None:
        """An operator's command, under conditions that are drawn. Raises BrokenRuleError."""
        before = self.stepper.safety
        try:
            self.stepper.command(name, self.now_s, self._conditions())
        except RefusedError:
            return
        if (Event(name), before.operating_state) not in ALLOWED:
            raise BrokenRuleError(f"{name} was taken in {before.operating_state}: no row of the table")
        self._check(Event(name), before, self.stepper.safety)

    def _check(self, event: Event, before: SafetyState, after: SafetyState) -> None:
        """What a step or a command did to the operating state is a row of the table."""
        source, target = before.operating_state, after.operating_state
        new = [fault for fault in after.faults if fault not in before.faults]
        if (after.faults != ()) != (target is OperatingState.FAULT):
            raise BrokenRuleError(f"{after}: allowed are faults in FAULT, and there only")
        if event is Event.FAULT and not new:
            if target is not source:
                raise BrokenRuleError(f"{source} to {target} without an event")
            return
        if target is not ALLOWED[event, source] and not (event is Event.STOP and Fault.STOPPED in before.faults):
            raise BrokenRuleError(f"{event} in {source} led to {target}: allowed is {ALLOWED[event, source]}")
        self.ways[f"{source} to {target} by {event}"] += source is not target

    def _some(self, low: float, high: float) -> float:
        draw = self._random
        return draw.choice(STRANGE) if draw.random() < self._strangeness else draw.uniform(low, high)

    def _measured(self) -> Measurement:
        """A homed device's that runs, mostly."""
        draw, some, number = self._random, self._some, self._number
        is_odd = draw.random() < 0.002
        self._number = number = number + (draw.random() < 0.97)
        reference = self.stepper.move.reference
        if reference is not None and abs(reference.gap_mm) < 200.0:  # carriages follow, more or less
            self._at_mm += 0.3 * (reference.gap_mm / 2.0 - 47.5 - self._at_mm)
        leap_mm = 4.0 if draw.random() < 1e-4 else 0.0
        return Measurement(
            number,
            self.now_s - (draw.choice((4e-3, 0.1)) if is_odd else 1e-3),
            some(self.now_s - 2e-3, self.now_s),
            self._at_mm + leap_mm + some(-0.005, 0.005),
            self._at_mm + some(-0.005, 0.005),
            0.1,
            0.1,
            some(0.0, 2.9) if is_odd else some(0.5, 1.5),
            0.042 * number,
            draw.choice([*DeviceMode]) if is_odd else DeviceMode.RUN,
            Switches(draw.randrange(32)) if is_odd else Switches.HOMED,
            DeviceFault(1 << draw.randrange(10)) if draw.random() < 1e-4 else DeviceFault(0),
            some(20.0, 30.0),
            some(9.0, 13.0),
            self.now_s - (draw.choice((0.03, 0.2)) if is_odd else 1e-3),
            self.now_s - (0.2 if is_odd and draw.random() < 0.2 else 0.01),
            0.0,
            LinkQuality(0.0, 0.0, 0.0, 6e-3 if is_odd else 1e-3, draw.choice((0.02, 0.2)) if is_odd else 3e-5),
        )

    def _conditions(self) -> Conditions:
        """Mostly those under which a device can be enabled."""
        draw = self._random
        good = [draw.random() < 0.97 for _ in range(5)]
        return Conditions(
            connected=good[0],
            fresh=good[1],
            homed=good[2],
            busy=not good[3],
            device_latched=not good[4],
            requested_N=draw.choice((None, 0.0, 0.0, 1.5, math.nan)),
            neutral_N=0.65,
            clock_drift=draw.choice((0.0, 0.0, 0.0, 0.2)),
        )


def run(count: int, seed: int) -> dict[str, Any]:
    """Walks `count` steps; the figures, and `failures`."""
    config = Config()
    walk = Walk(build_core(config).stepper, config.position.duty_limit, seed)
    failures: list[str] = []
    with tqdm(total=count, desc="random walk", unit="step", disable=None) as progress:
        while walk.steps < count and not failures:
            before = walk.steps
            try:
                walk.go(min(EPISODE, count - before))
            except BrokenRuleError as error:
                failures.append(f"step {walk.steps} of seed {seed}: {error}")
            progress.update(walk.steps - before)
    return {
        "steps": walk.steps,
        "driven": walk.driven,
        "ways": +walk.ways,
        "failures": failures,
    }
