"""What leads out of a fault: the commands that the daemon's own table names, before its cause has gone and after.

An operator does no more: looks which commands lead back, gives each as soon as the device neither homes nor opens,
with the publisher silent, and lets it publish once the brake is enabled. Before the cause has gone that must come to
nothing, or the fault be named all the while; afterwards the force has to be followed again.
"""

from fault_matrix.cases import Injection
from fault_matrix.rig import Rig
from fault_matrix.watch import MOST_OFF_N, MOST_OVER_N, Cell
from tormagd.safety.operating_state import Event, OperatingState, RefusedError, next_commands

MENDED_S = 1.5
"A device that was silent is asked once a second who it is, and one that was reset is told so."
SILENT_S = 0.2
"A setpoint is too old by then to be in the way of `enable`."
CLEARED_S = 0.6
"A fault that has not come back by then is cleared: `tormagctl clear-fault` waits as long."
PATIENCE_S = 12.0
"A command is given again for so long: homing may take 10 s, and a clock is judged over some."
FOLLOWED_S = 4.0
JUDGED_S = 1.0
"The end of it, in which the force is to be what is asked and nothing to be told any more."


def recover(injection: Injection, rig: Rig, cell: Cell) -> Cell:
    """The row with what came of the recovery, of a rig in which the fault may still last."""
    tried, is_held_back = "", True
    if not injection.passes and not rig.is_dead:
        tried, is_held_back = _before(rig, injection)
    rig.mend()
    mended_s = rig.loop.now_s
    rig.rest(MENDED_S)
    commands = next_commands(rig.safety, rig.is_homed)
    trouble = _obeyed(rig, commands, PATIENCE_S)
    back_s = rig.loop.now_s - mended_s
    is_held, told = _follow(rig)
    is_back = not trouble and not rig.safety.faults and is_held and not _named(injection, told)
    return cell._replace(
        tried=tried,
        recovery=tuple(map(str, commands)),
        back_s=round(back_s, 3) if is_back and commands else None,
        recovered=is_held_back and is_back,
    )


def _before(rig: Rig, injection: Injection) -> tuple[str, bool]:
    """What the recovery comes to while the cause lasts, and whether it is as it should be."""
    commands = next_commands(rig.safety, rig.is_homed)
    trouble = _obeyed(rig, commands, 0.0)
    if trouble:
        return trouble, True
    _, told = _follow(rig)
    if rig.safety.faults:
        return ", ".join((*commands, f"{rig.safety.faults[0]} again")), True
    if not injection.names:
        return "", True
    named = _named(injection, told)
    return (f"{named} still told", True) if named else ("goes on, unnamed", False)


def _follow(rig: Rig) -> tuple[bool, set[str]]:
    """Whether the force is as asked at the end of the next seconds, and which limits are told then. It is not where a
    fault shows, or nothing is enabled."""
    off_N: list[float] = []
    told: set[str] = set()
    for _ in rig.run(FOLLOWED_S - JUDGED_S):
        if rig.safety.faults:
            return False, told
    for sample in rig.run(JUDGED_S):
        off_N.append(rig.off_N)
        if sample is not None:
            told.update(map(str, (*sample.plan.limits, *sample.output.limits)))
    is_held = abs(sum(off_N) / len(off_N)) < MOST_OFF_N and max(off_N) < MOST_OVER_N
    return rig.safety.operating_state is OperatingState.ENABLED and is_held, told


def _obeyed(rig: Rig, commands: tuple[Event, ...], patience_s: float) -> str:
    """Gives the commands, and has the force published again; those that were taken and what came in the way then, empty
    where nothing did."""
    if not commands:
        return ""
    rig.publisher.is_silent = True
    rig.rest(SILENT_S)
    taken: list[str] = []
    for event in commands:
        _rest_until_ready(rig)
        if event is not Event.CLEAR_FAULT and rig.safety.faults:
            return ", ".join((*taken, f"{rig.safety.faults[0]} again"))
        refusal = _given(rig, event, patience_s)
        if refusal:
            return ", ".join((*taken, f"{event} refused: {refusal}"))
        taken.append(str(event))
        rig.rest(CLEARED_S if event is Event.CLEAR_FAULT else 0.0)
    rig.publisher.is_silent = False
    return ""


def _given(rig: Rig, event: Event, patience_s: float) -> str:
    """The code of the refusal that is left after so long."""
    until_s = rig.loop.now_s + patience_s
    while True:
        try:
            rig.loop.command(str(event))
        except RefusedError as error:
            if rig.loop.now_s >= until_s:
                return error.code
        else:
            return ""
        rig.tick()


def _rest_until_ready(rig: Rig) -> None:
    """Until the device neither homes nor opens, or nobody would wait any longer."""
    until_s = rig.loop.now_s + PATIENCE_S
    while rig.loop.conditions().busy and rig.loop.now_s < until_s:
        rig.tick()


def _named(injection: Injection, told: set[str]) -> str:
    """The code of the injection that is told."""
    return next((name for name in injection.names if name in told), "")
