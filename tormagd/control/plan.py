"""`plan`: from a setpoint to a gap. Governor, inverse, field to gap. Pure: no clock, no I/O, explicit state."""

import math
from typing import Final, final

import numpy as np

from firmware_protocol.value import Value
from tormagd.config import Config
from tormagd.control.contact import Contact
from tormagd.control.device_fit import UNSEEN, DeviceFit, observe
from tormagd.control.estimate import Estimate
from tormagd.control.governor import PATH_S, Governed, Governor, GovernorState, TimedSetpoint
from tormagd.control.handle import UNHEARD, HandleWatch
from tormagd.control.lateness import ON_TIME, Lateness, found, surprised
from tormagd.control.portrait import FieldOfGap, LawOfField, Portrait
from tormagd.control.remembered import NOTHING_REMEMBERED, Remembered, Remembering
from tormagd.control.sensor import UNJUDGED, Sensor, judge
from tormagd.control.sensor_zero import TARED, UNKNOWN_SD_N, SensorZero
from tormagd.control.sight import unsensed_s
from tormagd.control.slow_friction import NOTHING_SLOW, SLOWEST_MM_S, SlowFriction
from tormagd.inverse.solution import FieldSolution, FieldSolver, Reach
from tormagd.model.displacement import MOVING_MM_S
from tormagd.model.features import FEATURES
from tormagd.model.force_curve import ForceCurve, within
from tormagd.model.model_file import ForceModel
from tormagd.safety.codes import Limit
from tormagd.scenes.scene import Scene, terms_of

CEILING: Final = 1.25
"The gap stays where the device surely gives no more than this many times the scene's greatest force."
LAW_SHARE: Final = 0.12
"""The search's field may differ by this share from the one that the force law gives. On sample 1 it does by 1% at 42
mm/s, 6% at a creep and 11% at 300 mm/s and the least force: the law knows neither Stribeck nor viscous friction."""
LESSON_S: Final = 0.003
LONGEST_LESSON_S: Final = 0.02
"One reading teaches for the time since the last, no more often than that, however often is planned, and no longer."
CREEPING_MM_S: Final = 1.2 * MOVING_MM_S
COMES_TO_REST: Final = 3.0
"A handle that has slid no faster for some travel creeps; one that has slid so many times faster only comes to rest."
LEAST_EXPECTED_N: Final = 0.1
"Of less force no share is told."
UNTARED_N: Final = 0.15
"A sensor that is off by more is worth a word: it is half an hour's drift."
SURPRISE_S: Final = 0.03
SURPRISE_N: Final = 0.01
"""A mean over that time, in which noise leaves 2 to 5 mN, of more than this is the device's own: then its offset is
learned sooner, in a fifth of its time at twice as much. So noise alone hardly moves the gap, and a step settles."""
LEAST_ADAPTS_IN_S: Final = 0.04
BEYOND_MM: Final = 2.0
"Beyond the closed end, where a carriage may overrun, the model is asked no further."
LEAST_FORESIGHT: Final = 0.5
"With less what is planned leaps, and no carriages are on time."

# looking a member up takes longer than comparing it
_INSIDE: Final = Reach.INSIDE
_STALE: Final = Limit.STALE

_PARABOLA: Final = np.linalg.pinv(np.stack([np.array(PATH_S), np.array(PATH_S) ** 2 / 2.0], axis=1))
_TO_SPEED: Final[list[float]] = _PARABOLA[0].tolist()
_TO_ACCELERATION: Final[list[float]] = _PARABOLA[1].tolist()
"From the path's distances from its beginning to the speed and acceleration there of the nearest parabola."


@final
class Outside(Value):
    """A quantity that something was not asked about as it was, because that lies outside what is known of it."""

    def __init__(self, quantity: str, asked: float, used: float) -> None:
        self.quantity: Final = quantity
        self.asked: Final = asked
        self.used: Final = used


@final
class Plan(Value):
    """Where the gap should go, and why. `number` lets a recording say which plan a tick used; `foresight` is the
    governor's. The gap is never to be closer than `least_gap_mm`. `outside` says what MODEL_RANGE is about;
    `sensor_doubted_s` is for how long the force sensor has not been believed while the handle slid."""

    def __init__(
        self,
        number: int,
        time_s: float,
        setpoint_N: float | None,
        setpoint_age_s: float | None,
        governed_N: float,
        predicted_N: float | None,
        field_mT: float,
        gap_mm: float,
        gap_speed_mm_s: float,
        confidence: float,
        limits: tuple[Limit, ...],
        gap_acceleration_mm_s2: float = 0.0,
        foresight: float = 0.0,
        least_gap_mm: float = 0.0,
        outside: tuple[Outside, ...] = (),
        sensor_doubted_s: float = 0.0,
    ) -> None:
        self.number: Final = number
        self.time_s: Final = time_s
        self.setpoint_N: Final = setpoint_N
        self.setpoint_age_s: Final = setpoint_age_s
        self.governed_N: Final = governed_N
        self.predicted_N: Final = predicted_N
        self.field_mT: Final = field_mT
        self.gap_mm: Final = gap_mm
        self.gap_speed_mm_s: Final = gap_speed_mm_s
        self.confidence: Final = confidence
        self.limits: Final = limits
        self.gap_acceleration_mm_s2: Final = gap_acceleration_mm_s2
        self.foresight: Final = foresight
        self.least_gap_mm: Final = least_gap_mm
        self.outside: Final = outside
        self.sensor_doubted_s: Final = sensor_doubted_s


@final
class Shown(Value):
    """What the device has shown of itself by its readings up to number `read`, taken at `read_s`, at speed and at a
    creep, whether its sensor is believed, what it reads without a force, and the limits that come of it; how late its
    carriages are; and by how much the newest readings were more than expected, `surprise_N`."""

    def __init__(
        self,
        device: DeviceFit = UNSEEN,
        sensor: Sensor = UNJUDGED,
        read: int = -1,
        read_s: float = -math.inf,
        limits: tuple[Limit, ...] = (),
        slow: SlowFriction = NOTHING_SLOW,
        zero: SensorZero = TARED,
        lateness: Lateness = ON_TIME,
        surprise_N: float = 0.0,
    ) -> None:
        self.device: Final = device
        self.sensor: Final = sensor
        self.read: Final = read
        self.read_s: Final = read_s
        self.limits: Final = limits
        self.slow: Final = slow
        self.zero: Final = zero
        self.lateness: Final = lateness
        self.surprise_N: Final = surprise_N


NOTHING_SHOWN: Final = Shown()


@final
class PlanState(Value):
    """What planning remembers, and what the element does."""

    def __init__(
        self,
        governor: GovernorState,
        plan: Plan,
        shown: Shown = NOTHING_SHOWN,
        handle: HandleWatch = UNHEARD,
        remembered: Remembered = NOTHING_REMEMBERED,
    ) -> None:
        self.governor: Final = governor
        self.plan: Final = plan
        self.shown: Final = shown
        self.handle: Final = handle
        self.remembered: Final = remembered

    @property
    def device(self) -> DeviceFit:
        """The device as far as it has shown itself, and as its elastomer is relaxed now."""
        return self.shown.device.relaxed(self.remembered.relaxed_N)

    @property
    def sensor(self) -> Sensor:
        """The judgement of its force sensor."""
        return self.shown.sensor

    @property
    def trim(self) -> float:
        """The device's force over the model's, where the plan leads."""
        model_N = self.device.model_N(self.plan.governed_N)
        return self.plan.governed_N / model_N if model_N > 0.0 else self.device.scale


@final
class Planner:
    """The constants of planning: one scene, one model, one search. Its methods change nothing."""

    def __init__(
        self,
        config: Config,
        scene: Scene,
        model: ForceModel,
        search: FieldSolver,
        field: FieldOfGap,
        portrait: Portrait,
        law: LawOfField | None,
        cip_percent: float,
        contact: Contact,
    ) -> None:
        """`portrait` and `law` are of the gaps whose fields `search` may answer with; of a pad no law is known."""
        position, trim = config.position, config.trim
        self.portrait: Final = portrait
        self._network, self._search, self._field, self._law = model.network, search, field, law
        self._contact = contact
        terms = terms_of(scene)
        self._governor = Governor(portrait, scene.force, position.gap_speed_mm_s, terms)
        self._cip_percent = cip_percent
        self._closed_mm, self._open_mm = scene.insert.gap_closed_mm, scene.insert.gap_open_mm
        self._ceiling_N = CEILING * scene.force.most_N
        displacements_mm, rates_mm_s, fields_mT, _ = model.feature_ranges
        self._displacements_mm, self._rates_mm_s, self._fields_mT = displacements_mm, rates_mm_s, fields_mT
        memory = model.metadata.memory.of(relaxes=terms.relaxes, hysteresis=terms.hysteresis)
        self._memory = Remembering(memory, fields_mT)
        self._fastest_mm_s, self._hardest_mm_s2 = position.gap_speed_mm_s, position.gap_acceleration_mm_s2
        self._adapts_in_s, self._scales = trim.time_s, (trim.least, trim.most)
        self._low_confidence = config.limits.low_confidence
        self._unsensed_s = unsensed_s(1.0 / config.rates.control_hz)
        self._has_rate, self._has_lag = terms.rate, terms.lag
        self._learns_lag = terms.learning and terms.lag
        self._has_creep = terms.creep and contact.slides
        self._learns_creep = terms.learning and self._has_creep
        self._fits = terms.learning and (terms.scale or terms.offset)
        self._learns_scale, self._learns_offset = terms.scale, terms.offset
        self._only_curve: ForceCurve = self._network.curve(
            within(contact.displacement_mm, displacements_mm), within(contact.rate_mm_s, rates_mm_s), cip_percent
        )
        self._only_free_N = self._memory.free_N(self._only_curve)

    def start(self, now_s: float) -> PlanState:
        """The state before the first plan: gap open."""
        open_mm = self._open_mm
        least = self.portrait.least_N
        field_mT = self._field.field_mT(open_mm)
        resting = Plan(0, now_s, None, None, least, None, field_mT, open_mm, 0.0, 1.0, (Limit.NO_SETPOINT,))
        return PlanState(GovernorState(now_s, least, above_N=0.0), resting)

    def afresh(self, state: PlanState, now_s: float) -> PlanState:
        """Begins anew after `state`, for which no plan could be made: plans go on being numbered, and the elastomer has
        not forgotten."""
        begun = self.start(now_s)
        return begun.replaced(plan=begun.plan.replaced(number=state.plan.number + 1), remembered=state.remembered)

    def plan(
        self, state: PlanState, now_s: float, setpoint: TimedSetpoint | None, estimate: Estimate | None
    ) -> PlanState:
        """The next plan. `estimate` is None while the device has said nothing: nothing is learned of it then."""
        remembered = self._remember(state.remembered, now_s, estimate)
        model_N = self._model_N(estimate, remembered)
        handle = state.handle
        if self._contact.slides and estimate is not None and model_N is not None:
            handle = handle.heard(estimate.sensed_s, estimate.handle_mm, estimate.force_N, model_N)
        shown = self._learn(state.shown, now_s, estimate, model_N, remembered.relaxed_N, handle)
        # from here on over the model's force without memory, which searches and portrait know
        device = shown.device.relaxed(remembered.relaxed_N)
        if self._has_creep:
            sliding_mm_s = MOVING_MM_S if estimate is None else estimate.handle.sliding_mm_s
            device = device.times(shown.slow.factor_at(sliding_mm_s))
        lag_s = shown.lateness.lag_s if self._has_lag else 0.0
        governor, governed = self._governor.govern(state.governor, now_s, setpoint, device, lag_s)
        is_meant = setpoint is not None and _STALE not in governed.limits
        curve = self._only_curve
        displacement_mm, rate_mm_s = curve.displacement_mm, curve.rate_mm_s
        known_mm, known_mm_s = displacement_mm, rate_mm_s
        if self._has_rate:
            displacement_mm, rate_mm_s = self._contact.planned(setpoint if is_meant else None, estimate)
            known_mm = within(displacement_mm, self._displacements_mm)
            known_mm_s = within(rate_mm_s, self._rates_mm_s)
            curve = self._network.curve(known_mm, known_mm_s, self._cip_percent)
        wanted_N = device.model_N(governed.path_N[0])
        solution = self._search.solve(curve, wanted_N, state.plan.field_mT - state.remembered.lag_mT)
        lawful_mT = self._lawful_mT(solution, wanted_N)
        field_mT = lawful_mT + self._memory.lag_at_mT(remembered, lawful_mT + remembered.lag_mT)
        # the field grid ends where the gap range ends, up to rounding
        wanted_mm = min(max(self._field.gap_mm(field_mT), self._closed_mm), self._open_mm)
        least_mm = self.portrait.gap_mm_at(device.surely_within_N(self._ceiling_N))
        gap_mm = max(wanted_mm, least_mm)
        outside: tuple[Outside, ...] = ()
        if known_mm != displacement_mm:
            outside = (Outside(FEATURES[0], displacement_mm, known_mm),)
        if known_mm_s != rate_mm_s:
            outside = (*outside, Outside(FEATURES[1], rate_mm_s, known_mm_s))
        if lawful_mT != solution.field_mT:
            outside = (*outside, Outside(FEATURES[2], solution.field_mT, lawful_mT))
        limits = (*governed.limits, *shown.limits)
        if handle.is_lost:
            limits = (*limits, Limit.HANDLE_LOST)
        if outside:
            limits = (*limits, Limit.MODEL_RANGE)
        if gap_mm > wanted_mm:
            limits = (*limits, Limit.CEILING)
        if solution.confidence < self._low_confidence:
            limits = (*limits, Limit.LOW_CONFIDENCE)
        if solution.reach is not _INSIDE:
            reached = Limit.F_MIN if solution.reach is Reach.BELOW else Limit.F_MAX
            # where nobody asks for a force, none is held back for being too low
            if reached not in limits and (is_meant or reached is Limit.F_MAX):
                limits = (*limits, reached)
        shown = self._timed(shown, now_s - state.plan.time_s, estimate, governed.foresight, gap_mm)
        speed_mm_s, acceleration_mm_s2 = self._motion_ahead(governed, device)
        plan = Plan(
            number=state.plan.number + 1,
            time_s=now_s,
            setpoint_N=None if setpoint is None else setpoint.force_N,
            setpoint_age_s=governed.age_s,
            governed_N=governed.force_N,
            predicted_N=self._predicted_N(shown, estimate, model_N),
            field_mT=field_mT,
            gap_mm=gap_mm,
            gap_speed_mm_s=speed_mm_s,
            confidence=solution.confidence,
            limits=limits,
            gap_acceleration_mm_s2=acceleration_mm_s2,
            foresight=governed.foresight,
            least_gap_mm=least_mm,
            outside=outside,
            sensor_doubted_s=shown.sensor.doubted_s,
        )
        return PlanState(governor, plan, shown, handle, remembered)

    def foresee(self, state: PlanState) -> PlanState:
        """What can be prepared for the next plans once one is made: to be called after each, when nothing waits."""
        governor = self._governor.foresee(state.governor)
        if governor is state.governor:
            return state
        return PlanState(governor, state.plan, state.shown, state.handle, state.remembered)

    def _model_N(self, estimate: Estimate | None, remembered: Remembered) -> float | None:
        """What the model says of the force of now, at the measured gap; None without a gap."""
        if estimate is None or not estimate.is_homed:
            return None
        element_mT = within(remembered.field_mT - remembered.lag_mT, self._fields_mT)
        return self._present_curve(estimate).force_N(element_mT) - remembered.relaxed_N

    def _present_curve(self, estimate: Estimate) -> ForceCurve:
        if not self._has_rate:
            return self._only_curve
        displacement_mm, rate_mm_s = self._contact.present(estimate)
        return self._network.curve(
            within(displacement_mm, self._displacements_mm), within(rate_mm_s, self._rates_mm_s), self._cip_percent
        )

    def _remember(self, remembered: Remembered, now_s: float, estimate: Estimate | None) -> Remembered:
        """The element's memory after the measured gap. A brake has rested where the device was switched on, and relaxes
        of what a handle at the roller's speed would feel; a pad was not touched, and relaxes of what presses it."""
        if estimate is None:
            return remembered
        if self._contact.slides and not estimate.is_homed:
            # until both switches are found, positions count from where the carriages were, as if they were open
            opened_mm = max(estimate.gap_mm - self._open_mm, remembered.opened_mm)
            return Remembered(opened_mm=opened_mm) if remembered.is_empty else remembered
        gap_mm = max(estimate.gap_mm, self._closed_mm - BEYOND_MM) if estimate.is_homed else self._open_mm
        field_mT = self._field.field_mT(gap_mm)
        curve: ForceCurve = self._only_curve
        free_N = self._only_free_N
        if not self._contact.slides:
            curve = self._present_curve(estimate)
            free_N = self._memory.free_N(curve)
        if remembered.is_empty and self._contact.slides:
            found_mm = gap_mm - remembered.opened_mm
            is_known = self._closed_mm - BEYOND_MM <= found_mm <= self._open_mm + BEYOND_MM
            rested_mT = self._field.field_mT(found_mm if is_known else gap_mm)
            remembered = self._memory.rested(curve, free_N, rested_mT, now_s)
        elif remembered.is_empty:
            remembered = self._memory.unloaded(field_mT, now_s)
        return self._memory.followed(remembered, curve, free_N, field_mT, now_s)

    def _learn(
        self,
        shown: Shown,
        now_s: float,
        estimate: Estimate | None,
        model_N: float | None,
        relaxed_N: float,
        handle: HandleWatch,
    ) -> Shown:
        """From the force at the *measured* gap: the model's error is learned, not the tracking error, so it cannot
        fight the position loop. A sensor that is not believed teaches nothing, and what it has taught is forgotten."""
        if estimate is None or model_N is None or estimate.number == shown.read or now_s - shown.read_s < LESSON_S:
            return shown
        if now_s - estimate.sensed_s > self._unsensed_s:
            return shown  # its force is an old one
        slow, zero, lateness = shown.slow, shown.zero, shown.lateness
        if self._has_creep:
            slow = slow.followed(model_N, estimate.handle_mm)
        direction, rate_mm_s = estimate.handle.turn.direction, abs(estimate.handle.rate_mm_s)
        reading_N = estimate.force_N - direction * zero.zero_N
        zero_sd_N = zero.sd_N(now_s)
        is_zero_known = zero_sd_N <= UNKNOWN_SD_N
        elapsed_s = min(now_s - shown.read_s, LONGEST_LESSON_S)
        is_mobilised = self._contact.is_known(estimate)
        is_slow = rate_mm_s < MOVING_MM_S or handle.outlasts(model_N)
        if not is_mobilised or (self._contact.slides and is_slow):
            if shown.sensor.is_doubted:
                slow = NOTHING_SLOW
            elif (
                self._learns_creep
                and SLOWEST_MM_S < rate_mm_s < CREEPING_MM_S
                and estimate.handle.sliding_mm_s < min(CREEPING_MM_S, COMES_TO_REST * rate_mm_s)
            ):
                expected_N = shown.device.force_N(slow.followed_N)
                # before it is mobilised friction is less than the model's; more is more all the same
                is_lesson = is_zero_known and (is_mobilised or reading_N > expected_N)
                if expected_N > LEAST_EXPECTED_N and is_lesson:
                    slow = slow.observed(shown.device, rate_mm_s, reading_N, elapsed_s)
            return Shown(shown.device, shown.sensor, estimate.number, now_s, shown.limits, slow, zero, lateness)
        # the sensor is judged by all that an elastomer may do, whatever this one is thought to remember
        sensor = judge(
            shown.sensor,
            shown.device.relaxed(relaxed_N),
            model_N + relaxed_N,
            rate_mm_s,
            reading_N,
            elapsed_s,
            direction,
            zero_sd_N,
        )
        if sensor.is_doubted and not shown.sensor.is_doubted:
            zero = zero.doubted()
        zero = zero.heard(
            now_s,
            direction,
            estimate.force_N,
            model_N,
            rate_mm_s,
            elapsed_s,
            shown.device.scale,
            shown.device.scale_sd,
        )
        limits: tuple[Limit, ...] = (Limit.SENSOR_ZERO,) if abs(zero.zero_N) > UNTARED_N else ()
        if sensor.is_doubted:
            return Shown(UNSEEN, sensor, estimate.number, now_s, (Limit.SENSOR, *limits), NOTHING_SLOW, zero, lateness)
        if not is_zero_known:
            limits = (Limit.OFFSET_UNKNOWN, *limits)
            return Shown(shown.device, sensor, estimate.number, now_s, limits, shown.slow, zero, lateness)
        if not self._fits:
            return Shown(shown.device, sensor, estimate.number, now_s, limits, slow, zero, lateness)
        error_N = reading_N - shown.device.force_N(model_N)
        surprise_N = shown.surprise_N + elapsed_s / (SURPRISE_S + elapsed_s) * (error_N - shown.surprise_N)
        adapts_in_s = self._adapts_in_s / (1.0 + (surprise_N / SURPRISE_N) ** 2)
        device, is_held = observe(
            shown.device,
            model_N,
            reading_N,
            elapsed_s,
            adapts_in_s=max(adapts_in_s, LEAST_ADAPTS_IN_S),
            bounds=self._scales,
            learns_scale=self._learns_scale,
            learns_offset=self._learns_offset,
        )
        # what is known of a creep stays what it is while the rest is learned
        slow = slow.beside(shown.device.force_N(model_N), device.force_N(model_N))
        if is_held:
            limits = (Limit.TRIM, *limits)
        return Shown(device, sensor, estimate.number, now_s, limits, slow, zero, lateness, surprise_N)

    def _lawful_mT(self, solution: FieldSolution, wanted_N: float) -> float:
        """The search's field, no further than LAW_SHARE from the force law's."""
        if self._law is None:
            return solution.field_mT
        law_mT = self._law.field_mT(wanted_N)
        return min(max(solution.field_mT, (1.0 - LAW_SHARE) * law_mT), (1.0 + LAW_SHARE) * law_mT)

    def _timed(
        self, shown: Shown, elapsed_s: float, estimate: Estimate | None, foresight: float, planned_mm: float
    ) -> Shown:
        """What the device has shown, and of how late its carriages are behind this gap."""
        if not self._learns_lag:
            return shown
        if estimate is None or not estimate.is_homed or foresight < LEAST_FORESIGHT:
            lateness = surprised(shown.lateness)
        else:
            speed_mm_s = estimate.left_mm_s + estimate.right_mm_s
            lateness = found(shown.lateness, elapsed_s, planned_mm, estimate.gap_mm, speed_mm_s, self._fastest_mm_s)
        if lateness is shown.lateness:
            return shown
        return Shown(
            shown.device,
            shown.sensor,
            shown.read,
            shown.read_s,
            shown.limits,
            shown.slow,
            shown.zero,
            lateness,
            shown.surprise_N,
        )

    def _motion_ahead(self, governed: Governed, device: DeviceFit) -> tuple[float, float]:
        # along the portrait, not from one solution to the next: a difference would amplify the solver's grain
        start_mm = self.portrait.gap_mm_at(device.model_N(governed.path_N[0]))
        speed, acceleration = 0.0, 0.0
        for place, force_N in enumerate(governed.path_N):
            away_mm = self.portrait.gap_mm_at(device.model_N(force_N)) - start_mm
            speed += _TO_SPEED[place] * away_mm
            acceleration += _TO_ACCELERATION[place] * away_mm
        fastest, hardest = self._fastest_mm_s, self._hardest_mm_s2
        return min(max(speed, -fastest), fastest), min(max(acceleration, -hardest), hardest)

    def _predicted_N(self, shown: Shown, estimate: Estimate | None, model_N: float | None) -> float | None:
        """The force that the device is expected to show; None where nothing is known of it, as before break-away."""
        if estimate is None or model_N is None or not self._contact.is_known(estimate):
            return None
        return shown.device.force_N(model_N) * shown.slow.factor_at(abs(estimate.handle.rate_mm_s))
