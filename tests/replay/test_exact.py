"""Values as plain data: back as they were, to the bit, in both builds; anything else is refused."""

import ast
import math
import struct
from pathlib import Path
from typing import Any

import msgspec
import pytest
from flight import asked
from hypothesis import given, settings, strategies as st

from firmware_protocol.codec import Switches
from tormagd.control.assembly.build import Core
from tormagd.control.believe.believe import NOTHING_LEARNED
from tormagd.control.believe.strength import UNSEEN
from tormagd.control.records import Outside
from tormagd.control.safety.codes import Fault, Limit
from tormagd.control.safety.operating_state import SafetyState
from tormagd.element.model.displacement import Turn
from tormagd.ground.plain_values import InexactError, first_difference, kinds, packed, plain, restore, restored
from tormagd.hardware.link_statistics import RoundTrip
from tormagd.record.stream import KNOWN

ROOT = Path(__file__).parents[2]
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


@settings(max_examples=25)
@given(THINGS)
def test_what_comes_back_is_what_went(thing: object) -> None:
    back = through_msgpack(thing)
    assert type(back) is type(thing)
    assert packed(plain(back)) == packed(plain(thing))
    assert first_difference(plain(thing), plain(back)) is None


def test_floats_keep_their_bits() -> None:
    for number in (-0.0, math.nan, struct.unpack(">d", b"\x7f\xf8\x00\x00\x00\x00\x12\x34")[0], 0.1 + 0.2):
        assert struct.pack(">d", through_msgpack(Turn(number, 0.0, 0.0)).direction) == struct.pack(">d", number)


def test_sentinels_come_back_equal() -> None:
    assert [through_msgpack(each) for each in (NOTHING_LEARNED, UNSEEN)] == [NOTHING_LEARNED, UNSEEN]


def test_differences_have_a_name(core: Core) -> None:
    one, other = core.stepper(), core.stepper()
    one.safety = SafetyState(faults=(Fault.SKEW,))
    other.safety = one.safety.replaced(request_number=7)
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


def test_stages_in_the_middle_of_a_run_go_on_in_others_to_the_bit(fly: Any, core: Core) -> None:
    flight = fly(until_s=6.0)
    loop, planner = flight.loop, flight.planner
    stepper_again, planner_again = core.stepper(), core.planner()
    for own, new in ((loop.stepper, stepper_again), (planner, planner_again)):
        restore(new, msgspec.msgpack.decode(packed(plain(own))), KNOWN)
        assert first_difference(plain(own), plain(new)) is None
    assert planner.governor.forecast.trust > 0.0
    for tick in range(400):
        planned, setpoint = planner.planned, asked(loop.now_s)
        sample = loop.tick(setpoint)
        if planner.planned is not planned:
            assert planner_again.plan(sample.time_s, setpoint, stepper_again.measured) == planner.planned
            planner_again.governor.foresee()
        assert stepper_again.step(sample.time_s, sample.measurement, planner_again.planned) == sample.output
        if tick % 50 == 0:
            assert first_difference(plain(loop.stepper), plain(stepper_again)) is None
            assert first_difference(plain(planner), plain(planner_again)) is None


def test_what_changes_in_a_stage_is_annotated_in_its_class_or_made_at_its_beginning() -> None:
    of_bases = {"Actuator": {"self.reference", "self.acceleration_scale", "self.acted"}}
    for path in (ROOT / "tormagd" / "control").rglob("*.py"):
        for kind in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(kind, ast.ClassDef):
                named = [ast.unparse(it.target) for it in kind.body if isinstance(it, ast.AnnAssign)]
                inside = [it for method in kind.body if isinstance(method, ast.FunctionDef) for it in ast.walk(method)]
                annotated = [it for it in inside if isinstance(it, ast.AnnAssign)]
                final = [ast.unparse(it.target) for it in annotated if "Final" in ast.unparse(it.annotation)]
                attributes = [it for it in inside if isinstance(it, ast.Attribute) and isinstance(it.ctx, ast.Store)]
                own = {ast.unparse(it) for it in attributes if isinstance(it.value, ast.Name) and it.value.id == "self"}
                begun = [it for it in kind.body if isinstance(it, ast.FunctionDef) and it.name == "__init__"]
                made = [ast.unparse(it) for method in begun for it in ast.walk(method) if it in attributes]
                public = {f"self.{name}" for name in named} | {*made}
                public = {name for name in public if not name.startswith("self._")}
                public |= set().union(*(of_bases.get(ast.unparse(base), set()) for base in kind.bases))
                assert own - {*final} <= public, f"{path}: {kind.name}"


@pytest.mark.parametrize("change", [{"time_s": None}, {"unheard": 1.0}, {"safety": {"Unheard": {}}}, {"homing": 1.0}])
def test_a_stage_takes_its_own_fields_and_no_others(core: Core, change: dict[str, Any]) -> None:
    fields = plain(core.stepper())["Stepper"] | change
    told = {name: field for name, field in fields.items() if field is not None or name not in change}
    with pytest.raises(InexactError):
        restore(core.stepper(), {"Stepper": told}, KNOWN)


ROUND_TRIP = plain(RoundTrip())["RoundTrip"]


@pytest.mark.parametrize(
    "data",
    [
        *(None, {}, {"RoundTrip": 1}, {"RoundTrip": {"_lead": 1}}, {"DeviceLink": {}}),
        *({"RoundTrip": ROUND_TRIP | {name: {"Unheard": {}}}} for name in ("_recent", "_sent_s")),
    ],
)
def test_what_nobody_remembers_is_refused(data: Any) -> None:
    with pytest.raises(InexactError):
        restore(RoundTrip(), data, KNOWN)
