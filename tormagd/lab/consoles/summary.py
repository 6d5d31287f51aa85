"""What each recording in a folder or bucket says of its console, read by workers of this machine or of a cluster.

That is how well forces were followed, what held them back, and how the device is. Commissionings are read, too.
"""

import re
from array import array
from collections.abc import Callable
from concurrent.futures import Executor
from typing import Any, BinaryIO

import fsspec
import msgspec
import numpy as np

from tormagd.commission.sequence import MAX_BYTES, Report
from tormagd.lab.arrays import rms
from tormagd.lab.executors import finished
from tormagd.recording.overview import Floats, Glance, OverviewBuilder
from tormagd.recording.reader import Seen, read_open

SUFFIX = ".mcap"
READ = re.compile(r"(.*\.mcap|(.*/)?[0-9a-f]{8}\.json)", re.IGNORECASE)
"Recordings, and the findings of `tormagctl commission`, which a serial number names."
FIGURES = (
    "trim", "device_clock_drift", "device_temperature_C", "left_current_A", "right_current_A", "lateness_us",
)  # fmt: skip
"Of a tick, the numbers that a summary has figures of."


class Wanted(Glance, total=False):
    """What a summary takes of a message."""

    trim: float | None
    device_clock_drift: float | None
    device_temperature_C: float | None
    left_current_A: float | None
    right_current_A: float | None


class Summary(msgspec.Struct, frozen=True, kw_only=True):
    """Figures of one recording; what was not recorded is null, or an empty text.

    `trim` is the device's force over its model's, `current_A` the RMS of the motor that needed more. `clock_drift_ppm`
    by how much the device's clock runs fast. Each is over the time ENABLED. `tracking_rms_N` is that of while
    following, with the sensor's noise in it. Of a trim, a clock and a temperature it is the median.
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


def summarise(file: BinaryIO, name: str) -> Summary:
    """Return the summary of the recording in `file`, open and seekable, which errors call `name`.

    Figures of the device and lateness are of ticks while ENABLED, or of no stated operating state. Limits and faults
    are of the whole recording. What the recording does not say, or says as another type, is None or an empty text.
    Raises RecordingError and OSError where it cannot be read, and ValueError for one without messages. A recording that
    was cut is summed up as far as it goes, with `is_complete` False.
    """
    builder, enabled = OverviewBuilder(), {name: array("d") for name in FIGURES}

    def take(seen: Seen) -> None:
        builder.add(*seen)
        if seen.is_tick and seen.message.get("operating_state") in (None, "ENABLED"):
            for name, values in enabled.items():
                value = seen.message.get(name)
                if value is not None:
                    values.append(value)

    recording = read_open(file, name, Wanted, take)
    overview = builder.made()
    if not overview.ticks and not overview.snapshots:
        raise ValueError(f"{name}: the recording has no messages")
    scene = recording.described("scene", dict[str, Any]) or {}
    insert, codes = scene.get("insert", {}), overview.codes

    def figure(name: str, of: Callable[[Floats], Any]) -> float | None:
        return float(of(np.array(enabled[name]))) if enabled[name] else None

    currents_A = [figure(name, rms) for name in ("left_current_A", "right_current_A")]
    drift = figure("device_clock_drift", np.median)
    return Summary(
        serial_number=recording.described("serial_number", int),
        insert=str(insert.get("name", "")) if isinstance(insert, dict) else "",
        scene=str(scene.get("name", "")),
        version=recording.metadata.get("version", ""),
        start_s=overview.start_ns * 1e-9,
        duration_s=overview.duration_s,
        enabled_s=codes["operating_state"]["ENABLED"].held_ns * 1e-9 if "ENABLED" in codes["operating_state"] else 0.0,
        is_complete=recording.is_complete,
        tracking_rms_N=None if overview.following is None else overview.following.rms_N,
        late_p99_us=figure("lateness_us", lambda values: np.percentile(values, 99.0)),
        limits_s={name: each.held_ns * 1e-9 for name, each in codes["limits"].items()},
        faults_at_s={name: each.spans_ns[0][0] * 1e-9 for name, each in codes["faults"].items()},
        trim=figure("trim", np.median),
        clock_drift_ppm=None if drift is None else drift * 1e6,
        temperature_C=figure("device_temperature_C", np.median),
        current_A=max((each for each in currents_A if each is not None), default=None),
    )


def files(url: str) -> dict[str, str]:
    """Return the full address of every file of READ in and under a folder or URL, by its path there, sorted by that.

    `url` may also be one file, which is then returned by its name. Empty where no name fits. Nothing is read. Raises
    FileNotFoundError where there is no such folder or file, and OSError where it cannot be listed. Raises ValueError
    for an unknown kind of URL, and ImportError for one whose package is missing.
    """
    system, root = fsspec.core.url_to_fs(url)
    if not system.exists(root):
        raise FileNotFoundError(f"{url}: no such folder or file")
    folder = root if system.isdir(root) else root.rpartition("/")[0]
    found = sorted(path for path in system.find(root) if READ.fullmatch(path))
    return {path.removeprefix(folder).lstrip("/"): system.unstrip_protocol(path) for path in found}


def read(url: str) -> Summary | Report | str:
    """Read the file at `url`; return a recording's summary, a commissioning's report, or the reason why there is none.

    A name that ends with SUFFIX is a recording, any other a report, of which MAX_BYTES are read. A reason is one
    sentence for a person: the file is missing, not regular, damaged, or says nothing. Raises ImportError for a kind of
    address whose package is missing.
    """
    name = url.rpartition("/")[2]
    try:
        system, path = fsspec.core.url_to_fs(url)
        if not system.isfile(path):
            return "it is no regular file"
        with system.open(path, "rb") as file:
            if name.lower().endswith(SUFFIX):
                return summarise(file, name)
            return msgspec.json.decode(file.read(MAX_BYTES), type=Report)
    except (OSError, ValueError, RecursionError) as error:
        return str(error).removeprefix(f"{name}: ")


def read_all(urls: dict[str, str], executor: Executor) -> tuple[dict[str, Summary], dict[str, Report], dict[str, str]]:
    """Read all files of `urls`, addresses by name, by `executor`; return summaries, reports and reasons, each by name.

    Every name is in one of the three, which have the order of `urls`. A reason says why a file has neither; a failed
    worker makes one, too, and no error. The progress is shown on stderr.
    """
    found: dict[str, Summary | Report | str] = {}
    for url, future in finished(executor, read, urls.values(), "recording"):
        error = future.exception()
        found[url] = future.result() if error is None else f"the worker that read it failed: {error}"
    ordered = [(name, found[url]) for name, url in urls.items()]
    return (
        {name: each for name, each in ordered if isinstance(each, Summary)},
        {name: each for name, each in ordered if isinstance(each, Report)},
        {name: each for name, each in ordered if isinstance(each, str)},
    )
