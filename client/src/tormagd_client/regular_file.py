"""Files that anybody may have made: only a regular file is opened."""

import errno
import os
import stat
import sys
from pathlib import Path

_KINDS = {
    stat.S_IFDIR: "a directory",
    stat.S_IFIFO: "a pipe",
    stat.S_IFCHR: "a character device",
    stat.S_IFBLK: "a block device",
    stat.S_IFSOCK: "a socket",
}


def require_regular(path: Path, most_bytes: int = sys.maxsize) -> os.stat_result:
    """Return the status of a regular file of at most `most_bytes`. Raises OSError, whose `strerror` says what is
    allowed.
    """
    try:
        found = path.stat()
    except ValueError as error:  # a name with a zero in it
        raise OSError(errno.EINVAL, "no file can have this name", str(path)) from error
    kind = stat.S_IFMT(found.st_mode)
    if kind == stat.S_IFREG and found.st_size <= most_bytes:
        return found
    what = f"this has {found.st_size}" if kind == stat.S_IFREG else f"this is {_KINDS.get(kind, 'something else')}"
    size = "" if most_bytes == sys.maxsize else f" of at most {most_bytes} bytes"
    raise OSError(errno.EINVAL, f"allowed is a regular file{size}; {what}", str(path))
