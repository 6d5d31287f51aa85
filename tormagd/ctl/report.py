"""`tormagctl report` and `plot`: one page, or one picture, of a recording; and the page of two side by side."""

from pathlib import Path
from typing import Any

from tormagd.bounded_file import in_place_of
from tormagd.config import Config
from tormagd.ctl.outcome import Exit, Outcome, as_usage_error, usage_error
from tormagd.ctl.record import key_of
from tormagd.dashboard.report import report as page_of
from tormagd.recording.plot import figure, save_plot
from tormagd.recording.reader import RecordingFile

WRITABLE = "give a file in a directory you may write to"


def opened(config: Config, sources: list[Path]) -> list[RecordingFile]:
    """Open recordings, checked with the configured key, in the order of `sources`; an altered one is not refused."""
    key = key_of(config)
    with as_usage_error(ValueError, hint="give files that tormagctl record has made"):
        return [RecordingFile(source, key) for source in sources]


def _outcome(of: list[RecordingFile], target: Path, result: dict[str, Any]) -> Outcome:
    """Say what was written, and before that what the seals say: REFUSED where one is not sound."""
    seals = {str(each.path): each.seal.state for each in of}
    said = (f"{each.path}: {'. '.join(dict.fromkeys([each.seal.text(), *each.notes]))}" for each in of)
    text = "\n".join([*said, str(target)])
    is_sound = all(each.seal.is_sound for each in of)
    return Outcome({"file": str(target), "seals": seals, **result}, text, Exit.DONE if is_sound else Exit.REFUSED)


def report(config: Config, sources: list[Path], target: Path) -> Outcome:
    """Write an HTML page on one or two recordings to `target`; a page there is replaced, whole or not at all."""
    if len(sources) > 2:
        said = f"{len(sources)} recordings: allowed are one or two"
        raise usage_error(said, "tormagctl report A.mcap B.mcap -o AB.html")
    of = opened(config, sources)
    with as_usage_error(ValueError, hint="give recordings with data"):
        page = page_of(of)
    with as_usage_error(OSError, hint=WRITABLE), in_place_of(target) as unfinished:
        unfinished.write_text(page, encoding="utf-8")
    return _outcome(of, target, {})


def plot(config: Config, source: Path, target: Path) -> Outcome:
    """Draw the recording `source` into the picture file `target`; a picture there is replaced, whole or not at all."""
    (recording,) = of = opened(config, [source])
    overview, following = recording.overview, recording.overview.following
    with as_usage_error(ValueError, hint="give -o a picture's name, such as pulse.png, and a recording with data"):
        drawn = figure(overview, source.stem, recording.notes)
        with as_usage_error(OSError, hint=WRITABLE):
            save_plot(drawn, target)
    result = {
        "ticks": overview.ticks,
        "telemetry": overview.snapshots,
        "is_complete": recording.is_complete,
        "tracking_rms_N": None if following is None else following.rms_N,
        "aligned_rms_N": None if following is None else following.aligned_rms_N,
        "limits": list(overview.spans_s("limits")),
        "faults": list(overview.spans_s("faults")),
    }
    return _outcome(of, target, result)
