"""What becomes of setpoints that are sent: whether the daemon takes them, and the device renders them."""

import sys
import time
from typing import Any

import msgspec

from tormagd.ctl.operate import require_no_fault
from tormagd.ctl.outcome import CommandError, Exit
from tormagd.ground.terminal import write_line
from tormagd_client.blocking import Client
from tormagd_client.messages import Description, Explained, Status
from tormagd_client.wire import Pending, understood

LOOK_S = 0.1
LAST_ANSWER_S = 1.0
ARRIVAL_S = 0.5
"By then the last setpoint has arrived, even if an answer overtook it."
MIN_TAKEN = 0.9
"The first setpoints may be refused while their clock is not known."
SPOILING = ("RANGE", "F_MAX")
"These mean another force than asked. F_MIN is not among them: 0 N asks for the device's least force."


class Fate(msgspec.Struct, frozen=True):
    """How many setpoints were taken, how often they were seen rendered, and what held them back."""

    accepted: int
    rendered_share: float | None
    limits: tuple[str, ...]


def require_range(known: Description, least_N: float, most_N: float) -> None:
    """Raise CommandError unless the daemon's scene allows forces from `least_N` to `most_N`."""
    try:
        force = msgspec.convert(known.scene["force"], dict[str, Any])
        allowed = msgspec.convert((force["least_N"], force["most_N"]), tuple[float, float])
    except (KeyError, msgspec.ValidationError) as error:
        raise CommandError(
            Exit.UNREACHABLE,
            "unintelligible",
            f"the scene of tormagd {known.version} is not understood: {error}",
            "install tormagd and tormagctl of the same version, and start the daemon again",
        ) from error
    if not allowed[0] <= least_N <= most_N <= allowed[1]:
        raise CommandError(
            Exit.REFUSED,
            "out_of_range",
            f"{least_N:.12g}..{most_N:.12g} N is asked: allowed is {allowed[0]:.12g}..{allowed[1]:.12g} N "
            f"in scene {known.scene.get('name', '-')}; nothing was sent",
            "ask within the range, or let the daemon run another scene",
        )


def held_back(status: Status, source: str, *, is_over: bool = False) -> CommandError | None:
    """Return why the setpoints of `source` are not rendered, as an error."""
    require_no_fault(status, "the device is in FAULT", "tormagctl arm")
    if status.operating_state != "ENABLED":
        return CommandError(
            Exit.REFUSED,
            status.operating_state.lower(),
            f"the device is {status.operating_state}",
            "tormagctl resume" if status.operating_state == "PAUSED" else "tormagctl arm",
        )
    report = status.setpoints.by_source.get(source)
    why = {each.code: each for each in status.limit_details}
    if report is None:
        heard = f": {status.setpoints.last_refusal}" if status.setpoints.last_refusal else ""
        return CommandError(
            Exit.REFUSED, "not_heard", f"the daemon has taken nothing of {source!r}{heard}", "tormagctl status"
        )
    if report.state == "refused":
        other = why.get("OTHER_SOURCE") or Explained(
            "OTHER_SOURCE",
            f"{status.setpoints.newest_source!r} holds the brake, not {source!r}",
            f"end the other one, or tormagctl take {source}",
        )
        return CommandError(Exit.REFUSED, "other_source", other.cause, other.remedy)
    spoiling = {code: f"the force is held by the limit {code}" for code in SPOILING if code in status.limits}
    if report.state == "stale":
        spoiling = {"STALE": f"the setpoints of {source!r} come too late, or not at all"}
    if is_over or not spoiling:
        return None
    code, otherwise = next(iter(spoiling.items()))
    message = f"{code}: {why[code].cause}" if code in why else otherwise
    return CommandError(Exit.REFUSED, code.lower(), message, why[code].remedy if code in why else "tormagctl status")


class StatusWatch:
    """Looks at the daemon's status while one source's setpoints are sent."""

    def __init__(self, client: Client, source: str) -> None:
        self._client, self._source = client, source
        before = client.status()
        held = held_back(before, source)  # it may be enabled later, unless it is in FAULT
        if held is not None and before.operating_state != "ENABLED":
            write_line(f"{held.message}: nothing is felt until it is ENABLED; next: {held.hint}", sys.stderr)
        self._before = _accepted(before, source)
        self._asked: Pending | None = None
        self._look_s: float | None = None
        self._looks = self._rendered = 0
        self._held: CommandError | None = None
        self._spoilt: CommandError | None = None
        self._limits: dict[str, None] = {}

    def look(self) -> None:
        """Take a status that has arrived, or ask for one, without waiting."""
        now_s = time.monotonic()
        if self._look_s is None:  # an answer may overtake the first setpoint
            self._look_s = now_s + LOOK_S
        result = None if self._asked is None else self._client.answer(self._asked)
        if self._asked is None and now_s >= self._look_s:
            self._asked = self._client.ask("status")
        if result is None:
            return
        self._asked, self._look_s = None, now_s + LOOK_S
        status = understood(result, Status)
        held = held_back(status, self._source)
        self._limits |= dict.fromkeys(status.limits)
        self._looks += 1
        if held is None:
            self._rendered += 1
        elif self._held is None or held.code != self._held.code:
            write_line(f"tormagctl send: not rendered: {held.message}\n  next: {held.hint}", sys.stderr)
        # before the first rendered force it was waiting, as for tormagctl enable
        if held is not None and self._rendered:
            self._spoilt = held
        self._held = held

    def finish(self, sent: int) -> Fate:
        """Wait until the daemon has taken all `sent` setpoints, and return what became of them."""
        until_s = time.monotonic() + ARRIVAL_S
        while True:
            status = self._client.status(LAST_ANSWER_S)
            accepted = _accepted(status, self._source) - self._before
            if accepted >= sent or time.monotonic() > until_s:
                break
        held = held_back(status, self._source, is_over=True)
        why = held or self._spoilt or (self._held if self._looks and not self._rendered else None)
        if why is not None:
            share = f"{self._rendered / self._looks:.0%} of the time" if self._looks else "none of them"
            raise CommandError(
                why.exit_code, why.code, f"sent {sent} setpoints, rendered {share}: {why.message}", why.hint
            )
        if accepted < MIN_TAKEN * sent:
            raise CommandError(
                Exit.REFUSED,
                "not_taken",
                f"sent {sent} setpoints, and {accepted} were taken: {status.setpoints.last_refusal or 'see the log'}",
                "look at the source in tormagctl status: another publisher of its name, or a loss on the way",
            )
        share_rendered = round(self._rendered / self._looks, 3) if self._looks else None
        return Fate(accepted, share_rendered, tuple(self._limits))


def _accepted(status: Status, source: str) -> int:
    report = status.setpoints.by_source.get(source)
    return 0 if report is None else report.accepted
