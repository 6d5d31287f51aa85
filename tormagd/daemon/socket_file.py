"""The file of an `ipc://` socket: one process at a time has it, and only a left socket is ever replaced."""

import contextlib
import fcntl
import os
import socket
import stat
from collections.abc import Iterator
from pathlib import Path

from tormagd.ground.access_keys import require_own
from tormagd.ground.files import listener_of


class SocketFile:
    """A listening socket bound to `path`, which one process has at a time. Raises OSError saying what is in the way,
    and ConfigError where others may write to its folder."""

    def __init__(self, path: Path) -> None:
        self._path, folder = path, path.parent
        try:
            folder.mkdir(mode=0o755, parents=True, exist_ok=True)
        except OSError as error:
            raise OSError(
                f"the directory {folder} cannot be made: {error.filename}: {error.strerror}; name another"
            ) from error
        require_own(folder)
        with _locked(folder):
            self.listener = _listening(path)
        self._identity = _identity(path)

    def is_gone(self) -> bool:
        """Tell whether the socket's path was removed, or something else was put in its place."""
        return _identity(self._path) != self._identity

    def close(self) -> None:
        """Close the socket, and remove its path, unless another has been put in its place."""
        self.listener.close()
        if self._identity is not None and not self.is_gone():
            with contextlib.suppress(OSError):
                self._path.unlink()


def ipc_path(address: str) -> Path | None:
    """Return the path in an `ipc://` address; None for other addresses, and for `ipc://@name`, which has no file."""
    if not address.startswith("ipc://") or address.startswith("ipc://@"):
        return None
    return Path(address.removeprefix("ipc://"))


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Keep others that bind sockets in `folder` from doing so meanwhile, without waiting for them."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        _lock(folder, descriptor)
        yield
    finally:
        os.close(descriptor)


def _lock(folder: Path, descriptor: int) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise OSError(f"another process binds a socket in {folder} at this moment; start again") from error
    except OSError as error:
        raise OSError(
            f"{folder} cannot be locked: {error.strerror}: its file system may have no locks; "
            "name a folder of another, as /run or /tmp is"
        ) from error


def _listening(path: Path) -> socket.socket:
    """Return a socket that listens at `path`, in place of one that was left there."""
    if _identity(path) is not None:
        _require_left(path)
    made = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC)
    try:
        path.unlink(missing_ok=True)
        made.bind(str(path))
        made.listen(100)
    except OSError as error:
        made.close()
        raise OSError(f"{path} cannot be bound: {error.strerror or error}; name another path") from error
    return made


def _require_left(path: Path) -> None:
    """Raise OSError for what is no socket, and for one that somebody has open."""
    if not stat.S_ISSOCK(path.lstat().st_mode):
        raise OSError(f"{path} is there and not a socket; it is left alone: name another path")
    if (process := listener_of(path)) is not None:
        raise OSError(f"already running, pid {process or 'not known'}; end it, or name other addresses in [endpoints]")


def _identity(path: Path) -> tuple[int, int] | None:
    """Return device and inode of what is at `path`, links not followed; None where nothing is, or none can be read."""
    try:
        found = path.lstat()
    except OSError:
        return None
    return found.st_dev, found.st_ino
