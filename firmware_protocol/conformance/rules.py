"""The page's rules as data: what each mode takes, which messages are refused everywhere, and which check finds what.

`taking` makes its checks from TAKES and the REFUSED; a test compares both, and the words of RULES, with the page.
"""

from collections.abc import Callable
from typing import Any, Final

from firmware_protocol.codec import FUNCTION, Identity, State

MODES: Final = ("IDLE", "RUN", "HOMING", "RETRACTING", "LATCHED")
TAKES: Final = {
    "Drive OFF": ("answered", "RETRACTING", "answered", "answered", "answered"),
    "Drive RUN": ("RUN, or answered", "obeyed", "answered", "answered", "answered"),
    "Hello that fits": ("Identity",) * 5,
    "Hello that does not": ("LATCHED", "RETRACTING", "RETRACTING", "goes on, with the fault", "another fault"),
    "Retract": ("RETRACTING", "RETRACTING", "RETRACTING, not homed", "accepted, goes on", "refused"),
    "Home": ("HOMING", "refused", "refused", "refused", "refused"),
    "Clear": ("accepted, nothing to do", "refused", "refused", "refused", "IDLE, or refused while the cause lasts"),
}
"The page's table: a message's cells in the order of MODES."
NEVER_FOLLOWS: Final = {"RUN": ("IDLE", "HOMING", "LATCHED"), "LATCHED": ("RUN", "HOMING")}
"Modes that the page's diagram does not lead to from one within a Status."
REFUSED_DRIVES: Final[dict[str, dict[str, Any]]] = {
    "a left duty of 1.0001": {"left": 10_001},
    "a left duty of -1.0001": {"left": -10_001},
    "a left duty of -3.2768": {"left": -32_768},
    "a right duty of 1.0001": {"right": 10_001},
    "a right duty of -1.0001": {"right": -10_001},
    "a right duty of 3.2767": {"right": 32_767},
    "mode 2": {"mode": 2},
    "mode 129": {"mode": 129},
    "mode 255": {"mode": 255},
    "the counter of the one before": {"ahead": 0},
    "a wrong CRC-8": {"crc": 1},
    "another wrong CRC-8": {"crc": 0x80},
    "6 bytes": {"length": 6},
    "6 bytes, their CRC-8 right": {"body": 5},
    "8 bytes": {"length": 8},
    "8 bytes, their CRC-8 right": {"body": 7},
    "no bytes": {"length": 0},
    **{f"function {number}": {"function": number} for number in (10, 66, 127, FUNCTION[State], FUNCTION[Identity])},
}
"Drives, OFF and RUN, that change nothing: where each differs from a good one."
REFUSED_COMMANDS: Final[dict[str, Callable[[bytes], bytes] | None]] = {
    "a byte more": lambda body: body + body[-1:],
    "a zero more": lambda body: body + bytes(1),
    "a byte less": lambda body: body[:-1],
    "no bytes": lambda body: body[:0],
    "the last accepted nonce": None,
}
"Commands that change nothing: the change of length."
RULES: Final = {
    "A sender refuses a value that does not fit.": "own_messages",
    "Classical frames with the 11-bit identifier": "idle_stays",
    "over function, sequence and payload.": "idle_stays",
    "`00` always ends a frame. Empty frames are allowed anywhere.": "frames_as_they_come idle_stays",
    "A receiver counts gaps as lost frames,": "- the device tells nobody what it counts",
    "It drops a frame that equals the one before in every byte, and no other.": "frames_as_they_come",
    "Refuse a payload whose length is not that of its message.": "idle_stays run_stays",
    "Drive and State carry a counter and a CRC-8 of their own": "idle_without_zero_stays own_messages",
    "until Identity answers": "identity_answers_hello",
    "If hash and protocol version are equal, RUN is allowed": "run_drive_off",
    "If either differs, the device latches SCHEMA_MISMATCH, which opens the gap in RUN, and refuses RUN": (
        "misfitting_hello run_hello_misfit"
    ),
    "RUN is also refused, without a fault, before a fitting Hello.": "warm_reset cold_reset",
    "With mode OFF it only asks for measurements.": "idle_stays",
    "only if its CRC-8 is right, its values are in range, and its counter differs": (
        "every_counter latched_stays run_stays run_silence"
    ),
    "answer every accepted Drive at once, in every mode, even two within a millisecond.": (
        "every_drive_answered reports_in_time homing_stays retracting_stays"
    ),
    "Without Drive there are none.": "every_drive_answered",
    "is sent every 20 ms on the device's own clock, with or without a host, whatever its mode.": "reports_in_time",
    "The device acts on a nonce that differs from the last accepted one": "every_nonce latched_stays",
    "A refused command leaves no trace in Status.": "run_stays homing_stays retracting_stays latched_stays",
    "Hello is always answered, and its nonce counts as accepted.": "idle_stays run_stays",
    "in RUN without an accepted Drive the device shows COMMAND_TIMEOUT": "silence_is_noticed any_uptime",
    "At the open end it switches the drives off and is LATCHED.": "run_silence",
    "opens the gap in the same way and latches nothing.": "run_drive_off run_retract left_open",
    "a Drive OFF has to come before the next Drive RUN counts, also after a Clear and a Home.": (
        "let_go_after_all idle_not_let_go_stays homing_beside_run_stays"
    ),
    "The Drive OFF that ends RUN counts.": "run_drive_off",
    "Motors follow the duties only in RUN, from the Drive that enters it on.": (
        "let_go_after_all left_duty right_duty duties_make_currents any_uptime idle_stays"
    ),
    "At the open switch an opening duty counts as 0": "open_switch_stops",
    "LATCHED drops HOMED, and Clear does not restore it.": "latched_clear latched_hello_misfit idle_hello_misfit",
    "IDLE and RUN have no fault.": "status_consistent",
    "SKEW: in RUN, carriages over 2 mm apart": "skew_opens",
    "END_STOP: in RUN, a closed switch": "end_stop_opens",
    "OVERCURRENT: in RUN and HOMING, 0.15 s of a stall's current": "overcurrent",
    "UNCOMMANDED_MOTION: 0.2 mm, with the drives off": "uncommanded_motion",
    "SUPPLY, TEMPERATURE: outside 9 to 15 V, over 60 °C": "status_consistent supply temperature",
    "Clear is refused while a supply, temperature or mismatch fault lasts": "latched_by_a_mismatch_stays supply",
    "the device forgets zero, host and nonce, and is IDLE with the drives off.": "warm_reset cold_reset",
    "The first Drive counts whatever its counter is": "warm_reset cold_reset",
    "A command with nonce 0 repeats the last. A watchdog resets": "warm_reset watchdog",
    "A mismatch of schemas lasts until a Hello that fits.": "misfitting_hello retracting_hello_misfit",
    "brings each carriage to its open switch at the device's own speed": "run_drive_off retracting_stays",
    "At its switch a carriage is braked for 50 ms.": "status_consistent",
    "After 0.2 s it has moved by 0.1 mm, whatever it did before. One that is 2 mm in is open after 0.8 s.": (
        "run_drive_off run_retract"
    ),
    "or latches the fault for which it opened.": "run_silence retracting_after_silence_stays skew_opens",
    "A device that cannot open reports RETRACT_FAILED": "retract_failed",
    "Each encoder's zero is where its switch closes": "home_homes open_switch_stops",
    "The closed switches are 25.25 mm further in here, to 2 %.": "end_stop_opens",
    "Homing ends in IDLE with HOMED, at rest at both switches, within 8 s": "home_homes idle_home idle_retract",
    "The new origin counts from the first State after a Status with HOMED": "home_homes",
    "A carriage that moves 1 mm towards closed while driven open": "- it would take a motor with its leads swapped",
    "Left screw relative to home": "positions_run_on",
    "When the positions were latched, on the device's clock.": "clock_runs_on",
    "sampled with the State it follows.": "- a handle's constant lag, or one of all device times, nothing tells",
    "to 0.3 mm.": "- a zero that is less than that from its switch, as one for both of an even gap",
    "Share of the supply voltage at the left motor": "- its scale only a voltmeter tells",
    "Left motor current; positive": "- its scale only an ammeter tells",
    "positive drives towards open.": "duties_make_currents run_drive_off",
    "A motor at rest reads under 0.02 A, a force is at most 30 ms old.": "plausible_in_each_mode handle_runs_on",
    "Friction force at the roller": "- its scale only a weight tells, and its lag tormagctl commission",
    "positive against a positive motion of the handle.": "handle_runs_on force_follows_gap",
    "Roller surface position:": "handle_runs_on homing_retract homing_hello_misfit",
    "As in Hello, as the device knows it.": "status_consistent",
    "The handle's count starts anywhere: a reset loses its angle.": "handle_runs_on",
    "16384 counts a turn": "- how many a turn only a mark on the handle tells",
    "Temperature at the elastomer's mount.": "- only another thermometer tells",
    "Supply voltage at the motor bridges.": "- only another voltmeter tells; how it follows is for the bench",
    "Serial number of the device.": "- only its label tells",
}
"A sentence of the page, or its beginning, and the checks that hold it; after -, why none can."
