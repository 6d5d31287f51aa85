"""Files that anybody may have made, and files that a user names.

Only a regular file is read or replaced. What is written replaces it in one step, or is new, and is whole or not there.
"""

import contextlib
import errno
import os
import resource
import socket
import struct
from collections.abc import Iterable, Iterator
from importlib.resources.abc import Traversable
from pathlib import Path

from tormagd_client.endpoints import ConfigError
from tormagd_client.printable import in_short
from tormagd_client.regular_file import require_regular

CREDENTIALS = struct.Struct("3i")
"Process, user and group of a connection's other end: `struct ucred` of unix(7)."


def read_bounded(path: Path, most_bytes: int) -> bytes:
    """Return all bytes of a regular file of at most `most_bytes`, following links."""
    require_regular(path, most_bytes)
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    with os.fdopen(descriptor, "rb") as file:
        data = file.read(most_bytes + 1)
    if len(data) > most_bytes:  # a file that grows, or one of the kernel's without a size
        raise OSError(errno.EINVAL, f"allowed are at most {most_bytes} bytes; this has more", str(path))
    return data


@contextlib.contextmanager
def in_place_of(path: Path, *sources: Path) -> Iterator[Path]:
    """Give a path beside `path` to write to, which replaces `path` at the end, but none of `sources`."""
    with contextlib.suppress(FileNotFoundError):
        found = require_regular(path)
        if any(os.path.samestat(found, source.stat()) for source in sources):
            raise OSError(errno.EINVAL, "this is read here: allowed is another file", str(path))
    beside = path.with_name(f"{path.name}.part")
    with _whole_or_gone(beside, path):
        beside.unlink(missing_ok=True)
        yield beside
        with beside.open("rb") as file:
            os.fsync(file.fileno())
        beside.replace(path)


@contextlib.contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """Make an empty file to write to. Raises FileExistsError."""
    path.open("xb").close()
    with _whole_or_gone(path, path):
        yield path


def listener_of(path: Path) -> int | None:
    """Return the process that listens at a socket, 0 if the kernel does not say; None where it refuses a connection of
    whatever type."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK) as probe:
        if probe.connect_ex(str(path)) in (errno.ECONNREFUSED, errno.ENOENT):
            return None
        return int(CREDENTIALS.unpack(probe.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, CREDENTIALS.size))[0])


@contextlib.contextmanager
def _whole_or_gone(written: Path, path: Path) -> Iterator[None]:
    """Remove `written` after an error, which then names `path`."""
    try:
        yield
    except BaseException as error:
        with contextlib.suppress(OSError):
            written.unlink()
        ours = str(written)
        # of a copy, the second name is what is written
        if isinstance(error, OSError) and error.errno and ours in (error.filename or ours, error.filename2):
            error.filename = str(path)
        raise


def raise_open_files(least: int) -> None:
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard != resource.RLIM_INFINITY and hard < least:
        raise OSError(
            f"the hard limit of open files is {hard}: allowed is {least} or more; raise LimitNOFILE, or ulimit -Hn"
        )
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))


def shipped(folder: Traversable, ending: str) -> tuple[str, ...]:
    """Return the names of a package folder's files with `ending`, without it."""
    return tuple(sorted(each.name.removesuffix(ending) for each in folder.iterdir() if each.name.endswith(ending)))


def named(key: str, name: str, folder: Traversable, ending: str, beside: Path = Path()) -> Path:
    """Return the path of a shipped file, or else of the existing file `name`, relative to `beside`."""
    names, reason = shipped(folder, ending), ""
    if name in names:
        return Path(str(folder / f"{name}{ending}"))
    try:
        # a link to nowhere is for its reader to tell
        if name.encode() and ((beside / name).exists() or (beside / name).is_symlink()):
            return beside / name
    except (OSError, UnicodeEncodeError) as error:  # a name no file can have, or a directory that may not be entered
        reason = f"{getattr(error, 'strerror', 'no UTF-8 text')}; "
    near = did_you_mean(name, names)
    raise ConfigError(f"{key} = {in_short(name)}: {reason}allowed is a file or one of {', '.join(names)}{near}")


def did_you_mean(word: str, allowed: Iterable[str]) -> str:
    """Return `; did you mean ...?` with the allowed word nearest to `word`, or ""."""
    import difflib  # takes a moment, and most configurations are right

    near = difflib.get_close_matches(word, list(allowed), n=1)
    return f"; did you mean `{near[0]}`?" if near else ""
