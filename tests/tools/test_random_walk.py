"""The core walks at random, and keeps its rules; a rule that is broken is seen."""

import pytest
from hypothesis import settings, strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule, run_state_machine_as_test
from random_walk import ALLOWED, DRIVEN, BrokenRuleError, Walk

from tormagd.config import Config
from tormagd.control.core import build_core
from tormagd.safety.operating_state import COMMANDS, Event, OperatingState

LEAST_STEPS = 100_000
CONFIG = Config()
STEPPER = build_core(CONFIG).stepper
LIMIT = CONFIG.position.duty_limit


class Walking(RuleBasedStateMachine):
    """Stretches of a random walk, and operators between them; the walk itself judges every step."""

    steps = driven = 0

    @initialize(seed=st.integers(0, 2**32))
    def begin(self, seed: int) -> None:
        self.walk = Walk(STEPPER, LIMIT, seed)

    @rule(steps=st.integers(100, 600))
    def go(self, steps: int) -> None:
        before = self.walk.driven
        self.walk.go(steps)
        Walking.steps += steps
        Walking.driven += self.walk.driven - before

    @rule(name=st.sampled_from(COMMANDS))
    def operate(self, name: str) -> None:
        self.walk.operate(name)

    @rule()
    def lose_link(self) -> None:
        self.walk.state = STEPPER.lose_link(self.walk.state)


def test_no_step_breaks_a_rule() -> None:
    Walking.steps = Walking.driven = 0
    run_state_machine_as_test(Walking, settings=settings(max_examples=60, stateful_step_count=20, deadline=None))
    assert Walking.steps >= LEAST_STEPS
    assert Walking.driven > Walking.steps / 10, "what is never driven breaks no rule"


def test_a_walk_repeats_itself() -> None:
    first, again = Walk(STEPPER, LIMIT, 7), Walk(STEPPER, LIMIT, 7)
    first.go(1_500)
    again.go(1_500)
    assert first.state == again.state
    assert first.driven == again.driven > 0


def test_a_duty_beyond_the_limit_is_seen() -> None:
    with pytest.raises(BrokenRuleError, match="duties = "):
        Walk(STEPPER, 0.01, 7).go(1_500)


def test_a_way_that_is_in_no_row_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(ALLOWED, (Event.ENABLE, OperatingState.DISABLED))
    with pytest.raises(BrokenRuleError, match="enable was taken in DISABLED"):
        Walk(STEPPER, LIMIT, 7).go(1_500)


def test_what_is_driven_while_it_may_not_be_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    assert set(DRIVEN) == {OperatingState.ENABLED, OperatingState.PAUSED}
    monkeypatch.setattr("random_walk.DRIVEN", (OperatingState.PAUSED,))
    with pytest.raises(BrokenRuleError, match="allowed is OFF"):
        Walk(STEPPER, LIMIT, 7).go(1_500)
