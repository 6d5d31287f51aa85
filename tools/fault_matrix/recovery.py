"""What leads out of a fault: the commands that the daemon's own table names, before its cause has gone and after.

An operator does no more than to say `arm`, beside a publisher that goes on. Before the cause has gone that must come to
nothing, or the fault be named all the while. Afterwards the force has to be followed again.
"""

from fault_matrix.cases import Injection
from fault_matrix.rig import Rig
from fault_matrix.watch import MAX_OFF_N, MAX_OVER_N, Cell
from tormagd.daemon.arming import Arming
from tormagd.safety.operating_state import OperatingState, next_commands

MENDED_S = 1.5
"A device that was silent is asked once a second who it is, and one that was reset is told so."
PATIENCE_S = 12.0
"It is said again for so long: a clock is judged over some seconds."
FOLLOWED_S = 4.0
JUDGED_S = 1.0
"The end of it, in which the force is to be what is asked and nothing to be told any more."


def recover(injection: Injection, rig: Rig, cell: Cell) -> Cell:
    """The row with what came of the recovery, of a rig in which the fault may still last."""
    tried, is_held_back = "", True
    if not injection.passes and not rig.is_dead:
        tried, is_held_back = _before(rig, injection)
    rig.mend()
    rig.rest(MENDED_S)
    commands = next_commands(rig.safety, rig.is_homed)
    trouble = armed(rig, PATIENCE_S)
    is_held, told = _follow(rig)
    is_back = not trouble and not rig.safety.faults and is_held and not _named(injection, told)
    return cell._replace(
        tried=tried,
        recovery=tuple(map(str, commands)),
        recovered=is_held_back and is_back,
    )


def _before(rig: Rig, injection: Injection) -> tuple[str, bool]:
    """What the recovery comes to while the cause lasts, and whether it is as it should be."""
    commands = next_commands(rig.safety, rig.is_homed)
    trouble = armed(rig, 0.0)
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
    is_held = abs(sum(off_N) / len(off_N)) < MAX_OFF_N and max(off_N) < MAX_OVER_N
    return rig.safety.operating_state is OperatingState.ENABLED and is_held, told


def armed(rig: Rig, patience_s: float) -> str:
    """Says `arm`, again and again for so long. Returns the commands that were taken and what came in the way of the
    last one, empty where nothing did."""
    until_s = rig.loop.now_s + patience_s
    while True:
        commands, arming = next_commands(rig.safety, rig.is_homed), Arming(rig.loop.now_s, rig.safety.faults)
        while not arming.is_over:
            arming.advance(rig.loop.now_s, rig.safety, rig.loop.conditions(), rig.loop.command)
            rig.tick()
        why = arming.refusal
        if why is None:
            return ""
        if why.code == "fault":
            return ", ".join((*arming.given, f"{rig.safety.faults[0]} again"))
        if rig.loop.now_s >= until_s:
            return ", ".join((*arming.given, f"{commands[len(arming.given)]} refused: {why.code}"))


def _named(injection: Injection, told: set[str]) -> str:
    """The code of the injection that is told."""
    return next((name for name in injection.names if name in told), "")
