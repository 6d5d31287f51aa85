"""The force asked of the device, now and ahead, from the publisher's setpoint, with the reason for every difference.

now       what the setpoint asks for at the handle's place and way, within what the scene allows and the device gives
ahead     a wall's forces as the handle moves, or a preview; else the setpoints' slope, and a forecast as far as trusted
path      where forces ahead are known: those of the gap's path that misses them least; before a wall at most EARLY_N
          over the most that is felt there
blend     from one wall to another or to none: at the scene's release rate, besides what the handle's motion changes;
          where the scene has a decay, from any force or wall that gives way while the hand pushes on: at DECAY of it
decay     without a setpoint, or with one that is too old: to the device's least force at the scene's release rate
passing   to a publisher's forces at the release rate: from another publisher's, or from a force that followed none
          (before the first setpoint, while the gap was open or held, after a silence)
"""

import math
from typing import Final, final

from tormagd.control.aim.portrait import Portrait
from tormagd.control.ask.forecast import HORIZON_S, MAX_STEP_S, Forecast
from tormagd.control.ask.path import PATH_S, SPEEDING_UP_S, TIMES_S, Path
from tormagd.control.believe.strength import DeviceFit
from tormagd.control.interpolation import low_pass
from tormagd.control.records import AT_REST, Ask, GapSpeeds, TimedSetpoint, Travel, Wall
from tormagd.control.safety.codes import Limit
from tormagd.element.model.features import LARGEST, require_number
from tormagd.element.model.force_curve import within
from tormagd.element.physics.errors import DomainError
from tormagd.scenes.scene import EVERY_TERM, Force, Terms

# compiled, a constant of this module is a plain float
_LARGEST: Final[float] = LARGEST
SLOPE_FILTER_S: Final = 0.003
AHEAD_S: Final = 0.05
"Setpoints are carried on along their slope, or past their preview's end, by no more than this."
MIN_TIMES: Final = 9
"At least this many of TIMES_S are looked at, however short a preview is."
_FORECAST_S: Final = TIMES_S[:MIN_TIMES]
OUTRUN_N: Final = 0.02
"The limit RATE acts where the carriages make the path miss what is known ahead by more."

EARLY_N: Final = 0.08
"The gap closes before a wall by this much more than is felt there: 0.1 N with what is not known of a device."

DECAY: Final = 0.25
"A force that gives way falls more slowly than a gap opens, so that the hand can stop."

Bounds = tuple[float, float]


@final
class Governor:
    """The stage that turns setpoints, of one publisher after another, into the forces to render."""

    time_s: float
    asked_N: float
    above_N: float
    "`asked_N` less the device's least force, as that was known then."
    stamp_s: float
    "-inf where the force follows no setpoint."
    slope_N_s: float
    last_N: float
    "The newest setpoint's force, within what the scene allows."
    holder: int
    "Number of the publisher whose setpoint was followed last."
    is_passing: bool
    "Whether the force is on the ramp to the forces of its holder."
    sent_mm: float | None
    "The portrait's gap that the carriages were sent to; None where nothing is known ahead."
    from_mm: float
    "The portrait's gap that the newest plan asked for."
    expected_N: float | None
    "What the lagging gap should give by now on its path; None where it follows no path."
    law_N: float | None
    "The force asked at the place `law_mm` by a wall, or on the ramp from one."
    law_mm: float
    blend_N: float
    "What is left of the ramp from one wall to another, or to none."
    was_pushing: bool

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
        self._decay_N_s: Final = DECAY * force.release_N_s if force.breakthrough == "decay" else 0.0
        self.forecast = Forecast()
        self.begin(now_s)

    def begin(self, now_s: float) -> None:
        """Forget all setpoints, and begin at `now_s` with the gap open and no publisher."""
        self.time_s, self.asked_N, self.above_N = now_s, self._portrait.min_N, 0.0
        self.holder, self.is_passing = 0, False
        self._forget()

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
        lowest_N = max(device.force_N(self._portrait.min_N), 0.0)
        dt_s = max(now_s - self.time_s, 0.0)
        self.time_s = now_s
        if held_N is not None:
            self.asked_N, self.above_N, self.is_passing = held_N, max(held_N - lowest_N, 0.0), True
        if setpoint is None:
            return self._decay(dt_s, lowest_N, None, (Limit.NO_SETPOINT,))
        age_s = now_s - setpoint.stamp_s
        _require_numbers(setpoint, age_s)
        if age_s > setpoint.valid_for_s:
            return self._decay(dt_s, lowest_N, age_s, (Limit.STALE, *setpoint.limits))
        soon_s = max(age_s, 0.0)
        highest_N = max(device.force_N(self._portrait.max_N), 0.0)
        # slope and forecast are of what is asked, because the device's least force is learned and varies
        asked_N = setpoint.asked_N(travel)
        allowed_N = within(asked_N, self._allowed)
        blended_N = self._blended(setpoint, travel, allowed_N, dt_s)
        force_N, limits = self._within_reach(asked_N, blended_N, lowest_N, highest_N)
        limits = (*limits, *setpoint.limits)
        heard_N = within(setpoint.force_N, self._allowed)
        self._note_setpoint(setpoint, heard_N, force_N, device)
        given = lowest_N, highest_N
        bounds = within(self._allowed[0], given), within(self._allowed[1], given)
        foresight = 1.0
        wall = setpoint.wall
        if not travel.is_pushing and (wall is not None or setpoint.withdraw_N is not None):
            self._feed_forecast(setpoint.stamp_s, heard_N, soon_s)
            self.sent_mm, self.expected_N = None, None
            path_N = [force_N] * len(PATH_S)
            if held_N is None and force_N < self.asked_N:
                self.is_passing = False  # a hand that draws back is let go at once, off any ramp
        elif wall is not None:
            self._feed_forecast(setpoint.stamp_s, heard_N, soon_s)
            path_N = self._path_against(wall, travel, dt_s, force_N, bounds, device, lag_s)
        elif setpoint.preview_N:
            path_N = self._path_of_preview(setpoint, soon_s, dt_s, force_N, bounds, device, lag_s)
        else:
            foresight = self._feed_forecast(setpoint.stamp_s, heard_N, soon_s)
            path_N = self._path_continued(soon_s, dt_s, force_N, foresight, bounds, device, lag_s)
        if self.blend_N != 0.0 and wall is None:
            path_N = [within(each_N + self.blend_N, bounds) for each_N in path_N]
        governed_N = force_N if self.expected_N is None else within(self.expected_N, bounds)
        if self.blend_N != 0.0 or abs(governed_N - force_N) > OUTRUN_N:
            limits = (*limits, Limit.RATE)
        step_N = self._release_N_s * dt_s if held_N is None else 0.0
        self.is_passing = self.is_passing and abs(path_N[0] - self.asked_N) > step_N
        if self.is_passing:
            governed_N = self.asked_N + math.copysign(step_N, path_N[0] - self.asked_N)
            path_N, self.sent_mm, self.expected_N = [governed_N] * len(PATH_S), None, None
            limits, foresight = (*limits, Limit.TAKEOVER), 0.0
        self.asked_N, self.above_N = path_N[0], max(path_N[0] - lowest_N, 0.0)
        if self.sent_mm is not None:
            self.from_mm = self._path.gap_mm(self.asked_N, device)
        return Ask(governed_N, path_N, age_s, limits, foresight, is_meant=True, asked_N=asked_N)

    def foresee(self) -> bool:
        return self._has_forecast and self.forecast.foresee(self.slope_N_s)

    def _note_setpoint(self, setpoint: TimedSetpoint, allowed_N: float, force_N: float, device: DeviceFit) -> None:
        spacing_s = setpoint.stamp_s - self.stamp_s
        if setpoint.holder != self.holder:  # another publisher's forces say nothing about this one's
            self.holder, self.is_passing, self.slope_N_s = setpoint.holder, True, 0.0
            self.forecast.forget()
        elif spacing_s > MAX_STEP_S or not self._has_forecast or setpoint.wall is not None:
            self.slope_N_s = 0.0
        elif spacing_s > 0.0:
            slope_N_mm = device.scale * self._portrait.slope_at_N_mm(device.model_N(force_N))
            most_N_s = (-self._speeds.opening_mm_s * slope_N_mm, self._speeds.sure_mm_s * slope_N_mm)
            slope_N_s = within((allowed_N - self.last_N) / spacing_s, most_N_s)
            self.slope_N_s = low_pass(self.slope_N_s, slope_N_s, spacing_s, SLOPE_FILTER_S)
        self.stamp_s, self.last_N = setpoint.stamp_s, allowed_N

    def _blended(self, setpoint: TimedSetpoint, travel: Travel, allowed_N: float, dt_s: float) -> float:
        """Return `allowed_N`, or a force on the ramp to it after the wall was replaced or removed, or gave way."""
        wall, place_mm = setpoint.wall, travel.place_mm
        before_N, is_giving_way = self.law_N, self._decay_N_s > 0.0 and wall is None
        if before_N is None and (wall is not None or is_giving_way) and self.stamp_s != -math.inf and self.was_pushing:
            before_N = self.last_N
        blended_N = allowed_N
        # a new holder has a ramp of its own, and a hand that draws back is let go at once
        if before_N is not None and travel.is_pushing and setpoint.holder == self.holder:
            moved_N = 0.0 if wall is None else wall.stiffness_N_mm * abs(place_mm - self.law_mm)
            most_N = (self._decay_N_s if is_giving_way else self._release_N_s) * dt_s + moved_N
            blended_N = within(allowed_N, (before_N - most_N, math.inf if is_giving_way else before_N + most_N))
        self.blend_N = blended_N - allowed_N
        is_over = wall is None and self.blend_N == 0.0
        self.law_N = None if is_over or not travel.is_pushing else blended_N
        self.law_mm, self.was_pushing = place_mm, travel.is_pushing
        return blended_N

    def _path_against(
        self,
        wall: Wall,
        travel: Travel,
        dt_s: float,
        force_N: float,
        bounds: Bounds,
        device: DeviceFit,
        lag_s: float,
    ) -> list[float]:
        """Return the forces at PATH_S for a handle that pushes on at its present rate."""
        place_mm, rate_mm_s, added_N = travel.place_mm, travel.rate_mm_s, self.blend_N
        begins_s = lag_s + SPEEDING_UP_S
        wanted_N = [
            within(within(wall.force_N(place_mm + rate_mm_s * (begins_s + after_s)), self._allowed) + added_N, bounds)
            for after_s in TIMES_S
        ]
        over_N = within(within(wall.friction_N, self._allowed) + added_N, bounds) - wall.friction_N + EARLY_N
        most_N: list[Bounds] = []
        for after_s in PATH_S:
            now_N = wall.most_N(place_mm + rate_mm_s * after_s) + over_N
            most_N.append((now_N, wall.most_N(place_mm + rate_mm_s * (begins_s + after_s)) + over_N))
        return self._best_path(wanted_N, dt_s, force_N, bounds, device, lag_s, most_N)

    def _feed_forecast(self, stamp_s: float, allowed_N: float, soon_s: float) -> float:
        """Give the forecast one setpoint, and return how far it is trusted, 0..1."""
        if not self._has_forecast:
            return 0.0
        self.forecast.update(stamp_s, allowed_N)
        # a publisher that has fallen silent is not believed to go on as it did
        return self.forecast.trust if soon_s <= MAX_STEP_S else 0.0

    def _path_of_preview(
        self,
        setpoint: TimedSetpoint,
        soon_s: float,
        dt_s: float,
        force_N: float,
        bounds: Bounds,
        device: DeviceFit,
        lag_s: float,
    ) -> list[float]:
        if self._has_forecast and setpoint.preview_s < TIMES_S[-1]:
            # what comes after the preview is foreseen from its end
            self.slope_N_s = setpoint.preview_slope_N_s
            last_N = within(setpoint.preview_N[-1], self._allowed)
            self.forecast.update(setpoint.stamp_s + setpoint.preview_s, last_N)
        else:
            self.forecast.forget()
        wanted_N = _wanted_N(setpoint, soon_s + lag_s, bounds, self.forecast)
        return self._best_path(wanted_N, dt_s, force_N, bounds, device, lag_s)

    def _best_path(
        self,
        wanted_N: list[float],
        dt_s: float,
        force_N: float,
        bounds: Bounds,
        device: DeviceFit,
        lag_s: float,
        most_N: list[Bounds] | None = None,
    ) -> list[float]:
        """Return the forces at PATH_S on the gap's best path for `wanted_N` at TIMES_S."""
        from_mm, sent_mm = self._left_from(force_N, device)
        path_N, self.sent_mm = self._path.pursue(from_mm, sent_mm, dt_s, wanted_N, device, lag_s, most_N)
        # the path sets out earlier by as much as the carriages come later
        expected_N = force_N if self.is_passing else self.expected_N
        if expected_N is None:
            expected_N = self.asked_N
        if dt_s > 0.0:
            expected_N += dt_s / (lag_s + dt_s) * (path_N[0] - expected_N)
        self.expected_N = expected_N
        return [within(each_N, bounds) for each_N in path_N]

    def _path_continued(
        self,
        soon_s: float,
        dt_s: float,
        force_N: float,
        foresight: float,
        bounds: Bounds,
        device: DeviceFit,
        lag_s: float,
    ) -> list[float]:
        """Return the forces at PATH_S along the setpoints' slope and the forecast."""
        begins_s = soon_s + foresight * lag_s
        times_s = _FORECAST_S if foresight > 0.0 else PATH_S
        slope_N_s = self.slope_N_s
        path_N = [self.last_N + slope_N_s * min(begins_s + after_s, AHEAD_S) for after_s in times_s]
        if foresight > 0.0:
            for place, forecast_N in enumerate(self.forecast.forces_N(begins_s, times_s)):
                path_N[place] += foresight * (forecast_N - path_N[place])
        path_N = [within(each_N, bounds) for each_N in path_N]
        from_mm, sent_mm = self._left_from(force_N, device)
        self.sent_mm, self.expected_N = None, None
        if foresight > 0.0 and not self.is_passing and self._path.is_near(sent_mm, path_N[-1], device):
            pursued_N, self.sent_mm = self._path.pursue(from_mm, sent_mm, dt_s, path_N, device, lag_s)
            for place, each_N in enumerate(pursued_N):
                path_N[place] += foresight * (within(each_N, bounds) - path_N[place])
        return path_N[: len(PATH_S)]

    def _left_from(self, force_N: float, device: DeviceFit) -> tuple[float, float]:
        """Return two of the portrait's gaps: the last plan's, and where the carriages were sent."""
        # a ramp leads to what is asked, whatever the gap can make of it
        if self.is_passing or self.sent_mm is None:
            gap_mm = self._path.gap_mm(force_N if self.is_passing else self.asked_N, device)
            return gap_mm, gap_mm
        return self.from_mm, self.sent_mm

    def _within_reach(
        self, asked_N: float, allowed_N: float, lowest_N: float, highest_N: float
    ) -> tuple[float, tuple[Limit, ...]]:
        limits: tuple[Limit, ...] = () if self._least_N <= asked_N <= self._allowed[1] else (Limit.RANGE,)
        if asked_N < self._allowed[0] and self._least_N < self._allowed[0]:
            limits = (*limits, Limit.STANDBY)
        if allowed_N < lowest_N:
            return lowest_N, (*limits, Limit.F_MIN)
        if allowed_N > highest_N:
            return highest_N, (*limits, Limit.F_MAX)
        return allowed_N, limits

    def _decay(self, dt_s: float, lowest_N: float, age_s: float | None, limits: tuple[Limit, ...]) -> Ask:
        """Forget the setpoint, and return a force that falls to `lowest_N` at the release rate."""
        # where a device turns out weaker, the force above its least does not grow
        above_N = max(min(self.above_N, self.asked_N - lowest_N) - self._release_N_s * dt_s, 0.0)
        self.asked_N, self.above_N, self.is_passing = lowest_N + above_N, above_N, True
        self._forget()
        return Ask(self.asked_N, [self.asked_N] * len(PATH_S), age_s, limits)

    def _forget(self) -> None:
        self.stamp_s, self.slope_N_s, self.last_N = -math.inf, 0.0, 0.0
        self.sent_mm, self.from_mm, self.expected_N = None, 0.0, None
        self.law_N, self.law_mm, self.blend_N, self.was_pushing = None, 0.0, 0.0, True
        self.forecast.forget()


def _require_numbers(setpoint: TimedSetpoint, age_s: float) -> None:
    """Raise DomainError, naming the field, unless all numbers are finite and within LARGEST."""
    if not (
        -_LARGEST <= age_s <= _LARGEST
        and -_LARGEST <= setpoint.force_N <= _LARGEST
        and -_LARGEST <= setpoint.valid_for_s <= _LARGEST
        and -_LARGEST <= (setpoint.displacement_mm or 0.0) <= _LARGEST
        and -_LARGEST <= (setpoint.rate_mm_s or 0.0) <= _LARGEST
        and -_LARGEST <= (setpoint.withdraw_N or 0.0) <= _LARGEST
    ):
        for name in ("force_N", "stamp_s", "valid_for_s", "displacement_mm", "rate_mm_s", "withdraw_N"):
            require_number(name, getattr(setpoint, name) or 0.0)
        require_number("age_s", age_s)
    if setpoint.wall is not None:
        for name in ("place_mm", "stiffness_N_mm", "friction_N", "place_sd_mm", "stiffness_share"):
            require_number(name, getattr(setpoint.wall, name))
    if not setpoint.preview_N:
        return
    if not 0.0 < setpoint.preview_dt_s <= _LARGEST:
        raise DomainError("preview_dt_s", setpoint.preview_dt_s, "above 0 s")
    # one sum finds NaN and infinity anywhere
    if not -_LARGEST <= sum(setpoint.preview_N) <= _LARGEST:
        for force_N in setpoint.preview_N:
            require_number("preview_N", force_N)


def _wanted_N(setpoint: TimedSetpoint, begins_s: float, bounds: Bounds, forecast: Forecast) -> list[float]:
    """Return the forces of a preview at TIMES_S from `begins_s` after its stamp."""
    forces_N, spacing_s = setpoint.preview_N, setpoint.preview_dt_s
    last, last_N = len(forces_N), forces_N[-1]
    ends_s, mean_N_s, trust = setpoint.preview_s, setpoint.preview_slope_N_s, forecast.trust
    known_s = ends_s + HORIZON_S if trust > 0.0 else ends_s
    wanted_N: list[float] = []
    for after_s in TIMES_S:
        at_s = begins_s + after_s
        if at_s >= ends_s:
            if len(wanted_N) >= MIN_TIMES and at_s >= known_s:
                break
            force_N = last_N + mean_N_s * min(at_s - ends_s, AHEAD_S, ends_s)
            if trust > 0.0:
                force_N += trust * (forecast.forces_N(at_s - ends_s, [0.0])[0] - force_N)
        else:
            place = min(int(at_s / spacing_s), last - 1)
            before_N = forces_N[place - 1] if place else setpoint.force_N
            force_N = (forces_N[place] - before_N) / spacing_s * (at_s - spacing_s * place) + before_N
        if not -_LARGEST <= force_N <= _LARGEST:
            require_number("preview_N", force_N)
        wanted_N.append(within(force_N, bounds))
    return wanted_N
