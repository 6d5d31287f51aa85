"""Every term can be left out, which is decided at construction, and then it is not there: not learned, not used."""

import math
from collections.abc import Callable

import msgspec
import pytest

from tormagd.config import Config, Motor
from tormagd.assembly.build import Core, build_core
from tormagd.control.believe.strength import DeviceFit, UNSEEN, observe
from tormagd.control.records import Handle, Measured
from tormagd.control.records import TimedSetpoint
from tormagd.control.believe.carriage_lag import CarriageLag
from tormagd.control.ask.forecast import NOTHING_LEARNED
from tormagd.control.records import Plan
from tormagd.control.plan import PlanState
from tormagd.control.believe.believe import Learned
from tormagd.control.believe.slow_friction import NOTHING_SLOW
from tormagd.hardware.measurement import Measurement
from tormagd.model.displacement import MOBILISED_MM, Turn
from tormagd.safety.codes import Limit
from tormagd.safety.operating_state import Conditions
from tormagd.scenes.scene import EVERY_TERM, TERMS, Terms, load_scene

pytestmark = pytest.mark.usefixtures("forgetful")

CONFIG = Config()
PERIOD_S = 0.004
READY = Conditions(
    connected=True, fresh=True, homed=True, busy=False, device_latched=False, requested_N=None, neutral_N=0.5
)


def core_with(terms: Terms, config: Config = CONFIG) -> Core:
    return build_core(config, msgspec.structs.replace(load_scene("coronary"), terms=terms))


def core_without(*names: str) -> Core:
    return core_with(EVERY_TERM.without(*names))


def told(core: Core, state: PlanState, asked_N: float, rate_mm_s: float = 42.0, **setpoint: object) -> PlanState:
    """After one plan more, for which the device says something new: 1.2 N at 78 mm, less than the model expects."""
    now_s = state.plan.time_s + PERIOD_S
    at_mm = 100.0 + rate_mm_s * now_s
    handle = Handle(MOBILISED_MM, rate_mm_s, Turn(1.0, 0.0, at_mm), rate_mm_s)
    number = state.shown.read + 1
    force_N = 1.2 + 0.002 * (number % 2)  # a sensor that stands still is not believed
    estimate = Measured(number, True, 0.0, 39.0, 39.0, 0.0, 0.0, force_N, handle, at_mm, math.inf, 0.0)
    asked = TimedSetpoint(asked_N, now_s, 0.1).replaced(**setpoint)
    return core.planner.foresee(core.planner.plan(state, now_s, asked, estimate))


def after(core: Core, plans: int, rate_mm_s: float = 42.0, force_N: float = 1.0) -> PlanState:
    state = core.planner.start(0.0)
    for _ in range(plans):
        state = told(core, state, force_N, rate_mm_s)
    return state


def test_all_terms_are_in_unless_a_scene_says_so() -> None:
    assert EVERY_TERM.left_out == ()
    assert Terms(**dict.fromkeys(TERMS, False)).left_out == TERMS


def test_without_the_rate_one_table_answers_and_no_network_is_asked() -> None:
    unlearned = ("scale", "offset", "creep")
    full, core = core_without(*unlearned), core_without("rate", *unlearned)
    assert core.solver.solver == "portrait"
    gaps = [after(core, 2, rate).plan.gap_mm for rate in (2.0, 42.0, 250.0)]
    differing = [after(full, 2, rate).plan.gap_mm for rate in (2.0, 42.0, 250.0)]
    assert max(gaps) == min(gaps)
    assert max(differing) - min(differing) > 0.2
    start = core.planner.start(0.0)
    for force_N in (0.7, 1.0, 1.5):
        state = core.planner.plan(start, PERIOD_S, TimedSetpoint(force_N, PERIOD_S, 0.1), None)
        reach = core.planner.portrait
        assert state.plan.gap_mm == pytest.approx(reach.gap_mm_at(force_N), abs=1e-6)
        assert state.plan.confidence == 1.0
    assert Limit.F_MIN in core.planner.plan(start, PERIOD_S, TimedSetpoint(0.1, PERIOD_S, 0.1), None).plan.limits


def test_a_search_that_is_named_runs_all_the_same() -> None:
    scene = load_scene("pulse")
    core = build_core(Config(scene="pulse"), msgspec.structs.replace(scene, terms=EVERY_TERM.without("rate")))
    assert core.solver.solver == scene.solver.name == "nearest"


def test_scale_and_offset_are_learned_each_on_its_own() -> None:
    fits = {names: after(core_without(*names), 100).device for names in ((), ("scale",), ("offset",))}
    assert fits[()].scale != 1.0
    assert fits[()].offset_N != 0.0
    assert fits[("scale",)].scale == 1.0
    assert fits[("scale",)].scale_variance == pytest.approx(UNSEEN.scale_variance)
    assert fits[("offset",)].offset_N == 0.0
    for names, fit in fits.items():
        assert fit.force_N(1.0871) == pytest.approx(1.2, abs=0.04), names
    neither = after(core_without("scale", "offset"), 100)
    assert neither.device == UNSEEN
    assert neither.shown.read > 0


def test_what_is_left_out_keeps_its_uncertainty_and_is_counted_with() -> None:
    """Schmidt's filter against the covariance of any gain, in Joseph's form."""
    fit = DeviceFit(1.1, 0.02, 0.02, 0.001, 0.008)
    for learns_scale, learns_offset in ((True, False), (False, True)):
        found, _ = observe(
            fit,
            1.5,
            1.7,
            0.01,
            adapts_in_s=0.5,
            bounds=(0.6, 1.6),
            learns_scale=learns_scale,
            learns_offset=learns_offset,
        )
        aged, _ = observe(
            fit, 1.5, 1.7, 0.01, adapts_in_s=0.5, bounds=(0.6, 1.6), learns_scale=False, learns_offset=False
        )
        noise = 3e-4 / 0.01
        by_scale = 1.5 * aged.scale_variance + aged.covariance_N
        by_offset = 1.5 * aged.covariance_N + aged.offset_variance_N2
        whole = 1.5 * by_scale + by_offset + noise
        gains = (by_scale / whole * learns_scale, by_offset / whole * learns_offset)
        kept = ((1.0 - 1.5 * gains[0], -gains[0]), (-1.5 * gains[1], 1.0 - gains[1]))
        before = ((aged.scale_variance, aged.covariance_N), (aged.covariance_N, aged.offset_variance_N2))

        def joseph(i: int, j: int, kept=kept, before=before, gains=gains, noise=noise) -> float:
            total = sum(kept[i][k] * before[k][m] * kept[j][m] for k in range(2) for m in range(2))
            return float(total + gains[i] * gains[j] * noise)

        assert found.scale_variance == pytest.approx(joseph(0, 0))
        assert found.covariance_N == pytest.approx(joseph(0, 1))
        assert found.offset_variance_N2 == pytest.approx(joseph(1, 1))
        assert (found.scale == fit.scale) is not learns_scale
        assert (found.offset_N == fit.offset_N) is not learns_offset


def test_without_the_creep_term_nothing_slow_is_learned() -> None:
    assert after(core_without(), 100, rate_mm_s=2.0).shown.slow.factor > 1.0
    assert after(core_without("creep"), 100, rate_mm_s=2.0).shown.slow == NOTHING_SLOW


def test_without_the_slope_a_force_is_held_until_the_next() -> None:
    def path(core: Core) -> tuple[float, float]:
        state = core.planner.start(0.0)
        for number in range(50):
            state = told(core, state, 1.0 + 0.002 * number)
        return state.governor.slope_N_s, state.plan.gap_speed_mm_s

    slope_N_s, speed_mm_s = path(core_without())
    assert slope_N_s == pytest.approx(0.5, rel=0.05)
    assert speed_mm_s < -5.0
    assert path(core_without("slope")) == (0.0, 0.0)


def test_without_the_forecast_nothing_is_remembered() -> None:
    def remembered(core: Core) -> bool:
        return after(core, 20).governor.periodicity == NOTHING_LEARNED

    assert not remembered(core_without())
    assert remembered(core_without("forecast"))


def test_without_the_preview_what_follows_is_not_looked_at() -> None:
    ahead = {"preview_N": tuple(1.0 + 0.005 * step for step in range(1, 35)), "preview_dt_s": 0.002}

    def speed_mm_s(core: Core, **setpoint: object) -> float:
        state = after(core, 20)
        for _ in range(10):  # from rest, a gap gains speed with a time constant of 25 ms
            state = told(core, state, 1.0, **setpoint)
        return state.plan.gap_speed_mm_s

    assert speed_mm_s(core_without(), **ahead) < -20.0
    assert speed_mm_s(core_without("preview"), **ahead) == speed_mm_s(core_without("preview"))


def late_s(core: Core) -> float:
    """What was learned of carriages that are always a millimetre behind, while what comes is known."""
    state = core.planner.start(0.0)
    state = state.replaced(governor=state.governor.replaced(asked_N=1.0))
    for number in range(100):
        now_s = (number + 1) * PERIOD_S
        force_N = 1.0 + 0.5 * now_s
        gap_mm = core.planner.portrait.gap_mm_at(force_N) + 0.3
        handle = Handle(MOBILISED_MM, 42.0, Turn(1.0, 0.0, 100.0), 42.0)
        estimate = Measured(number, True, 0.0, gap_mm / 2, gap_mm / 2, -7.0, -7.0, 1.0, handle, 100.0, -math.inf, 0.0)
        preview = tuple(force_N + 0.5 * 0.002 * step for step in range(1, 35))
        setpoint = TimedSetpoint(force_N, now_s, 0.1, preview_N=preview, preview_dt_s=0.002)
        state = core.planner.plan(state, now_s, setpoint, estimate)
    return state.shown.lateness.lag_s


def test_without_the_lag_late_carriages_stay_late() -> None:
    assert late_s(core_without()) > 0.002
    assert late_s(core_without("lag")) == 0.0


def test_without_the_lag_what_is_known_of_it_is_not_looked_at() -> None:
    ahead = {"preview_N": tuple(1.0 + 0.1 * (step > 15) for step in range(35)), "preview_dt_s": 0.002}

    def gap_mm(core: Core, lag_s: float) -> float:
        state = core.planner.start(0.0).replaced(shown=Learned(lateness=CarriageLag(lag_s)))
        return told(core, state, 1.0, **ahead).plan.gap_mm

    assert gap_mm(core_without(), 0.02) != gap_mm(core_without(), 0.0)
    assert gap_mm(core_without("lag"), 0.02) == gap_mm(core_without("lag"), 0.0)


def duties(core: Core, measure: Callable[..., Measurement], target_mm: float) -> list[float]:
    """The first duties of an armed device on its way from 80 mm; it has not moved yet, so nearly all is fed forward."""
    state = core.stepper.start(0.0)
    found = []
    for tick in range(1, 7):
        plan = Plan(1, tick * 1e-3, None, None, 0.0, None, 0.0, target_mm, 0.0, 1.0, ())
        state, output = core.stepper.step(state, tick * 1e-3, measure(tick), plan)
        if tick == 2:
            state = core.stepper.command(state, "enable", tick * 1e-3, READY)
        if tick > 3:
            found.append(output.left_duty)
    return found


def test_without_the_motor_nothing_is_fed_forward(measure) -> None:
    for target_mm in (90.0, 60.0):
        full, left = (duties(core_without(*names), measure, target_mm) for names in ((), ("motor",)))
        assert abs(left[0]) < 0.1 * abs(full[0])
        assert all(abs(duty) < abs(whole) for duty, whole in zip(left, full, strict=True))


def test_dry_friction_counts_both_ways_and_the_magnets_pull_where_it_opens(measure) -> None:
    for target_mm, is_opening in ((90.0, True), (60.0, False)):
        full = duties(core_without(), measure, target_mm)
        smooth = duties(core_with(EVERY_TERM, Config(motor=Motor(coulomb_V=0.0))), measure, target_mm)
        assert all(abs(duty) < abs(whole) for duty, whole in zip(smooth, full, strict=True))
        free = duties(core_with(EVERY_TERM, Config(motor=Motor(pull_V=0.0))), measure, target_mm)
        assert all((whole > duty) is is_opening for duty, whole in zip(free, full, strict=True))
        assert is_opening or free == full


def test_learning_can_be_stopped_for_a_measurement() -> None:
    learning, frozen = core_without(), core_with(Terms(learning=False))
    state = after(learning, 100)
    kept = state
    for _ in range(50):
        kept = told(frozen, kept, 1.4)
    assert (kept.device, kept.shown.slow.factor) == (state.device, state.shown.slow.factor)
    assert kept.shown.lateness.lag_s == state.shown.lateness.lag_s
    assert kept.shown.read == state.shown.read + 50
