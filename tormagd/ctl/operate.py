"""The commands that change what the device does."""

import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from tormagd.ctl.outcome import CommandError, Exit, Outcome
from tormagd.ground.terminal import write_line
from tormagd_client.blocking import Client
from tormagd_client.messages import Explained, Status

POLL_S = 0.05
BEGIN_S = 2.0
"By then a device that took the command is busy, even over the slowest link."
ARMS_S, HOMES_S, OPENS_S = 30.0, 30.0, 10.0
"Homing takes six seconds at most."

DONE: dict[str, tuple[str, tuple[str, ...]]] = {
    "enable": ("enabled", ("ENABLED",)),
    "disable": ("disabled; the gap opens", ("DISABLED",)),
    "pause": ("paused; the gap is held", ("PAUSED",)),
    "resume": ("resumed", ("ENABLED",)),
    "stop": ("stopped and latched; the gap opens. tormagctl arm when it is safe to go on", ("FAULT",)),
    # nothing is latched, so there is nothing to clear
    "clear-fault": ("fault cleared; nothing moves before tormagctl arm", ("DISABLED", "ENABLED", "PAUSED")),
}
"What each command has done, and the operating states that show it."
STOPPED_WITHOUT_DEVICE = (
    "latched, but no device is connected: nothing could be sent, and the gap does not open. The device is told to open "
    "it when it is back; tormagctl status shows the link"
)
IS_OPEN = {
    "disable": "disabled; the gap is open",
    "stop": "stopped and latched; the gap is open. tormagctl arm when it is safe to go on",
}
STAYED_SHUT = ("NOT_OPENING", "DEVICE_RETRACT_FAILED")
COMES_BACK_S = 0.6
"The daemon waits this long for the device to drop a cleared fault (CLEARING_S), then latches it again."
LONGEST_WRITE_S = 30.0
"Longest wait for a black box; writing takes a second or two, at low priority."


def arm(client: Client) -> Outcome:
    """Have the daemon clear faults, home and enable as needed, and report each step on stderr."""
    begun_s = time.monotonic()
    return armed(client.arm(ARMS_S, report_step), client.status(), time.monotonic() - begun_s)


def report_step(step: str) -> None:
    write_line(f"tormagctl arm: {step}", sys.stderr)


def armed(given: Sequence[str], known: Status, seconds: float) -> Outcome:
    """Return the outcome of an `arm`. Raises CommandError if the device is not enabled after it."""
    if known.operating_state != "ENABLED":
        raise _not_done(f"it was armed, and is {known.operating_state}")
    to = "what is published next" if known.setpoint_cf is None else f"{known.setpoint_cf:.2f} N"
    text = f"armed in {seconds:.1f} s; the force goes to {to} along the scene's ramp"
    result = {"operating_state": known.operating_state, "given": list(given), "seconds": round(seconds, 2)}
    return Outcome(result, text if given else "it was armed already")


def operate(client: Client, command: str) -> Outcome:
    is_needless = command == "clear-fault" and not client.status().faults
    outcome = done(command, client.request(command))
    if is_needless:
        return Outcome(outcome.result, f"no fault is latched; it is {outcome.result['operating_state']}")
    if command == "clear-fault":
        for _, after in statuses(client, COMES_BACK_S):
            require_no_fault(after, "the fault came back")
    return outcome


def done(command: str, result: dict[str, Any]) -> Outcome:
    """Return the outcome of a command that the daemon has answered. Raises CommandError if it was not done."""
    state = result.get("operating_state")
    text, states = DONE[command]
    if state not in states:
        raise _not_done(f"the daemon answers {command} with operating_state = {state!r}: it was not done")
    if command == "stop" and result.get("is_connected") is False:
        return Outcome(result, STOPPED_WITHOUT_DEVICE, Exit.REFUSED)
    return Outcome(result, text)


def open_gap(client: Client, command: str) -> Outcome:
    """Give `disable` or `stop`, and wait until the gap is open."""
    begun = operate(client, command)
    if begun.exit_code is not Exit.DONE:
        return begun
    gap_mm = None
    for elapsed_s, state in statuses(client, OPENS_S):
        gap_mm = state.gap_mm
        if state.is_open and not state.is_busy:
            return Outcome({**begun.result, "seconds": round(elapsed_s, 2)}, IS_OPEN[command])
        # stop has latched STOPPED itself, and earlier faults may be over
        if command == "disable" or (not state.is_busy and not set(STAYED_SHUT).isdisjoint(state.faults)):
            require_no_fault(state, "the gap is not open")
    raise CommandError(
        Exit.REFUSED,
        "not_open",
        f"after {OPENS_S:g} s the gap is not " + ("known to be open" if gap_mm is None else f"open: {gap_mm:.1f} mm"),
        "it goes on by itself; tormagctl status shows how far",
    )


def take(client: Client, source: str) -> Outcome:
    result = client.request("take", source=source)
    if result.get("source") != source:
        raise _not_done(f"the daemon answers that {result.get('source')!r} holds the brake, not {source!r}")
    before = result.get("instead_of")
    instead = "already" if before == source else f"instead of {before!r}; the force goes to its setpoints along a ramp"
    return Outcome(result, f"{source!r} holds the brake {instead}")


def confirm(client: Client, what: str) -> Outcome:
    """Settle a dispute between force sensor and believed device."""
    result = client.request("confirm", what=what)
    if result.get("confirmed") != what:
        raise _not_done(f"the daemon answers that {result.get('confirmed')!r} is confirmed, not {what!r}")
    text = "the device has changed: it is learned anew" if what == "device" else "the force sensor is wrong: SENSOR"
    return Outcome(result, text)


def _not_done(what: str) -> CommandError:
    return CommandError(Exit.REFUSED, "not_done", what, "tormagctl status")


def home(client: Client) -> Outcome:
    before, has_begun = client.status(), False
    result = client.request("home")
    for elapsed_s, state in statuses(client, HOMES_S):
        require_no_fault(state, "fault while homing")
        # a homing too short to be seen has changed the device to homed
        has_begun = has_begun or state.is_busy or (state.is_homed and not before.is_homed)
        if has_begun and not state.is_busy:
            if state.is_homed:
                return Outcome({**result, "seconds": round(elapsed_s, 2)}, f"homed in {elapsed_s:.1f} s")
            lost = f"; the link was lost: {state.link.last_loss}" * (state.link.losses > before.link.losses)
            raise CommandError(
                Exit.REFUSED, "not_homed", f"homing ended, but the device is not homed{lost}", "tormagctl status"
            )
        if not has_begun and elapsed_s > BEGIN_S:
            raise CommandError(
                Exit.REFUSED, "not_begun", "the device did not begin to home", "look at the link in tormagctl status"
            )
    raise CommandError(
        Exit.REFUSED,
        "timeout",
        f"still homing after {HOMES_S:g} s",
        "it goes on by itself; tormagctl status shows how far, tormagctl stop ends it",
    )


def black_box(client: Client) -> Outcome:
    """Have the daemon write its black box, and wait until the file is on the disk."""
    written = Path(client.request("blackbox")["file"])
    boxes = (state.black_box for _, state in statuses(client, LONGEST_WRITE_S))
    box = next((each for each in boxes if each.newest == written.name or written.name in each.refusal), None)
    if box is None or box.newest != written.name:
        raise CommandError(
            Exit.REFUSED,
            "not_written",
            f"{written} was not written within {LONGEST_WRITE_S:g} s" if box is None else box.refusal,
            "make room in [black_box] folder, or name another; the daemon's log says more",
        )
    return Outcome({"file": str(written)}, f"{written}\ntormagctl replay runs it again, tormagctl plot draws it")


def statuses(client: Client, longest_s: float) -> Iterator[tuple[float, Status]]:
    """Yield seconds since the start and status, every POLL_S, until `longest_s`."""
    started_s = time.monotonic()
    while (elapsed_s := time.monotonic() - started_s) < longest_s:
        yield elapsed_s, client.status()
        time.sleep(POLL_S)


def require_no_fault(state: Status, what: str, then: str = "tormagctl clear-fault") -> None:
    """Raise CommandError if the device is in FAULT, with causes and remedy."""
    if state.operating_state != "FAULT":
        return
    # what the device met is worth more than that somebody stopped it
    told = sorted(state.fault_details, key=lambda each: each.code == "STOPPED")
    first = told[0] if told else Explained("FAULT", "see tormagctl status", "tormagctl arm")
    raise CommandError(
        Exit.FAULT,
        "fault",
        f"{what}: {', '.join(state.faults) or first.code}: {first.cause}",
        first.remedy.replace("tormagctl arm", then),
    )
