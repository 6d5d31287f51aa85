"""Every stage of the core, fed with what it should never see: where bad numbers are looked for.

A stage is fed at its border. If another check stands before it, that is named, and the stage gets whatever passes the
check; otherwise it gets NaN, infinities and the largest floats too. In each episode a fresh stage has healthy inputs,
then hostile ones, then healthy ones again. A number that is not finite afterwards, in the output or in a field of the
stage, has travelled. A stage that refused is made anew, as its owner does.
"""

import math
import random
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

from leaves import leaves

from firmware_protocol.codec import DecodeError, EncodeError
from tormagd.control.safety.codes import Fault, Limit
from tormagd.control.safety.operating_state import RefusedError
from tormagd.element.physics.errors import DomainError
from tormagd_client.endpoints import ConfigError
from tormagd_client.messages import MessageError

NO_NUMBERS = (math.nan, math.inf, -math.inf)
TINY = (0.0, -0.0, 5e-324, -5e-324, 2.2250738585072014e-308, 1e-300, -1e-12)
LARGE = (1e9, -1e9, 1e10, -1e10, 1.0, -1.0, 300.0, -300.0)
"What passes the core's borders."
HUGE = (1.7976931348623157e308, -1.7976931348623157e308, 1e300, 1e11, -1e11)
EVERYTHING = (*NO_NUMBERS, *TINY, *LARGE, *HUGE)
BOUNDED = (*TINY, *LARGE)
REFUSALS = (DomainError, ConfigError, MessageError, RefusedError, EncodeError, DecodeError)
"They name the name, the value and what is allowed."
UNNAMED = (ArithmeticError, ValueError, TypeError, LookupError, AssertionError, RuntimeError)
USUAL_STEPS, HOSTILE_STEPS, AFTER_STEPS = 3, 6, 3
SHARE = 0.25
"Share of the numbers of a hostile step that are hostile."
MAX_TOLD = 3
MEANT = {("out.Plan.stamp_s", -math.inf), ("out.0.Belief.anchor_N", math.inf)}
"Infinities that a record states: it follows no setpoint, and a device that has not slid sets no ceiling."


class Draw:
    def __init__(self, rng: random.Random, strange: tuple[float, ...]) -> None:
        self._rng, self._strange, self.has_nan = rng, strange, False
        self.now_s = self.last_s = 10.0
        self.steps, self.is_hostile = 0, False

    def turn(self, is_hostile: bool) -> None:
        self.steps, self.is_hostile, self.has_nan = self.steps + 1, is_hostile, False

    def step(self, period_s: float) -> float:
        """Return the time of this step: a period on; in a hostile step maybe the same, earlier or much later."""
        self.last_s = self.now_s
        self.now_s += self._rng.choice((0.0, -0.5, 5.0, period_s)) if self.is_hostile else period_s
        return self.now_s

    def __call__(self, usual: float) -> float:
        value = self._drawn(usual, self._strange)
        self.has_nan |= math.isnan(value)
        return value

    def bounded(self, usual: float) -> float:
        return self._drawn(usual, BOUNDED)

    def positive(self, usual: float) -> float:
        return abs(self.bounded(usual)) or usual

    def _drawn(self, usual: float, strange: tuple[float, ...]) -> float:
        return self._rng.choice(strange) if self.is_hostile and self._rng.random() < SHARE else usual


class Stage(NamedTuple):
    """One row of the table. `make` gives a fresh stage; `feed` takes one step of it and returns what came out."""

    name: str
    make: Callable[[], Any]
    feed: Callable[[Any, Draw], object]
    border: str = ""
    period_s: float = 0.0


COUNTED = ("cases", "refused", "stated", "nonfinite", "swallowed", "unnamed")
"Steps with hostile inputs, those refused by name, those with a limit or a fault, and what must not be."


def tried(stage: Stage, episodes: int, seed: int) -> dict[str, Any]:
    rng = random.Random(f"{seed} {stage.name}")
    counts: Counter[str] = Counter()
    told: list[str] = []
    for _ in range(episodes):
        draw = Draw(rng, BOUNDED if stage.border else EVERYTHING)
        fed = stage.make()
        sentinels = {path for path, value in leaves(fed) if math.isinf(value)}
        for step in range(USUAL_STEPS + HOSTILE_STEPS + AFTER_STEPS):
            draw.turn(USUAL_STEPS <= step < USUAL_STEPS + HOSTILE_STEPS)
            counts["cases"] += draw.is_hostile
            if stage.period_s:
                draw.step(stage.period_s)
            try:
                came = stage.feed(fed, draw)
            except REFUSALS as error:
                counts["refused"] += step >= USUAL_STEPS
                if step < USUAL_STEPS:
                    _tell(counts, told, "unnamed", f"refused what is usual: {error}")
                fed = stage.make()
                continue
            except UNNAMED as error:
                _tell(counts, told, "unnamed", f"{type(error).__name__}: {error}")
                fed = stage.make()
                continue
            is_stated = any(isinstance(each, Limit | Fault) for each in _members(came))
            counts["stated"] += draw.is_hostile and is_stated
            if draw.has_nan and not is_stated:
                _tell(counts, told, "swallowed", f"of NaN came {came}")
            for path, value in (*leaves(came, "out"), *leaves(fed)):
                if math.isnan(value) or (math.isinf(value) and path not in sentinels and (path, value) not in MEANT):
                    _tell(counts, told, "nonfinite", f"{path} = {value}")
                    fed = stage.make()
                    break
    return {"stage": stage.name, "border": stage.border, **{name: counts[name] for name in COUNTED}, "told": told}


def _tell(counts: Counter[str], told: list[str], kind: str, what: str) -> None:
    counts[kind] += 1
    if len(told) < MAX_TOLD and what not in told:
        told.append(what[:120])


def _members(came: object) -> Iterator[object]:
    if isinstance(came, list | tuple):
        for each in came:
            yield from _members(each)
    elif isinstance(came, Limit | Fault):
        yield came
    elif hasattr(came, "limits"):
        yield from came.limits
