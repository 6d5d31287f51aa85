"""The brake is not closed by mistake: three layers that each hold alone, and a sensor that is judged (synthetic)."""

import random

import msgspec
import numpy as np
import pytest
from lying import Lie, LyingSensor

from tormagd.control.aim.portrait import Portrait
from tormagd.control.ask.governor import Governor
from tormagd.control.assembly.build import Core
from tormagd.control.believe.believe import Learned
from tormagd.control.believe.strength import DeviceFit
from tormagd.control.safety.codes import Fault, Limit
from tormagd.control.safety.operating_state import OperatingState, RefusedError
from tormagd.simulation.closed_loop import ClosedLoop, Sample
from tormagd.simulation.hand import RecordedHand, ReversingHand

ASKED_N, MAX_N = 1.5, 2.0
NAMED = {Limit.SENSOR, Limit.DEVICE_OR_SENSOR}
CEILING_N = 1.25 * MAX_N + 0.1
WEAKEST_AND_STRONGEST = ("sample_2", "sample_3")


def worst_N(samples: list[Sample]) -> float:
    return max(abs(sample.truth.force_N) for sample in samples)


def named_s(samples: list[Sample]) -> float:
    doubted = [sample.time_s for sample in samples if NAMED & set(sample.plan.limits)]
    assert doubted, "the readings were never named"
    return doubted[0] - samples[0].time_s


LIES: dict[str, Lie] = {
    "+0.3 N": lambda _, reading_N: reading_N + 0.3,
    "-0.3 N": lambda _, reading_N: reading_N - 0.3,
    "-0.5 N": lambda _, reading_N: reading_N - 0.5,
    "+1 N": lambda _, reading_N: reading_N + 1.0,
    "-1 N": lambda _, reading_N: reading_N - 1.0,
    "frozen": lambda first_N, _: first_N,
    "tenfold": lambda _, reading_N: 10.0 * reading_N,
    "inverted": lambda _, reading_N: -reading_N,
}


@pytest.mark.parametrize("lie", ["+0.3 N", "-0.3 N", "+1 N", "-1 N", "frozen", "tenfold", "inverted"])
def test_a_sensor_that_begins_to_lie_is_named_and_closes_nothing(render, lie: str, armed: ClosedLoop) -> None:
    render(armed, ASKED_N, 2.0)
    LyingSensor(armed.simulated.plant, LIES[lie])
    samples = render(armed, ASKED_N, 1.5)
    assert named_s(samples) < 0.5
    assert worst_N(samples) < ASKED_N + 0.25


@pytest.fixture
def lying(make):
    def build(lie: str, **options: object):
        loop = make(**options)
        LyingSensor(loop.simulated.plant, LIES[lie])
        loop.arm()
        return loop

    return build


@pytest.mark.parametrize("lie", ["-0.5 N", "+1 N", "inverted"])
def test_a_sensor_that_lies_from_the_beginning_keeps_the_device_disabled(lying, lie: str) -> None:
    loop = lying(lie)
    loop.command("disable")
    list(loop.run(1.5))
    with pytest.raises(RefusedError, match="force sensor") as refused:
        loop.command("enable")
    assert refused.value.code == "sensor_doubted"


@pytest.mark.parametrize(
    ("lie", "most_N", "is_named"),
    [("-0.3 N", ASKED_N + 0.35, False), ("+0.3 N", ASKED_N, False), ("frozen", ASKED_N + 0.3, True)],
)
def test_a_sensor_that_lies_a_little_from_the_beginning_presses_more_by_no_more(
    lying, render, lie: str, most_N: float, is_named: bool
) -> None:
    samples = render(lying(lie), ASKED_N, 3.0)
    assert worst_N(samples) < most_N
    assert not is_named or named_s(samples) < 1.0


def test_a_sensor_that_stays_doubted_is_a_fault_where_the_scene_needs_it(render, armed: ClosedLoop) -> None:
    render(armed, ASKED_N, 2.0)
    LyingSensor(armed.simulated.plant, LIES["-1 N"])
    samples = render(armed, ASKED_N, 3.0)
    assert samples[-1].safety.faults == (Fault.SENSOR,)
    healthy_s = 1e-3 * sum(not sample.safety.faults for sample in samples)
    assert healthy_s == pytest.approx(2.06, abs=0.1)


@pytest.mark.parametrize("sample", WEAKEST_AND_STRONGEST)
def test_an_honest_sensor_is_believed_and_a_start_from_rest_is_not_over_force(arm, render, sample: str) -> None:
    loop = arm(sample, ReversingHand(2.0))
    for asked_N in (MAX_N, 0.7, MAX_N, 1.4):
        samples = render(loop, asked_N, 3.0)
        assert not any(NAMED & set(sample.plan.limits) for sample in samples)
        assert samples[-1].safety.operating_state is OperatingState.ENABLED
        assert worst_N(samples) < CEILING_N


@pytest.fixture(scope="session")
def open_core(core: Core) -> Core:
    """The scene allows thirty times the force, so that no ceiling acts."""
    force = msgspec.structs.replace(core.scene.force, most_N=30.0 * core.scene.force.release_N_s)
    return core._replace(scene=msgspec.structs.replace(core.scene, force=force))


def test_the_governed_force_holds_alone(make, render, core: Core, open_core: Core) -> None:
    loop = make(core=open_core)
    loop.planner.governor = core.planner().governor
    loop.arm()
    samples = render(loop, 1_000.0, 2.5)
    assert worst_N(samples) < MAX_N + 0.15
    assert Limit.RANGE in samples[-1].plan.limits


def ask_for_six_newtons(core: Core) -> Governor:
    """A governor that has gone mad, and asks for 6 N whatever the scene wants."""
    giant = Portrait([95.0, 45.0], [0.0, 100.0], [2.0, 2.0])
    force = msgspec.structs.replace(core.scene.force, least_N=6.0, most_N=6.0)
    return Governor(0.0, giant, force, core.gap_speeds)


@pytest.mark.parametrize("sample", WEAKEST_AND_STRONGEST)
def test_the_gap_holds_alone(make, render, core: Core, open_core: Core, sample: str) -> None:
    loop = make(sample)
    loop.stepper, loop.planner.governor = open_core.stepper(), ask_for_six_newtons(core)
    loop.arm()
    samples = render(loop, 1.0, 3.0)
    assert samples[-1].plan.governed_N == 6.0
    assert MAX_N < worst_N(samples) < CEILING_N
    assert Limit.CEILING in samples[-1].plan.limits
    assert samples[-1].safety.operating_state is OperatingState.ENABLED


@pytest.mark.parametrize("sample", WEAKEST_AND_STRONGEST)
def test_the_measured_force_holds_alone(arm, core: Core, sample: str) -> None:
    shut = list(arm(sample).hold(47.0, 4.0))
    assert shut[-1].safety.faults == (Fault.OVER_FORCE,)
    assert any(Limit.OVER_FORCE in sample.output.limits for sample in shut)
    forces_N = np.array([sample.truth.force_N for sample in shut])
    assert 1e-3 * np.count_nonzero(forces_N > CEILING_N) < 0.3, "seconds over it"
    assert forces_N.max() < CEILING_N + 0.5
    # a force that vanishes at once would be a hazard of its own
    assert 1.0 < (forces_N[:-20] - forces_N[20:]).max() / 0.02 < core.scene.force.most_release_N_s
    assert shut[-1].truth.gap_mm > 90.0


# -- a profile is a prior for tracking only


RESTS_S = 3.0


@pytest.mark.parametrize("goes_mm_s", [0.0, 1.0, 42.0])
@pytest.mark.parametrize("scale", [0.1, 2.0])
@pytest.mark.parametrize("offset_N", [-1.0, 1.0])
def test_a_profile_that_lies_never_presses_over_the_ceiling(
    arm, render, goes_mm_s: float, scale: float, offset_N: float
) -> None:
    draw = random.Random(f"{goes_mm_s} {scale} {offset_N}")
    hand = RecordedHand((0.0, RESTS_S, RESTS_S + 30.0), (0.0, 0.0, 30.0 * goes_mm_s))
    loop = arm(f"sample_{draw.randint(1, 3)}", hand)
    fit = DeviceFit(scale, offset_N, draw.choice((1e-6, 1e-2)), 0.0, 1e-4)
    loop.planner.believe.teach(Learned(fit, draw.uniform(0.7, 1.2), 1.0, draw.uniform(-0.3, 0.3)))
    samples = render(loop, MAX_N, 4.0)
    assert worst_N(samples) < CEILING_N
    assert set(samples[-1].safety.faults) <= {Fault.SENSOR}
