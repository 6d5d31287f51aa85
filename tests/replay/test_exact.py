"""Values as plain data: back as they were, to the bit, in both builds; anything else is refused."""

import math
import struct
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_protocol.codec import Switches
from tormagd.control.device_fit import UNSEEN
from tormagd.control.governor import GovernorState
from tormagd.control.plan import NOTHING_SHOWN, Outside, Plan, PlanState
from tormagd.control.step import StepState
from tormagd.exact import InexactError, first_difference, kinds, packed, plain, restored
from tormagd.model.displacement import Turn
from tormagd.model.relaxing import Relaxed
from tormagd.replay.rerun import KNOWN
from tormagd.safety.codes import Fault, Limit
from tormagd.safety.operating_state import SafetyState

PLAN = Plan(1, 0.5, 3.5, 0.001, 3.5, None, 180.0, 78.0, 0.0, 1.0, (Limit.F_MIN,))
FLOATS = st.one_of(st.floats(), st.sampled_from([-0.0, math.nan, -math.inf, 5e-324]))
LEAVES = st.one_of(FLOATS, st.integers(-(2**63), 2**64 - 1), st.booleans(), st.none(), st.text(), st.binary())
LEAVES |= st.sampled_from([Limit.RATE, Fault.SKEW, Switches.HOMED | Switches.LEFT_OPEN])
THINGS = st.recursive(
    LEAVES,
    lambda inner: st.one_of(
        st.lists(inner),
        st.lists(inner).map(tuple),
        st.builds(Outside, st.text(), FLOATS, FLOATS),
        st.builds(Turn, FLOATS, FLOATS, FLOATS),
    ),
    max_leaves=20,
)


def through_msgpack(thing: object) -> Any:
    return restored(msgspec.msgpack.decode(packed(plain(thing))), {**KNOWN, **kinds(Switches)})


def test_what_a_pad_remembers_comes_back() -> None:
    state = PlanState(GovernorState(1.0, 2.0), PLAN, relaxed=Relaxed(1.0, (3.5, 0.25), (0.5, 0.125), 0.0625))
    assert through_msgpack(state) == state


@settings(max_examples=25)
@given(THINGS)
def test_what_comes_back_is_what_went(thing: object) -> None:
    back = through_msgpack(thing)
    assert type(back) is type(thing)
    assert packed(plain(back)) == packed(plain(thing))
    assert first_difference(plain(thing), plain(back)) is None


def test_floats_keep_their_bits() -> None:
    for number in (-0.0, math.nan, struct.unpack(">d", b"\x7f\xf8\x00\x00\x00\x00\x12\x34")[0], 0.1 + 0.2):
        back = through_msgpack(Turn(number, 0.0, 0.0)).direction
        assert struct.pack(">d", back) == struct.pack(">d", number)


def test_sentinels_come_back_equal() -> None:
    """Nothing in the core asks which of two equal ones it is; replays from snapshots show it."""
    assert through_msgpack(NOTHING_SHOWN) == NOTHING_SHOWN
    assert through_msgpack(UNSEEN) == UNSEEN


def test_differences_have_a_name() -> None:
    one = StepState(1.0, SafetyState(faults=(Fault.SKEW,)))
    other = one.replaced(safety=one.safety.replaced(request_number=7))
    assert first_difference(plain(one), plain(other)) == ("safety.request_number", 0, 7)
    assert first_difference(plain((1.0, 2.0)), plain((1.0, 2.0, 3.0))) == ("length", 2, 3)
    assert first_difference(plain(0.0), plain(-0.0)) == ("", 0.0, -0.0)


@pytest.mark.parametrize(
    "data",
    [
        {"Unheard": {}},
        {"Turn": {"direction": 1.0}},
        {"Turn": {"direction": 1.0, "turned_mm": 0.0, "furthest_mm": 0.0, "more": 1}},
        {"Turn": 3},
        {"Turn": []},
        {"Limit": "SLOW"},
        {"Limit": {}},
        {"Limit": "RATE", "Turn": {}},
        {},
        {1: 2},
        [{"Fault": None}],
    ],
)
def test_what_stands_for_no_value_is_refused(data: Any) -> None:
    with pytest.raises(InexactError):
        restored(data, KNOWN)


def test_what_has_no_plain_form_is_refused() -> None:
    with pytest.raises(TypeError, match="allowed are values"):
        plain({"a": 1})
