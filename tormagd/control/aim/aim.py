"""The gap that gives the force asked for: force -> field -> gap, and what holds the gap back.

force  m = (F - o) / s                   of the model, without memory, for the device that is believed in
field  B: m(B) = m                       the search, held near the force law
gap    of B + l                          l the lag of the element's field; no closer than the ceiling's floor
ahead  the same along the portrait for the forces to come, as the speed and acceleration of a parabola
"""

import math
from typing import Final, NamedTuple, final

import numpy as np

from tormagd.config import Config
from tormagd.control.aim.portrait import CEILING, LawOfField, Portrait, least_mm
from tormagd.control.ask.path import PATH_S
from tormagd.control.believe.memory import ElementMemory
from tormagd.control.believe.strength import DeviceFit
from tormagd.control.move.motor import gap_speeds
from tormagd.control.nominal import FieldOfGap, Nominal
from tormagd.control.records import Ask, Belief, Measured, Outside, Plan, TimedSetpoint
from tormagd.control.safety.codes import Limit
from tormagd.element.inverse.solution import Answer, FieldSolution, FieldSolver, Question, Reach
from tormagd.element.model.features import FEATURES
from tormagd.element.model.force_curve import ForceCurve, within
from tormagd.element.model.memory import Memory
from tormagd.element.physics.errors import DomainError
from tormagd.scenes.scene import Scene

# looking a member up takes longer than comparing it
_INSIDE: Final = Reach.INSIDE

OLDEST_ANSWER_S: Final = 0.5
"Planning fails with an answer that is older than this, and the gap opens."

_PARABOLA: Final = np.linalg.pinv(np.stack([np.array(PATH_S), np.array(PATH_S) ** 2 / 2.0], axis=1))
_TO_SPEED: Final[list[float]] = _PARABOLA[0].tolist()
_TO_ACCELERATION: Final[list[float]] = _PARABOLA[1].tolist()
"Weights from distances along a path to the speed and acceleration of a fitted parabola at its start."


class Element(NamedTuple):
    """The nominal device: how its element makes force."""

    nominal: Nominal
    memory: Memory
    field: FieldOfGap
    portrait: Portrait
    search: FieldSolver
    law: LawOfField | None
    is_beside: bool = False


@final
class Aim:
    """The last stage of planning: turns the force into a field, the field into a gap, and both into a plan."""

    number: int = 0
    element_mT: float = 0.0
    "Of several fields that give a force, the nearest to this is taken."
    question: Question | None = None
    "None where plans search themselves."
    answer: Answer

    def __init__(self, config: Config, scene: Scene, element: Element) -> None:
        self._element: Final = element
        self._portrait: Final = element.portrait
        self._range_mm: Final = (scene.insert.gap_closed_mm, scene.insert.gap_open_mm)
        self._ceiling_N: Final = CEILING * scene.force.most_N
        self._scales: Final = (config.trim.least, config.trim.most)
        self._speeds: Final = gap_speeds(config)
        self._max_mm_s2: Final = config.position.gap_acceleration_mm_s2
        self._low_confidence: Final = config.limits.low_confidence

    def begin(self, now_s: float, number: int, lag_mT: float) -> Plan:
        """Begin at `now_s`, and return a plan with the gap open and no setpoint."""
        field_mT = self._element.field.field_mT(self._range_mm[1])
        self.number, self.element_mT = number, field_mT - lag_mT
        min_N = self._portrait.min_N
        self.answer = Answer(now_s, FieldSolution(self.element_mT, min_N, 1.0, 0, _INSIDE))
        return Plan(number, now_s, None, None, min_N, None, field_mT, self._range_mm[1], 0.0, 1.0, (Limit.NO_SETPOINT,))

    def update(
        self,
        now_s: float,
        setpoint: TimedSetpoint | None,
        ask: Ask,
        belief: Belief,
        memory: ElementMemory,
        measured: Measured | None,
        before: Plan | None = None,
    ) -> Plan:
        """Return the next plan, which the gap reaches from the plan `before`."""
        device = belief.device
        curve, outside = self._element.nominal.planned(None if ask.asked_N is None else setpoint, measured)
        wanted_N = device.model_N(ask.path_N[0])
        solution = self._solution(now_s, curve, wanted_N)
        law = self._element.law
        element_mT = solution.field_mT if law is None else law.held_mT(solution.field_mT, wanted_N)
        if element_mT != solution.field_mT:
            outside = (*outside, Outside(FEATURES[2], solution.field_mT, element_mT))
        field_mT = element_mT + memory.lag_at_mT(element_mT + memory.lag_mT)
        # the field grid ends where the gap range ends, up to rounding
        wanted_mm = within(self._element.field.gap_mm(field_mT), self._range_mm)
        wanted_mm = self._reached_mm(wanted_mm, before, now_s, ask, device)
        min_mm = least_mm(self._portrait, belief, self._ceiling_N, self._scales)
        self.element_mT = field_mT - memory.lag_mT
        self.number += 1
        return self._plan(now_s, setpoint, ask, belief, field_mT, wanted_mm, min_mm, solution, outside)

    def _reached_mm(self, wanted_mm: float, before: Plan | None, now_s: float, ask: Ask, device: DeviceFit) -> float:
        """Return how far the gap gets from the plan `before`, besides what the setpoint leaps."""
        if before is None or before.setpoint_N is None or ask.asked_N is None:
            return wanted_mm
        portrait = self._portrait
        leap_mm = abs(portrait.gap_for_mm(ask.asked_N, device) - portrait.gap_for_mm(before.setpoint_N, device))
        closed_mm, opened_mm = self._speeds.reach_mm(max(now_s - before.time_s, 0.0))
        return within(wanted_mm, (before.gap_mm - closed_mm - leap_mm, before.gap_mm + opened_mm + leap_mm))

    def answer_to(self, question: Question) -> Answer:
        """Answer `question` in the search that runs beside the plans."""
        curve = self._element.nominal.curve(question.displacement_mm, question.rate_mm_s)
        return Answer(question.time_s, self._element.search.solve(curve, question.force_N, question.last_field_mT))

    def _solution(self, now_s: float, curve: ForceCurve, wanted_N: float) -> FieldSolution:
        if not self._element.is_beside:
            return self._element.search.solve(curve, wanted_N, self.element_mT)
        self.question = Question(now_s, curve.displacement_mm, curve.rate_mm_s, wanted_N, self.element_mT)
        age_s = now_s - self.answer.time_s
        if age_s > OLDEST_ANSWER_S:
            raise DomainError("solver", f"no answer for {age_s:.2f} s", f"one not older than {OLDEST_ANSWER_S:g} s")
        return self.answer.solution

    def _plan(
        self,
        now_s: float,
        setpoint: TimedSetpoint | None,
        ask: Ask,
        belief: Belief,
        field_mT: float,
        wanted_mm: float,
        min_mm: float,
        solution: FieldSolution,
        outside: tuple[Outside, ...],
    ) -> Plan:
        speed_mm_s, acceleration_mm_s2 = self._motion_ahead(ask.path_N, belief.device)
        model_N = belief.at_speed.model_N(ask.force_N)
        return Plan(
            number=self.number,
            time_s=now_s,
            setpoint_N=ask.asked_N,
            setpoint_age_s=ask.age_s,
            governed_N=ask.force_N,
            predicted_N=belief.predicted_N,
            field_mT=field_mT,
            gap_mm=max(wanted_mm, min_mm),
            gap_speed_mm_s=speed_mm_s,
            confidence=solution.confidence,
            limits=self._limits(ask, belief.limits, outside, min_mm > wanted_mm, solution),
            gap_acceleration_mm_s2=acceleration_mm_s2,
            foresight=ask.foresight,
            min_gap_mm=min_mm,
            outside=outside,
            sensor_doubted_s=belief.sensor_doubted_s,
            trim=ask.force_N / model_N if model_N > 0.0 else belief.at_speed.scale,
            stamp_s=-math.inf if setpoint is None or ask.asked_N is None else setpoint.stamp_s,
            search_age_s=now_s - self.answer.time_s if self._element.is_beside else 0.0,
        )

    def _limits(
        self,
        ask: Ask,
        believed: tuple[Limit, ...],
        outside: tuple[Outside, ...],
        is_held: bool,
        solution: FieldSolution,
    ) -> tuple[Limit, ...]:
        limits = (
            ask.limits
            + believed
            + ((Limit.MODEL_RANGE,) if outside else ())
            + ((Limit.CEILING,) if is_held else ())
            + ((Limit.LOW_CONFIDENCE,) if solution.confidence < self._low_confidence else ())
        )
        # where nobody asks for a force, none is held back for being too low
        if solution.reach is _INSIDE or (ask.asked_N is None and solution.reach is not Reach.ABOVE):
            return limits
        reached = Limit.F_MIN if solution.reach is Reach.BELOW else Limit.F_MAX
        return limits if reached in limits else (*limits, reached)

    def _motion_ahead(self, path_N: list[float], device: DeviceFit) -> tuple[float, float]:
        """Return the gap's speed and acceleration at the start of a path of forces, by a fitted parabola."""
        # along the portrait: a difference of two solutions would amplify the solver's grain
        start_mm = self._portrait.gap_for_mm(path_N[0], device)
        speed, acceleration = 0.0, 0.0
        for place in range(1, len(path_N)):
            away_mm = self._portrait.gap_for_mm(path_N[place], device) - start_mm
            speed += _TO_SPEED[place] * away_mm
            acceleration += _TO_ACCELERATION[place] * away_mm
        most, hardest = self._speeds, self._max_mm_s2
        return within(speed, (-most.closing_mm_s, most.opening_mm_s)), within(acceleration, (-hardest, hardest))
