"""`tormagctl send`: publish setpoints at a steady rate; whether the daemon takes them, and the device renders them."""

import math
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec

from tormagd.ctl.operate import require_no_fault, statuses
from tormagd.ctl.outcome import CommandError, Exit, Outcome, as_usage_error, usage_error
from tormagd.ctl.waveform import Waveform, WaveformError, read_csv, shape
from tormagd.ground.force_file import stated_columns
from tormagd.ground.table import TableError
from tormagd.ground.terminal import interrupted_by, write_line
from tormagd.scenes.scene import Scene
from tormagd_client.blocking import Client
from tormagd_client.endpoints import Endpoints
from tormagd_client.errors import UnreachableError, not_understood
from tormagd_client.messages import MAX_PREVIEW_SAMPLES, Description, Explained, Status
from tormagd_client.wire import Pending, understood

LOOK_S = 0.1
ARRIVAL_S = 0.5
"By then the last setpoint has arrived, even if an answer overtook it."
MIN_TAKEN = 0.9
"The first setpoints may be refused while their clock is not known."
OTHER_SOURCE = "OTHER_SOURCE"
OF_STATE = {"refused": OTHER_SOURCE, "stale": "STALE"}
"The limit that a source meets in these states."
SPOILING = ("RANGE", "F_MAX")
"These mean another force than asked. F_MIN is not among them: 0 N asks for the device's least force."


def require_range(known: Description, least_N: float, most_N: float) -> None:
    """Raise CommandError unless the daemon's scene allows forces from `least_N` to `most_N`."""
    try:
        scene = msgspec.convert(known.scene, Scene)
    except ValueError as error:
        raise not_understood("scene", error) from error
    force = scene.force
    if not force.least_N <= least_N <= most_N <= force.most_N:
        raise CommandError(
            Exit.REFUSED,
            "out_of_range",
            f"{least_N:.12g}..{most_N:.12g} N is asked: allowed is {force.least_N:.12g}..{force.most_N:.12g} N "
            f"in scene {scene.name}; nothing was sent",
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
    if report is None:
        heard = f": {status.setpoints.last_refusal}" if status.setpoints.last_refusal else ""
        return CommandError(
            Exit.REFUSED, "not_heard", f"the daemon has taken nothing of {source!r}{heard}", "tormagctl status"
        )
    code = OF_STATE.get(report.state) or next((each for each in SPOILING if each in status.limits), None)
    if code is None or (is_over and code != OTHER_SOURCE):
        return None
    unexplained = Explained(code, f"it holds the force of {source!r} back", "tormagctl status")
    known = next((each for each in status.limit_details if each.code == code), unexplained)
    return CommandError(Exit.REFUSED, code.lower(), f"{code}: {known.cause}", known.remedy)


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

    def finish(self, sent: int) -> dict[str, Any]:
        """Wait until the daemon has taken all `sent` setpoints, and return how many it took, how often they were seen
        rendered, and what held them back.
        """
        for _, status in statuses(self._client, ARRIVAL_S):
            accepted = _accepted(status, self._source) - self._before
            if accepted >= sent:
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
        return {"accepted": accepted, "rendered_share": share_rendered, "limits": list(self._limits)}


def _accepted(status: Status, source: str) -> int:
    report = status.setpoints.by_source.get(source)
    return 0 if report is None else report.accepted


def send(
    endpoints: Endpoints,
    wait_s: float,
    what: str,
    column: str | None,
    time_column: str | None,
    rate_hz: float,
    duration_s: float | None,
    from_N: float | None,
    to_N: float | None,
    frequency_hz: float | None,
    source: str,
    valid_for_ms: float,
    preview_ms: float,
    is_blind: bool,
) -> Outcome:
    """Publish a shape or a CSV file at `rate_hz`, and report what became of it."""
    is_file, of_shape = bool(Path(what).suffix), {"--from-N": from_N, "--to-N": to_N, "--frequency": frequency_hz}
    for name, given in (of_shape if is_file else {"--column": column, "--time-column": time_column}).items():
        if given is not None:
            raise usage_error(f"{name}: allowed only with a {'shape' if is_file else 'file'}", "tormagctl send --help")
    with as_usage_error(
        WaveformError,
        TableError,
        hint="correct it and send again; tormagctl send --help shows the choices",
    ):
        if is_file:
            waveform = read_csv(Path(what), stated_columns(column, time_column))
            lasts_s = min(waveform.duration_s, duration_s or math.inf)
        else:
            lasts_s = duration_s or 10.0
            lower_N, upper_N = 1.4 if from_N is None else from_N, 1.7 if to_N is None else to_N
            waveform = shape(what, lower_N, upper_N, frequency_hz or 1.2, lasts_s)
    if valid_for_ms < 1e3 / rate_hz:
        raise usage_error(
            f"--valid-for-ms = {valid_for_ms:g}: allowed is at least one period, {1e3 / rate_hz:g} ms",
            "raise --valid-for-ms or --rate, or every setpoint is stale before the next comes",
        )
    preview = round(preview_ms * rate_hz * 1e-3)
    if preview > MAX_PREVIEW_SAMPLES:
        raise usage_error(
            f"--preview-ms = {preview_ms:g}: {preview} setpoints at {rate_hz:g} Hz; allowed are {MAX_PREVIEW_SAMPLES}",
            "look less far ahead",
        )
    with Client(endpoints, wait_s, source) as client:
        watch = None if is_blind else _watched(client, endpoints, waveform, source)
        client.require_taken()
        with interrupted_by(signal.SIGINT, signal.SIGTERM) as is_interrupted:
            done = _publish(
                client,
                endpoints.setpoint,
                waveform,
                lasts_s,
                rate_hz,
                valid_for_ms,
                preview,
                is_interrupted,
                watch,
            )
            became = {} if watch is None else watch.finish(done["sent"])
    left_out = f", {done['skipped']} left out because this machine was late" if done["skipped"] else ""
    read = f"{what}: {'; '.join(waveform.told)}\n" if waveform.told else ""
    text = f"{read}sent {done['sent']} setpoints as {source!r} in {done['seconds']:.1f} s{left_out}; "
    result = {"source": source, "read": waveform.told, **done, **became}
    if watch is None:
        return Outcome(result, f"{text}whether they were taken is not known")
    held = f", held by {', '.join(became['limits'])} at times" if became["limits"] else ""
    return Outcome(result, f"{text}{became['accepted']} taken and rendered{held}")


def _watched(client: Client, endpoints: Endpoints, waveform: Waveform, source: str) -> StatusWatch:
    """Check the waveform's forces against the daemon's scene, and return a watch of `source`."""
    try:
        known = client.describe()
    except UnreachableError as error:
        if endpoints.curve is not None and endpoints.curve.client_secret:
            error.hint += "; with a key that may only publish: --blind"
        raise
    require_range(known, waveform.least_N, waveform.most_N)
    return StatusWatch(client, source)


def _publish(
    client: Client,
    address: str,
    waveform: Waveform,
    duration_s: float,
    rate_hz: float,
    valid_for_ms: float,
    preview: int,
    is_interrupted: Callable[[], bool],
    watch: StatusWatch | None,
) -> dict[str, Any]:
    sent = skipped = index = 0
    start_s, start_ns = time.monotonic(), time.time_ns()
    # the margin keeps the last one despite the rounding of a file's times
    last = int(duration_s * rate_hz + 1e-6)
    while index <= last and not is_interrupted():
        t_s = index / rate_hz
        wait_s = start_s + t_s - time.monotonic()
        if wait_s > 0.0:
            time.sleep(wait_s)
        late_s = time.monotonic() - start_s - t_s
        overdue = min(int(late_s * rate_hz), last - index)
        skipped += overdue
        index += overdue
        sample = waveform.at(index / rate_hz)
        ahead = range(index + 1, index + 1 + preview)
        try:
            client.publish(
                sample.force_N,
                valid_for_ms,
                start_ns + round(index / rate_hz * 1e9),  # the time for which the force is meant, whenever it is sent
                displacement_mm=sample.displacement_mm,
                rate_mm_s=sample.rate_mm_s,
                preview_N=tuple(waveform.at(min(later / rate_hz, duration_s)).force_N for later in ahead) or None,
                preview_dt_ms=1e3 / rate_hz if ahead else None,
            )
        except UnreachableError as error:
            message = f"the daemon at {address} went away after {sent} setpoints"
            raise CommandError(Exit.UNREACHABLE, "gone", message, error.hint) from error
        sent, index = sent + 1, index + 1
        if watch is not None:
            watch.look()
    return {
        "sent": sent,
        "skipped": skipped,
        "start_ns": start_ns,
        "seconds": round(time.monotonic() - start_s, 3),
        "interrupted": bool(is_interrupted()),
    }
