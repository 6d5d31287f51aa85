"""Who is right where the readings leave the believed device: the sensor, or a device that has changed.

    moved    d    what the fit has learned of late, N, where it is now; forgotten as fast as an elastomer relaxes
    excused  e    what it has learned because conditions changed, N: no more than the distance from the usual explains
    dispute  |d| > what a device changes by itself: the fit goes back by d, and learns nothing more
    lead     l    by how much the readings are over the fit's force, N: the device is taken for that much stronger
    agreed   the readings come back to the fit: it learns again

In a dispute the gap follows the explanation with more force. So a rising reading opens the gap, and a falling one moves
nothing. A sensor that shows what no device gives is wrong, and opens nothing.
"""

from typing import Final, Literal, final

from tormagd.control.believe.freshness import Freshness
from tormagd.control.believe.sensor_zero import UNKNOWN_SD_N
from tormagd.control.believe.strength import SURE, DeviceBounds, DeviceFit
from tormagd.control.interpolation import low_pass

Disputed = Literal["device", "sensor"]
"What an operator may say in a dispute: the device has changed, or the sensor is wrong."

FILTER_S: Final = 0.01
"Time constant of the readings' mean."
LEARNS_S: Final = 0.5
"A device that has not slid for so long has shown nothing to dispute."
MOVED_N: Final = 0.12
"Hysteresis, a creep and a kelvin may move a device's force so far at once."
SHAPE: Final = 0.25
"A device's force may move by this share of the change of the model's force of late: field laws differ in shape."
VISCOUS_N_S_MM: Final = 6e-4
"A device's force may also move by so much for each mm/s by which the handle's rate has changed of late."
LATELY_S: Final = 1.0
"Time constant of what counts as of late."
SLACK_N: Final = 0.05
"So much slack a gap that hardly moves gives, too: it excuses nothing."
USUAL_S: Final = 60.0
"Time constant of what counts as usual."
EXCUSED: Final = 0.08
"A fit may err by this share of the force's distance from the usual: field laws differ in shape."
EXCUSED_N: Final = 0.05
"So much may be excused at the usual force, too."
RELAXES_1_S: Final = 0.012
"An elastomer may lose, or win back, this share of its force a second beyond what its model remembers."
RELAXED: Final = 0.12
"An elastomer may lose no more than this share altogether, or in SLOWEST_S again."
SLOWEST_S: Final = 900.0
AGREES_N: Final = 0.06
AGREES_S: Final = 0.2
"Readings within AGREES_N of the fit for so long agree with it."
DRIFTS_S: Final = 10.0
"So long they have to agree at most, however slowly they have left the fit."
NAMED_S: Final = 0.1
"A dispute is reported once it has lasted for longer."
RISES_N_S: Final = 2.0
"Greatest rate of `lead_N`: a device that is 20% stronger at once is followed in 0.2 s."
LEADS_S: Final = 0.03
"Time constant of `lead_N`."
NOISE_N: Final = 0.05
"What noise, a creep and the model's shape leave of a device at one of its bounds."
WRONG_S: Final = 0.05
"Evidence for so long shows that the sensor is wrong."
TRUSTED_AGAIN_S: Final = 1.0
"The readings of a wrong sensor have to agree for longer than this."


@final
class SensorTrust:
    """Judge of one force sensor against the fit of its device. Finds, follows and ends their disputes."""

    known_s: float = 0.0
    "How long the device has slid, LEARNS_S at most."
    measured_N: float = 0.0
    "Mean of the readings over FILTER_S."
    model_N: float = 0.0
    "Mean of the model's force over LATELY_S."
    rate_mm_s: float = 0.0
    "Mean of the handle's rate over LATELY_S."
    direction: float = 0.0
    "The way the handle goes, 1 or -1; 0 before the first reading."
    usual_N: float = 0.0
    "Mean of the model's force over USUAL_S."
    slack_N: float = 0.0
    "What the fit may learn at once, as model force, rate or zero have changed of late."
    moved_N: float = 0.0
    "What the fit has learned of late, and would have to unlearn in a dispute."
    leaves_s: float = 0.0
    "For how long `moved_N` has been over half of MOVED_N."
    excused_N: float = 0.0
    "What the fit has learned besides, as far as the distance of the force from the usual explains it."
    relaxed_N: float = 0.0
    "How much force the device has lost by relaxing, beyond what its model remembers; below 0 where it has gained."
    is_disputed: bool = False
    "Whether sensor and device are in dispute: the fit does not learn."
    disputed_s: float = 0.0
    "How long the dispute has lasted, in time of sliding."
    back_N: float = 0.0
    "By how much the fit had to change when the newest dispute began."
    began_way: float = 0.0
    "The handle's `direction` when the newest dispute began."
    agreed_s: float = 0.0
    "How long the readings have agreed with the fit in the dispute."
    lead_N: float = 0.0
    "By how much the device is taken for stronger than its fit, at the model's present force."
    is_doubted: bool = False
    "Whether the sensor is shown to be wrong."
    doubted_s: float = 0.0
    "How long the sensor has been doubted, in time of sliding."
    wrong_s: float = 0.0
    "How long the readings have been such as no device gives; falls while they are not."

    def __init__(self, bounds: DeviceBounds) -> None:
        self._bounds: Final = bounds
        self.freshness = Freshness()

    @property
    def has_slid(self) -> bool:
        return self.known_s >= LEARNS_S

    @property
    def is_named(self) -> bool:
        return self.is_disputed and self.disputed_s > NAMED_S

    def update(
        self,
        fit: DeviceFit,
        model_N: float,
        rate_mm_s: float,
        direction: float,
        reading_N: float,
        zero_sd_N: float,
        dt_s: float,
    ) -> None:
        """Take one reading and judge it against `fit`."""
        if self.is_disputed:
            zero_sd_N = 0.0  # a reversal has to tell the zero first
        self.freshness.update(fit.scale, model_N, reading_N, dt_s, learns=not self.is_disputed)
        self._hear(model_N, reading_N, dt_s)
        self._update_slack(fit, model_N, rate_mm_s, direction, zero_sd_N, dt_s)
        self._judge(self.measured_N - fit.force_N(model_N), self._is_strange(model_N, zero_sd_N), dt_s)

    def fit_moved(self, learned_N: float, force_N: float, dt_s: float) -> None:
        """Take the change `learned_N` that one reading made to the fit's force, which now is `force_N`."""
        if not self.has_slid:
            return
        self.moved_N += learned_N
        self.leaves_s = self.leaves_s + dt_s if abs(self.moved_N) > 0.5 * MOVED_N else 0.0
        if abs(self.moved_N) > MOVED_N + self.slack_N:
            self._begin(self.moved_N)
        else:
            self._fade_moved(max(force_N, 0.0), dt_s)

    def compare(self, fit: DeviceFit, model_N: float) -> None:
        """Begin a dispute where the mean of the last readings has left `fit`, unless the device has slid for under
        LEARNS_S."""
        over_N = self.measured_N - fit.force_N(model_N)
        if self.has_slid and abs(over_N) > MOVED_N + self.slack_N + SURE * fit.deviation_N(model_N):
            self._begin(over_N)

    def zero_moved(self, found_N: float) -> float:
        """Take a change `found_N` of the sensor's zero, shown by a reversal, and return how far it shifts
        the fit, N."""
        self.relaxed_N = 0.0
        return found_N * self.direction if self.is_disputed and self.began_way == self.direction else 0.0

    def confirm(self, wrong: Disputed) -> None:
        """Take the operator's word in a dispute."""
        if wrong == "device":
            self._settle()
            self.known_s = self.excused_N = 0.0
        else:
            self.is_doubted = True

    def _hear(self, model_N: float, reading_N: float, dt_s: float) -> None:
        if self.known_s == 0.0:
            self.measured_N, self.model_N, self.usual_N = reading_N, model_N, model_N
        self.known_s = min(self.known_s + dt_s, LEARNS_S)
        self.measured_N = low_pass(self.measured_N, reading_N, dt_s, FILTER_S)

    def _update_slack(
        self, fit: DeviceFit, model_N: float, rate_mm_s: float, direction: float, zero_sd_N: float, dt_s: float
    ) -> None:
        """Update `slack_N`: what the device may show that its fit did not, as conditions have changed of late."""
        # where the handle has turned a wrong zero counts twice
        is_turned = direction * self.direction < 0.0
        slack_N = (
            SURE * max(fit.deviation_N(model_N) - fit.deviation_N(self.model_N), 0.0)
            + SHAPE * abs(model_N - self.model_N)
            + VISCOUS_N_S_MM * abs(rate_mm_s - self.rate_mm_s)
            + SURE * (2.0 * zero_sd_N if is_turned else max(zero_sd_N - UNKNOWN_SD_N, 0.0))
        )
        self.direction = direction
        self.slack_N = max(low_pass(self.slack_N, 0.0, dt_s, LATELY_S), slack_N)
        self.model_N = low_pass(self.model_N, model_N, dt_s, LATELY_S)
        self.usual_N = low_pass(self.usual_N, model_N, dt_s, USUAL_S)
        self.rate_mm_s = low_pass(self.rate_mm_s, rate_mm_s, dt_s, LATELY_S)

    def _judge(self, over_N: float, is_strange: bool, dt_s: float) -> None:
        """Judge who is right by how much the readings are over the fit's force, `over_N`."""
        agrees = not is_strange and abs(over_N) <= AGREES_N
        self.wrong_s = self.wrong_s + dt_s if is_strange else max(self.wrong_s - dt_s, 0.0)
        if self.wrong_s > WRONG_S and not self.is_doubted:
            if not self.is_disputed:
                self._begin(0.0)
            self.is_doubted, self.doubted_s = True, 0.0
        if not self.is_disputed:
            return
        self.disputed_s += dt_s
        self.agreed_s = self.agreed_s + dt_s if agrees else 0.0
        if self.is_doubted:
            self.doubted_s += dt_s
        wanted_N = 0.0 if is_strange or self.is_doubted else max(over_N, 0.0)
        change_N = low_pass(self.lead_N, wanted_N, dt_s, LEADS_S) - self.lead_N
        self.lead_N += min(max(change_N, -RISES_N_S * dt_s), RISES_N_S * dt_s)
        least_s = TRUSTED_AGAIN_S if self.is_doubted else AGREES_S
        if self.agreed_s > max(least_s, min(2.0 * self.leaves_s, DRIFTS_S)):
            self._settle()

    def _settle(self) -> None:
        """End the dispute, if any: the sensor is believed again."""
        self.is_disputed = self.is_doubted = False
        self.disputed_s = self.agreed_s = self.doubted_s = self.wrong_s = 0.0
        self.lead_N = self.moved_N = self.leaves_s = 0.0

    def _begin(self, over_N: float) -> None:
        """Begin a dispute with readings `over_N` over the fit's force, and note how far the fit has to go back."""
        self.is_disputed, self.disputed_s, self.agreed_s = True, 0.0, 0.0
        self.lead_N, self.began_way = max(over_N, 0.0), self.direction
        self.back_N, self.moved_N = -self.moved_N, 0.0

    def _fade_moved(self, force_N: float, dt_s: float) -> None:
        """Bring `moved_N` towards 0 by what is excused, and by what the device relaxes in `dt_s`."""
        self._excuse(dt_s)
        self.relaxed_N = low_pass(self.relaxed_N, 0.0, dt_s, SLOWEST_S)
        relaxes_N = RELAXES_1_S * force_N * dt_s
        most_N = max(RELAXED * force_N, abs(self.relaxed_N))  # at a greater force before, more may have relaxed
        relaxed_N = self.relaxed_N + min(max(-self.moved_N, -relaxes_N), relaxes_N)
        relaxed_N = min(max(relaxed_N, -most_N), most_N)
        self.moved_N += relaxed_N - self.relaxed_N
        self.relaxed_N = relaxed_N

    def _excuse(self, dt_s: float) -> None:
        """Move from `moved_N` to `excused_N` what the slack of the last `dt_s` explains."""
        most_N = EXCUSED * abs(self.model_N - self.usual_N) + EXCUSED_N
        by_slack_N = max(self.slack_N - SLACK_N, 0.0) / LEARNS_S * dt_s
        now_N = self.excused_N + min(max(self.moved_N, -by_slack_N), by_slack_N)
        now_N = min(max(now_N, -most_N), most_N)
        self.moved_N -= now_N - self.excused_N
        self.excused_N = now_N

    def _is_strange(self, model_N: float, zero_sd_N: float) -> bool:
        """Tell whether no device gives the newest readings: they are frozen, or beyond the bounds of all devices."""
        if self.freshness.is_frozen:
            return True
        unknown_N = NOISE_N + SURE * max(zero_sd_N - UNKNOWN_SD_N, 0.0)
        weakest_N = self._bounds.min_scale * (1.0 - RELAXED) * model_N - unknown_N
        return not weakest_N <= self.measured_N <= self._bounds.max_scale * (1.0 + RELAXED) * model_N + unknown_N
