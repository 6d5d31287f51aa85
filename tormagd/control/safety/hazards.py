"""What harm may come of each hazard, and causes that no code names, in the terms of ISO 14971.

It is written for a person who analyses the risk of a device, and certifies nothing.
"""

from typing import Final, NamedTuple

from firmware_protocol.conformance.check import Hazard

HARMS: Final[dict[Hazard, str]] = {
    Hazard.SHUT: "a hand that cannot draw back what it moves",
    Hazard.CLOSES: "a hand that is stopped in the middle of a motion, or pushes against what is not there",
    Hazard.OPENS: "a hand that stumbles forward where it leaned against a force",
    Hazard.MISLED: "a motion that was decided by a wrong force",
    Hazard.WORN: "none at once; the device fails later",
}
"The harm that may come of each."


class Cause(NamedTuple):
    """A cause that no code of its own names."""

    name: str
    hazard: Hazard
    cause: str
    control: str = ""
    "Empty where nothing can be done."
    test: str = ""
    "As FILE::FUNCTION within tests."
    cell: str = ""
    "A row of the fault matrix."


CAUSES: Final = (
    Cause("no_supply", Hazard.SHUT, "the motors have no supply: nothing opens the gap, and friction holds the force"),
    Cause(
        "killed",
        Hazard.SHUT,
        "the daemon is killed or stopped, or takes no processor time",
        "the device opens by itself after 50 ms",
        "end_to_end/test_daemon.py::test_a_daemon_that_is_killed_unplugged_and_ended",
        "daemon killed or cable cut",
    ),
    Cause(
        "bus_off",
        Hazard.SHUT,
        "a node leaves the CAN bus (bus-off)",
        "LINK_LOST; the device opens by itself after 50 ms",
        "hardware/test_connection.py::test_each_trouble_has_its_state_cause_and_remedy_and_goes_when_it_is_mended",
        "cable pulled: nothing goes either way",
    ),
    Cause(
        "flood",
        Hazard.SHUT,
        "requests or setpoints come in a flood, and a stop waits",
        "stop and disable go first; what is read is bounded",
        "daemon/test_endpoint.py::test_a_flood_is_drained_in_bounded_portions",
    ),
    Cause(
        "turns_round",
        Hazard.CLOSES,
        "a motor turns round in the middle of a run: WRONG_DIRECTION after 31 ms, but the device's own opening presses "
        "that side shut",
    ),
    Cause(
        "homes_shut",
        Hazard.CLOSES,
        "a firmware that watches no direction homes the wrong way: WRONG_DIRECTION after 3 mm, but no host can stop a "
        "homing",
    ),
    Cause(
        "worn_out", Hazard.CLOSES, "the gearbox is worn out, and the motors have no supply: the magnets close the gap"
    ),
    Cause(
        "damage",
        Hazard.OPENS,
        "an adapter or a driver damages Sense or Status, which carry no checksum of their own",
        "it is named as a fault of the device; no force is lost faster than in any fault",
        "hardware/test_contract.py::test_on_any_line_the_output_keeps_its_limits_and_what_is_wrong_has_a_name",
        "5% of the frames damaged",
    ),
    Cause(
        "scale",
        Hazard.MISLED,
        "encoders count too much: the closed switch, which would contradict them, is never reached",
    ),
    Cause(
        "clock_set",
        Hazard.MISLED,
        "a publisher's clock is set",
        "its offset is estimated anew; the daemon's own is monotonic",
        "daemon/test_inbox.py::test_a_clock_that_is_set_makes_no_setpoint_older_or_younger",
        "publisher's clock set forward by an hour",
    ),
    Cause(
        "real_device",
        Hazard.MISLED,
        "a real device does not keep the protocol: the firmware that runs today is the simulated one's",
        "the conformance kit, below",
        "firmware_protocol/test_conformance.py::test_the_c_sources_pass",
    ),
)
