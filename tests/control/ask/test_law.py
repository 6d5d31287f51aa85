"""What is asked over the handle's place and way: a wall, another force for withdrawing, and where the brake waits."""

import math

import msgspec
import numpy as np
import pytest

from tormagd.control.aim.portrait import Portrait
from tormagd.control.ask.governor import DECAY, EARLY_N, Governor
from tormagd.control.ask.way import SLID_MM, Way
from tormagd.control.believe.strength import UNSEEN, DeviceFit
from tormagd.control.records import Ask, GapSpeeds, Handle, Measured, TimedSetpoint, Travel, Wall
from tormagd.control.safety.codes import Limit
from tormagd.element.model.displacement import TURN_MM, Turn
from tormagd.scenes.scene import Force

PORTRAIT = Portrait(
    np.linspace(95.0, 45.0, 19).tolist(), np.linspace(0.4, 2.2, 19).tolist(), np.linspace(0.01, 0.1, 19).tolist()
)
SCENE = Force(least_N=0.0, most_N=2.0, resolution_N=0.1, tolerance_rms_N=0.05)
WALL = Wall(10.0, 0.25, 0.6)
PERIOD_S = 0.002
PASSES = 10
"How many plans before the wall the gap may set out: 20 ms."


class Following:
    def __init__(self, scene: Force = SCENE) -> None:
        self.governor = Governor(0.0, PORTRAIT, scene, GapSpeeds(38.0, 38.0, 38.0))
        self.now_s = 0.0

    def ask(self, travel: Travel, force_N: float = 0.0, device: DeviceFit = UNSEEN, **law: object) -> Ask:
        self.now_s += PERIOD_S
        setpoint = TimedSetpoint(force_N, self.now_s, 0.1, **law)
        return self.governor.update(self.now_s, setpoint, device, 0.0, travel)


@pytest.fixture
def following() -> Following:
    return Following()


@pytest.mark.parametrize(("rate_mm_s", "is_slow"), [(3.0, True), (10.0, False), (60.0, False)])
def test_a_handle_feels_the_wall_where_it_is_and_at_most_a_little_before(following, rate_mm_s, is_slow) -> None:
    before_N = []
    for place_mm in np.arange(-20.0, 14.0, rate_mm_s * PERIOD_S).tolist():
        ask = following.ask(Travel(place_mm, rate_mm_s), wall=WALL)
        assert ask.asked_N == WALL.force_N(place_mm)
        if place_mm < WALL.place_mm:
            before_N.append(ask.path_N[0])
    assert max(before_N[:-PASSES]) <= WALL.friction_N + EARLY_N + 1e-3
    assert before_N[-1] > WALL.friction_N + (0.0 if is_slow else 0.05)
    assert (ask.path_N[0] == pytest.approx(ask.asked_N, abs=0.03)) is is_slow
    assert (Limit.RATE in ask.limits) is not is_slow


def test_the_less_sure_a_wall_is_the_sooner_the_gap_sets_out_to_it() -> None:
    places_mm = [*np.arange(-20.0, 12.0, 30.0 * PERIOD_S).tolist(), *[12.0] * 500]
    at_wall, before_N = places_mm.index(min(places_mm, key=lambda place: abs(place - 10.0))) - PASSES, []
    for sure in ((0.0, 0.0), (2.0, 0.0), (2.0, 1.0), (1e4, 1.0)):
        following, wall = Following(), Wall(10.0, 0.5, 0.6, *sure)
        gap_N = [following.ask(Travel(place, 30.0 * (place < 12.0)), wall=wall).path_N[0] for place in places_mm]
        before_N.append(max(gap_N[:at_wall]))
        assert gap_N[-1] == pytest.approx(1.6, abs=0.01)
        assert max(gap_N) < 1.65
    assert before_N == sorted(before_N)
    assert before_N[0] < 0.6 + EARLY_N + 1e-3
    assert 0.6 + EARLY_N + 0.05 < before_N[1] < 0.6 + EARLY_N + 1.0


@pytest.mark.parametrize("learned_N_s", [-0.5, 0.0, 0.5])
def test_what_is_learned_on_the_way_leaves_the_gap_where_it_is(following: Following, learned_N_s: float) -> None:
    gaps_mm = []
    for place_mm in np.arange(9.0, 15.0, 30.0 * PERIOD_S).tolist():
        device = DeviceFit(offset_N=learned_N_s * following.now_s)
        ask = following.ask(Travel(place_mm, 30.0), device=device, wall=Wall(10.0, 1.0, 0.6))
        gaps_mm.append(PORTRAIT.gap_mm_at(device.model_N(ask.path_N[0])))
    assert np.diff(gaps_mm[-20:]) == pytest.approx(-38.0 * PERIOD_S, rel=0.02)


def test_from_one_wall_to_the_next_the_force_goes_along_a_ramp() -> None:
    following = Following(msgspec.structs.replace(SCENE, release_N_s=1.0))
    at = Travel(14.0, 0.0)
    for _ in range(1000):
        before = following.ask(at, wall=WALL)
    steps_N = []
    for wall in [Wall(10.0, 0.05, 0.6)] * 100 + [None] * 600:
        ask = following.ask(at, force_N=1.6, wall=wall)
        steps_N.append(ask.force_N - before.force_N)
        before = ask
    assert max(map(abs, steps_N)) < 0.03
    assert min(steps_N) < -0.5 * PERIOD_S
    assert (ask.force_N, ask.path_N[0], ask.limits) == (1.6, 1.6, ())


@pytest.mark.parametrize("stiffness_N_mm", [1.0, 100.0])
def test_a_wall_that_is_gone_is_let_go_from_what_was_rendered(following: Following, stiffness_N_mm: float) -> None:
    for place_mm in np.arange(-5.0, 10.0, 0.02).tolist():
        following.ask(Travel(place_mm, 10.0), wall=Wall(0.0, stiffness_N_mm))
    for _ in range(round(SCENE.most_N / SCENE.release_N_s / PERIOD_S) + 1):
        ask = following.ask(Travel(10.0, 1.0), 0.5)
    assert (ask.asked_N, ask.force_N, ask.limits) == (0.5, 0.5, ())


def test_a_wall_that_goes_with_the_handle_asks_for_what_it_says(following: Following) -> None:
    for place_mm in np.arange(0.0, 60.0, 0.03).tolist():
        ask = following.ask(Travel(place_mm, 15.0), wall=Wall(place_mm - 1.2, 1.0))
        assert ask.asked_N == pytest.approx(1.2)
        # each message moves the wall: the gap sets out to what would come, at 1 mm of 0.036 N
        assert ask.force_N <= 1.2 + PORTRAIT.min_N + EARLY_N + 0.036


@pytest.mark.parametrize(
    ("law", "asked_N"),
    [({"withdraw_N": 0.5}, 0.5), ({"withdraw_N": 0.5, "wall": WALL}, 0.5), ({"wall": WALL}, 0.6), ({}, 1.5)],
)
def test_a_handle_that_withdraws_is_asked_for_its_own_force(following: Following, law, asked_N: float) -> None:
    following.ask(Travel(14.0, 5.0), 1.5, **law)
    ask = following.ask(Travel(14.0, -5.0, is_pushing=False), 1.5, **law)
    assert (ask.asked_N, ask.path_N) == (asked_N, [asked_N] * 7)


@pytest.mark.parametrize(
    ("asked_N", "rendered_N", "limits"), [(0.3, 0.6, (Limit.STANDBY,)), (0.6, 0.6, ()), (0.9, 0.9, ())]
)
def test_a_brake_waits_at_its_standby_and_says_so(asked_N: float, rendered_N: float, limits) -> None:
    waiting = Following(msgspec.structs.replace(SCENE, standby_N=0.6))
    for _ in range(3):
        ask = waiting.ask(Travel(0.0, 10.0), asked_N)
    assert (ask.force_N, ask.limits) == (rendered_N, limits)
    assert waiting.governor.update(2.0, None, DeviceFit(), 0.0).force_N == 0.4, "without a publisher nothing waits"


class Pushed:
    """A way whose handle and force sensor the test moves, with the encoder's sign of pushing on."""

    def __init__(self, push_sign: int) -> None:
        self._way, self._sign, self._turn = Way(push_sign), push_sign, Turn(1.0, 0.0, 0.0)

    def at(self, place_mm: float, hand_N: float, *, zero_N: float = 0.0, is_sensor_believed: bool = True) -> Travel:
        encoder_mm = self._sign * place_mm
        self._turn = self._turn.moved_to(encoder_mm)
        direction = self._turn.direction
        handle = Handle(self._turn.displacement_mm(encoder_mm), 5.0, self._turn)
        against_N = direction * (self._sign * hand_N + zero_N)
        measured = Measured(1, True, 0.0, 40.0, 40.0, 0.0, 0.0, against_N, handle, encoder_mm, 0.0, 0.0)
        return self._way.update(measured, zero_N, is_sensor_believed)


@pytest.fixture
def pushed() -> Pushed:
    made = Pushed(1)
    made.at(5.0, 1.5)
    return made


@pytest.mark.parametrize("push_sign", [1, -1])
def test_a_held_handle_withdraws_once_the_hand_pulls(push_sign: int) -> None:
    pushed = Pushed(push_sign)
    assert all(pushed.at(place_mm, 1.5).is_pushing for place_mm in np.arange(0.0, 5.0, 0.1))
    back_mm = 4.9 - 2.0 * TURN_MM
    assert pushed.at(back_mm, 0.2).is_pushing
    pulled = pushed.at(back_mm, -0.2)
    assert (pulled.is_pushing, pulled.place_mm, pulled.rate_mm_s) == (False, pytest.approx(back_mm), -5.0)
    assert [pushed.at(back_mm + 2.0 * TURN_MM, hand_N).is_pushing for hand_N in (-0.2, 0.3)] == [False, True]


def test_a_sensor_that_is_not_believed_shows_no_way_but_a_handle_that_comes_back_does(pushed: Pushed) -> None:
    assert pushed.at(4.8, -0.5, is_sensor_believed=False).is_pushing
    assert not pushed.at(5.0 - 1.01 * SLID_MM, -0.5, is_sensor_believed=False).is_pushing


@pytest.mark.parametrize("push_sign", [1, -1])
@pytest.mark.parametrize("zero_N", [0.15, -0.15])
def test_what_a_sensors_zero_is_off_by_is_no_hand_that_pulls(push_sign: int, zero_N: float) -> None:
    pushed = Pushed(push_sign)
    pushed.at(5.0, 1.5, zero_N=zero_N)
    for place_mm in (5.0, 4.9, 5.0):
        assert [pushed.at(place_mm, hand_N, zero_N=zero_N).is_pushing for hand_N in (0.05, -0.05)] == [True, True]
    assert not pushed.at(5.0, -0.11, zero_N=zero_N).is_pushing


def test_a_tremor_of_a_held_handle_changes_no_way(pushed: Pushed) -> None:
    for time_s in np.arange(0.0, 2.0, 0.001):
        swing = math.sin(math.tau * 8.0 * time_s)
        assert pushed.at(5.0 + 0.1 * swing, 1.0 + 0.5 * swing).is_pushing


def test_a_silent_device_keeps_its_place_and_way(pushed: Pushed) -> None:
    assert pushed._way.update(None, 0.0, is_sensor_believed=True) == Travel(5.0, 0.0)


@pytest.mark.parametrize("breakthrough", ["off", "decay"])
def test_a_force_that_gives_way_is_let_go_at_once_or_along_the_ramp_and_comes_back_at_once(breakthrough: str) -> None:
    following = Following(msgspec.structs.replace(SCENE, breakthrough=breakthrough))
    pushes = Travel(10.0, 30.0)
    for force_N in (*np.linspace(0.5, 1.8, 650), *[1.8] * 50):
        held = following.ask(pushes, force_N)
    assert (held.force_N, Limit.RATE in held.limits) == (1.8, False)
    for plan in range(1, 301):
        ask = following.ask(pushes, 0.5)
        fallen_N = DECAY * SCENE.release_N_s * PERIOD_S * plan if breakthrough == "decay" else 1.3
        assert ask.force_N == pytest.approx(max(1.8 - fallen_N, 0.5))
        assert (Limit.RATE in ask.limits) == (breakthrough == "decay")
        assert max(ask.path_N) <= 1.8
    assert following.ask(pushes, 1.6).force_N == 1.6
    following.ask(pushes, 0.5)
    assert following.ask(Travel(10.0, -1.0, is_pushing=False), 0.5, withdraw_N=0.5).force_N == 0.5
