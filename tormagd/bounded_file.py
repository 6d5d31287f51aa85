"""Files that anybody may have made: nothing but a regular file is read, and no more of it than it can mean to hold."""

import errno
import os
import stat
from pathlib import Path

MOST_TABLE_BYTES = 1 << 30
"A table of measurements, which is read row by row: a day of a testing machine."
_KINDS = {
    stat.S_IFDIR: "a directory",
    stat.S_IFIFO: "a pipe",
    stat.S_IFCHR: "a character device",
    stat.S_IFBLK: "a block device",
    stat.S_IFSOCK: "a socket",
}


def require_regular(path: Path, most_bytes: int) -> os.stat_result:
    """What is known of a regular file of at most `most_bytes`. Raises OSError; its `strerror` says what is allowed."""
    try:
        found = path.stat()
    except ValueError as error:  # a name with a zero in it
        raise OSError(errno.EINVAL, "no file can have this name", str(path)) from error
    kind = stat.S_IFMT(found.st_mode)
    if kind == stat.S_IFREG and found.st_size <= most_bytes:
        return found
    what = f"this has {found.st_size}" if kind == stat.S_IFREG else f"this is {_KINDS.get(kind, 'something else')}"
    raise OSError(errno.EINVAL, f"allowed is a regular file of at most {most_bytes} bytes; {what}", str(path))


def read_bounded(path: Path, most_bytes: int) -> bytes:
    """All of a regular file of at most `most_bytes`. Raises OSError; its `strerror` says what is allowed.

    Whatever lies there: nothing is waited for, and nothing opened that does something when it is, as a port does.
    """
    require_regular(path, most_bytes)
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    with os.fdopen(descriptor, "rb") as file:
        data = file.read(most_bytes + 1)
    if len(data) > most_bytes:  # it grows, or, as some of the kernel's, does not know its size
        raise OSError(errno.EFBIG, f"allowed is a regular file of at most {most_bytes} bytes; this has more", str(path))
    return data
