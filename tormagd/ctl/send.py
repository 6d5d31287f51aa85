"""`tormagctl send`: publish setpoints at a steady rate."""

import math
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec

from tormagd.ctl.outcome import CommandError, Exit, Outcome, as_usage_error, usage_error
from tormagd.ctl.watch import StatusWatch, require_range
from tormagd.ctl.waveform import Waveform, WaveformError, read_csv, shape
from tormagd.ground.force_file import stated_columns
from tormagd.ground.table import TableError
from tormagd.ground.terminal import interrupted_by
from tormagd_client.blocking import Client
from tormagd_client.endpoints import Endpoints
from tormagd_client.errors import UnreachableError
from tormagd_client.messages import MAX_PREVIEW_SAMPLES


def send(
    endpoints: Endpoints,
    wait_s: float,
    what: str,
    column: str | None,
    time_column: str | None,
    rate_hz: float,
    duration_s: float | None,
    from_N: float,
    to_N: float,
    frequency_hz: float,
    source: str,
    valid_for_ms: float,
    preview_ms: float,
    is_blind: bool,
) -> Outcome:
    """Publish a shape or a CSV file at `rate_hz`, and report what became of it."""
    with as_usage_error(
        WaveformError,
        TableError,
        hint="correct it and send again; tormagctl send --help shows the choices",
    ):
        if Path(what).suffix:
            waveform = read_csv(Path(what), stated_columns(column, time_column))
            lasts_s = min(waveform.duration_s, duration_s or math.inf)
        else:
            lasts_s = duration_s or 10.0
            waveform = shape(what, from_N, to_N, frequency_hz, lasts_s)
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
            became = None if watch is None else watch.finish(done["sent"])
    left_out = f", {done['skipped']} left out because this machine was late" if done["skipped"] else ""
    read = f"{what}: {'; '.join(waveform.told)}\n" if waveform.told else ""
    text = f"{read}sent {done['sent']} setpoints as {source!r} in {done['seconds']:.1f} s{left_out}; "
    if became is None:
        return Outcome({"source": source, "read": waveform.told, **done}, f"{text}whether they were taken is not known")
    held = f", held by {', '.join(became.limits)} at times" if became.limits else ""
    result = {"source": source, "read": waveform.told, **done, **msgspec.structs.asdict(became)}
    return Outcome(result, f"{text}{became.accepted} taken and rendered{held}")


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
    worst_late_s = 0.0
    start_s, start_ns = time.monotonic(), time.time_ns()
    # the margin keeps the last one despite the rounding of a file's times
    last = int(duration_s * rate_hz + 1e-6)
    while index <= last and not is_interrupted():
        t_s = index / rate_hz
        wait_s = start_s + t_s - time.monotonic()
        if wait_s > 0.0:
            time.sleep(wait_s)
        late_s = time.monotonic() - start_s - t_s
        worst_late_s = max(worst_late_s, late_s)
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
        "worst_late_ms": round(worst_late_s * 1e3, 3),
        "interrupted": bool(is_interrupted()),
    }
