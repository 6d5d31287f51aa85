"""Files that anybody may have made: only a regular file is read, and never more than a given size.

What is written replaces an earlier file in one step.
"""

import contextlib
import errno
import os
from collections.abc import Iterator
from pathlib import Path

from tormagd_client.regular_file import require_regular


def read_bounded(path: Path, most_bytes: int) -> bytes:
    """Return all bytes of a regular file of at most `most_bytes`, following links."""
    require_regular(path, most_bytes)
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    with os.fdopen(descriptor, "rb") as file:
        data = file.read(most_bytes + 1)
    if len(data) > most_bytes:  # a file that grows, or one of the kernel's without a size
        raise OSError(errno.EFBIG, f"allowed is a regular file of at most {most_bytes} bytes; this has more", str(path))
    return data


@contextlib.contextmanager
def in_place_of(path: Path) -> Iterator[Path]:
    """Give a path beside `path` to write to, which replaces `path` at the end."""
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, "this is a folder: allowed is a file's name", str(path))
    beside = path.with_name(f"{path.name}.part")
    beside.unlink(missing_ok=True)
    try:
        yield beside
        with beside.open("rb") as file:
            os.fsync(file.fileno())
        beside.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            beside.unlink()
        raise
