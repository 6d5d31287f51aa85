"""What one recording says of its console: how well forces were followed, what held them back, how the device is."""

from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np

from tormagd.lab.arrays import rms
from tormagd.recording.overview import Floats
from tormagd.recording.reader import Recording
from tormagd.recording.series import bands, end_ns, is_enabled, series, start_ns, tracking_rms_N

FIELDS = (
    "setpoint_cf",
    "measured_cf",
    "operating_state",
    "limits",
    "faults",
    "lateness_us",
    "tick",
    "trim",
    "device_clock_drift",
    "device_temperature_C",
    "left_current_A",
    "right_current_A",
)
"Fields of a recording's messages that a summary needs."


class Summary(msgspec.Struct, frozen=True, kw_only=True):
    """Figures of one recording; what was not recorded is null, or an empty text.

    `trim` is the device's force over its model's, `current_A` the RMS of the motor that needed more. `clock_drift_ppm`
    is how much the device's clock runs fast. These and `tracking_rms_N`, with the sensor's noise and the approach in
    it, are over the time ENABLED. Trim, clock and temperature are medians.
    """

    serial_number: int | None
    insert: str
    scene: str
    version: str
    start_s: float
    "Time of the first message, since 1970."
    duration_s: float
    enabled_s: float
    is_complete: bool
    tracking_rms_N: float | None
    late_p99_us: float | None
    limits_s: dict[str, float]
    "How long each limit acted."
    faults_at_s: dict[str, float]
    "When each fault first came, since the start."
    trim: float | None
    clock_drift_ppm: float | None
    temperature_C: float | None
    current_A: float | None


def summarise(recording: Recording) -> Summary:
    """Return the summary of a recording. Raises ValueError for one without messages."""
    begin_ns = start_ns(recording)
    scene = recording.described("scene", dict[str, Any]) or {}
    insert = scene.get("insert", {})
    states = {band.name: band.spans_s for band in bands(recording, "operating_state")}
    currents_A = [_enabled(recording, name, rms) for name in ("left_current_A", "right_current_A")]
    drift = _enabled(recording, "device_clock_drift", np.median)
    return Summary(
        serial_number=recording.described("serial_number", int),
        insert=str(insert.get("name", "")) if isinstance(insert, dict) else "",
        scene=str(scene.get("name", "")),
        version=recording.metadata.get("version", ""),
        start_s=begin_ns * 1e-9,
        duration_s=(end_ns(recording) - begin_ns) * 1e-9,
        enabled_s=sum(end - start for start, end in states.get("ENABLED", ())),
        is_complete=recording.is_complete,
        tracking_rms_N=tracking_rms_N(recording),
        late_p99_us=_enabled(recording, "lateness_us", lambda values: np.percentile(values, 99.0)),
        limits_s={band.name: sum(end - start for start, end in band.spans_s) for band in bands(recording, "limits")},
        faults_at_s={band.name: band.spans_s[0][0] for band in bands(recording, "faults")},
        trim=_enabled(recording, "trim", np.median),
        clock_drift_ppm=None if drift is None else drift * 1e6,
        temperature_C=_enabled(recording, "device_temperature_C", np.median),
        current_A=max((each for each in currents_A if each is not None), default=None),
    )


def _enabled(recording: Recording, name: str, figure: Callable[[Floats], Any]) -> float | None:
    """Return a figure of all finite values of the quantity `name` while ENABLED; None where there are none."""
    known = series(recording, name)
    if known is None:
        return None
    values = known.values[np.isfinite(known.values) & is_enabled(recording, known.t_s)]
    return float(figure(values)) if values.size else None
