"""From the publisher's setpoint to the force that will be asked of the device, with the reason for every difference."""

import math
from itertools import pairwise
from typing import Final, final

from firmware_protocol.value import Value
from tormagd.control.device_fit import DeviceFit
from tormagd.control.periodicity import (
    HORIZON_S,
    LONGEST_STEP_S,
    NOTHING_LEARNED,
    Periodicity,
    forecast_N,
    foreseen,
    observe,
)
from tormagd.control.portrait import Portrait
from tormagd.control.pursuit import nearest_way_mm
from tormagd.safety.codes import Limit
from tormagd.scenes.scene import EVERY_TERM, Force, Terms

SLOPE_FILTER_S: Final = 0.003
AHEAD_S: Final = 0.05
"Setpoints are carried forward along their slope, or past the end of their preview, by no more than this."
PATH_S: Final = [0.0, 0.005, 0.01, 0.015, 0.02, 0.025, 0.03]
"The times, from the moment that is planned for, at which a plan looks at the force to come."
PATH_STEP_S: Final = 0.005
WAY_S: Final = [*PATH_S, 0.04, 0.06, 0.09, 0.13, 0.18, 0.25, 0.33, 0.4]
"""The times at which a preview is looked at, as far as it goes: the sparser, the less they matter to the gap's next
moves. By the last the gap crosses a third of its stroke, and what comes later can wait."""
LEAST_WAY: Final = 9
"So many of them are looked at even where a preview ends before."
_FORESEEN_S: Final = WAY_S[:LEAST_WAY]
"The times at which a forecast is looked at."
NEAR_S: Final = 0.18
"""What the gap gets to in this time is near. Chosen on sample 1: with a third of it a finger's pulse (AAC364) is missed
by 39 instead of 35 mN, and without an end palpation, which nobody foresees, by 521 instead of 510."""
WAY_LASTS_S: Final = [
    0.5 * (after_s - before_s) for before_s, after_s in zip([0.0, *WAY_S[:-1]], [*WAY_S[1:], WAY_S[-1]], strict=True)
]
"The time that each of them stands for: from half way to the one before to half way to the next."
STARTING_S: Final = 0.025
"""Time constant with which the gap comes to another speed where its carriages are not late. Chosen on sample 1 with its
inertia, 1.7 and 2.5 times of it: a finger's pulse, which is too steep (AAC249), is missed by 10.5, 10.1 and 10.0 mN
with 20, 25 and 30 ms, palpation by 318 each."""
_CHANGES_PER_S: Final = [1.0 / (after_s - before_s) for before_s, after_s in pairwise(WAY_S)]
"From how much the gap wanted changes to the next point to its speed."
FLATTEST_N_MM: Final = 1e-3
"A force that hardly depends on the gap counts as if it did by this much."
OUTRUN_N: Final = 0.02
"Of what is known ahead no more is missed without a word: further from it, the carriages are too slow, which is RATE."


@final
class TimedSetpoint(Value):
    """The newest valid setpoint. `stamp_s` is when the publisher meant it, on the clock of `now_s`; `preview_N` are the
    forces that follow it, `preview_dt_s` apart. `holder` numbers the publishers that have held the brake, one after the
    other; with `is_contested` somebody else sends setpoints too.
    """

    def __init__(
        self,
        force_N: float,
        stamp_s: float,
        valid_for_s: float,
        displacement_mm: float | None = None,
        rate_mm_s: float | None = None,
        preview_N: tuple[float, ...] = (),
        preview_dt_s: float = 0.0,
        holder: int = 0,
        is_contested: bool = False,
    ) -> None:
        self.force_N: Final = force_N
        self.stamp_s: Final = stamp_s
        self.valid_for_s: Final = valid_for_s
        self.displacement_mm: Final = displacement_mm
        self.rate_mm_s: Final = rate_mm_s
        self.preview_N: Final = preview_N
        self.preview_dt_s: Final = preview_dt_s
        self.holder: Final = holder
        self.is_contested: Final = is_contested

    @property
    def preview_s(self) -> float:
        """How long after its stamp the preview ends."""
        return self.preview_dt_s * len(self.preview_N)

    @property
    def preview_slope_N_s(self) -> float:
        """The mean slope of a preview that is there."""
        return (self.preview_N[-1] - self.force_N) / self.preview_s


@final
class GovernorState(Value):
    """What the governor remembers between plans: `asked_N` is the force that the last one asked of the device, and
    `above_N` how far that was above the least that the device then seemed to make; where it was known or foreseen what
    comes the carriages were sent to that of `drive_N`; `expected_N` is the force by now on the way of a preview;
    `holder` whose setpoints it followed; while `is_passing` the force is on its way to those of a new holder."""

    def __init__(
        self,
        time_s: float,
        asked_N: float,
        stamp_s: float = -math.inf,
        slope_N_s: float = 0.0,
        last_N: float = 0.0,
        periodicity: Periodicity = NOTHING_LEARNED,
        holder: int = 0,
        is_passing: bool = False,
        above_N: float = math.inf,
        drive_N: float | None = None,
        expected_N: float | None = None,
    ) -> None:
        self.time_s: Final = time_s
        self.asked_N: Final = asked_N
        self.stamp_s: Final = stamp_s
        self.slope_N_s: Final = slope_N_s
        self.last_N: Final = last_N
        self.periodicity: Final = periodicity
        self.holder: Final = holder
        self.is_passing: Final = is_passing
        self.above_N: Final = above_N
        self.drive_N: Final = drive_N
        self.expected_N: Final = expected_N


@final
class Governed(Value):
    """The force to render now, what it will be PATH_S after the moment that is planned for, and what holds it back.

    `foresight`, 0..1, is how well what comes is known: 1 from a preview, less where the force repeats itself, 0 where
    it is extrapolated.
    """

    def __init__(
        self,
        force_N: float,
        path_N: list[float],
        age_s: float | None,
        limits: tuple[Limit, ...],
        foresight: float = 0.0,
    ) -> None:
        self.force_N: Final = force_N
        self.path_N: Final = path_N
        self.age_s: Final = age_s
        self.limits: Final = limits
        self.foresight: Final = foresight


@final
class Governor:
    """The constants of governing: what the scene allows, and the fastest that the gap may be driven."""

    def __init__(self, portrait: Portrait, scene: Force, gap_speed_mm_s: float, terms: Terms = EVERY_TERM) -> None:
        self._has_slope: Final = terms.slope
        self._has_forecast: Final = terms.forecast
        self._has_preview: Final = terms.preview
        self._portrait: Final = portrait
        self._least_N: Final = scene.least_N
        self._most_N: Final = scene.most_N
        self._release_N_s: Final = scene.release_N_s
        self._gap_speed_mm_s: Final = gap_speed_mm_s

    def govern(
        self, state: GovernorState, now_s: float, setpoint: TimedSetpoint | None, device: DeviceFit, lag_s: float
    ) -> tuple[GovernorState, Governed]:
        """One decision, for now and, where what comes is known, for up to `lag_s` later: an extrapolation that far is a
        guess. The force is within what the scene allows and `device`, as far as it has shown itself, gives; with a
        preview it is what the gap can best make of it. A missing or stale setpoint decays to F_min along the scene's
        `release_N_s`, and from one holder's force to the next one's it goes as fast: never a jump, never a force held
        for ever.
        """
        portrait = self._portrait
        lowest = max(device.force_N(portrait.least_N), 0.0)
        if setpoint is None:
            return self._ramp(state, now_s, lowest, None, Limit.NO_SETPOINT)
        age = now_s - setpoint.stamp_s
        if age > setpoint.valid_for_s:
            return self._ramp(state, now_s, lowest, age, Limit.STALE, setpoint.is_contested)
        highest = max(device.force_N(portrait.most_N), 0.0)
        # what comes is told from what is asked: the least that the device makes is learned, and so it varies
        asked_N = min(max(setpoint.force_N, self._least_N), self._most_N)
        force, reasons = self._within_range(setpoint.force_N, asked_N, lowest, highest)
        if setpoint.is_contested:
            reasons = (*reasons, Limit.OTHER_SOURCE)
        is_new_holder = setpoint.holder != state.holder
        slope, learned = state.slope_N_s, state.periodicity
        spacing = setpoint.stamp_s - state.stamp_s
        if is_new_holder:  # another publisher's forces say nothing of this one's
            slope, learned = 0.0, NOTHING_LEARNED
        elif spacing > LONGEST_STEP_S or not self._has_slope:
            slope = 0.0
        elif spacing > 0.0:
            renderable = device.scale * portrait.force_rate_N_s(device.model_N(force), self._gap_speed_mm_s)
            between = min(max((asked_N - state.last_N) / spacing, -renderable), renderable)
            slope += spacing / (SLOPE_FILTER_S + spacing) * (between - slope)
        least, most = min(max(self._least_N, lowest), highest), min(max(self._most_N, lowest), highest)
        soon_s = max(age, 0.0)
        is_passing = is_new_holder or state.is_passing
        drive_N: float | None = None
        expected_N: float | None = None
        # what it passes to is what is asked, not what the gap can make of it
        asks_N = force if is_passing else state.asked_N
        sent_N = asks_N if is_passing or state.drive_N is None else state.drive_N
        elapsed_s = max(now_s - state.time_s, 0.0)
        if setpoint.preview_N and self._has_preview:
            periodicity, foresight = NOTHING_LEARNED, 1.0
            if self._has_forecast and setpoint.preview_s < WAY_S[-1]:
                # what comes after its end is foreseen from there
                slope = setpoint.preview_slope_N_s
                last_N = min(max(setpoint.preview_N[-1], self._least_N), self._most_N)
                periodicity = observe(learned, setpoint.stamp_s + setpoint.preview_s, last_N)
            wanted_N = _previewed_N(setpoint, soon_s + lag_s, least, most, periodicity)
            path, drive_N = self._pursued_N(asks_N, sent_N, elapsed_s, wanted_N, device, lag_s)
            # the path sets out sooner by as much as the carriages come later
            expected_N = asks_N if is_passing or state.expected_N is None else state.expected_N
            if elapsed_s > 0.0:
                expected_N += elapsed_s / (lag_s + elapsed_s) * (path[0] - expected_N)
        else:
            periodicity = observe(learned, setpoint.stamp_s, asked_N) if self._has_forecast else NOTHING_LEARNED
            # one that has fallen silent for longer than a stream may is not believed to go on as it did
            foresight = periodicity.trust if age <= LONGEST_STEP_S else 0.0
            path = _expected_N(asked_N, slope, periodicity, foresight, soon_s + foresight * lag_s)
        within = [min(max(force_N, least), most) for force_N in path]
        governed = force
        if expected_N is not None:
            governed = min(max(expected_N, least), most)
        elif foresight > 0.0 and not is_passing and self._is_near(sent_N, within[-1], device):
            pursued, drive_N = self._pursued_N(asks_N, sent_N, elapsed_s, within, device, lag_s)
            for place, force_N in enumerate(pursued):
                within[place] += foresight * (min(max(force_N, least), most) - within[place])
        within = within[: len(PATH_S)]
        if abs(governed - force) > OUTRUN_N:
            reasons = (*reasons, Limit.RATE)
        if is_passing:
            step_N = self._release_N_s * elapsed_s
            left_N = within[0] - state.asked_N
            is_passing = abs(left_N) > step_N
            if is_passing:
                governed = state.asked_N + math.copysign(step_N, left_N)
                within, drive_N, expected_N = [governed] * len(PATH_S), None, None
                reasons, foresight = (*reasons, Limit.TAKEOVER), 0.0
        rendered = GovernorState(
            now_s,
            within[0],
            setpoint.stamp_s,
            slope,
            asked_N,
            periodicity,
            setpoint.holder,
            is_passing,
            max(within[0] - lowest, 0.0),
            drive_N,
            expected_N,
        )
        return rendered, Governed(governed, within, age, reasons, foresight)

    def _is_near(self, sent_N: float, wanted_N: float, device: DeviceFit) -> bool:
        """Whether the gap gets there soon. Where it does not, nothing is gained by what comes, and it goes at once."""
        portrait = self._portrait
        away_mm = portrait.gap_mm_at(device.model_N(sent_N)) - portrait.gap_mm_at(device.model_N(wanted_N))
        return abs(away_mm) < NEAR_S * self._gap_speed_mm_s

    def _pursued_N(
        self, asks_N: float, sent_N: float, elapsed_s: float, wanted_N: list[float], device: DeviceFit, lag_s: float
    ) -> tuple[list[float], float]:
        """The forces at PATH_S on the way of the gap that misses least of those wanted (n), at WAY_S, and the one that
        the carriages are sent to. `elapsed_s` ago those were `asks_N` and `sent_N`.

        A gap comes to another speed only gradually: it is taken to follow its carriages with a time constant, which is
        STARTING_S and by how much a device is later, `lag_s`. So those are wanted ahead of it by what its speed takes
        in that time. As a slope does not reach so far, the forces wanted of a late device are later ones, too.
        """
        portrait = self._portrait
        late_s = STARTING_S + lag_s
        wanted_mm: list[float] = []
        weights: list[float] = []
        for place, force_N in enumerate(wanted_N):
            gap_mm, slope_N_mm = portrait.gap_and_slope_at(device.model_N(force_N))
            slope_N_mm = max(slope_N_mm, FLATTEST_N_MM)
            if place:
                wanted_mm[place - 1] += late_s * _CHANGES_PER_S[place - 1] * (gap_mm - wanted_mm[place - 1])
            wanted_mm.append(gap_mm)
            weights.append(WAY_LASTS_S[place] * slope_N_mm * slope_N_mm)
        sent_mm, gap_mm = portrait.gap_mm_at(device.model_N(sent_N)), portrait.gap_mm_at(device.model_N(asks_N))
        way_mm = nearest_way_mm(sent_mm, elapsed_s, WAY_S, wanted_mm, weights, self._gap_speed_mm_s, len(PATH_S))
        forces_N: list[float] = []
        left, left_in_a_step = math.exp(-elapsed_s / late_s), math.exp(-PATH_STEP_S / late_s)
        for drive_mm in way_mm:
            gap_mm = drive_mm + (gap_mm - drive_mm) * left
            forces_N.append(device.force_N(portrait.force_N_at(gap_mm)))
            left = left_in_a_step
        return forces_N, device.force_N(portrait.force_N_at(way_mm[0]))

    def foresee(self, state: GovernorState) -> GovernorState:
        """The state with a forecast of what comes, where one is due: for the time between decisions."""
        if not self._has_forecast:
            return state
        periodicity = foreseen(state.periodicity, state.slope_N_s)
        if periodicity is state.periodicity:
            return state
        return GovernorState(
            state.time_s,
            state.asked_N,
            state.stamp_s,
            state.slope_N_s,
            state.last_N,
            periodicity,
            state.holder,
            state.is_passing,
            state.above_N,
            state.drive_N,
            state.expected_N,
        )

    def _ramp(
        self,
        state: GovernorState,
        now_s: float,
        lowest_N: float,
        age_s: float | None,
        reason: Limit,
        is_contested: bool = False,
    ) -> tuple[GovernorState, Governed]:
        elapsed = max(0.0, now_s - state.time_s)
        # a device that is found to make less than was believed is not asked for more above its least than it was
        above_N = max(min(state.above_N, state.asked_N - lowest_N) - self._release_N_s * elapsed, 0.0)
        force = lowest_N + above_N
        reasons: tuple[Limit, ...] = (reason, Limit.OTHER_SOURCE) if is_contested else (reason,)
        decayed = GovernorState(now_s, force, holder=state.holder, is_passing=state.is_passing, above_N=above_N)
        return decayed, Governed(force, [force] * len(PATH_S), age_s, reasons)

    def _within_range(
        self, setpoint_N: float, allowed_N: float, lowest_N: float, highest_N: float
    ) -> tuple[float, tuple[Limit, ...]]:
        """Of the setpoint, what the scene allows of it and the device gives: never over the scene's greatest, unless
        the open gap itself makes more."""
        reasons: tuple[Limit, ...] = () if allowed_N == setpoint_N else (Limit.RANGE,)
        if allowed_N < lowest_N:
            return lowest_N, (*reasons, Limit.F_MIN)
        if allowed_N > highest_N:
            return highest_N, (*reasons, Limit.F_MAX)
        return allowed_N, reasons


def _expected_N(
    asked_N: float, slope_N_s: float, periodicity: Periodicity, foresight: float, begins_s: float
) -> list[float]:
    """The forces at PATH_S, or at _FORESEEN_S where some of what comes is foreseen, from `begins_s` after the newest
    setpoint on: those along its slope, with so large a share of the forecast."""
    times_s = _FORESEEN_S if foresight > 0.0 else PATH_S
    forces_N = [asked_N + slope_N_s * min(begins_s + after_s, AHEAD_S) for after_s in times_s]
    if foresight > 0.0:
        for place, forecast in enumerate(forecast_N(periodicity, begins_s, times_s)):
            forces_N[place] += foresight * (forecast - forces_N[place])
    return forces_N


def _previewed_N(
    setpoint: TimedSetpoint, begins_s: float, least_N: float, most_N: float, periodicity: Periodicity
) -> list[float]:
    """The forces at WAY_S from `begins_s`, 0 or more, after the setpoint's stamp on, within what is allowed: as many as
    the preview knows of, and at least LEAST_WAY. Past its end a short preview goes on as `periodicity` foresees it, as
    far as that is trusted, or else as it has run so far; a long one has no end in sight."""
    forces_N, spacing_s = setpoint.preview_N, setpoint.preview_dt_s
    last, last_N = len(forces_N), forces_N[-1]
    ends_s, mean_N_s, trust = setpoint.preview_s, setpoint.preview_slope_N_s, periodicity.trust
    known_s = ends_s + HORIZON_S if trust > 0.0 else ends_s
    wanted_N: list[float] = []
    for after_s in WAY_S:
        at_s = begins_s + after_s
        if at_s >= ends_s:
            if len(wanted_N) >= LEAST_WAY and at_s >= known_s:
                break
            force_N = last_N + mean_N_s * min(at_s - ends_s, AHEAD_S, ends_s)
            if trust > 0.0:
                force_N += trust * (forecast_N(periodicity, at_s - ends_s, [0.0])[0] - force_N)
        else:
            place = min(int(at_s / spacing_s), last - 1)
            before_N = forces_N[place - 1] if place else setpoint.force_N
            force_N = (forces_N[place] - before_N) / spacing_s * (at_s - spacing_s * place) + before_N
        wanted_N.append(min(max(force_N, least_N), most_N))
    return wanted_N
