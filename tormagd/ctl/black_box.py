"""`tormagctl blackbox`: have the daemon write its last half minute, and fetch the file."""

import shutil
from pathlib import Path

from tormagd.ctl.operate import statuses
from tormagd.ctl.outcome import CommandError, Exit, Outcome, as_usage_error, usage_error
from tormagd.ground.files import new_file
from tormagd_client.blocking import Client

LONGEST_S = 30.0
"Longest wait for the file; writing takes a second or two, at low priority."


def black_box(client: Client, copy: Path | None) -> Outcome:
    """Have the daemon write its black box, wait until the file is on the disk, and copy it to the new file `copy`."""
    if copy is not None and copy.exists():
        raise usage_error(f"{copy} exists", "give another name; nothing is overwritten")
    written = Path(client.request("blackbox")["file"])
    boxes = (state.black_box for _, state in statuses(client, LONGEST_S))
    box = next((each for each in boxes if each.newest == written.name or each.refusal), None)
    if box is None or box.newest != written.name:
        raise CommandError(
            Exit.REFUSED,
            "not_written",
            f"{written} was not written within {LONGEST_S:g} s" if box is None else box.refusal,
            "make room in [black_box] folder, or name another; the daemon's log says more",
        )
    if copy is None:
        return Outcome({"file": str(written)}, f"{written}\ntormagctl replay runs it again, tormagctl plot draws it")
    hint = f"it is {written} on the daemon's machine: fetch it from there"
    with as_usage_error(OSError, hint=hint), new_file(copy):
        shutil.copyfile(written, copy)
    return Outcome({"file": str(copy), "original": str(written)}, f"{copy} (also {written})")
