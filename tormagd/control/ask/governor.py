"""The force asked of the device: what is wanted over the next 400 ms, and the corridor around it.

wanted    at TIMES_S: a wall's forces as the handle moves; or a preview, and past its end (without one, past the newest
          setpoint) the slope and, as far as it is trusted, the forecast, until MAX_STEP_S without a new one
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
from tormagd.control.ask.forecast import GRID_S, HORIZON, MAX_STEP_S, Forecast
from tormagd.control.ask.path import (
    FLATTEST_N_MM,
    LASTS_S,
    PATH_S,
    SPEEDING_UP_S,
    TIMES_S,
    nearest_path_mm,
)
from tormagd.control.believe.strength import DeviceFit
from tormagd.control.interpolation import at_step, low_pass
from tormagd.control.records import AT_REST, Ask, GapSpeeds, TimedSetpoint, Travel, Wall
from tormagd.control.safety.codes import Limit
from tormagd.element.model.force_curve import within
from tormagd.scenes.scene import EVERY_TERM, Force, Terms

SLOPE_FILTER_S: Final = 0.003
AHEAD_S: Final = 0.05
"The slope goes on for so long, and for no longer than the preview before it."
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
    target_N: float | None
    "What was asked of a hand that pushed on at `target_mm`."
    target_mm: float = 0.0
    slope_N_s: float
    "How the force goes on after what is known."
    silent_s: float
    "How long no new setpoint has come."
    is_passing: bool
    "Whether the force is on the ramp to the forces of its holder."

    def __init__(
        self, now_s: float, portrait: Portrait, force: Force, speeds: GapSpeeds, terms: Terms = EVERY_TERM
    ) -> None:
        self._has_forecast: Final = terms.forecast
        self._portrait: Final = portrait
        self._speeds: Final = speeds
        self._force: Final = force
        self._allowed: Final = (force.waiting_N, force.most_N)
        self.forecast = Forecast()
        self.begin(now_s)

    def begin(self, now_s: float) -> None:
        """Forget all setpoints, and begin at `now_s` with the gap open and no publisher."""
        self.time_s = now_s
        self._stand_at(self._portrait.min_N, DeviceFit())
        self._forget()
        self.is_passing = False

    def foresee(self) -> bool:
        return self._has_forecast and self.forecast.foresee(self.slope_N_s)

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
            self.is_passing, dt_s = True, 0.0
            self._stand_at(held_N, device)
        age_s: float | None = None
        if setpoint is not None:
            age_s = now_s - setpoint.stamp_s
            setpoint.require_numbers()
            is_new = self.last is None or setpoint.stamp_s != self.last.stamp_s
            self.silent_s = 0.0 if is_new else self.silent_s + dt_s
            if age_s <= setpoint.valid_for_s:
                return self._followed(setpoint, age_s, device, lag_s, travel, dt_s, given, held_N is None)
        # where a device turns out weaker, the gap does not close for it
        left_N = min(self.asked_N, device.force_N(self._portrait.force_N_at(self.from_mm)))
        self._stand_at(max(left_N - self._force.release_N_s * dt_s, given[0]), device)
        self._forget()
        limits = (Limit.NO_SETPOINT,) if setpoint is None else (Limit.STALE, *setpoint.limits)
        return Ask(self.asked_N, [self.asked_N] * len(PATH_S), age_s, limits)

    def _followed(
        self,
        setpoint: TimedSetpoint,
        age_s: float,
        device: DeviceFit,
        lag_s: float,
        travel: Travel,
        dt_s: float,
        given: tuple[float, float],
        is_free: bool,
    ) -> Ask:
        asked_N, step_N = setpoint.asked_N(travel), self._force.release_N_s * dt_s
        allowed_N = within(asked_N, self._allowed)
        lawful_N = self._lawful_N(setpoint, travel, allowed_N, step_N)
        blend_N, force_N = lawful_N - allowed_N, within(lawful_N, given)
        self._learn(setpoint, force_N, device)
        ahead_N, trust = self._ahead_N(setpoint, travel, max(age_s, 0.0), lag_s)
        bounds = within(self._allowed[0], given), within(self._allowed[1], given)
        wanted_N = [within(within(each_N, bounds) + blend_N, bounds) for each_N in ahead_N]
        if self.is_passing:
            trust, is_let_go = 0.0, is_free and setpoint.lets_go(travel) and force_N < self.asked_N
            self.is_passing = not is_let_go and abs(wanted_N[0] - self.asked_N) > step_N
        if self.is_passing:
            force_N = self.asked_N + math.copysign(step_N, wanted_N[0] - self.asked_N)
            wanted_N = [force_N] * len(PATH_S)
        path_N, governed_N = wanted_N[: len(PATH_S)], force_N
        if trust > 0.0:
            path_mm = self._path_mm(setpoint.wall, travel, wanted_N, device, lag_s, dt_s, blend_N, bounds)
            path_N = self._behind_N(path_mm, wanted_N, trust, device, lag_s, dt_s, bounds)
            governed_N = within(self.expected_N, bounds) if setpoint.is_told else force_N
        else:
            self._stand_at(path_N[0], device)
        is_late = blend_N != 0.0 or abs(governed_N - force_N) > OUTRUN_N
        return Ask(governed_N, path_N, age_s, self._limits(setpoint, asked_N, lawful_N, given, is_late), trust, asked_N)

    def _limits(
        self, setpoint: TimedSetpoint, asked_N: float, lawful_N: float, given: tuple[float, float], is_late: bool
    ) -> tuple[Limit, ...]:
        """Return what holds the force that is asked for now."""
        waiting_N, most_N = self._allowed
        return (
            ((Limit.RANGE,) if not self._force.least_N <= asked_N <= most_N else ())
            + ((Limit.STANDBY,) if self._force.least_N < waiting_N > asked_N else ())
            + ((Limit.F_MIN,) if lawful_N < given[0] else ())
            + ((Limit.F_MAX,) if lawful_N > given[1] else ())
            + setpoint.limits
            + ((Limit.RATE,) if is_late else ())
            + ((Limit.TAKEOVER,) if self.is_passing else ())
        )

    def _lawful_N(self, setpoint: TimedSetpoint, travel: Travel, allowed_N: float, step_N: float) -> float:
        """Return what a law's ramp leaves of `allowed_N`."""
        before_N, last, wall, lawful_N = self.target_N, self.last, setpoint.wall, allowed_N
        # a new holder has a ramp of its own
        if travel.is_pushing and before_N is not None and last is not None and setpoint.holder == last.holder:
            rises_N = falls_N = step_N
            if wall is not None:
                rises_N = falls_N = step_N + wall.stiffness_N_mm * abs(travel.place_mm - self.target_mm)
            elif self._force.breakthrough == "decay":
                rises_N, falls_N = ENDLESS, DECAY * step_N
            elif last.wall is None and before_N == within(last.force_N, self._allowed):
                rises_N = falls_N = ENDLESS
            lawful_N = within(allowed_N, (before_N - falls_N, before_N + rises_N))
        self.target_N, self.target_mm = lawful_N if travel.is_pushing else None, travel.place_mm
        return lawful_N

    def _learn(self, setpoint: TimedSetpoint, force_N: float, device: DeviceFit) -> None:
        """Learn how the force goes on after what is known: after a preview, or else after the newest force."""
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
        end_N = setpoint.force_N
        if setpoint.preview_N:
            end_N = setpoint.preview_N[-1]
            self.slope_N_s = (end_N - setpoint.force_N) / setpoint.preview_s
        if setpoint.preview_s >= TIMES_S[-1]:
            self.forecast.forget()
        elif self._has_forecast:
            self.forecast.update(setpoint.stamp_s + setpoint.preview_s, within(end_N, self._allowed))

    def _ahead_N(
        self, setpoint: TimedSetpoint, travel: Travel, soon_s: float, lag_s: float
    ) -> tuple[list[float], float]:
        """Return the forces known ahead at TIMES_S, and the trust in them."""
        wall = setpoint.wall
        if setpoint.lets_go(travel):
            return [setpoint.asked_N(travel)] * len(PATH_S), 0.0
        if wall is not None:
            place_mm = travel.place_mm + travel.rate_mm_s * (lag_s + SPEEDING_UP_S)
            return [wall.force_N(place_mm + travel.rate_mm_s * after_s) for after_s in TIMES_S], 1.0
        # a publisher that has fallen silent is not believed to go on as it did
        foreseen = self.forecast.trust if soon_s <= MAX_STEP_S else 0.0
        if self.silent_s > setpoint.preview_s + MAX_STEP_S:
            self.slope_N_s = 0.0
        trust = 1.0 if setpoint.preview_N else foreseen
        return self.going_on_N(setpoint, soon_s + trust * lag_s, foreseen), trust

    def going_on_N(self, setpoint: TimedSetpoint, begins_s: float, foreseen: float) -> list[float]:
        """Return the forces at TIMES_S from `begins_s` after the stamp: of the preview, and of what comes after it."""
        end_s, forces_N = setpoint.preview_s, [setpoint.force_N, *setpoint.preview_N]
        known_s = end_s + (HORIZON * GRID_S if foreseen > 0.0 else 0.0)
        most_s = min(AHEAD_S, end_s) if setpoint.preview_N else AHEAD_S
        last_N, from_N = within(forces_N[-1], self._allowed), self.forecast.from_N() if foreseen > 0.0 else 0.0
        ahead_N: list[float] = []
        for after_s in TIMES_S:
            at_s = begins_s + after_s
            past_s = at_s - end_s
            if at_s >= known_s and len(ahead_N) >= MIN_TIMES:
                break
            if past_s < 0.0:
                force_N = at_step(at_s / setpoint.preview_dt_s, forces_N)
            else:
                force_N = last_N + self.slope_N_s * min(past_s, most_s)
                if foreseen > 0.0:
                    force_N += foreseen * (self.forecast.force_at_N(past_s, from_N) - force_N)
            ahead_N.append(force_N)
        return ahead_N

    def _path_mm(
        self,
        wall: Wall | None,
        travel: Travel,
        wanted_N: list[float],
        device: DeviceFit,
        lag_s: float,
        dt_s: float,
        blend_N: float,
        bounds: tuple[float, float],
    ) -> list[float]:
        """Return the best path through `wanted_N` for late carriages, not early before a wall."""
        portrait, late_s = self._portrait, SPEEDING_UP_S + lag_s
        # compiled, pairs and ** make objects
        wanted_mm, weights = wanted_N[:], LASTS_S[: len(wanted_N)]
        for place, force_N in enumerate(wanted_N):
            wanted_mm[place], slope_N_mm = portrait.gap_and_slope_at(device.model_N(force_N))
            weights[place] *= math.pow(max(slope_N_mm, FLATTEST_N_MM), 2.0)
        if wall is None:
            for place in range(len(wanted_mm) - 1):
                wanted_mm[place] += (
                    late_s * (wanted_mm[place + 1] - wanted_mm[place]) / (TIMES_S[place + 1] - TIMES_S[place])
                )
        path_mm = nearest_path_mm(self.sent_mm, dt_s, TIMES_S, wanted_mm, weights, self._speeds, len(PATH_S))
        if wall is None:
            return path_mm
        over_N = within(within(wall.friction_N, self._allowed) + blend_N, bounds) - wall.friction_N + EARLY_N
        lead_mm, on_mm = late_s * self._speeds.sure_mm_s, travel.rate_mm_s * late_s
        for place, after_s in enumerate(PATH_S):
            place_mm = travel.place_mm + travel.rate_mm_s * after_s
            now_mm = portrait.gap_for_mm(wall.most_N(place_mm) + over_N, device) - lead_mm
            then_mm = portrait.gap_for_mm(wall.most_N(place_mm + on_mm) + over_N, device)
            # compiled, max() of three makes objects
            path_mm[place] = max(path_mm[place], max(now_mm, then_mm))
        return path_mm

    def _behind_N(
        self,
        path_mm: list[float],
        wanted_N: list[float],
        trust: float,
        device: DeviceFit,
        lag_s: float,
        dt_s: float,
        bounds: tuple[float, float],
    ) -> list[float]:
        """Send the carriages along the path, and return the forces of the gap behind them."""
        portrait, late_s, gap_mm, path_N = self._portrait, SPEEDING_UP_S + lag_s, self.from_mm, []
        left, left_in_a_step = math.exp(-dt_s / late_s), math.exp(-PATH_S[1] / late_s)
        for to_mm, other_N in zip(path_mm, wanted_N):  # noqa: B905 only such a zip is compiled to a plain loop
            gap_mm, left = to_mm + (gap_mm - to_mm) * left, left_in_a_step
            given_N = within(device.force_N(portrait.force_N_at(gap_mm)), bounds)
            path_N.append(trust * given_N + (1.0 - trust) * other_N)
        # the path sets out earlier by as much as the carriages come later
        expected_N = low_pass(self.expected_N, path_N[0], dt_s, lag_s) if dt_s > 0.0 else self.expected_N
        self._stand_at(path_N[0], device)
        # a path may lead past the portrait's ends, where no carriages are sent
        self.expected_N, self.sent_mm = expected_N, within(path_mm[0], (portrait.gap_mm[-1], portrait.gap_mm[0]))
        return path_N

    def _stand_at(self, force_N: float, device: DeviceFit) -> None:
        self.asked_N, self.expected_N = force_N, force_N
        self.from_mm = self.sent_mm = self._portrait.gap_for_mm(force_N, device)

    def _forget(self) -> None:
        self.last, self.target_N, self.slope_N_s, self.silent_s, self.is_passing = None, None, 0.0, 0.0, True
        self.forecast.forget()
