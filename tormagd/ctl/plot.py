"""`tormagctl plot`: a picture of a recording."""

from pathlib import Path

from tormagd.ctl.outcome import Outcome, as_usage_error, usage_error
from tormagd.recording.plot import save_plot
from tormagd.recording.reader import RecordingError, read_recording
from tormagd.recording.series import bands, tracking_rms_N


def plot(source: Path, target: Path) -> Outcome:
    """Draw `source` into `target`. Raises CommandError (USAGE) where one cannot be read or the other not written."""
    with as_usage_error(RecordingError, hint="give a file that tormagctl record has made"):
        recording = read_recording(source)
    try:
        save_plot(recording, target, source.stem)
    except ValueError as error:
        raise usage_error(
            str(error), "give -o a picture's name, such as pulse.png, and a recording with data"
        ) from error
    except OSError as error:
        raise usage_error(f"{target}: {error.strerror}", "give a file in a directory you may write to") from error
    result = {
        "file": str(target),
        "ticks": int(recording.ticks.t_ns.size),
        "telemetry": int(recording.telemetry.t_ns.size),
        "is_complete": recording.is_complete,
        "tracking_rms_N": tracking_rms_N(recording),
        "limits": [band.name for band in bands(recording, "limits")],
        "faults": [band.name for band in bands(recording, "faults")],
    }
    cut = "" if recording.is_complete else f"; {source} was cut short: what was written before that is shown"
    return Outcome(result, f"{target}{cut}")
