"""The control core: `plan` and `step` call the stages in the order in which data flows.

    step   every tick    measure -> watch -> move
    plan   when due      believe -> ask -> aim

Deterministic: no clock, no I/O, no globals. The same stages and inputs give the same bits, compiled and interpreted, in
the daemon, in virtual time and in a replay. All state is in the stages' fields; what passes between them is a record.
"""

import math
from typing import Final, final

from firmware_protocol.codec import DriveMode
from tormagd.config import Config
from tormagd.control.aim.aim import Aim, Element
from tormagd.control.ask.governor import Governor
from tormagd.control.ask.way import Way
from tormagd.control.believe.believe import Believe
from tormagd.control.believe.memory import ElementMemory
from tormagd.control.believe.strength import DeviceFit
from tormagd.control.measure import Measure
from tormagd.control.move.actuator import Actuator
from tormagd.control.move.carriages import Carriages
from tormagd.control.move.motor import full_speed_mm_s, gap_speeds
from tormagd.control.move.routines import Homing, Opening
from tormagd.control.move.watch import Watch, ceiling_N
from tormagd.control.records import Duty, Measured, Plan, TimedSetpoint
from tormagd.control.safety.codes import Fault, Limit
from tormagd.control.safety.operating_state import Conditions, OperatingState, SafetyState, command, homed_again, latch
from tormagd.element.model.features import require_number
from tormagd.element.physics.errors import DomainError
from tormagd.hardware.measurement import Measurement
from tormagd.scenes.scene import Scene

PLAN_ERRORS: Final = (ValueError, ArithmeticError, RuntimeError)
"What a plan may raise: DomainError and the errors of NumPy."
_ENABLED: Final = OperatingState.ENABLED
_RUN: Final = DriveMode.RUN
_OFF: Final = DriveMode.OFF


@final
class Planner:
    """The planning half of the core: turns the newest setpoint and measurement into a plan of the gap."""

    def __init__(self, config: Config, scene: Scene, element: Element, now_s: float = 0.0) -> None:
        """Begin at `now_s` with the gap open and nothing known of the device."""
        memory = ElementMemory(
            element.memory, element.nominal, element.field, (scene.insert.gap_closed_mm, scene.insert.gap_open_mm)
        )
        self.believe = Believe(config, scene, element.nominal, memory)
        self._portrait: Final = element.portrait
        self.way = Way(config.handle.push_sign)
        self.governor = Governor(now_s, element.portrait, scene.force, gap_speeds(config), scene.terms)
        self.aim = Aim(config, scene, element)
        self.planned = self.aim.begin(now_s, 0, 0.0)

    def plan(
        self, now_s: float, setpoint: TimedSetpoint | None, measured: Measured | None, is_followed: bool = True
    ) -> Plan:
        """Make the next plan, and keep it in `planned`."""
        if not -math.inf < now_s < math.inf:
            require_number("now_s", now_s)
        belief = self.believe.update(now_s, measured)
        is_believed = belief.sensor_doubted_s == 0.0 and self.believe.knows_zero(now_s)
        travel = self.way.update(measured, self.believe.zero.zero_N, is_sensor_believed=is_believed)
        held_N = None if is_followed else self._held_N(measured, belief.device)
        # at the open gap the element's field lags and gives more than the portrait says
        device = belief.device.relaxed(self._portrait.min_N - self.believe.memory.open_N())
        ask = self.governor.update(now_s, setpoint, device, belief.lag_s, travel, held_N)
        before = self.planned if is_followed else None
        plan = self.aim.update(now_s, setpoint, ask, belief, self.believe.memory, measured, before)
        # what is learned of the carriages' delay acts on the next plan
        self.believe.learn_lag(now_s - self.planned.time_s, measured, plan.foresight, plan.gap_mm)
        self.planned = plan
        return plan

    def _held_N(self, measured: Measured | None, device: DeviceFit) -> float:
        """Return the force of `device`, N, at the measured gap, or at the open gap while that is unknown."""
        portrait, planned = self._portrait, self.planned
        if measured is None or not measured.is_homed:
            return device.force_N(portrait.min_N)
        # the rest of the plan's gap is the element's memory and the handle's rate
        is_held, planned_mm = Limit.CEILING in planned.limits, portrait.gap_for_mm(planned.governed_N, device)
        return device.force_N(portrait.force_N_at(measured.gap_mm + (0.0 if is_held else planned_mm - planned.gap_mm)))

    def afresh(self, now_s: float) -> None:
        """Begin again at `now_s` after a failed plan, with nothing known of the device or of setpoints."""
        self.believe.forget()
        self.governor.begin(now_s)
        self.planned = self.aim.begin(now_s, self.planned.number + 1, self.believe.memory.lag_mT)


@final
class Stepper:
    """The driving half of the core: turns measurements and plans into duties, and latches faults."""

    def __init__(self, config: Config, scene: Scene, now_s: float = 0.0, move: Actuator | None = None) -> None:
        self.time_s = now_s
        self.safety = SafetyState()
        self._period_s: Final = 1.0 / config.rates.control_hz
        self.measure = Measure(
            home_mm=scene.insert.gap_open_mm / 2.0,
            derivative_filter_s=config.position.derivative_filter_s,
            turns=scene.element == "torque",
            full_speed_mm_s=full_speed_mm_s(config.motor),
            period_s=self._period_s,
        )
        self.homing = Homing(ceiling_N(scene))
        self.opening = Opening(config, scene)
        self.watch = Watch(config, scene)
        self.move: Actuator = Carriages(config, scene) if move is None else move

    @property
    def measured(self) -> Measured | None:
        return self.measure.measured

    @property
    def is_followed(self) -> bool:
        return self.safety.operating_state is _ENABLED

    def step(self, now_s: float, measurement: Measurement | None, plan: Plan) -> Duty:
        """Run one control period: measure, latch the faults that show, and return the duties that follow `plan`."""
        last_s = self.time_s
        if not -math.inf < now_s < math.inf:
            require_number("now_s", now_s)
        self.time_s = now_s
        if measurement is None:
            self.lose_link()
            return self._duty(_OFF, 0.0, 0.0, ())
        if not measurement.is_finite:
            return self._begin_anew()
        measured = self.measure.update(last_s, now_s, measurement, self.safety.needs_homing)
        measured = self._judge(now_s, measurement, measured, plan)
        if not self.safety.is_driven:
            if measurement.is_busy:  # homing moves the origin
                self.measure.begin(measurement)
            self.move.stop()
            return self._duty(_OFF, 0.0, 0.0, ())
        sight = self.measure.sight
        if sight.is_blind or self.measure.leap is not None:
            return self._hold(now_s)
        if sight.was_blind:
            self.move.resume(measured)
        # a clock that stood still gives no period
        is_period = 0.0 < now_s - last_s < 10.0 * self._period_s
        return self._drive(now_s, now_s - last_s if is_period else self._period_s, measurement, measured, plan)

    def command(self, name: str, now_s: float, conditions: Conditions) -> None:
        """Carry out an operator's command, one of `operating_state.COMMANDS`."""
        measured, before = self.measured, self.safety
        self.safety = command(before, name, now_s, self.watch.command_conditions(conditions, measured))
        if self.is_followed and before.operating_state is OperatingState.DISABLED:
            assert measured is not None, "nothing is fresh without one"
            self.move.begin(measured.gap_mm)
            self.watch.begin(now_s)

    def latch(self, fault: Fault) -> None:
        self.safety = latch(self.safety, (fault,))

    def lose_link(self) -> None:
        """Forget the device whose link broke."""
        if self.safety.is_driven:
            self.latch(Fault.LINK_LOST)
        self.opening.rest(self.safety.request_number)
        self.measure.lose_device()
        self.move.lose_device()

    def _judge(self, now_s: float, measurement: Measurement, measured: Measured, plan: Plan) -> Measured:
        measure = self.measure
        shown = self.watch.faults(
            now_s, self.safety, measurement, measured, measure.sight, measure.leap, plan.sensor_doubted_s
        )
        if not self.safety.is_driven:
            self.homing.update(now_s, measurement)
            shown = self.homing.faults + shown
        is_placed = measured.is_homed and not self.safety.needs_homing
        is_blind = measure.sight.is_blind or measure.leap is not None
        self.opening.update(measurement, is_placed, is_blind, self.safety)
        self.safety = latch(self.safety, self.opening.faults + shown)
        if not self.safety.needs_homing:
            return measured
        self.safety = homed_again(self.safety, measurement.is_homed)
        return measure.without_position(measured)

    def _hold(self, now_s: float) -> Duty:
        """Return zero duties in mode RUN: the device keeps answering, and friction holds the gap."""
        seen = Limit.HOST_STALL if self.measure.sight.has_stalled(now_s) else Limit.DEVICE_SILENT
        limit = seen if self.measure.leap is None else Limit.ENCODER
        self.watch.rest()
        return self._duty(_RUN, 0.0, 0.0, (limit,))

    def _drive(self, now_s: float, dt_s: float, measurement: Measurement, measured: Measured, plan: Plan) -> Duty:
        try:
            drive = self.move.update(
                now_s, dt_s, plan if self.is_followed else None, measurement, measured, self.watch.is_over
            )
        except DomainError:
            return self._begin_anew()
        self.watch.update(dt_s, measured, self.move.reference, drive.left_motor, drive.right_motor)
        limits = drive.limits + self.watch.limits(now_s, measurement, measured, self.measure.sight)
        return self._duty(_RUN, drive.left_duty, drive.right_duty, limits)

    def _begin_anew(self) -> Duty:
        """Latch NOT_FINITE, forget all motion, and stop driving."""
        self.latch(Fault.NOT_FINITE)
        self.measure.forget()
        self.watch.begin(math.inf)
        self.watch.rest()
        self.move.forget()
        return self._duty(_OFF, 0.0, 0.0, ())

    def _duty(self, mode: DriveMode, left: float, right: float, limits: tuple[Limit, ...]) -> Duty:
        return Duty(mode, left, right, self.safety.request, self.safety.request_number, limits)
