"""`plan`: from a setpoint to a gap. Governor, inverse, field to gap. Pure: no clock, no I/O, explicit state."""

from typing import NamedTuple

import numpy as np

from tormagd.config import Config
from tormagd.control.estimate import Estimate
from tormagd.control.governor import PATH_S, Governed, GovernorState, TimedSetpoint, govern
from tormagd.control.portrait import FieldOfGap, portrait
from tormagd.inverse.solution import FieldSolution, FieldSolver, Reach
from tormagd.learning.displacement import MOBILISED_MM, MOVING_MM_S
from tormagd.learning.model_file import ForceModel
from tormagd.safety.codes import Limit
from tormagd.scenes.scene import Scene

TAUGHT_N = 0.2
"Smaller forces do not teach it either: the sensor's offset would."
LAG_TIME_S = 1.0
MOST_LAG_S = 0.03
LEAST_FORESIGHT = 0.5
"With less the lag is hardly made up for, and teaching it would have no end."
LEAST_TRAVEL_MM_S = 10.0
"Slower carriages teach the lag less."

_FIT = np.linalg.pinv(np.stack([PATH_S, PATH_S**2 / 2.0], axis=1))
"From the path's distances from its beginning to the speed and acceleration there of the nearest parabola."
_LIMIT_OF_REACH = {Reach.BELOW: Limit.F_MIN, Reach.ABOVE: Limit.F_MAX}


class Plan(NamedTuple):
    """Where the gap should go, and why. `number` lets a recording say which plan a tick used; `foresight` is the
    governor's."""

    number: int
    time_s: float
    setpoint_N: float | None
    setpoint_age_s: float | None
    governed_N: float
    predicted_N: float | None
    field_mT: float
    gap_mm: float
    gap_speed_mm_s: float
    confidence: float
    limits: tuple[Limit, ...]
    gap_acceleration_mm_s2: float = 0.0
    foresight: float = 0.0


class PlanState(NamedTuple):
    """What planning remembers. `trim` is measured over predicted force, `lag_s` how late the carriages are: both slowly
    learned.
    """

    governor: GovernorState
    plan: Plan
    trim: float = 1.0
    lag_s: float = 0.0


class Planner:
    """The constants of planning: one scene, one model, one solver. Its methods change nothing."""

    def __init__(
        self,
        config: Config,
        scene: Scene,
        model: ForceModel,
        solver: FieldSolver,
        field: FieldOfGap,
        cip_percent: float,
    ) -> None:
        self._config, self._scene, self._model, self._solver, self._field = config, scene, model, solver, field
        self._cip_percent = cip_percent
        self._gaps_mm = (scene.insert.gap_closed_mm, scene.insert.gap_open_mm)
        self.portrait = portrait(model, field, cip_percent, self._gaps_mm)

    def start(self, now_s: float) -> PlanState:
        """The state before the first plan: gap open."""
        open_mm = self._gaps_mm[1]
        least = self.portrait.least_N
        field_mT = self._field.field_mT(open_mm)
        resting = Plan(0, now_s, None, None, least, None, field_mT, open_mm, 0.0, 1.0, (Limit.NO_SETPOINT,))
        return PlanState(GovernorState(now_s, least), resting)

    def plan(
        self, state: PlanState, now_s: float, setpoint: TimedSetpoint | None, estimate: Estimate | None
    ) -> PlanState:
        """The next plan. `estimate` is None while the device has said nothing: the trim then stays as it is."""
        position = self._config.position
        governor, governed = govern(
            state.governor,
            now_s,
            setpoint,
            portrait=self.portrait,
            scene=self._scene.force,
            limits=self._config.limits,
            gap_speed_mm_s=position.gap_speed_mm_s,
            lead_s=position.lead_ms * 1e-3,
            lag_s=state.lag_s,
        )
        predicted = self._predict(estimate) if estimate is not None and estimate.is_homed else None
        trim, trim_limits = self._learn(state, now_s, estimate, predicted)
        lag_s = self._learn_lag(state, now_s, estimate, governed, trim)
        displacement, rate = self._motion(None if Limit.STALE in governed.limits else setpoint, estimate)
        solution = self._solver.solve(
            displacement, rate, float(governed.path_N[0]) / trim, self._cip_percent, state.plan.field_mT
        )
        gap, gap_limits = self._gap(solution, governed)
        limits = (*governed.limits, *trim_limits, *gap_limits)
        if solution.confidence < self._config.limits.low_confidence:
            limits = (*limits, Limit.LOW_CONFIDENCE)
        speed, acceleration = self._motion_ahead(governed, trim)
        plan = Plan(
            number=state.plan.number + 1,
            time_s=now_s,
            setpoint_N=None if setpoint is None else setpoint.force_N,
            setpoint_age_s=governed.age_s,
            governed_N=governed.force_N,
            predicted_N=None if predicted is None else predicted * trim,
            field_mT=solution.field_mT,
            gap_mm=gap,
            gap_speed_mm_s=speed,
            confidence=solution.confidence,
            limits=limits,
            gap_acceleration_mm_s2=acceleration,
            foresight=governed.foresight,
        )
        return PlanState(governor, plan, trim, lag_s)

    def _motion(self, setpoint: TimedSetpoint | None, estimate: Estimate | None) -> tuple[float, float]:
        # the field sets how much friction there can be, so it is asked for at full mobilisation and in motion: before
        # break-away the force is the hand's choice, not the field's, and the inverse there is ill-posed
        displacement = MOBILISED_MM
        rate = 0.0 if estimate is None else abs(estimate.handle.rate_mm_s)
        if setpoint is not None:
            displacement = displacement if setpoint.displacement_mm is None else setpoint.displacement_mm
            rate = rate if setpoint.rate_mm_s is None else abs(setpoint.rate_mm_s)
        return displacement, max(rate, MOVING_MM_S)

    def _predict(self, estimate: Estimate) -> float:
        gap = min(max(estimate.gap_mm, self._gaps_mm[0] - 5.0), self._gaps_mm[1] + 5.0)
        handle = estimate.handle
        return self._model.predict_one(
            handle.displacement_mm, abs(handle.rate_mm_s), self._field.field_mT(gap), self._cip_percent
        )

    def _learn(
        self, state: PlanState, now_s: float, estimate: Estimate | None, predicted: float | None
    ) -> tuple[float, tuple[Limit, ...]]:
        """Measured over predicted force at the *measured* gap: it learns the model's error, not the tracking error,
        so it cannot fight the position loop."""
        if estimate is None or predicted is None or predicted < TAUGHT_N:
            return state.trim, ()
        handle = estimate.handle
        if handle.displacement_mm < MOBILISED_MM or abs(handle.rate_mm_s) < MOVING_MM_S:
            return state.trim, ()
        settings = self._config.trim
        elapsed = max(0.0, now_s - state.plan.time_s)
        share = elapsed / (settings.time_s + elapsed)
        wanted = state.trim + share * (estimate.force_N / predicted - state.trim)
        trim = min(max(wanted, settings.least), settings.most)
        return trim, () if trim == wanted else (Limit.TRIM,)

    def _learn_lag(
        self, state: PlanState, now_s: float, estimate: Estimate | None, governed: Governed, trim: float
    ) -> float:
        """How far the gap is behind over how fast it moves: a motor weaker than it is believed to be comes late."""
        if estimate is None or not estimate.is_homed or governed.foresight < LEAST_FORESIGHT:
            return state.lag_s
        behind_mm = float(self.portrait.gaps_mm(np.array([governed.force_N / trim]))[0]) - estimate.gap_mm
        if abs(behind_mm) > MOST_LAG_S * self._config.position.gap_speed_mm_s:
            return state.lag_s  # on its way after a jump
        travel_mm_s = estimate.left_mm_s + estimate.right_mm_s
        late_s = behind_mm * travel_mm_s / (travel_mm_s**2 + LEAST_TRAVEL_MM_S**2)
        elapsed = max(0.0, now_s - state.plan.time_s)
        return min(max(state.lag_s + elapsed / (LAG_TIME_S + elapsed) * late_s, 0.0), MOST_LAG_S)

    def _gap(self, solution: FieldSolution, governed: Governed) -> tuple[float, tuple[Limit, ...]]:
        # the field grid ends where the gap range ends, up to rounding
        gap = min(max(self._field.gap_mm(solution.field_mT), self._gaps_mm[0]), self._gaps_mm[1])
        reached = _LIMIT_OF_REACH.get(solution.reach)
        return gap, () if reached is None or reached in governed.limits else (reached,)

    def _motion_ahead(self, governed: Governed, trim: float) -> tuple[float, float]:
        # along the portrait, not from one solution to the next: a difference would amplify the solver's grain
        gaps = self.portrait.gaps_mm(governed.path_N / trim)
        speed, acceleration = _FIT.dot(gaps - gaps[0]).tolist()
        position = self._config.position
        fastest, hardest = position.gap_speed_mm_s, position.gap_acceleration_mm_s2
        return min(max(speed, -fastest), fastest), min(max(acceleration, -hardest), hardest)
