"""What is believed of one device: its estimators, and which of them may learn from a reading of the force sensor.

The force teaches only while friction is mobilised and the handle slides: only there the model knows the force. A
reading is compared with the model at the *measured* gap, so no tracking error is learned. Friction follows a rising
force only as the handle goes on: what it has not followed yet is no weak device. A sensor that is not believed teaches
nothing.
"""

import math
from typing import Final, final

from firmware_protocol.value import Value
from tormagd.config import Config
from tormagd.control.believe.carriage_lag import MAX_DT_S, CarriageLag
from tormagd.control.believe.handle import HandleWatch
from tormagd.control.believe.memory import ElementMemory
from tormagd.control.believe.ripple import Ripple
from tormagd.control.believe.sensor import DOUBTED_S, KNOWN_N, NAMED_S, SLACK_N, Disputed, SensorTrust
from tormagd.control.believe.sensor_zero import UNKNOWN_SD_N, SensorZero
from tormagd.control.believe.slow_friction import SLOWEST_MM_S, SlowFriction
from tormagd.control.believe.strength import MIDDLE_N, SURE, UNSEEN, Anchor, DeviceFit, adapting_s, observe
from tormagd.control.measure import unsensed_s
from tormagd.control.nominal import Nominal
from tormagd.control.records import Belief, Measured
from tormagd.control.safety.codes import Limit
from tormagd.element.model.displacement import MOVING_MM_S
from tormagd.scenes.scene import Scene

MIN_DT_S: Final = 0.003
"Readings teach every MIN_DT_S at most; a gap between readings counts as MAX_DT_S at most."
CREEPING_MM_S: Final = 1.2 * MOVING_MM_S
STOPPING_MM_S: Final = 0.5 * MOVING_MM_S
STUCK_N: Final = 0.08
"""A handle is stuck where its rate over the last 10 ms is under STOPPING_MM_S and its force so much less than friction.
"""
COMES_TO_REST: Final = 3.0
"A handle whose `sliding_mm_s` is at least this many times its rate only comes to rest."
UNSTEADY_MM_S: Final = 1.0
"One whose rate over 10 ms is this far off trembles."
UNTARED_N: Final = 0.15
"A zero that is further off gives the limit SENSOR_ZERO: half an hour's drift."
CONTRADICTED_N: Final = 0.4
"A reading further off than this contradicts a fit from another day: no rest, warmth or zero explains it."
MIN_FORESIGHT: Final = 0.5
"With less foresight a plan's gap leaps, and any carriages come late: no lag is learned."
OVER_N: Final = 0.15
"The device as it first showed itself gives no more than the scene's greatest force and this."
MOST_RIPPLE: Final = 0.15
"No friction varies by a greater share over angle and way."
AHEAD_S: Final = 0.018
"How late the gap comes beside the carriages' lag: a ripple is asked ahead. Chosen on sample 1."


@final
class Learned(Value):
    """What is known of a device from another day."""

    def __init__(
        self,
        device: DeviceFit = UNSEEN,
        slow_factor: float = 1.0,
        slow_learned: float = 0.0,
        sensor_zero_N: float = 0.0,
        lag_s: float = 0.0,
    ) -> None:
        self.device: Final = device
        self.slow_factor: Final = slow_factor
        self.slow_learned: Final = slow_learned
        self.sensor_zero_N: Final = sensor_zero_N
        self.lag_s: Final = lag_s


NOTHING_LEARNED: Final = Learned()


@final
class Believe:
    """The stage that learns one device from its readings: it updates the estimators, and says what is believed."""

    fit: DeviceFit
    "Scale and offset of the device at speed, with nothing relaxed."
    slow: SlowFriction
    zero: SensorZero
    sensor: SensorTrust
    ripple: Ripple
    carriages: CarriageLag
    handle: HandleWatch
    read: int
    "Number of the newest measurement that taught; -1 before the first."
    read_s: float
    "When that measurement taught; -inf before the first."
    limits: tuple[Limit, ...]
    "What is wrong with the sensor or with the fit, as the newest reading at speed shows."
    is_prior: bool
    "Whether a fit from another day was taught, and no reading has contradicted it."

    def __init__(self, config: Config, scene: Scene, nominal: Nominal, memory: ElementMemory) -> None:
        """Begin with an unseen device."""
        self.memory, self.learns = memory, scene.terms.learning
        self._has_motor: Final = scene.terms.motor
        self._fits: Final = (scene.terms.scale, scene.terms.offset)
        self._trim: Final = config.trim
        self._scales: Final = (config.trim.least, config.trim.most)
        self._offsets_N: Final = (config.trim.least_offset_N, config.trim.most_offset_N)
        self._radius_mm: Final = scene.insert.roller_radius_mm
        self._surely_N: Final = scene.force.most_N + OVER_N
        self._nominal: Final = nominal
        self._unknown_sd_N: Final = max(UNKNOWN_SD_N, scene.force.tolerance_rms_N)
        self._unsensed_s: Final = unsensed_s(1.0 / config.rates.control_hz)
        self._top_speed_mm_s: Final = config.position.gap_speed_mm_s
        self._has_creep: Final = scene.terms.creep and nominal.contact.slides
        self.forget()

    @property
    def device(self) -> DeviceFit:
        return self.fit.relaxed(self.memory.relaxed_N)

    def knows_zero(self, now_s: float) -> bool:
        """Tell whether the sensor's zero is known to within what the scene tolerates: else readings teach nothing."""
        return not self.sensor.is_disputed and self.zero.sd_N(now_s) <= self._unknown_sd_N

    def learned(self) -> Learned:
        """Return what is known of this device now, to `teach` on another day."""
        return Learned(self.fit, self.slow.factor_at(0.0), self.slow.learned, self.zero.zero_N, self.carriages.lag_s)

    def teach(self, learned: Learned) -> None:
        """Replace all that is known of the device by `learned`, and begin its estimators anew."""
        self.fit = learned.device
        self.slow, self.zero, self.ripple = SlowFriction(self._trim), SensorZero(), Ripple()
        self.sensor, self.carriages = SensorTrust(self._trim, learned.device), CarriageLag()
        self.slow.factor, self.slow.learned = learned.slow_factor, learned.slow_learned
        self.zero.zero_N, self.zero.way, self.carriages.lag_s = learned.sensor_zero_N, self._trim.way, learned.lag_s
        self.read, self.read_s, self.limits = -1, -math.inf, ()
        self.is_prior = learned.device is not UNSEEN

    def forget(self) -> None:
        """Forget the device, and begin the watch on the encoder anew."""
        self.teach(NOTHING_LEARNED)
        self.handle = HandleWatch()

    def update(self, now_s: float, measured: Measured | None) -> Belief:
        """Learn from `measured`, where it is new, and return the belief at `now_s`."""
        ripple, predicted_N = 1.0, None
        if measured is not None:
            self.memory.update(now_s, measured)
            if measured.is_homed:
                model_N = self.memory.force_N(self._nominal.now(measured))
                slid_N = self.handle.update(measured, model_N) if self._nominal.contact.slides else model_N
                self._hear(now_s, measured, model_N, slid_N)
                if self._nominal.contact.is_known(measured):
                    predicted_N = (
                        self.fit.force_N(slid_N)
                        * self.slow.factor_at(abs(measured.handle.rate_mm_s))
                        * self._ripple(measured)
                    )
            ripple = self._ripple(measured, AHEAD_S + self.carriages.lag_s)
        return self._belief(ripple, predicted_N)

    def learn_lag(self, dt_s: float, measured: Measured | None, foresight: float, planned_mm: float) -> None:
        """Learn the carriages' lag from the gap of a plan, `planned_mm`, which came `dt_s` after the last plan."""
        if self.learns and self._has_motor and measured is not None:
            known_mm = planned_mm if measured.is_homed and foresight >= MIN_FORESIGHT else None
            self.carriages.update(dt_s, known_mm, measured.gap_mm, measured.gap_speed_mm_s, self._top_speed_mm_s)

    def _belief(self, ripple: float, predicted_N: float | None) -> Belief:
        at_speed, has_slid = self.device, self.sensor.has_slid
        slow = self.slow.factor_at(self.handle.creep_mm_s) if self._has_creep else 1.0
        return Belief(
            device=at_speed.times(slow * ripple),
            at_speed=at_speed,
            unseen=UNSEEN.relaxed(self.memory.relaxed_N) if self.is_prior and not has_slid else None,
            lag_s=self.carriages.lag_s if self._has_motor else 0.0,
            predicted_N=predicted_N,
            limits=(*self.limits, Limit.HANDLE_LOST) if self.handle.is_lost else self.limits,
            sensor_doubted_s=self.sensor.doubted_s,
            anchor_N=self._anchor_N(slow * max(ripple, 1.0)) if has_slid else math.inf,
        )

    def _anchor_N(self, factor: float) -> float:
        """Return the model's force, N, of the ceiling on the anchor."""
        anchor, most_N = self.sensor.anchor, self._surely_N
        most_N += SURE * max(anchor.deviation_N(anchor.model_N(most_N)) - 2.0 * KNOWN_N, 0.0)
        return anchor.model_N(most_N / factor) + self.memory.relaxed_N

    def _ripple(self, measured: Measured, ahead_s: float = 0.0) -> float:
        """Return the friction where the handle will be in `ahead_s`, over its mean."""
        share = self.ripple.share((measured.handle_mm + ahead_s * measured.handle.rate_mm_s) / self._radius_mm)
        return 1.0 + min(max(share + self.zero.way * measured.handle.turn.direction, -MOST_RIPPLE), MOST_RIPPLE)

    def _hear(self, now_s: float, measured: Measured, model_N: float, slid_N: float) -> None:
        """Learn from the newest reading, with the model's force `model_N` at the measured gap."""
        if (
            measured.number == self.read
            or now_s - self.read_s < MIN_DT_S
            or now_s - measured.sensed_s > self._unsensed_s
        ):
            return
        dt_s = min(now_s - self.read_s, MAX_DT_S)
        self.read, self.read_s = measured.number, now_s
        rate_mm_s = abs(measured.handle.rate_mm_s)
        reading_N = (measured.force_N - measured.handle.turn.direction * self.zero.zero_N) / self._ripple(measured)
        is_mobilised = self._nominal.contact.is_known(measured)
        # a hand that meets a wall stops within 10 ms
        is_stuck = abs(measured.handle.quick_mm_s) < STOPPING_MM_S and reading_N < self.fit.force_N(model_N) - STUCK_N
        if is_mobilised and not (
            self._nominal.contact.slides
            and (rate_mm_s < MOVING_MM_S or is_stuck or self.handle.moved_gap_at_rest(model_N))
        ):
            self._hear_at_speed(now_s, measured, reading_N, slid_N * self.slow.factor_at(rate_mm_s), dt_s)
        else:
            self._hear_at_creep(now_s, measured, reading_N, slid_N, rate_mm_s, dt_s, is_mobilised)

    def _hear_at_creep(
        self,
        now_s: float,
        measured: Measured,
        reading_N: float,
        model_N: float,
        rate_mm_s: float,
        dt_s: float,
        is_mobilised: bool,
    ) -> None:
        """Learn slow friction from a reading at a creep."""
        is_creep = (
            SLOWEST_MM_S < rate_mm_s < CREEPING_MM_S
            and measured.handle.sliding_mm_s < min(CREEPING_MM_S, COMES_TO_REST * rate_mm_s)
            and abs(abs(measured.handle.quick_mm_s) - rate_mm_s) < UNSTEADY_MM_S
        )
        expected_N = self.fit.force_N(model_N)
        # friction not yet mobilised is less than the model's: only a greater reading teaches then
        is_told = expected_N > SLACK_N and (is_mobilised or reading_N > expected_N)
        if is_creep and is_told and self._has_creep and self.learns and self.knows_zero(now_s):
            self.slow.update(self.fit, model_N, rate_mm_s, reading_N, dt_s)

    def _hear_at_speed(self, now_s: float, measured: Measured, reading_N: float, model_N: float, dt_s: float) -> None:
        """Take one reading of a handle that slides at speed."""
        rate_mm_s, angle = abs(measured.handle.rate_mm_s), measured.handle_mm / self._radius_mm
        zero, fit, sensor, zero_sd_N = self.zero, self.fit, self.sensor, self.zero.sd_N(now_s)
        # an anchor that was learned one way only was misread
        sensor.anchor.values[1] += zero.update(
            now_s,
            measured.handle.turn.direction,
            measured.force_N / (1.0 + self.ripple.share(angle)),
            model_N,
            rate_mm_s,
            dt_s,
            fit,
            learns=self.learns,
            is_disputed=sensor.wrong_s + sensor.outside_s > 2.0 * NAMED_S,
        )
        taught_N = sensor.update(
            fit,
            model_N,
            rate_mm_s,
            reading_N,
            zero_sd_N,
            dt_s,
            learns=self.learns and zero_sd_N <= UNKNOWN_SD_N,
        )
        unknown_N = self._unknown_N(zero_sd_N)
        is_more = sensor.has_slid and reading_N >= fit.force_N(model_N) + unknown_N
        if taught_N is None or not self.learns or (unknown_N > 0.0 and not is_more):
            return
        anchor_N = max(sensor.anchor.force_N(model_N), SLACK_N)
        self._fit(model_N, rate_mm_s, taught_N - unknown_N, anchor_N + sensor.off_N, dt_s)
        if self._nominal.contact.slides and Limit.TRIM not in self.limits:
            self.ripple.update(angle, measured.handle.rate_mm_s, anchor_N, reading_N)

    def _unknown_N(self, zero_sd_N: float) -> float:
        """Update `limits`, and return what a zero that is known to within `zero_sd_N` may explain, if that is much."""
        self.limits = (Limit.SENSOR_ZERO,) if abs(self.zero.zero_N) > UNTARED_N else ()
        if self.sensor.is_disputed:
            self.limits = (Limit.SENSOR if self.sensor.is_doubted else Limit.DEVICE_OR_SENSOR, *self.limits)
        elif zero_sd_N > self._unknown_sd_N:
            self.limits = (Limit.OFFSET_UNKNOWN, *self.limits)
            return SURE * zero_sd_N + SLACK_N
        return 0.0

    def _fit(self, model_N: float, rate_mm_s: float, reading_N: float, mean_N: float, dt_s: float) -> None:
        """Learn the fit's scale and offset from one reading, the sooner the more the readings' mean is off."""
        before_N = self.fit.force_N(model_N)
        if self.is_prior and not self.sensor.has_slid and abs(reading_N - before_N) > CONTRADICTED_N:
            self.is_prior, self.fit, self.sensor.anchor = False, UNSEEN, Anchor(UNSEEN)
        self.fit, is_held = observe(
            self.fit,
            model_N,
            reading_N,
            dt_s,
            adapts_in_s=adapting_s(self._trim.time_s, mean_N - before_N),
            scales=self._scales,
            offsets_N=self._offsets_N,
            learns=self._fits,
        )
        if is_held:
            self.limits = (Limit.TRIM, *self.limits)
        # the force at a slower creep stays while scale and offset are learned
        self.slow.rescale(before_N, self.fit.force_N(model_N), rate_mm_s)

    def confirm(self, wrong: Disputed) -> None:
        """Take the operator's word in a dispute of device and sensor."""
        sensor, fit = self.sensor, self.fit
        if sensor.is_disputed and wrong == "device":
            self.fit, self.sensor = DeviceFit(fit.scale, fit.offset_N), SensorTrust(self._trim)
        elif sensor.is_disputed:
            self.fit = DeviceFit(fit.scale, sensor.anchor.force_N(MIDDLE_N) - fit.scale * MIDDLE_N)
            sensor.wrong_s = DOUBTED_S
