"""The force asked of the device: what is wanted over the next 400 ms, and the corridor around it.

wanted    at TIMES_S: a wall's forces as the handle moves, or a preview; else slope and, as far as trusted, forecast
corridor  what the scene allows and the device gives; besides
          law     to another wall or to none: the release rate, and what the handle's motion changes; where the scene
                  has a decay, DECAY of that rate for what gives way while the hand pushes on
          wall    at most EARLY_N over the most that is felt there
          holder  the release rate, from another publisher's force, or from one that followed none
          none    without a valid setpoint: that rate to the device's least force
          A hand that draws back is let go at once.
path      of the gap through both, from where it is (`path.py`); straight where nothing is known ahead
"""

import math
from typing import Final, final

from tormagd.control.aim.portrait import Portrait
from tormagd.control.ask.forecast import HORIZON_S, MAX_STEP_S, Forecast
from tormagd.control.ask.path import PATH_S, SPEEDING_UP_S, TIMES_S, Path
from tormagd.control.believe.strength import DeviceFit
from tormagd.control.interpolation import at_step, low_pass, require_finite
from tormagd.control.records import AT_REST, Ask, GapSpeeds, TimedSetpoint, Travel, Wall
from tormagd.control.safety.codes import Limit
from tormagd.element.model.force_curve import within
from tormagd.scenes.scene import EVERY_TERM, Force, Terms

SLOPE_FILTER_S: Final = 0.003
AHEAD_S: Final = 0.05
"Setpoints are carried on along their slope, or past their preview's end, by no more than this."
MIN_TIMES: Final = 9
"At least this many of TIMES_S are looked at, however short a preview is."
OUTRUN_N: Final = 0.02
"The limit RATE acts where the carriages make the path miss what is known ahead by more."
EARLY_N: Final = 0.08
"The gap closes before a wall by this much more than is felt there: 0.1 N with what is not known of a device."
DECAY: Final = 0.25
"A force that gives way falls more slowly than a gap opens, so that the hand can stop."

ENDLESS: Final[float] = math.inf
"Compiled, a plain float."

Bounds = tuple[float, float]


@final
class Governor:
    """The stage that turns setpoints, of one publisher after another, into the forces to render."""

    time_s: float
    asked_N: float
    from_mm: float
    "The portrait's gap of `asked_N`."
    sent_mm: float
    "Where the carriages were sent."
    expected_N: float
    "What the lagging gap should give by now."
    last: TimedSetpoint | None
    slope_N_s: float
    is_passing: bool
    "Whether the force is on the ramp to the forces of its holder."
    target_N: float | None
    "What was asked of a hand that pushed on at `target_mm`."
    target_mm: float
    blend_N: float
    "What is left of a law's ramp."

    def __init__(
        self, now_s: float, portrait: Portrait, force: Force, speeds: GapSpeeds, terms: Terms = EVERY_TERM
    ) -> None:
        self._has_forecast: Final = terms.forecast
        self._portrait: Final = portrait
        self._path: Final = Path(portrait, speeds)
        self._speeds: Final = speeds
        self._least_N: Final = force.least_N
        self._allowed: Final = (force.waiting_N, force.most_N)
        self._release_N_s: Final = force.release_N_s
        self._decay_N_s: Final = DECAY * force.release_N_s if force.breakthrough == "decay" else ENDLESS
        self.forecast = Forecast()
        self.begin(now_s)

    def begin(self, now_s: float) -> None:
        """Forget all setpoints, and begin at `now_s` with the gap open and no publisher."""
        self.time_s = now_s
        self._stand_at(self._portrait.min_N, DeviceFit())
        self._forget()
        self.is_passing = False

    def foresee(self, *, is_whole: bool = True) -> bool:
        return self._has_forecast and self.forecast.foresee(self.slope_N_s, is_whole=is_whole)

    def update(
        self,
        now_s: float,
        setpoint: TimedSetpoint | None,
        device: DeviceFit,
        lag_s: float,
        travel: Travel = AT_REST,
        held_N: float | None = None,
    ) -> Ask:
        """Return the force to render now and the forces ahead, with the limits on them."""
        given = max(device.force_N(self._portrait.min_N), 0.0), max(device.force_N(self._portrait.max_N), 0.0)
        dt_s, self.time_s = max(now_s - self.time_s, 0.0), now_s
        if held_N is not None:
            self.is_passing = True
            self._stand_at(held_N, device)
        age_s, limits = None, [Limit.NO_SETPOINT]
        if setpoint is not None:
            age_s = now_s - setpoint.stamp_s
            setpoint.require_numbers()
            require_finite("age_s", age_s)
            if age_s <= setpoint.valid_for_s:
                return self._followed(setpoint, age_s, device, lag_s, travel, dt_s, given, held_N is None)
            limits = [Limit.STALE, *setpoint.limits]
        # where a device turns out weaker, the gap does not close for it
        left_N = min(self.asked_N, device.force_N(self._portrait.force_N_at(self.from_mm)))
        self._stand_at(max(left_N - self._release_N_s * dt_s, given[0]), device)
        self._forget()
        return Ask(self.asked_N, [self.asked_N] * len(PATH_S), age_s, tuple(limits))

    def _followed(
        self,
        setpoint: TimedSetpoint,
        age_s: float,
        device: DeviceFit,
        lag_s: float,
        travel: Travel,
        dt_s: float,
        given: Bounds,
        is_free: bool,
    ) -> Ask:
        asked_N = setpoint.asked_N(travel)
        force_N, limits = self._target(setpoint, travel, asked_N, dt_s, given)
        self._learn(setpoint, travel, force_N, device)
        path_N, foresight, governed_N, sent_mm = self._path_N(
            setpoint, travel, max(age_s, 0.0), device, lag_s, dt_s, force_N, given
        )
        if self.blend_N != 0.0 or abs(governed_N - force_N) > OUTRUN_N:
            limits = (*limits, Limit.RATE)
        step_N = self._release_N_s * dt_s if is_free else 0.0
        is_let_go = is_free and force_N < self.asked_N and setpoint.lets_go(travel)
        self.is_passing = self.is_passing and not is_let_go and abs(path_N[0] - self.asked_N) > step_N
        if self.is_passing:
            governed_N = self.asked_N + math.copysign(step_N, path_N[0] - self.asked_N)
            path_N, sent_mm = [governed_N] * len(PATH_S), None
            limits, foresight = (*limits, Limit.TAKEOVER), 0.0
        self._stand_at(path_N[0], device, sent_mm)
        return Ask(governed_N, path_N, age_s, limits, foresight, is_meant=True, asked_N=asked_N)

    def _target(
        self, setpoint: TimedSetpoint, travel: Travel, asked_N: float, dt_s: float, given: Bounds
    ) -> tuple[float, tuple[Limit, ...]]:
        """Return what is asked for now, within the corridor, and what holds it there."""
        allowed_N = within(asked_N, self._allowed)
        lawful_N = within(allowed_N, self._law(setpoint, travel, dt_s))
        self.blend_N = lawful_N - allowed_N
        self.target_N, self.target_mm = lawful_N if travel.is_pushing else None, travel.place_mm
        waiting_N, most_N = self._allowed
        return within(lawful_N, given), (
            *((Limit.RANGE,) if not self._least_N <= asked_N <= most_N else ()),
            *((Limit.STANDBY,) if self._least_N < waiting_N > asked_N else ()),
            *((Limit.F_MIN,) if lawful_N < given[0] else ()),
            *((Limit.F_MAX,) if lawful_N > given[1] else ()),
            *setpoint.limits,
        )

    def _law(self, setpoint: TimedSetpoint, travel: Travel, dt_s: float) -> Bounds:
        """Return what a law's ramp leaves of the corridor."""
        before_N, last, wall = self.target_N, self.last, setpoint.wall
        # a new holder has a ramp of its own
        if last is None or before_N is None or not travel.is_pushing or setpoint.holder != last.holder:
            return -ENDLESS, ENDLESS
        if wall is not None:
            most_N = self._release_N_s * dt_s + wall.stiffness_N_mm * abs(travel.place_mm - self.target_mm)
        elif self._decay_N_s < ENDLESS:
            return before_N - self._decay_N_s * dt_s, ENDLESS
        else:
            most_N = ENDLESS if last.wall is None and self.blend_N == 0.0 else self._release_N_s * dt_s
        return before_N - most_N, before_N + most_N

    def _learn(self, setpoint: TimedSetpoint, travel: Travel, force_N: float, device: DeviceFit) -> None:
        last, self.last = self.last or setpoint, setpoint
        spacing_s = setpoint.stamp_s - last.stamp_s
        if setpoint.holder != last.holder:  # another publisher's forces say nothing about this one's
            self.is_passing, self.slope_N_s = True, 0.0
            self.forecast.forget()
        elif spacing_s > MAX_STEP_S or not self._has_forecast or setpoint.wall is not None:
            self.slope_N_s = 0.0
        elif spacing_s > 0.0:
            per_mm_s = device.scale * self._portrait.slope_at_N_mm(device.model_N(force_N))
            most = -self._speeds.opening_mm_s * per_mm_s, self._speeds.sure_mm_s * per_mm_s
            risen_N = within(setpoint.force_N, self._allowed) - within(last.force_N, self._allowed)
            self.slope_N_s = low_pass(self.slope_N_s, within(risen_N / spacing_s, most), spacing_s, SLOPE_FILTER_S)
        if self._has_forecast:
            self._remember(
                setpoint, 0.0 if setpoint.wall is not None or setpoint.lets_go(travel) else setpoint.preview_s
            )

    def _remember(self, setpoint: TimedSetpoint, ahead_s: float) -> None:
        """Give the forecast the newest force, or a preview's last."""
        if ahead_s >= TIMES_S[-1]:
            self.forecast.forget()
            return
        newest_N = setpoint.force_N
        if ahead_s > 0.0:
            self.slope_N_s, newest_N = setpoint.preview_slope_N_s, setpoint.preview_N[-1]
        self.forecast.update(setpoint.stamp_s + ahead_s, within(newest_N, self._allowed))

    def _path_N(
        self,
        setpoint: TimedSetpoint,
        travel: Travel,
        soon_s: float,
        device: DeviceFit,
        lag_s: float,
        dt_s: float,
        force_N: float,
        given: Bounds,
    ) -> tuple[list[float], float, float, float | None]:
        """Return the forces at PATH_S, how far they are foreseen, what the gap gives by now, and where it is sent."""
        if setpoint.lets_go(travel):
            return [force_N] * len(PATH_S), 1.0, force_N, None
        bounds = within(self._allowed[0], given), within(self._allowed[1], given)
        ahead_N, trust = self._ahead_N(setpoint, travel, soon_s, lag_s)
        wanted_N = [within(within(each_N, bounds) + self.blend_N, bounds) for each_N in ahead_N]
        is_near = setpoint.is_told or (trust > 0.0 and self._path.is_near(self.sent_mm, wanted_N[-1], device))
        if self.is_passing or not is_near:
            return wanted_N[: len(PATH_S)], trust, force_N, None
        most_N = self._most_N(setpoint.wall, travel, lag_s, bounds)
        pursued_N, sent_mm = self._path.pursue(self.from_mm, self.sent_mm, dt_s, wanted_N, device, lag_s, most_N)
        path_N = [
            trust * within(each_N, bounds) + (1.0 - trust) * other_N
            for each_N, other_N in zip(pursued_N, wanted_N)  # noqa: B905 only such a zip is compiled to a plain loop
        ]
        # the path sets out earlier by as much as the carriages come later
        if dt_s > 0.0:
            self.expected_N = low_pass(self.expected_N, path_N[0], dt_s, lag_s)
        return path_N, trust, within(self.expected_N, bounds) if setpoint.is_told else force_N, sent_mm

    def _ahead_N(
        self, setpoint: TimedSetpoint, travel: Travel, soon_s: float, lag_s: float
    ) -> tuple[list[float], float]:
        """Return the forces known ahead at TIMES_S, and the trust in them."""
        wall, slope_N_s = setpoint.wall, self.slope_N_s
        if wall is not None:
            place_mm = travel.place_mm + travel.rate_mm_s * (lag_s + SPEEDING_UP_S)
            return [wall.force_N(place_mm + travel.rate_mm_s * after_s) for after_s in TIMES_S], 1.0
        if setpoint.preview_N:
            return previewed_N(setpoint, soon_s + lag_s, self.forecast), 1.0
        # a publisher that has fallen silent is not believed to go on as it did
        trust = self.forecast.trust if soon_s <= MAX_STEP_S else 0.0
        begins_s, times_s = soon_s + trust * lag_s, TIMES_S[: MIN_TIMES if trust > 0.0 else len(PATH_S)]
        last_N = within(setpoint.force_N, self._allowed)
        ahead_N = [last_N + slope_N_s * min(begins_s + after_s, AHEAD_S) for after_s in times_s]
        if trust > 0.0:
            for place, forecast_N in enumerate(self.forecast.forces_N(begins_s, times_s)):
                ahead_N[place] += trust * (forecast_N - ahead_N[place])
        return ahead_N, trust

    def _most_N(self, wall: Wall | None, travel: Travel, lag_s: float, bounds: Bounds) -> list[Bounds] | None:
        """Return the most at PATH_S that the gap may give, and may be sent to."""
        if wall is None:
            return None
        over_N = within(within(wall.friction_N, self._allowed) + self.blend_N, bounds) - wall.friction_N + EARLY_N
        places_mm = [travel.place_mm + travel.rate_mm_s * after_s for after_s in PATH_S]
        on_mm = travel.rate_mm_s * (lag_s + SPEEDING_UP_S)
        return [(wall.most_N(each_mm) + over_N, wall.most_N(each_mm + on_mm) + over_N) for each_mm in places_mm]

    def _stand_at(self, force_N: float, device: DeviceFit, sent_mm: float | None = None) -> None:
        self.asked_N, self.from_mm = force_N, self._portrait.gap_mm_at(device.model_N(force_N))
        if sent_mm is None:
            self.expected_N, sent_mm = force_N, self.from_mm
        self.sent_mm = sent_mm

    def _forget(self) -> None:
        self.last, self.slope_N_s, self.is_passing = None, 0.0, True
        self.target_N, self.target_mm, self.blend_N = None, 0.0, 0.0
        self.forecast.forget()


def previewed_N(setpoint: TimedSetpoint, begins_s: float, forecast: Forecast) -> list[float]:
    """Return the forces of a preview at TIMES_S from `begins_s` after its stamp."""
    trust = forecast.trust
    ahead_N: list[float] = []
    known_s = setpoint.preview_s + (HORIZON_S if trust > 0.0 else 0.0)
    forces_N = [setpoint.force_N, *setpoint.preview_N]
    for after_s in TIMES_S:
        at_s = begins_s + after_s
        past_s = at_s - setpoint.preview_s
        if at_s >= known_s and len(ahead_N) >= MIN_TIMES:
            break
        force_N = at_step(at_s / setpoint.preview_dt_s, forces_N)
        if past_s >= 0.0:
            force_N += setpoint.preview_slope_N_s * min(min(past_s, AHEAD_S), setpoint.preview_s)
            if trust > 0.0:
                force_N += trust * (forecast.forces_N(past_s, [0.0])[0] - force_N)
        require_finite("preview_N", force_N)
        ahead_N.append(force_N)
    return ahead_N
