"""Values as plain data: back as they were, to the bit, in both builds; anything else is refused."""

import math
import struct
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings, strategies as st
from tormagd.control.plan import PlanState
from tormagd.control.step import StepState

from firmware_protocol.codec import SCHEMA_HASH, Identity, Switches
from tormagd.control.ask.governor import GovernorState
from tormagd.control.believe.believe import NOTHING_LEARNED
from tormagd.control.believe.memory import Remembered
from tormagd.control.believe.strength import UNSEEN
from tormagd.control.records import Outside, Plan
from tormagd.exact import InexactError, first_difference, kinds, packed, plain, restore, restored
from tormagd.hardware.link import DeviceLink
from tormagd.hardware.link_statistics import RoundTrip
from tormagd.model.displacement import Turn
from tormagd.replay import conversation
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


def test_what_an_element_remembers_comes_back() -> None:
    remembered = Remembered(400.0, 1.5, (3.5, 0.25), (0.5, 0.125), 0.0625, 1.0)
    state = PlanState(GovernorState(1.0, 2.0), PLAN, remembered=remembered)
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
    assert through_msgpack(NOTHING_LEARNED) == NOTHING_LEARNED
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


def test_what_changes_in_place_is_given_what_another_remembered() -> None:
    one, other = DeviceLink(1.0), DeviceLink(2.0)
    one.receive(1.5, Identity(SCHEMA_HASH, 1, 0, 7))
    one.round_trip.drive(3, 1.5)
    restore(other, msgspec.msgpack.decode(msgspec.msgpack.encode(plain(one))), conversation.KNOWN)
    assert first_difference(plain(one), plain(other)) is None
    assert (other.state, other.identity) == (one.state, one.identity)
    other.round_trip.drive(4, 2.5)
    assert first_difference(plain(one), plain(other)) == ("round_trip._newest", 3, 4)


@pytest.mark.parametrize(
    "data", [None, {}, {"RoundTrip": 1}, {"RoundTrip": {"_lead": 1}}, {"DeviceLink": {}}, "_recent", "_sent_s"]
)
def test_what_nobody_remembers_is_refused(data: Any) -> None:
    if isinstance(data, str):
        data = {"RoundTrip": plain(RoundTrip())["RoundTrip"] | {data: {"Unheard": {}}}}
    with pytest.raises(InexactError):
        restore(RoundTrip(), data, conversation.KNOWN)
