"""`tormagctl plot`: a picture of a recording."""

from pathlib import Path

from tormagd.ctl.outcome import Outcome, as_usage_error, usage_error
from tormagd.recording.plot import figure, save_plot
from tormagd.recording.reader import RecordingError, RecordingFile


def plot(source: Path, target: Path) -> Outcome:
    """Draw the recording `source` into the picture file `target`, whose suffix says its format; a file there is
    replaced.

    The outcome tells counts, errors of following in N, limits and faults. What came before a cut is drawn, and the cut
    said. Raises CommandError (USAGE) where the recording cannot be read or is empty, or the picture not be written.
    """
    with as_usage_error(RecordingError, hint="give a file that tormagctl record has made"):
        recording = RecordingFile(source)
    overview = recording.overview
    try:
        save_plot(figure(overview, source.stem, recording.is_complete), target)
    except ValueError as error:
        raise usage_error(
            str(error), "give -o a picture's name, such as pulse.png, and a recording with data"
        ) from error
    except OSError as error:
        raise usage_error(f"{target}: {error.strerror}", "give a file in a directory you may write to") from error
    result = {
        "file": str(target),
        "ticks": overview.ticks,
        "telemetry": overview.snapshots,
        "is_complete": recording.is_complete,
        "tracking_rms_N": overview.following.rms_N,
        "aligned_rms_N": overview.following.aligned_rms_N,
        "limits": list(overview.spans_s("limits")),
        "faults": list(overview.spans_s("faults")),
    }
    cut = "" if recording.is_complete else f"; {source} was cut short: what was written before that is shown"
    return Outcome(result, f"{target}{cut}")
