"""One run of the core over a seeded history, and a digest of all that came out: what both builds have in common.

    python tests/core/histories.py     a line of JSON: which build ran, and the history's SHA-256

Every float goes into its digest as it is, to the last bit. A whole run, in both builds, is a black box that
tests/replay has the other build run again.
"""

import hashlib
import json
import math
import random
from collections.abc import Callable

from firmware_protocol.build import settle
from firmware_protocol.codec import DeviceFault, DeviceMode, DriveMode, Switches

BUILD = settle()  # before anything of the core is imported

from tormagd.config import Config  # noqa: E402
from tormagd.control.assembly.build import Core, build_core  # noqa: E402
from tormagd.control.records import Duty, Plan, TimedSetpoint  # noqa: E402
from tormagd.control.safety.codes import Fault  # noqa: E402
from tormagd.control.safety.operating_state import (  # noqa: E402
    ROWS,
    Conditions,
    Event,
    OperatingState,
    RefusedError,
    SafetyState,
    Transition,
)
from tormagd.ground.plain_values import packed, plain  # noqa: E402
from tormagd.hardware.link_statistics import LinkQuality  # noqa: E402
from tormagd.hardware.measurement import Measurement  # noqa: E402

CONFIG = Config()
STRANGE = [math.nan, math.inf, -math.inf, 0.0, -0.0, 1e-300, -1e300, 1e9, -1.0]
EPISODES, TICKS = 40, 150
COMMANDS = ["enable", "disable", "pause", "resume", "home", "stop", "clear-fault"]
NEXT = {OperatingState.DISABLED: "enable", OperatingState.FAULT: "clear-fault"}
DRIVEN = (OperatingState.ENABLED, OperatingState.PAUSED)
See = Callable[[object], None]
"Takes what came out."
WAYS = {(row.event, row.source): row.target for row in ROWS if isinstance(row, Transition)}


def hostile(core: Core, see: See, episodes: int = EPISODES) -> None:
    """Random measurements, setpoints and commands; a tenth of all numbers is none that a device gives."""
    rng = random.Random(12)
    for _ in range(episodes):
        strangeness = rng.choice([0.0, 0.0, 0.01, 0.1])
        now_s, number, at_mm = rng.uniform(0.0, 1e5), 0, rng.uniform(-25.0, 0.0)
        stepper, planner = core.stepper(now_s), core.planner(now_s)
        measured: Measurement | None = None
        for _ in range(TICKS):
            now_s += rng.choice([0.0, 2e-3, 0.02, -1e-3]) if rng.random() < 0.05 else 1e-3
            if rng.random() < 0.9:
                number += rng.random() < 0.95
                at_mm += rng.uniform(-0.02, 0.02)
                measured = measurement(rng, number, now_s, at_mm, strangeness)
            elif rng.random() < 0.02:
                measured = None
            plan = planner.planned
            if rng.random() < 0.5:
                gap_mm, speed_mm_s = rng.uniform(40.0, 100.0), rng.uniform(-40.0, 40.0)
                if rng.random() < strangeness:
                    gap_mm = rng.choice(STRANGE)
                plan = Plan(1, now_s, None, None, 0.0, None, 0.0, gap_mm, speed_mm_s, 1.0, ())
            before = stepper.safety
            output = stepper.step(now_s, measured, plan)
            see([output, stepper])
            check_step(output, before, stepper.safety)
            if rng.random() < 0.3:
                setpoint = None if rng.random() < 0.1 else setpoint_at(rng, now_s)
                try:
                    planner.plan(now_s, setpoint, stepper.measured, rng.random() < 0.8)
                    see(planner)
                    planner.governor.foresee()
                except (ValueError, OverflowError) as error:
                    see(error)
                    see(planner)
                    planner = core.planner(now_s)
            if rng.random() < 0.1:
                name = NEXT.get(stepper.safety.operating_state, "resume")
                if rng.random() < 0.2:
                    name = rng.choice(COMMANDS)
                before = stepper.safety
                _attempted(see, stepper.command, name, now_s, conditions(rng))
                if stepper.safety is not before:
                    check_way(Event(name), before, stepper.safety)
            if rng.random() < 0.003:
                before = stepper.safety
                stepper.lose_link()
                check_way(Event.FAULT, before, stepper.safety)


def check_step(output: Duty, before: SafetyState, after: SafetyState) -> None:
    duties, limit = (output.left_duty, output.right_duty), CONFIG.position.duty_limit
    assert all(abs(duty) <= limit for duty in duties), f"duties = {duties} in {after}"
    assert after.request_number >= before.request_number, f"{before} to {after}"
    is_off = output.mode is DriveMode.OFF and duties == (0.0, 0.0)
    assert is_off or after.operating_state in DRIVEN, f"{output} in {after}"
    check_way(Event.FAULT, before, after)


def check_way(event: Event, before: SafetyState, after: SafetyState) -> None:
    """Check that the operating state changes along a row of the table, and that faults are latched in FAULT alone."""
    source, target = before.operating_state, after.operating_state
    assert (after.faults != ()) == (target is OperatingState.FAULT), str(after)
    if event is Event.FAULT and set(after.faults) <= set(before.faults):
        assert target is source, f"{source} to {target} without an event"
    elif event is not Event.STOP or Fault.STOPPED not in before.faults:
        assert (event, source) in WAYS, f"{event} was taken in {source}"
        assert target is WAYS[event, source], f"{event} in {source} led to {target}"


def measurement(rng: random.Random, number: int, now_s: float, at_mm: float, strangeness: float) -> Measurement:
    def some(low: float, high: float) -> float:
        return rng.choice(STRANGE) if rng.random() < strangeness else rng.uniform(low, high)

    return Measurement(
        number=number,
        received_s=now_s - (rng.choice([1e-3, 4e-3, 0.1]) if rng.random() < 0.02 else 0.0),
        device_time_s=some(now_s - 2e-3, now_s),
        left_mm=at_mm + some(-0.01, 0.01),
        right_mm=at_mm + some(-0.05, 0.05),
        left_current_A=some(-3.0, 3.0),
        right_current_A=some(-3.0, 3.0),
        force_N=some(-0.5, 3.5),
        handle_mm=some(-50.0, 50.0) if rng.random() < 0.1 else 0.042 * number,
        mode=rng.choice([*DeviceMode]) if rng.random() < 0.02 else DeviceMode.RUN,
        switches=Switches(rng.randrange(32)) if rng.random() < 0.02 else Switches.HOMED,
        faults=DeviceFault(1 << rng.randrange(10)) if rng.random() < 0.005 else DeviceFault(0),
        temperature_C=some(20.0, 90.0),
        supply_V=some(9.0, 13.0),
        sensed_s=now_s - (rng.choice([1e-3, 0.03, 0.2]) if rng.random() < 0.02 else 0.0),
        reported_s=now_s - (rng.choice([0.02, 0.2]) if rng.random() < 0.02 else 0.0),
        delay_s=rng.choice([0.0, 2e-3, 0.02]),
        link=LinkQuality(
            rng.choice([0.0, 0.01, 0.5]), 0.0, 0.0, rng.choice([1e-3, 6e-3]), rng.choice([0.0, 3e-5, 0.02])
        ),
    )


def setpoint_at(rng: random.Random, now_s: float) -> TimedSetpoint:
    """A setpoint as it may come through the endpoint: finite, but far from what the scene asks."""
    preview_N = tuple(rng.uniform(0.0, 3.0) for _ in range(rng.choice([0, 0, 1, 7])))
    return TimedSetpoint(
        rng.choice([rng.uniform(0.0, 2.5), 0.0, 1e6]),
        now_s - rng.choice([0.0, 1e-3, 0.5, -0.01]),
        rng.choice([0.05, 0.2]),
        rng.choice([None, 0.0, 0.4, 30.0]),
        rng.choice([None, 0.0, -42.0, 1e4]),
        preview_N,
        0.01 if preview_N else 0.0,
    )


def conditions(rng: random.Random) -> Conditions:
    good = [rng.random() < 0.95 for _ in range(3)]
    return Conditions(
        connected=good[0],
        fresh=good[1],
        homed=good[2],
        busy=rng.random() < 0.05,
        device_latched=rng.random() < 0.05,
    )


def _attempted(see: See, attempt: Callable[..., object], *arguments: object) -> None:
    try:
        see(attempt(*arguments))
    except RefusedError as error:
        see(error)


def main() -> None:
    digest = hashlib.sha256()

    def see(thing: object) -> None:
        digest.update(packed(f"{type(thing).__name__}: {thing}" if isinstance(thing, Exception) else plain(thing)))

    hostile(build_core(CONFIG), see)
    print(json.dumps({"is_compiled": BUILD.is_compiled, "digest": digest.hexdigest()}))


if __name__ == "__main__":
    main()
