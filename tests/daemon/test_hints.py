"""Whoever follows `next:` word for word gets what was wished, and arms only for a force."""

import pytest

from tormagd.daemon.arming import Arming
from tormagd.safety.codes import Fault
from tormagd.safety.operating_state import (
    COMMANDS,
    Conditions,
    DeviceRequest,
    OperatingState,
    RefusedError,
    SafetyState,
    command,
    homed_again,
)

DISABLED, ENABLED, PAUSED, FAULT = OperatingState
READY = Conditions(connected=True, fresh=True, homed=True, busy=False, device_latched=False)
FORCE = ("enable", "resume", "arm")
WISHED = {
    **dict.fromkeys(FORCE, (ENABLED,)),
    **dict.fromkeys(("disable", "home", "use-scene"), (DISABLED,)),
    "pause": (PAUSED, DISABLED),  # nothing follows a setpoint
    "stop": (FAULT,),
    "clear-fault": (DISABLED, ENABLED, PAUSED),
}
CONDITIONS: dict[str, dict[str, bool | float]] = {
    "ready": {},
    "lost by a fault": {},
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
"What is wrong with a device, by the code of the refusal."


class Console:
    """`given` are the commands, `hints` those that were followed."""

    def __init__(self, state: OperatingState, amiss: str) -> None:
        faults = (Fault.STOPPED,) if state is FAULT else ()
        self.state = SafetyState(state, faults, needs_homing=amiss == "lost by a fault" and state in (DISABLED, FAULT))
        self.present = READY.replaced(**CONDITIONS[amiss])
        self.given: list[str] = []
        self.hints: list[str] = []

    def give(self, name: str) -> None:
        self.given.append(name)
        if name == "arm":
            self.arm()
            return
        before, self.state = self.state, command(self.state, name, 0.0, self.present)
        if self.state.request_number > before.request_number:
            is_clear = self.state.request is DeviceRequest.CLEAR
            self.present = self.present.replaced(busy=not is_clear, device_latched=False)

    def wait(self) -> None:
        if self.state.request is DeviceRequest.HOME:
            self.state = homed_again(self.state, is_homed=False)
            self.present = self.present.replaced(homed=True, apart_mm=0.0)
        self.present = self.present.replaced(busy=False)

    def arm(self) -> None:
        arming, now_s = Arming(0.0, self.state.faults), 0.0
        while not arming.is_over:
            arming.advance(now_s, self.state, self.present, self.give)
            self.wait()
            now_s += 1.0
        if arming.refusal is not None:
            raise arming.refusal

    def wish(self, name: str) -> None:
        while len(self.hints) <= 2:
            try:
                self.give(name)
            except RefusedError as error:
                if error.hint == "nothing to do":
                    return
                self.follow(error)
            else:
                return

    def follow(self, refused: RefusedError) -> None:
        self.hints.append(refused.hint)
        name = refused.hint.removeprefix("tormagctl ")
        if name in (*COMMANDS, "arm"):
            self.wish(name)
        elif refused.code == "busy":
            self.wait()
        else:
            mended = CONDITIONS[refused.code]
            self.present = self.present.replaced(**{key: getattr(READY, key) for key in mended})


@pytest.mark.parametrize("amiss", CONDITIONS)
@pytest.mark.parametrize("state", OperatingState)
@pytest.mark.parametrize("name", [*COMMANDS, "arm"])
def test_two_hints_lead_to_what_was_wished_and_none_arms_without_a_wish(
    name: str, state: OperatingState, amiss: str
) -> None:
    if amiss == "not_connected" and state in (ENABLED, PAUSED):
        return  # no such state: LINK_LOST comes with the loss
    console = Console(state, amiss)
    console.wish(name)
    assert console.state.operating_state in WISHED[name], console.hints
    assert len(console.hints) <= 2
    assert name in FORCE or {"arm", "enable", "resume"}.isdisjoint(console.given), console.hints
