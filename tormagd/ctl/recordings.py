"""`tormagctl recordings` and `mark`: what a folder of recordings holds, and which of it stays."""

import hashlib
import shutil
from pathlib import Path
from typing import Any

from tormagd.config import Config
from tormagd.ctl.outcome import Exit, Outcome, as_usage_error, usage_error
from tormagd.ground.files import new_file
from tormagd.record.folder import RecordingFolder, Segment, mark as mark_segment
from tormagd.record.reader import RecordingError, damage_in, summary_of
from tormagd_client.blocking import Client


def mark(client: Client, text: str) -> Outcome:
    """Put an event into telemetry, and so into every recording; a folder's present segment is then kept
    from pruning."""
    return Outcome(client.request("mark", text=text), f"marked: {text}")


def recordings(config: Config, action: str, path: Path | None, target: Path | None) -> Outcome:
    """List a folder, prune it to its budget, mark a recording so that it is kept, or copy it to `target`."""
    if target is not None and action != "export":
        raise usage_error(
            "--to: allowed only for recordings export", "tormagctl recordings export FILE.mcap --to FOLDER"
        )
    with as_usage_error(OSError, ValueError, hint="tormagctl recordings --help"):
        if action in ("list", "prune"):
            folder = RecordingFolder(path or Path(config.recordings.folder), config.recordings)
            if not folder.path.is_dir():
                raise usage_error(f"{folder.path}: no such folder", "name the folder, or set [recordings] folder")
            return _list(folder) if action == "list" else _prune(folder)
        if path is None:
            raise usage_error(f"{action}: no recording is named", f"tormagctl recordings {action} FILE.mcap")
        if action == "mark":
            kept = mark_segment(path)
            return Outcome({"file": str(kept)}, f"{kept} stays until somebody takes it away")
        return _export(path, target)


def _list(folder: RecordingFolder) -> Outcome:
    """Describe each segment of the folder, the oldest first, and say their total size."""
    rows = [_row(segment) for segment in folder.segments()]
    size_MB = sum(row["MB"] for row in rows)
    lines = [
        f"{row['name']:<44} {row['MB']:9.1f} MB {row['seconds'] or 0.0:9.1f} s  "
        f"{'marked' if row['is_marked'] else '':<7}{row['said']}"
        for row in rows
    ]
    count = f"{len(rows)} recording{'s' * (len(rows) != 1)}"
    total = f"{count}, {size_MB:.1f} of {folder.budget.most_MB:.1f} MB in {folder.path}"
    return Outcome({"folder": str(folder.path), "recordings": rows, "MB": size_MB}, "\n".join([*lines, total]))


def _row(segment: Segment) -> dict[str, Any]:
    """Describe one segment by its overview; without one, `said` tells why."""
    seconds, faults, marks = None, [], []
    try:
        known = summary_of(segment.path)
    except RecordingError as error:
        said = [str(error).removeprefix(f"{segment.path}: ")]
    else:
        said = ["no overview: still written, not ended by its recorder, or older"]
        if known is not None:
            _, overview = known
            seconds = round(overview.duration_s, 3)
            faults, marks = list(overview.spans_s("faults")), [each.text for each in overview.marks]
            said = [*faults, *(f"“{text}”" for text in marks)]
    return {
        "name": segment.path.name,
        "began_s": segment.began_s,
        "MB": round(segment.bytes / 1e6, 3),
        "is_marked": segment.is_marked,
        "seconds": seconds,
        "faults": faults,
        "marks": marks,
        "said": ", ".join(said),
    }


def _prune(folder: RecordingFolder) -> Outcome:
    """Delete what is over the budget, and say what was deleted and whether that is enough."""
    gone = folder.prune()
    over = folder.make_room(0)
    names = [each.path.name for each in gone]
    text = f"{len(gone)} recording{'s' * (len(gone) != 1)} taken away, {sum(each.bytes for each in gone) / 1e6:.1f} MB"
    return Outcome({"removed": names, "over": over}, f"{text}\n{over}".strip(), Exit.REFUSED if over else Exit.DONE)


def _export(path: Path, target: Path | None) -> Outcome:
    """Copy a recording to a new file, check the copy's CRCs, and tell its SHA-256; REFUSED where it is damaged."""
    if target is None:
        raise usage_error("export: no place is named", f"tormagctl recordings export {path} --to FOLDER")
    copy = target / path.name if target.is_dir() else target
    with new_file(copy):
        shutil.copyfile(path, copy)
    with copy.open("rb") as made:
        digest = hashlib.file_digest(made, "sha256").hexdigest()
        damage = damage_in(made)
    text = "\n".join([f"{copy}: SHA-256 {digest}", *([f"damaged: {damage}"] if damage else [])])
    result = {"file": str(copy), "sha256": digest, "damage": damage}
    return Outcome(result, text, Exit.REFUSED if damage else Exit.DONE)
