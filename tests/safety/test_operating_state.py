"""Armed on purpose, opened on every fault, never re-armed by itself; and every code is explained."""

import pytest
from hypothesis import given, strategies as st

from firmware_protocol.codec import DeviceFault
from tormagd.control.safety.codes import FAULTS, LIMITS, Fault, Limit, Position, device_faults
from tormagd.control.safety.operating_state import (
    CLEARING_S,
    COMMANDS,
    ROWS,
    TRANSITIONS,
    Conditions,
    Event,
    OperatingState,
    Refusal,
    RefusedError,
    SafetyState,
    Transition,
    command,
    homed_again,
    latch,
    next_commands,
    reason,
)
from tormagd.hardware.measurement import DeviceRequest

READY = Conditions(connected=True, fresh=True, homed=True, busy=False, device_latched=False)
NEED_NO_DEVICE = ("stop", "use-scene")
DISABLED, ENABLED, PAUSED, FAULT = OperatingState
FAULTED, SKEWED = (latch(SafetyState(), (fault,)) for fault in (Fault.DEVICE_OVERCURRENT, Fault.SKEW))


def refusal(state: SafetyState, name: str, present: Conditions = READY) -> RefusedError:
    with pytest.raises(RefusedError) as caught:
        command(state, name, 0.0, present)
    assert caught.value.message
    assert caught.value.hint
    return caught.value


FIGURES = {
    "skewed": " mm apart: allowed is at most 1 mm",
    "link_degraded": "the round trip to the device is 11.1 ms: allowed is at most 11.0 ms, or the carriages swing",
    "clock": "10.1%: allowed is 10%",
    "not_fresh": "no fresh measurement from the device: no Sense yet",
}


@pytest.mark.parametrize(
    ("name", "changes", "code"),
    [
        ("enable", {"connected": False}, "not_connected"),
        ("enable", {"device_latched": True}, "device_latched"),
        ("enable", {"busy": True}, "busy"),
        ("enable", {"homed": False}, "not_homed"),
        ("enable", {"fresh": False, "cause": "no Sense yet"}, "not_fresh"),
        ("enable", {"sensor_doubted": True}, "sensor_doubted"),
        ("enable", {"apart_mm": 1.01, "most_apart_mm": 1.0}, "skewed"),
        ("enable", {"apart_mm": float("nan"), "most_apart_mm": 1.0}, "skewed"),
        ("enable", {"round_trip_s": 0.0111, "most_round_trip_s": 0.011}, "link_degraded"),
        ("enable", {"clock_drift": -0.101, "most_clock_drift": 0.1}, "clock"),
        ("enable", {"clock_drift": 0.101, "most_clock_drift": 0.1}, "clock"),
        ("home", {"device_latched": True}, "device_latched"),
        ("home", {"busy": True}, "busy"),
        ("clear-fault", {"busy": True}, "busy"),
    ],
)
def test_what_a_command_wants_and_has_not_is_said(name: str, changes: dict[str, bool | float], code: str) -> None:
    refused = refusal(SafetyState(), name, READY.replaced(**changes))
    assert refused.code == code
    assert code != "device_latched" or refused.hint == (ARM if name == "enable" else CLEAR)
    assert FIGURES.get(code, "") in refused.message


def test_only_a_missing_device_has_a_remedy_of_its_own() -> None:
    missing = READY.replaced(connected=False, cause="no port", remedy="plug it in")
    refused = refusal(SafetyState(), "enable", missing)
    assert (refused.message, refused.hint) == ("the device is not connected: no port", "plug it in")
    assert refusal(SafetyState(), "enable", missing.replaced(connected=True, homed=False)).hint == "tormagctl arm"


OPENED = (DISABLED, DeviceRequest.RETRACT)
STOPPED = (FAULT, DeviceRequest.RETRACT)
ARM, CLEAR = "tormagctl arm", "tormagctl clear-fault"
TAKEN: dict[str, tuple[OperatingState | tuple[OperatingState, DeviceRequest] | str, ...]] = {
    # in DISABLED, ENABLED, PAUSED, FAULT
    "enable": (ENABLED, "nothing to do", "tormagctl resume", ARM),
    "disable": (OPENED, OPENED, OPENED, CLEAR),
    "pause": ("nothing to do", PAUSED, "nothing to do", CLEAR),
    "resume": (ARM, "nothing to do", ENABLED, ARM),
    "home": ((DISABLED, DeviceRequest.HOME), "tormagctl disable", "tormagctl disable", CLEAR),
    "stop": (STOPPED, STOPPED, STOPPED, STOPPED),
    "clear-fault": (DISABLED, ENABLED, PAUSED, DISABLED),
    "use-scene": (DISABLED, "tormagctl disable", "tormagctl disable", CLEAR),
}
"Where each command leads and what it asks of the device, or the hint where it is refused."


@pytest.mark.parametrize("present", OperatingState)
@pytest.mark.parametrize("name", COMMANDS)
def test_each_command_in_each_state(name: str, present: OperatingState) -> None:
    state = FAULTED if present is FAULT else SafetyState(present)
    wanted = TAKEN[name][list(OperatingState).index(present)]
    if isinstance(wanted, str) and not isinstance(wanted, OperatingState):
        refused = refusal(state, name)
        row = TRANSITIONS[Event(name), present]
        assert (refused.code, refused.hint) == (row.code, wanted)
        if present is FAULT:
            assert (refused.code, Fault.DEVICE_OVERCURRENT in refused.message) == ("fault", True)
        else:
            assert refused.message == (f"already {present}" if name == "enable" else f"cannot {name} while {present}")
        return
    if name not in NEED_NO_DEVICE:
        assert refusal(state, name, READY.replaced(connected=False, fresh=False)).code == "not_connected"
    after = command(state, name, 0.0, READY)
    has_asked = after.request_number > state.request_number
    assert ((after.operating_state, after.request) if has_asked else after.operating_state) == wanted
    assert after.is_driven is (after.operating_state in (ENABLED, PAUSED))


def test_stop_is_taken_without_a_device() -> None:
    assert command(SafetyState(), "stop", 0.0, READY.replaced(connected=False, fresh=False)).faults == (Fault.STOPPED,)


def test_an_unknown_command_lists_the_known_ones() -> None:
    refused = refusal(SafetyState(), "detonate")
    assert (refused.code, refused.message, refused.hint) == (
        "unknown_command",
        "no command 'detonate'",
        f"commands: status, describe, arm, take, confirm, mark, blackbox, {', '.join(COMMANDS)}",
    )


def test_clearing_asks_the_device_only_where_it_has_latched_too() -> None:
    ours = command(FAULTED, "clear-fault", 2.0, READY)
    assert (ours.operating_state, ours.faults, ours.request_number) == (DISABLED, (), FAULTED.request_number)
    both = command(FAULTED, "clear-fault", 2.0, READY.replaced(device_latched=True))
    assert (both.request, both.request_number, both.clearing_until_s) == (
        DeviceRequest.CLEAR,
        FAULTED.request_number + 1,
        2.0 + CLEARING_S,
    )
    assert command(both, "enable", 2.1, READY).clearing_until_s < 0.0, "enabling ends the wait for it to go"


@pytest.mark.parametrize("present", [ENABLED, PAUSED])
@pytest.mark.parametrize("device_latched", [False, True])
def test_clearing_while_driven_hides_no_fault_of_the_device(present: OperatingState, device_latched: bool) -> None:
    state = SafetyState(present)
    assert command(state, "clear-fault", 2.0, READY.replaced(device_latched=device_latched)) == state


@pytest.mark.parametrize("fault", [Fault.NO_MOTION, Fault.FOLLOWING_ERROR, Fault.SKEW])
def test_an_encoder_fault_takes_homing_away_until_the_device_has_homed_again(fault: Fault) -> None:
    latched = latch(latch(SafetyState(), (Fault.LINK_LOST, fault)), (Fault.STOPPED,))
    cleared = command(latched, "clear-fault", 2.0, READY)
    refused = refusal(homed_again(cleared, is_homed=True), "enable")
    assert (refused.code, refused.hint) == ("not_homed", "tormagctl arm")
    asked = command(cleared, "home", 2.0, READY)
    assert refusal(asked, "enable").code == "not_homed"
    homing = homed_again(asked, is_homed=False)
    assert command(homed_again(homing, is_homed=True), "enable", 2.0, READY).operating_state is ENABLED


def test_faults_are_kept_in_the_order_they_came() -> None:
    assert latch(latch(SafetyState(), (Fault.SKEW,)), (Fault.STOPPED, Fault.SKEW, Fault.LINK_LOST)).faults == (
        Fault.SKEW,
        Fault.STOPPED,
        Fault.LINK_LOST,
    )


@given(found=st.lists(st.sampled_from(Fault), unique=True, max_size=len(Fault)))
def test_faults_that_show_at_once_are_named_in_the_order_of_their_table(found: list[Fault]) -> None:
    assert latch(SafetyState(), tuple(found)).faults == tuple(fault for fault in Fault if fault in found)


def test_the_table_has_a_row_for_every_event_in_every_state() -> None:
    assert len(TRANSITIONS) == len(ROWS) == len(Event) * len(OperatingState)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row.event} in {row.source}")
def test_a_row_says_why_it_is_and_what_its_guards_want(row: Transition | Refusal) -> None:
    is_taken = isinstance(row, Transition)
    assert reason(row.event, row.source) == (f"{row.source} to {row.target}: {row.reason}" if is_taken else "")
    assert all(guard.wants and guard.remedy for guard in (row.guards if is_taken else ()))


@pytest.mark.parametrize(
    ("state", "is_homed", "commands"),
    [
        (SafetyState(OperatingState.ENABLED), True, ()),
        (SafetyState(OperatingState.PAUSED), True, ("resume",)),
        (SafetyState(), True, ("enable",)),
        (SafetyState(), False, ("home", "enable")),
        (SafetyState(needs_homing=True), True, ("home", "enable")),
        (SafetyState(OperatingState.FAULT, (Fault.STOPPED,)), True, ("clear-fault", "enable")),
        (SafetyState(OperatingState.FAULT, (Fault.STOPPED,)), False, ("clear-fault", "home", "enable")),
        (SafetyState(OperatingState.FAULT, (Fault.STOPPED, Fault.LINK_LOST)), True, ("clear-fault", "home", "enable")),
        (SafetyState(OperatingState.FAULT, (Fault.SKEW,)), True, ("clear-fault", "home", "enable")),
    ],
)
def test_the_next_commands_lead_to_a_force_that_is_followed(
    state: SafetyState, is_homed: bool, commands: tuple[str, ...]
) -> None:
    assert next_commands(state, is_homed) == commands


@pytest.mark.parametrize("fault", Fault)
def test_the_next_commands_of_each_fault_are_taken_and_arm_it(fault: Fault) -> None:
    state = latch(SafetyState(OperatingState.ENABLED), (fault,))
    is_homed = FAULTS[fault].position is not Position.LOST_THERE
    commands = next_commands(state, is_homed)
    assert ", then ".join(commands[:-1]) == FAULTS[fault].clears
    for name in commands:
        state = command(state, name, 0.0, READY.replaced(homed=is_homed))
        if name == "home":
            is_homed, state = True, homed_again(state, is_homed=False)
    assert (state.operating_state, next_commands(state, is_homed)) == (OperatingState.ENABLED, ())


FORCE = ("enable", "resume", "arm")
WISHED = {
    **dict.fromkeys(FORCE, (ENABLED,)),
    **dict.fromkeys(("disable", "home", "use-scene"), (DISABLED,)),
    "pause": (PAUSED, DISABLED),  # nothing follows a setpoint
    "stop": (FAULT,),
    "clear-fault": (DISABLED, ENABLED, PAUSED),
}
"""The states in which a command's wish is fulfilled."""
AMISS: dict[str, dict[str, bool | float]] = {
    "": {},
    "not_homed": {"homed": False},
    "device_latched": {"device_latched": True, "homed": False},
    "not_connected": {"connected": False},
    "busy": {"busy": True},
    "not_fresh": {"fresh": False},
    "sensor_doubted": {"sensor_doubted": True},
    "skewed": {"apart_mm": 2.0, "most_apart_mm": 1.0},
    "link_degraded": {"round_trip_s": 0.2, "most_round_trip_s": 0.1},
    "clock": {"clock_drift": 0.2, "most_clock_drift": 0.1},
}
"""What is amiss with a device, by the code of the refusal that it leads to."""


class Person:
    """Gives commands to a device that does at once what it is asked for, and follows the hints of refusals, two at
    most."""

    def __init__(self, state: SafetyState, present: Conditions) -> None:
        self.state, self.present, self.hints = state, present, list[str]()

    def give(self, name: str) -> None:
        self.state = command(self.state, name, 0.0, self.present)
        if self.state.request is DeviceRequest.HOME:
            self.state = homed_again(self.state, is_homed=False)
            self.present = self.present.replaced(homed=True, apart_mm=0.0)
        elif self.state.request is DeviceRequest.CLEAR:
            self.present = self.present.replaced(device_latched=False)

    def wish(self, name: str) -> None:
        try:
            for each in next_commands(self.state, self.present.homed) if name == "arm" else (name,):
                self.give(each)
        except RefusedError as error:
            if error.hint == "nothing to do":
                return
            self.hints.append(error.hint.removeprefix("tormagctl "))
            assert len(self.hints) <= 2, self.hints
            if self.hints[-1] in WISHED:
                self.wish(self.hints[-1])
            else:
                self.present = self.present.replaced(**{key: getattr(READY, key) for key in AMISS[error.code]})
            self.wish(name)


@pytest.mark.parametrize("amiss", AMISS)
@pytest.mark.parametrize(
    "state",
    [SafetyState(), SafetyState(ENABLED), SafetyState(PAUSED), SafetyState(needs_homing=True), FAULTED, SKEWED],
)
@pytest.mark.parametrize("name", WISHED)
def test_two_hints_lead_to_what_was_wished_and_none_arms_without_a_wish(
    name: str, state: SafetyState, amiss: str
) -> None:
    # a device that is lost while it is driven is in FAULT at once
    person = Person(state, READY.replaced(**AMISS["" if state.is_driven and amiss == "not_connected" else amiss]))
    person.wish(name)
    assert person.state.operating_state in WISHED[name], person.hints
    assert name in FORCE or not set(FORCE) & set(person.hints)


@pytest.mark.parametrize(
    "bits", [DeviceFault(0), *DeviceFault, DeviceFault.SUPPLY | DeviceFault.SKEW, DeviceFault(sum(DeviceFault))]
)
def test_every_device_fault_is_a_fault_of_its_own_and_a_stalled_hosts_timeout_the_hosts(bits: DeviceFault) -> None:
    names = [f"DEVICE_{bit.name}" for bit in bits]
    stalled = ["HOST_STALL" if name == "DEVICE_COMMAND_TIMEOUT" else name for name in names]
    assert (device_faults(bits), device_faults(bits, is_host_stall=True)) == (tuple(names), tuple(stalled))


def test_codes_are_their_names_and_each_is_explained_in_the_order_of_its_table() -> None:
    assert all(code.value == code.name for kind in (Fault, Limit) for code in kind)
    assert (tuple(FAULTS), tuple(LIMITS)) == (tuple(Fault), tuple(Limit))
    rows = [*FAULTS.values(), *LIMITS.values()]
    assert all(row.cause and row.remedy and row.shows and row.safe_ms > 0.0 for row in rows)
    assert len({row.cause for row in rows}) == len(rows), "an explanation of its own"
    latched = [row for fault, row in FAULTS.items() if fault.startswith("DEVICE_")]
    assert {row.position for row in latched} == {Position.LOST_THERE}
