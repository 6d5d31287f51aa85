"""`plan`: from a setpoint to a gap. Governor, inverse, field to gap. Pure: no clock, no I/O, explicit state."""

from typing import NamedTuple

import numpy as np

from tormagd.config import Config
from tormagd.control.device_fit import DeviceFit, observe
from tormagd.control.estimate import Estimate
from tormagd.control.governor import PATH_S, Governed, GovernorState, TimedSetpoint, govern
from tormagd.control.portrait import FieldOfGap, LawOfField, portrait
from tormagd.control.sensor import Sensor, judge
from tormagd.inverse.solution import FieldSolution, FieldSolver, Reach
from tormagd.learning.displacement import MOBILISED_MM, MOVING_MM_S
from tormagd.learning.features import FEATURES
from tormagd.learning.model_file import ForceModel
from tormagd.physics.force import Elastomer, Geometry
from tormagd.safety.codes import Limit
from tormagd.scenes.scene import Scene

CREEP_MM_S = 0.5
"A slower handle is planned for as if it crept: its friction is static."
CEILING = 1.25
"The gap stays where the device surely gives no more than this many times the scene's greatest force."
LAW_SHARE = 0.12
"""The search's field may differ by this share from the one that the force law gives. On sample 1 it does by 1% at 42
mm/s, 6% at a creep and 11% at 300 mm/s and the least force: the law knows neither Stribeck nor viscous friction."""
LESSON_S, LONGEST_LESSON_S = 0.003, 0.02
"One reading teaches for the time since the last, no more often than that, however often is planned, and no longer."
BEYOND_MM = 2.0
"Beyond the closed end, where a carriage may overrun, the model is asked no further."
LAG_TIME_S = 1.0
MOST_LAG_S = 0.03
LEAST_FORESIGHT = 0.5
"With less the lag is hardly made up for, and teaching it would have no end."
LEAST_TRAVEL_MM_S = 10.0
"Slower carriages teach the lag less."

_FIT = np.linalg.pinv(np.stack([PATH_S, PATH_S**2 / 2.0], axis=1))
"From the path's distances from its beginning to the speed and acceleration there of the nearest parabola."
_LIMIT_OF_REACH = {Reach.BELOW: Limit.F_MIN, Reach.ABOVE: Limit.F_MAX}
_DISPLACEMENT, _RATE, _FIELD, _ = FEATURES


class Replaced(NamedTuple):
    """A quantity that something was not asked about as it was, because that lies outside what is known of it."""

    quantity: str
    asked: float
    used: float


class Plan(NamedTuple):
    """Where the gap should go, and why. `number` lets a recording say which plan a tick used; `foresight` is the
    governor's. The gap is never to be closer than `least_gap_mm`. `replaced` says what MODEL_RANGE is about;
    `sensor_doubted_s` is for how long the force sensor has not been believed while the handle slid."""

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
    least_gap_mm: float = 0.0
    replaced: tuple[Replaced, ...] = ()
    sensor_doubted_s: float = 0.0


class Shown(NamedTuple):
    """What the device has shown of itself by its readings up to number `read`, taken at `read_s`, whether its sensor is
    believed, and the limits that come of both."""

    device: DeviceFit = DeviceFit()
    sensor: Sensor = Sensor()
    read: int = -1
    read_s: float = float("-inf")
    limits: tuple[Limit, ...] = ()


class PlanState(NamedTuple):
    """What planning remembers. `lag_s` is how late the device's carriages are."""

    governor: GovernorState
    plan: Plan
    shown: Shown = Shown()
    lag_s: float = 0.0

    @property
    def device(self) -> DeviceFit:
        """The device as far as it has shown itself."""
        return self.shown.device

    @property
    def sensor(self) -> Sensor:
        """The judgement of its force sensor."""
        return self.shown.sensor

    @property
    def trim(self) -> float:
        """The device's force over the model's, where the plan leads."""
        model_N = self.device.model_N(self.plan.governed_N)
        return self.plan.governed_N / model_N if model_N > 0.0 else self.device.scale


class Planner:
    """The constants of planning: one scene, one model, one solver. Its methods change nothing."""

    def __init__(
        self,
        config: Config,
        scene: Scene,
        model: ForceModel,
        solver: FieldSolver,
        field: FieldOfGap,
        fields_mT: tuple[float, float],
        elastomer: Elastomer,
        cip_percent: float,
    ) -> None:
        """`fields_mT` are those that the search may answer with: of the scene's gaps, what the model knows."""
        self._config, self._scene, self._model, self._solver, self._field = config, scene, model, solver, field
        self._cip_percent = cip_percent
        insert = scene.insert
        self._gaps_mm = (insert.gap_closed_mm, insert.gap_open_mm)
        self.portrait = portrait(model, field, cip_percent, (field.gap_mm(fields_mT[1]), field.gap_mm(fields_mT[0])))
        geometry = Geometry(
            insert.inner_radius_mm * 1e-3,
            insert.outer_radius_mm * 1e-3,
            insert.thickness_mm * 1e-3,
            insert.roller_radius_mm * 1e-3,
        )
        self._law = LawOfField.beside(self.portrait, field, elastomer, geometry)
        self._displacements_mm, self._rates_mm_s, self._fields_mT, _ = model.feature_ranges

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
        """The next plan. `estimate` is None while the device has said nothing: nothing is learned of it then."""
        position = self._config.position
        model_N = self._mobilised_N(estimate)
        shown = self._learn(state.shown, now_s, estimate, model_N)
        device = shown.device
        governor, governed = govern(
            state.governor,
            now_s,
            setpoint,
            portrait=self.portrait,
            device=device,
            scene=self._scene.force,
            limits=self._config.limits,
            gap_speed_mm_s=position.gap_speed_mm_s,
            lead_s=position.lead_ms * 1e-3,
            lag_s=state.lag_s,
        )
        lag_s = self._learn_lag(state, now_s, estimate, governed, device)
        displacement, rate, replaced = self._motion(None if Limit.STALE in governed.limits else setpoint, estimate)
        wanted_N = device.model_N(float(governed.path_N[0]))
        solution = self._solver.solve(displacement, rate, wanted_N, self._cip_percent, state.plan.field_mT)
        field_mT, unlawful = self._lawful(solution, wanted_N)
        # the field grid ends where the gap range ends, up to rounding
        wanted_mm = min(max(self._field.gap_mm(field_mT), self._gaps_mm[0]), self._gaps_mm[1])
        least_mm = self.portrait.gap_mm_at(device.surely_within_N(CEILING * self._scene.force.most_N))
        gap_mm = max(wanted_mm, least_mm)
        replaced += unlawful
        reached = _LIMIT_OF_REACH.get(solution.reach)
        limits = (*governed.limits, *shown.limits)
        if replaced:
            limits = (*limits, Limit.MODEL_RANGE)
        if gap_mm > wanted_mm:
            limits = (*limits, Limit.CEILING)
        if solution.confidence < self._config.limits.low_confidence:
            limits = (*limits, Limit.LOW_CONFIDENCE)
        speed, acceleration = self._motion_ahead(governed, device)
        plan = Plan(
            number=state.plan.number + 1,
            time_s=now_s,
            setpoint_N=None if setpoint is None else setpoint.force_N,
            setpoint_age_s=governed.age_s,
            governed_N=governed.force_N,
            predicted_N=None if model_N is None else device.force_N(model_N),
            field_mT=field_mT,
            gap_mm=gap_mm,
            gap_speed_mm_s=speed,
            confidence=solution.confidence,
            limits=limits if reached is None or reached in limits else (*limits, reached),
            gap_acceleration_mm_s2=acceleration,
            foresight=governed.foresight,
            least_gap_mm=least_mm,
            replaced=replaced,
            sensor_doubted_s=shown.sensor.doubted_s,
        )
        return PlanState(governor, plan, shown, lag_s)

    def _motion(
        self, setpoint: TimedSetpoint | None, estimate: Estimate | None
    ) -> tuple[float, float, tuple[Replaced, ...]]:
        """The displacement and the rate that the force is planned for, within what the model knows."""
        # the field sets how much friction there can be, so it is asked for at full mobilisation and in motion: before
        # break-away the force is the hand's choice, not the field's, and the inverse there is ill-posed
        displacement = MOBILISED_MM
        rate = MOVING_MM_S if estimate is None else estimate.handle.sliding_mm_s
        if setpoint is not None:
            displacement = displacement if setpoint.displacement_mm is None else setpoint.displacement_mm
            rate = rate if setpoint.rate_mm_s is None else abs(setpoint.rate_mm_s)
        rate = max(rate, CREEP_MM_S)
        known_mm, known_mm_s = _within(displacement, self._displacements_mm), _within(rate, self._rates_mm_s)
        replaced: tuple[Replaced, ...] = ()
        if known_mm != displacement:
            replaced = (Replaced(_DISPLACEMENT, displacement, known_mm),)
        if known_mm_s != rate:
            replaced = (*replaced, Replaced(_RATE, rate, known_mm_s))
        return known_mm, known_mm_s, replaced

    def _mobilised_N(self, estimate: Estimate | None) -> float | None:
        """What the model says at the measured gap and rate; None before break-away, of which it knows nothing."""
        if estimate is None or not estimate.is_homed or estimate.handle.displacement_mm < MOBILISED_MM:
            return None
        gap_mm = max(estimate.gap_mm, self._gaps_mm[0] - BEYOND_MM)
        return self._model.predict_one(
            _within(MOBILISED_MM, self._displacements_mm),
            _within(abs(estimate.handle.rate_mm_s), self._rates_mm_s),
            _within(self._field.field_mT(gap_mm), self._fields_mT),
            self._cip_percent,
        )

    def _learn(self, shown: Shown, now_s: float, estimate: Estimate | None, model_N: float | None) -> Shown:
        """From the force at the *measured* gap: the model's error is learned, not the tracking error, so it cannot
        fight the position loop. A sensor that is not believed teaches nothing, and what it has taught is forgotten."""
        if estimate is None or model_N is None or estimate.number == shown.read or now_s - shown.read_s < LESSON_S:
            return shown
        rate_mm_s, reading_N = abs(estimate.handle.rate_mm_s), estimate.force_N
        if rate_mm_s < MOVING_MM_S:
            return shown
        elapsed_s = min(now_s - shown.read_s, LONGEST_LESSON_S)
        sensor = judge(shown.sensor, shown.device, model_N, rate_mm_s, reading_N, elapsed_s)
        if sensor.is_doubted:
            return Shown(DeviceFit(), sensor, estimate.number, now_s, (Limit.SENSOR,))
        trim = self._config.trim
        device, is_held = observe(
            shown.device, model_N, reading_N, elapsed_s, adapts_in_s=trim.time_s, bounds=(trim.least, trim.most)
        )
        return Shown(device, sensor, estimate.number, now_s, (Limit.TRIM,) if is_held else ())

    def _lawful(self, solution: FieldSolution, wanted_N: float) -> tuple[float, tuple[Replaced, ...]]:
        """The search's field, no further than LAW_SHARE from the force law's."""
        law_mT = self._law.field_mT(wanted_N)
        field_mT = _within(solution.field_mT, ((1.0 - LAW_SHARE) * law_mT, (1.0 + LAW_SHARE) * law_mT))
        if field_mT == solution.field_mT:
            return field_mT, ()
        return field_mT, (Replaced(_FIELD, solution.field_mT, field_mT),)

    def _learn_lag(
        self, state: PlanState, now_s: float, estimate: Estimate | None, governed: Governed, device: DeviceFit
    ) -> float:
        """How far the gap is behind over how fast it moves: a motor weaker than it is believed to be comes late."""
        if estimate is None or not estimate.is_homed or governed.foresight < LEAST_FORESIGHT:
            return state.lag_s
        behind_mm = self.portrait.gap_mm_at(device.model_N(governed.force_N)) - estimate.gap_mm
        if abs(behind_mm) > MOST_LAG_S * self._config.position.gap_speed_mm_s:
            return state.lag_s  # on its way after a jump
        travel_mm_s = estimate.left_mm_s + estimate.right_mm_s
        late_s = behind_mm * travel_mm_s / (travel_mm_s**2 + LEAST_TRAVEL_MM_S**2)
        elapsed = max(0.0, now_s - state.plan.time_s)
        return min(max(state.lag_s + elapsed / (LAG_TIME_S + elapsed) * late_s, 0.0), MOST_LAG_S)

    def _motion_ahead(self, governed: Governed, device: DeviceFit) -> tuple[float, float]:
        # along the portrait, not from one solution to the next: a difference would amplify the solver's grain
        gaps = self.portrait.gaps_mm((governed.path_N - device.offset_N) / device.scale)
        speed, acceleration = _FIT.dot(gaps - gaps[0]).tolist()
        position = self._config.position
        fastest, hardest = position.gap_speed_mm_s, position.gap_acceleration_mm_s2
        return min(max(speed, -fastest), fastest), min(max(acceleration, -hardest), hardest)


def _within(value: float, ends: tuple[float, float]) -> float:
    return min(max(value, ends[0]), ends[1])
