"""The core at its entries, each stage as a whole, and how each is fed: see `stages.py`.

A stage owns its parts, and all of their fields are looked at. A part has a row of its own where what its stage lets
through does not reach its edges.
"""

import math
import random
from functools import cache, partial
from typing import Any

import numpy as np

from firmware_protocol.codec import (
    DeviceFault,
    DeviceMode,
    Sense,
    State,
    Status,
    Switches,
)
from judge.stages import Draw, Stage
from tormagd.config import Config, Motor, Position
from tormagd.control.aim.aim import Aim
from tormagd.control.aim.portrait import Portrait, PortraitSearch
from tormagd.control.ask.forecast import Forecast
from tormagd.control.ask.governor import Governor
from tormagd.control.ask.path import TIMES_S
from tormagd.control.assembly.build import Core, build_core
from tormagd.control.believe.believe import Believe
from tormagd.control.believe.handle import HandleWatch
from tormagd.control.believe.slow_friction import SlowFriction
from tormagd.control.believe.strength import UNSEEN, Anchor
from tormagd.control.core import Planner, Stepper
from tormagd.control.interpolation import Rising, at_step, interpolated
from tormagd.control.measure import Measure
from tormagd.control.move.carriages import Carriages
from tormagd.control.move.motor import full_speed_mm_s, margins
from tormagd.control.nominal import FieldOfGap
from tormagd.control.records import Ask, Handle, Measured, Plan, TimedSetpoint, Travel, Wall
from tormagd.control.safety.codes import Fault
from tormagd.control.safety.operating_state import Conditions, SafetyState, command
from tormagd.element.inverse.choice import RUNTIME_SOLVERS, build, named
from tormagd.element.model.displacement import MOBILISED_MM, Turn
from tormagd.element.model.model_file import load_model, model_path
from tormagd.element.physics.errors import DomainError
from tormagd.hardware.link import DeviceLink
from tormagd.hardware.link_statistics import DeviceClock, LinkQuality
from tormagd.hardware.measurement import Measurement

PERIOD_S, PLAN_S, LONGEST_S = 1e-3, 4e-3, 1e-2
"Periods of a tick and of a plan, and the longest tick of `Stepper`."
BEGINS_S = 9.9
CONFIG = Config(scene="coronary")
BOUNDS = CONFIG.trim
READY = Conditions(True, True, True, False, False)
OWN, MEASUREMENT, SETPOINT, CODEC, CONFIGURATION = (
    "",
    "Stepper, of measurements",
    "ask/governor, of setpoints",
    "firmware_protocol: codec",
    "config",
)
"Checks in front of a stage, beside its own."


@cache
def core() -> Core:
    return build_core(CONFIG)


# -- inputs, all of them at the time of the draw -------------------------------------------------------------------


def measurement(draw: Draw) -> Measurement:
    """Return a healthy homed device's measurement at a gap of 80 mm, except for what is drawn."""
    return Measurement(
        number=draw.steps,
        received_s=draw(draw.now_s),
        device_time_s=draw(draw.now_s),
        left_mm=draw(-7.5),
        right_mm=draw(-7.5),
        left_current_A=draw(0.1),
        right_current_A=draw(0.1),
        force_N=draw(1.1),
        handle_mm=draw(42.0 * draw.now_s),
        mode=DeviceMode.RUN,
        switches=Switches.HOMED,
        faults=DeviceFault(0),
        temperature_C=draw(23.0),
        supply_V=draw(12.0),
        sensed_s=draw(draw.now_s),
        reported_s=draw(draw.now_s),
        delay_s=draw(0.0),
        link=LinkQuality(0.0, 0.0, 0.0, draw(2e-3), draw(0.0)),
    )


def measured(draw: Draw) -> Measured:
    some, now_s = draw.bounded, draw.now_s
    turn = Turn(1.0 if some(1.0) >= 0.0 else -1.0, some(0.0), some(42.0 * now_s))
    handle = Handle(min(abs(some(MOBILISED_MM)), MOBILISED_MM), some(42.0), turn, abs(some(42.0)))
    return Measured(
        number=draw.steps,
        is_homed=True,
        device_time_s=some(now_s),
        left_mm=some(40.0),
        right_mm=some(40.0),
        left_mm_s=some(0.0),
        right_mm_s=some(0.0),
        force_N=some(1.1),
        handle=handle,
        handle_mm=some(42.0 * now_s),
        sensed_s=some(now_s),
        handle_time_s=some(now_s),
    )


def setpoint(draw: Draw) -> TimedSetpoint:
    """Return about 1.2 N, in a third of the steps with a preview, in a quarter with a wall."""
    preview = tuple([draw(1.2) for _ in range(8)]) if draw.steps % 3 == 0 else ()
    made = TimedSetpoint(draw(1.2), draw(draw.now_s), draw(0.1), None, None, preview, draw(0.05) if preview else 0.0)
    if draw.steps % 4 == 1:
        made = made.replaced(withdraw_N=draw(0.5), wall=Wall(draw(5.0), draw(0.3), draw(0.5)))
    return made.replaced(displacement_mm=draw(MOBILISED_MM), rate_mm_s=draw(42.0)) if draw.steps % 2 else made


def plan(draw: Draw) -> Plan:
    at_s = draw(draw.now_s)
    at = Plan(1, at_s, 1.2, draw(0.0), draw(1.2), draw(1.1), draw(200.0), draw(79.0), draw(-5.0), draw(1.0), ())
    return at.replaced(gap_acceleration_mm_s2=draw(0.0), min_gap_mm=draw(45.0), sensor_doubted_s=draw(0.0))


def usual(now_s: float) -> Draw:
    draw = Draw(random.Random(0), ())
    draw.now_s = now_s
    return draw


# -- the core through its entries ----------------------------------------------------------------------------------


def stepper() -> Stepper:
    made = core().stepper(BEGINS_S)
    for tick in range(1, 4):
        draw = usual(BEGINS_S + tick * PERIOD_S)
        draw.steps = -tick
        made.step(draw.now_s, measurement(draw), Plan(1, draw.now_s, None, None, 0.0, None, 0.0, 80.0, 0.0, 1.0, ()))
    made.command("enable", BEGINS_S + 0.01, READY)
    return made


def step(stage: Stepper, draw: Draw) -> object:
    duty = stage.step(draw(draw.now_s), measurement(draw), plan(draw))
    faults = stage.safety.faults
    if Fault.NOT_FINITE in faults:
        raise DomainError("measurement or plan", Fault.NOT_FINITE, "finite numbers")
    return [duty, list(faults), stage.measured]


def planner() -> Planner:
    return core().planner(BEGINS_S)


def planning(stage: Planner, draw: Draw) -> object:
    now_s, told_s = draw.now_s, draw(draw.now_s)
    try:
        made = stage.plan(now_s if math.isfinite(told_s) else told_s, setpoint(draw), measured(draw))
    except DomainError as error:
        stage.afresh(now_s)
        try:
            stage.plan(now_s, setpoint(usual(now_s)), measured(usual(now_s)))
        except DomainError as again:
            raise AssertionError(f"afresh after {error}") from again
        raise
    stage.governor.foresee()
    return made


# -- measure -------------------------------------------------------------------------------------------------------


def measure(stage: Measure, draw: Draw) -> object:
    return stage.update(draw.last_s, draw.now_s, measurement(draw), False)


# -- believe -------------------------------------------------------------------------------------------------------


def believing(stage: Believe, draw: Draw) -> object:
    seen = measured(draw)
    belief = stage.update(draw.now_s, seen)
    stage.learn_lag(0.0, seen, draw(1.0), draw(80.0))
    return [belief, stage.learned(), stage.memory.open_N()]


def slow_friction(stage: SlowFriction, draw: Draw) -> object:
    stage.rescale(draw(1.1), draw(1.1), abs(draw(5.0)))
    if (model_N := draw(1.1)) > 0.1:  # as in `believe`
        stage.update(UNSEEN, model_N, abs(draw(1.0)) % 6.0, draw(1.2), PLAN_S)
    return stage.factor_at(abs(draw(1.0)))


def anchor(stage: Anchor, draw: Draw) -> object:
    stage.learn(draw(1.1), draw(1.2), draw.positive(PLAN_S))
    return [stage.force_N(1.1), stage.deviation_N(1.1), stage.model_N(2.15)]


def handle_watch(stage: HandleWatch, draw: Draw) -> object:
    return [stage.update(measured(draw), draw(1.1)), stage.creep_mm_s, stage.moved_gap_at_rest(1.1)]


# -- ask -----------------------------------------------------------------------------------------------------------


def governor(stage: Governor, draw: Draw) -> object:
    travel = Travel(draw.bounded(6.0), draw.bounded(20.0), draw.steps % 3 > 0)
    asked = stage.update(draw.now_s, setpoint(draw), UNSEEN, abs(draw.bounded(0.02)), travel)
    stage.foresee()
    return asked


def forecast(stage: Forecast, draw: Draw) -> object:
    if not stage.history or len(stage.history) < 800:  # what it needs to forecast
        for place in range(150):
            stage.update(draw.step(0.01), 1.2 + 0.2 * math.sin(0.6 * place))
    stage.update(draw.step(0.01), draw(1.2))
    stage.foresee(draw(1.0))
    ahead = [stage.force_at_N(after_s, stage.from_N()) for after_s in TIMES_S] if stage.trust > 0.0 else []
    return [stage.trust, *ahead, *np.frombuffer(stage.history).tolist()]


# -- aim -----------------------------------------------------------------------------------------------------------


def aim() -> list[Any]:
    made, believe = core(), planner().believe
    begun = Aim(CONFIG, made.scene, made.element)
    begun.begin(BEGINS_S, 0, 0.0)
    return [begun, believe.memory, believe.update(BEGINS_S, None)]


def aiming(stage: list[Any], draw: Draw) -> object:
    begun, remembered, believed = stage
    asked = Ask(draw.bounded(1.2), [draw(1.2) for _ in range(7)], 0.0, (), draw.bounded(1.0), 1.2)
    return begun.update(draw.now_s, setpoint(usual(draw.now_s)), asked, believed, remembered, measured(draw))


def portrait(stage: Portrait, draw: Draw) -> object:
    force_N = draw(1.2)
    return [
        *stage.gap_and_slope_at(force_N),
        stage.force_N_at(draw(70.0)),
        stage.force_rate_N_s(force_N, draw.bounded(38.0)),
        stage.gap_mm_at(draw(1.2)),
    ]


# -- move ----------------------------------------------------------------------------------------------------------


def carriages() -> Carriages:
    made = Carriages(CONFIG, core().scene)
    made.begin(80.0)
    return made


def driving(stage: Carriages, draw: Draw) -> object:
    # `Stepper` bounds the time between two ticks
    seen, dt_s, planned = measured(draw), min(draw.positive(PERIOD_S), LONGEST_S), plan(draw)
    reading = measurement(usual(draw.now_s)).replaced(supply_V=draw.bounded(12.0), number=draw.steps)
    return [stage.update(draw.now_s, dt_s, planned, reading, seen, False), stage.reference, stage.expected]


def motor(_: object, draw: Draw) -> object:
    """Feed a motor with some configuration keys at an end of what is accepted."""
    if not draw.is_hostile:
        return []
    ends = [
        usual_is if draw(1.0) == 1.0 else (least if draw.steps % 2 else most)
        for least, usual_is, most in MOTORS.values()
    ]
    made = Motor(**dict(zip(MOTORS, ends, strict=True)))
    return [*margins(made, Position(), PERIOD_S), full_speed_mm_s(made)]


MOTORS = {
    "supply_V": (3.0, 12.0, 60.0),
    "resistance_ohm": (0.05, 2.2, 100.0),
    "inductance_mH": (0.01, 1.5, 100.0),
    "back_emf_V_s": (1e-4, 0.011, 1.0),
    "inertia_kg_m2": (1e-9, 8e-7, 1e-2),
    "gear_ratio": (1.0, 70.0, 1_000.0),
    "screw_lead_mm": (0.2, 8.0, 50.0),
}


# -- what several stages use ---------------------------------------------------------------------------------------


def tables(_: object, draw: Draw) -> object:
    """Feed five points: also equal ones, and some that are a denormal apart or do not rise."""
    points = [draw(each) for each in (0.0, 1.0, 2.0, 3.0, 4.0)]
    points = points if draw.steps % 3 else sorted(points)
    gaps_mm = [95.0, 80.0, 65.0, 50.0, 35.0]
    degenerate, value = Portrait(gaps_mm, points, [0.1] * 5), draw(points[draw.steps % 5])
    return [
        interpolated(value, Rising(points), gaps_mm),
        at_step(abs(draw(1.5)), gaps_mm),
        *degenerate.gap_and_slope_at(value),
        degenerate.force_N_at(draw(70.0)),
    ]


def field(stage: FieldOfGap, draw: Draw) -> object:
    return [stage.field_mT(draw(80.0)), stage.gap_mm(draw(200.0))]


def curve(_: object, draw: Draw) -> object:
    made = core().element.nominal._network.curve(draw(2.0), draw(42.0), draw(40.0))
    field_mT = draw.bounded(200.0)
    return [made.force_N(field_mT), *made.force_and_slope(field_mT), made.confidence(field_mT, draw.bounded(0.1))]


def search(stage: Any, draw: Draw) -> object:
    found = stage.solve(core().element.nominal.only, draw(1.2), draw(200.0) if draw.steps % 2 else None)
    return [found.field_mT, found.predicted_force_N, found.confidence]


# -- the borders ---------------------------------------------------------------------------------------------------


def link() -> DeviceLink:
    made = DeviceLink(BEGINS_S)
    made.receive(BEGINS_S, Status(DeviceMode.RUN, Switches.HOMED, DeviceFault(0), 23.0, 12.0, 0, 1))
    made.receive(BEGINS_S, Sense(0.1, 0.1, 0.6, 0.0))
    return made


def linked(stage: DeviceLink, draw: Draw) -> object:
    now_s = draw.now_s
    if draw.steps % 20 == 0:
        stage.receive(now_s, Status(DeviceMode.RUN, Switches.HOMED, DeviceFault(0), draw(23.0), draw(12.0), 0, 1))
    stage.receive(now_s, State(draw(-7.5), draw(-7.5), draw(now_s % 0.65536), draw.steps % 256))
    stage.receive(now_s, Sense(draw(0.1), draw(0.1), draw(0.6), draw(1.0)))
    return stage.measurement


def clock(stage: DeviceClock, draw: Draw) -> object:
    stage.add(draw.now_s, draw(draw.now_s))
    return [stage.drift, stage.fit()]


def safety(stages: list[SafetyState], draw: Draw) -> object:
    some = READY.replaced(
        round_trip_s=abs(draw(2e-3)),
        clock_drift=draw(0.0),
        apart_mm=abs(draw(0.0)),
        most_apart_mm=1.0,
        most_round_trip_s=0.01,
        most_clock_drift=0.1,
    )
    stages[0] = command(SafetyState(), "enable", draw.step(PERIOD_S), some)
    return [some.round_trip_s, some.clock_drift, some.apart_mm]


def stages() -> list[Stage]:
    made = core()
    element = made.element
    range_mT, scene = element.nominal.fields_mT, made.scene
    model = load_model(model_path(scene.insert.model, made.models), element=scene.element)
    return [
        Stage("hardware/link", link, linked, CODEC, PERIOD_S),
        Stage("hardware/link_statistics", DeviceClock, clock, CODEC, 0.6),
        Stage("safety/operating_state", lambda: [SafetyState()], safety),
        Stage("Stepper", stepper, step, OWN, PERIOD_S),
        Stage("Planner", planner, planning, OWN, PLAN_S),
        Stage("measure", lambda: Measure(47.5, 0.003, True, 8.0, PERIOD_S), measure, MEASUREMENT, PERIOD_S),
        Stage("believe/believe", lambda: planner().believe, believing, MEASUREMENT, PLAN_S),
        Stage("believe/slow_friction", partial(SlowFriction, BOUNDS), slow_friction, MEASUREMENT),
        Stage("believe/anchor", partial(Anchor, UNSEEN), anchor, MEASUREMENT),
        Stage("believe/handle", HandleWatch, handle_watch, MEASUREMENT, PLAN_S),
        Stage("ask/governor", lambda: planner().governor, governor, OWN, PLAN_S),
        Stage("ask/forecast", Forecast, forecast, SETPOINT),
        Stage("aim/aim", aim, aiming, OWN, PLAN_S),
        Stage("aim/portrait", lambda: made.portrait, portrait),
        Stage("move/carriages", carriages, driving, OWN, PERIOD_S),
        Stage("move/motor", lambda: None, motor, CONFIGURATION),
        Stage("interpolation", lambda: None, tables),
        Stage("field_of_gap", lambda: element.field, field),
        Stage("model/force_curve", lambda: None, curve),
        # on few fields: a number travels through one as through a thousand, row by row
        *[
            Stage(f"inverse: {name}", partial(build, choice, range_mT, model, rises=True), search)
            for name, choice in ((name, named(name)._replace(step_mT=10.0)) for name in RUNTIME_SOLVERS)
        ],
        Stage("inverse: portrait", lambda: PortraitSearch(made.portrait, element.field), search),
    ]
