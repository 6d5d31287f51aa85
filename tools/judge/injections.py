"""The faults of the matrix: where each is put, how it must be named, and how it must end."""

from functools import partial
from typing import NamedTuple

from bad_lines import MakeTransfer, damaging, delaying, doubling, losing, reordering, whole

OPENS = "opens"
"The gap is open and the force below 1 N."
HELD = "held"
"The force goes on as asked, and no fault opens the gap."
FOLLOWED = "followed"
"The force goes to what is asked now, and no fault opens the gap."
LIMITED = "limited"
"The force stays within the scene's range, and no fault opens the gap."
HELD_OR_OPENS = "held or opens"
STAYS = "stays"
"Nothing can open the gap, or nothing has been driven: it closes by at most MAX_CLOSED_MM."

SERIAL, CAN = "serial", "can"


class Injection(NamedTuple):
    """A fault: of the simulated device (a `--fault` word), of the host, of the publisher, or of the line."""

    name: str
    names: tuple[str, ...]
    safe: str = OPENS
    device: str | None = None
    host: str | None = None
    stall_ms: int = 0
    way: MakeTransfer = whole
    fill_frames_ms: float = 0.0
    sensor: str | None = None
    publisher: str | None = None
    within_ms: float | None = None
    "When the reaction must have begun, unless the table of codes says so."
    is_driven: bool = True
    buses: tuple[str, ...] = (SERIAL, CAN)

    @property
    def passes(self) -> bool:
        return bool(self.stall_ms) or self.host in ("stop", "disable") or self.device in PASSING


NOTHING = Injection("", ())
PASSING = ("reset", "frozen", "encoder_jump", "encoder_jump_left")

MATRIX = (
    Injection("daemon killed or cable cut", ("device:COMMAND_TIMEOUT",), host="silent"),
    Injection("daemon stalls for 45 ms", ("HOST_STALL",), HELD, stall_ms=45),
    Injection("daemon stalls for 83 ms", ("HOST_STALL",), stall_ms=83),
    Injection("device hears nothing", ("MEASUREMENT_STALE",), device="commands_vanish"),
    Injection("device resets", ("DEVICE_NOT_RUNNING",), device="reset"),
    Injection("motor supply fails", ("DEVICE_SUPPLY",), STAYS, device="supply_loss"),
    Injection("left encoder stuck", ("NO_MOTION",), device="encoder_stuck_left"),
    Injection("left drag +50%", (), HELD, device="drag_left=+50%"),
    Injection("worn gearbox", (), HELD, device="worn_gearbox"),
    Injection("worn gearbox, then daemon killed", ("device:COMMAND_TIMEOUT",), device="worn_gearbox", host="silent"),
    Injection("publisher silent", ("STALE",), host="stale"),
    Injection("another source takes over", (), FOLLOWED, host="other"),
    Injection("operator: stop", ("STOPPED",), host="stop"),
    Injection("operator: disable", (), host="disable"),
    Injection(
        "operator: disable, and the gap does not open",
        ("NOT_OPENING", "DEVICE_RETRACT_FAILED"),
        STAYS,
        device="opening=-100%",
        host="disable",
    ),
    Injection(
        "operator: disable, and the gap opens too slowly", ("NOT_OPENING",), device="opening=-60%", host="disable"
    ),
    # one of its streams stops
    Injection("no State any more", ("MEASUREMENT_STALE",), device="no_state"),
    Injection("no Sense any more", ("SENSE_STALE",), device="no_sense"),
    Injection("no Status any more", ("STATUS_STALE",), device="no_status"),
    Injection("wrong CRC-8 in State", ("MEASUREMENT_STALE",), device="state_crc"),
    # measurements against physics
    Injection("both encoders jump by 4 mm", ("ENCODER",), device="encoder_jump"),
    Injection("left encoder jumps by 4 mm", ("ENCODER", "DEVICE_SKEW"), device="encoder_jump_left"),
    Injection("left encoder turns round", ("WRONG_DIRECTION",), device="encoder_reversed_left"),
    Injection("duties taken the other way", ("WRONG_DIRECTION",), device="duties_reversed"),
    Injection("device clock 2% fast", ("CLOCK",), HELD, device="clock=+2%"),
    Injection("device clock 30% slow", ("CLOCK",), device="clock=-30%"),
    # the line
    Injection("5% of the frames lost", ("LINK_DEGRADED",), HELD, way=partial(losing, 0.05)),
    Injection(
        "5% of the frames damaged",
        ("LINK_DEGRADED", "LINK_LOST"),
        HELD_OR_OPENS,
        way=partial(damaging, 0.05),
        within_ms=1_000.0,  # a Hello that is hit opens the device at once, States have to be counted
    ),
    Injection("every frame twice", (), HELD, way=doubling),
    Injection("20% of the frames overtaken", (), HELD, way=partial(reordering, 0.2)),
    Injection("round trip of 7 ms", ("LINK_DEGRADED",), HELD, way=partial(delaying, 0.003)),
    Injection("round trip of 15 ms", ("LINK_DEGRADED",), way=partial(delaying, 0.007)),
    Injection("every other Drive answered", ("LINK_DEGRADED",), HELD, device="answers_half"),
    Injection("bus full", ("LINK_DEGRADED", "STATUS_STALE"), HELD_OR_OPENS, fill_frames_ms=7.4, buses=(CAN,)),
    Injection("cable pulled: nothing goes either way", ("LINK_LOST", "MEASUREMENT_STALE"), way=partial(losing, 1.0)),
    Injection("daemon stalls for 12 ms, ten times a second", ("HOST_STALL",), HELD, host="hogged"),
    Injection(
        "firmware hangs, its watchdog resets it",
        ("MEASUREMENT_STALE",),
        device="frozen",
        within_ms=151.0,  # nothing can act before the watchdog, after 100 ms
    ),
    # the force sensor and the handle
    Injection("force sensor stuck", ("SENSOR",), sensor="stuck"),
    Injection("force sensor 0.8 N too high", ("DEVICE_OR_SENSOR",), LIMITED, sensor="high"),
    Injection("force sensor 0.8 N too low", ("DEVICE_OR_SENSOR",), HELD, sensor="low"),
    Injection("force sensor at its end", ("OVER_FORCE",), sensor="saturated"),
    Injection("force sensor reads nothing", ("SENSOR",), sensor="dead"),
    Injection("handle's encoder lost", ("HANDLE_LOST",), HELD, device="no_handle"),
    # motors, screws, switches, temperature
    Injection("left carriage blocked", ("NO_MOTION", "SKEW", "FOLLOWING_ERROR"), STAYS, device="blocked_left"),
    Injection(
        "both carriages blocked",
        ("NO_MOTION", "FOLLOWING_ERROR"),
        STAYS,
        device="blocked_left blocked_right",
    ),
    Injection("left motor without current", ("NO_MOTION", "SKEW", "FOLLOWING_ERROR"), STAYS, device="motor_dead_left"),
    Injection("backlash of the screws x10", (), HELD, device="backlash=+900%"),
    Injection("device too hot", ("DEVICE_TEMPERATURE",), device="overheated"),
    Injection("left closed end stop reported", ("DEVICE_END_STOP",), device="end_stop_left"),
    Injection("left open switch stuck", ("OUT_OF_STROKE",), STAYS, device="switch_stuck_left"),
    # setpoints, through the daemon's own border
    Injection("setpoints of NaN", ("STALE",), publisher="nan"),
    Injection("setpoints below 0", ("STALE",), publisher="negative"),
    Injection("setpoints far over the range", ("RANGE",), LIMITED, publisher="huge"),
    Injection("setpoints out of order", ("OTHER_SOURCE",), HELD, publisher="disordered"),
    Injection(
        "setpoints of a second ago, played again beside the new ones", ("OTHER_SOURCE",), HELD, publisher="replayed"
    ),
    Injection("a second source that does not hold the brake", ("OTHER_SOURCE",), HELD, publisher="second"),
    Injection("publisher's clock set forward by an hour", (), HELD, publisher="clock"),
    Injection("publisher started again", (), HELD, publisher="restarted"),
    # there from the beginning
    Injection(
        "homing: left motor wired the wrong way",
        ("WRONG_DIRECTION",),
        STAYS,
        "motor_reversed_left",
        is_driven=False,
    ),
    Injection(
        "homing: left encoder counts backwards",
        ("WRONG_DIRECTION",),
        STAYS,
        "encoder_reversed_left",
        is_driven=False,
    ),
    Injection(
        "homing: left switch never closes",
        ("DEVICE_OVERCURRENT",),
        STAYS,
        "switch_dead_left",
        within_ms=6_000.0,  # from the closed end
        is_driven=False,
    ),
    Injection(
        "homing: left open switch stuck",
        ("HOMING",),
        STAYS,
        "switch_stuck_left",
        within_ms=6_000.0,
        is_driven=False,
    ),
    Injection(
        "first motion the wrong way",
        ("WRONG_DIRECTION",),
        OPENS,
        "duties_reversed",
        within_ms=15_000.0,
        is_driven=False,
    ),
    Injection(
        "from the start: no Sense",
        ("not_connected: no Sense yet",),
        STAYS,
        "no_sense",
        is_driven=False,
    ),
    Injection(
        "from the start: no Status",
        ("not_connected: no Status yet",),
        STAYS,
        "no_status",
        is_driven=False,
    ),
    Injection(
        "from the start: wrong CRC-8 in State",
        ("not_connected: State refused: CRC-8",),
        STAYS,
        "state_crc",
        is_driven=False,
    ),
    Injection(
        "from the start: round trip of 15 ms",
        ("link_degraded",),
        STAYS,
        way=partial(delaying, 0.007),
        within_ms=14_100.0,
        is_driven=False,
    ),
    Injection(
        "from the start: device clock 30% slow",
        ("clock",),
        STAYS,
        "clock=-30%",
        within_ms=14_100.0,
        is_driven=False,
    ),
    Injection(
        "from the start: firmware of another protocol",
        ("not_connected: the firmware's protocol schema",),
        STAYS,
        "other_schema",
        is_driven=False,
    ),
)
