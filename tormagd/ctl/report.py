"""`tormagctl report` and `plot`: one page, or one picture, of a recording; and the page of two side by side."""

from pathlib import Path
from typing import Any

from tormagd.ctl.outcome import WRITABLE, Exit, Outcome, as_usage_error, usage_error
from tormagd.ground.files import in_place_of
from tormagd.record.reader import RecordingFile
from tormagd.view.plot import figure, save_plot
from tormagd.view.report import report as page_of


def opened(sources: list[Path]) -> list[RecordingFile]:
    with as_usage_error(ValueError, hint="give files that tormagctl record has made"):
        return [RecordingFile(source) for source in sources]


def _outcome(of: list[RecordingFile], target: Path, result: dict[str, Any]) -> Outcome:
    """Say what was written, and what to note of each recording; REFUSED if one is damaged."""
    said = (f"{each.path}: {'. '.join(each.notes)}" for each in of if each.notes)
    notes = {str(each.path): each.notes for each in of}
    exit_code = Exit.REFUSED if any(each.damage or each.lost for each in of) else Exit.DONE
    return Outcome({"file": str(target), "notes": notes, **result}, "\n".join([*said, str(target)]), exit_code)


def report(sources: list[Path], target: Path) -> Outcome:
    """Write an HTML page on one or two recordings to `target`."""
    if len(sources) > 2:
        said = f"{len(sources)} recordings: allowed are one or two"
        raise usage_error(said, "tormagctl report A.mcap B.mcap -o AB.html")
    if target.suffix.lower() != ".html":
        raise usage_error(f"-o {target}: allowed is a name that ends with .html", "give a page's name")
    of = opened(sources)
    with as_usage_error(ValueError, hint="give recordings with data"):
        page = page_of(of)
    with as_usage_error(OSError, hint=WRITABLE), in_place_of(target, *sources) as unfinished:
        unfinished.write_text(page, encoding="utf-8", errors="backslashreplace")
    return _outcome(of, target, {})


def plot(source: Path, target: Path) -> Outcome:
    (recording,) = of = opened([source])
    overview, following = recording.overview, recording.overview.following
    with as_usage_error(ValueError, hint="give -o a picture's name, such as pulse.png, and a recording with data"):
        drawn = figure(overview, recording.name.removesuffix(".mcap"), recording.notes)
        with as_usage_error(OSError, hint=WRITABLE):
            save_plot(drawn, target, source)
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
