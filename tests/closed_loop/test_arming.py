"""Arming beside a live publisher, from every state: the force goes to its setpoint along the scene's ramp."""

from collections.abc import Callable

import pytest

from tormagd.control.assembly.build import Core
from tormagd.control.records import TimedSetpoint
from tormagd.control.safety.codes import Fault, Limit
from tormagd.control.safety.operating_state import Conditions, OperatingState, RefusedError, SafetyState, latch
from tormagd.daemon.control_loop import MOVES_S, PATIENCE_S, Arming
from tormagd.simulation.closed_loop import ClosedLoop, Sample

ASKED_N = 1.5
OVER_S = 0.05
READY = Conditions(True, True, True, False, False)
DISABLED, ENABLED, _, _ = OperatingState
STOPPED = latch(SafetyState(), (Fault.STOPPED,))


def live(now_s: float, force_N: float = ASKED_N) -> TimedSetpoint:
    return TimedSetpoint(force_N, now_s - now_s % 0.002, 0.1)


def ticks(loop: ClosedLoop, duration_s: float, force_N: float | None = ASKED_N) -> list[Sample]:
    return list(loop.run(duration_s, lambda now_s: None if force_N is None else live(now_s, force_N)))


def arm_beside(loop: ClosedLoop) -> tuple[Arming, list[Sample]]:
    arming, samples = Arming(loop.now_s, loop.stepper.safety.faults), []
    while not arming.is_over:
        arming.advance(loop.now_s, loop.stepper.safety, loop.conditions(), loop.command)
        samples.append(loop.tick(live(loop.now_s)))
    return arming, samples + ticks(loop, 2.0)


@pytest.mark.parametrize(
    ("was_armed", "before_s", "before_N", "command", "after_s", "given"),
    [
        pytest.param(True, 1.5, 1.1, "pause", 0.2, ("resume",), id="paused"),
        # the gap still opens
        pytest.param(True, 1.0, ASKED_N, "stop", 0.1, ("clear-fault", "enable"), id="stopped"),
        pytest.param(True, 0.0, ASKED_N, "disable", 0.5, ("enable",), id="disabled"),
        pytest.param(True, 0.0, ASKED_N, None, 0.0, (), id="enabled"),
        pytest.param(False, 1.0, ASKED_N, None, 0.0, ("home", "enable"), id="not homed"),
    ],
)
def test_from_each_state_the_force_goes_to_a_live_setpoint_along_the_ramp(
    make: Callable[..., ClosedLoop],
    arm: Callable[..., ClosedLoop],
    core: Core,
    was_armed: bool,
    before_s: float,
    before_N: float,
    command: str | None,
    after_s: float,
    given: tuple[str, ...],
) -> None:
    loop = arm() if was_armed else make()
    ticks(loop, before_s, before_N)
    if command:
        loop.command(command)
    ticks(loop, after_s)
    arming, samples = arm_beside(loop)
    assert (arming.given, arming.refusal) == (given, None)
    followed = samples[[it.safety.operating_state for it in samples].index(ENABLED) :]
    forces_N, later = [it.truth.force_N for it in followed], round(OVER_S * 1e3)
    fastest_N_s = max(abs(after - now) / OVER_S for now, after in zip(forces_N, forces_N[later:], strict=False))
    # the carriages may be behind the ramp, and catch up
    assert fastest_N_s <= 1.25 * core.scene.force.release_N_s
    assert any(Limit.TAKEOVER in it.plan.limits for it in followed)
    assert samples[-1].truth.force_N == pytest.approx(ASKED_N, abs=0.05)


def test_a_fault_that_comes_on_the_way_ends_it_and_nothing_is_cleared_twice() -> None:
    arming, given = Arming(0.0, STOPPED.faults), list[str]()
    arming.advance(0.0, latch(STOPPED, (Fault.ENCODER,)), READY, given.append)
    assert (given, arming.refusal and arming.refusal.code) == ([], "fault")
    arming = Arming(0.0, STOPPED.faults)
    for now_s in (0.0, 0.1):
        arming.advance(now_s, STOPPED, READY, given.append)
    assert (given, arming.refusal and arming.refusal.code) == (["clear-fault"], "fault")


@pytest.mark.parametrize(
    ("changes", "code", "after_s"),
    [
        ({"connected": False}, "not_connected", 0.0),
        ({"busy": True}, "busy", MOVES_S),
        ({"homed": False}, "busy", PATIENCE_S),
    ],
)
def test_what_does_not_come_to_its_end_ends_it_with_the_reason(
    changes: dict[str, bool], code: str, after_s: float
) -> None:
    arming, now_s = Arming(0.0, ()), 0.0
    while not arming.is_over:
        arming.advance(now_s, SafetyState(), READY.replaced(**changes), lambda name: None)
        now_s += 0.1
    assert (arming.refusal and arming.refusal.code, now_s) == (code, pytest.approx(after_s, abs=0.25))


@pytest.mark.parametrize(("code", "given"), [("not_fresh", 1), ("sensor_doubted", 0)])
def test_a_refusal_that_goes_away_is_waited_for_and_another_is_told(code: str, given: int) -> None:
    arming, refusals = Arming(0.0, ()), [RefusedError(code, "so it is", "wait")]

    def give(name: str) -> None:
        if refusals:
            raise refusals.pop()

    for now_s, state in ((0.0, DISABLED), (0.1, DISABLED), (0.2, DISABLED if code == "sensor_doubted" else ENABLED)):
        arming.advance(now_s, SafetyState(state), READY, give)
    assert (len(arming.given), arming.is_over) == (given, True)
    assert (arming.refusal and arming.refusal.code) == (None if given else code)
