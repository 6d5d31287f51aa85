"""`tormagctl report`: one page of a recording, or of two side by side."""

from pathlib import Path

from tormagd.bounded_file import in_place_of
from tormagd.config import Config
from tormagd.ctl.outcome import Exit, Outcome, as_usage_error, usage_error
from tormagd.ctl.record import key_of
from tormagd.dashboard.report import Reported, report as page_of
from tormagd.recording.reader import RecordingFile
from tormagd.recording.seal import verified


def report(config: Config, sources: list[Path], target: Path) -> Outcome:
    """Write an HTML page on one or two recordings to `target`; a page there is replaced, whole or not at all.

    The outcome is REFUSED where one was altered, or sealed without the configured key. Raises CommandError (USAGE):
    more than two, one that cannot be read, or a page that cannot be written.
    """
    if len(sources) > 2:
        said = f"{len(sources)} recordings: allowed are one or two"
        raise usage_error(said, "tormagctl report A.mcap B.mcap -o AB.html")
    key = key_of(config)
    with as_usage_error(ValueError, OSError, hint="give files that tormagctl record has made"):
        of = [Reported(RecordingFile(source), verified(source, key)) for source in sources]
        page = page_of(of)
    with as_usage_error(OSError, hint="give a file in a directory you may write to"), in_place_of(target) as unfinished:
        unfinished.write_text(page, encoding="utf-8")
    seals = {str(each.file.path): each.seal.state for each in of}
    text = "\n".join([*(f"{each.file.path}: {each.seal.text()}" for each in of), str(target)])
    is_sound = all(each.seal.is_sound for each in of)
    return Outcome({"file": str(target), "seals": seals}, text, Exit.DONE if is_sound else Exit.REFUSED)
