"""`plan`: from a setpoint to a gap. Governor, inverse, field to gap. Pure: no clock, no I/O, explicit state."""

from typing import NamedTuple

from tormagd.config import Config
from tormagd.control.estimate import MOBILISED_MM, Estimate
from tormagd.control.governor import Governed, GovernorState, TimedSetpoint, govern
from tormagd.control.portrait import FieldOfGap, portrait
from tormagd.inverse.solution import FieldSolution, FieldSolver, Reach
from tormagd.learning.model_file import ForceModel
from tormagd.safety.codes import Limit
from tormagd.scenes.scene import Scene

LEAST_SLOPE_N_MM = 1e-3
"Where the gap hardly changes the force, no gap speed helps."
MOVING_MM_S = 5.0
"Slower handles do not teach the trim, and no force is planned for them: their friction may be static."
TAUGHT_N = 0.2
"Smaller forces do not teach it either: the sensor's offset would."


_LIMIT_OF_REACH = {Reach.BELOW: Limit.F_MIN, Reach.ABOVE: Limit.F_MAX}


class Plan(NamedTuple):
    """Where the gap should go, and why. `number` lets a recording say which plan a tick used."""

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


class PlanState(NamedTuple):
    """What planning remembers. `trim` is measured over predicted force, slowly learned."""

    governor: GovernorState
    plan: Plan
    trim: float = 1.0


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
        )
        predicted = self._predict(estimate) if estimate is not None and estimate.is_homed else None
        trim, trim_limits = self._learn(state, now_s, estimate, predicted)
        displacement, rate = self._motion(setpoint, estimate)
        solution = self._solver.solve(
            displacement, rate, governed.ahead_N / trim, self._cip_percent, state.plan.field_mT
        )
        gap, gap_limits = self._gap(solution, governed)
        limits = (*governed.limits, *trim_limits, *gap_limits)
        if solution.confidence < self._config.limits.low_confidence:
            limits = (*limits, Limit.LOW_CONFIDENCE)
        plan = Plan(
            number=state.plan.number + 1,
            time_s=now_s,
            setpoint_N=None if setpoint is None else setpoint.force_N,
            setpoint_age_s=governed.age_s,
            governed_N=governed.force_N,
            predicted_N=None if predicted is None else predicted * trim,
            field_mT=solution.field_mT,
            gap_mm=gap,
            gap_speed_mm_s=self._gap_speed(governed, trim),
            confidence=solution.confidence,
            limits=limits,
        )
        return PlanState(governor, plan, trim)

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

    def _gap(self, solution: FieldSolution, governed: Governed) -> tuple[float, tuple[Limit, ...]]:
        # the field grid ends where the gap range ends, up to rounding
        gap = min(max(self._field.gap_mm(solution.field_mT), self._gaps_mm[0]), self._gaps_mm[1])
        reached = _LIMIT_OF_REACH.get(solution.reach)
        return gap, () if reached is None or reached in governed.limits else (reached,)

    def _gap_speed(self, governed: Governed, trim: float) -> float:
        # along the portrait, not from one solution to the next: a difference would amplify the solver's grain
        most = self._config.position.gap_speed_mm_s
        steepness = trim * self.portrait.slope_at_N_mm(governed.ahead_N / trim)
        return min(max(-governed.slope_N_s / max(steepness, LEAST_SLOPE_N_MM), -most), most)
