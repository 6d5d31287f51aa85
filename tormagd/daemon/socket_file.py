"""The file of an `ipc://` socket: one process at a time has it, and only a left socket is ever replaced."""

import contextlib
import fcntl
import os
import socket
import stat
from pathlib import Path

from tormagd.ground.access_keys import require_own
from tormagd.ground.files import is_left_socket


class SocketFile:
    """A listening socket bound to `path`, which one process has at a time. Raises OSError saying what is in the way,
    and ConfigError where others may write to its folder."""

    def __init__(self, path: Path) -> None:
        self._path, self._lock_path = path, path.with_name(f"{path.name}.lock")
        try:
            path.parent.mkdir(mode=0o755, parents=True, exist_ok=True)
        except OSError as error:
            raise OSError(
                f"the directory {path.parent} cannot be made: {error.filename}: {error.strerror}; name another"
            ) from error
        require_own(path.parent)
        self._lock = _locked(self._lock_path)
        try:
            self.listener = _listening(path)
        except OSError:
            self._unlock()
            raise
        self._identity = _identity(path)

    def is_gone(self) -> bool:
        """Tell whether the socket's path was removed, or something else was put in its place."""
        return _identity(self._path) != self._identity

    def close(self) -> None:
        """Close the socket, and remove its path and its lock, unless others have been put in their place."""
        self.listener.close()
        if self._identity is not None and not self.is_gone():
            with contextlib.suppress(OSError):
                self._path.unlink()
        self._unlock()

    def _unlock(self) -> None:
        """Remove the lock's file, if it is still ours, and let the lock go."""
        held = os.fstat(self._lock)
        # before the lock is let go: a process that has opened the file then finds it gone, and tries again
        if _identity(self._lock_path) == (held.st_dev, held.st_ino):
            with contextlib.suppress(OSError):
                self._lock_path.unlink()
        os.close(self._lock)


def ipc_path(address: str) -> Path | None:
    """Return the path in an `ipc://` address; None for other addresses, and for `ipc://@name`, which has no file."""
    if not address.startswith("ipc://") or address.startswith("ipc://@"):
        return None
    return Path(address.removeprefix("ipc://"))


def _locked(path: Path) -> int:
    """Lock the file `path`, write our process number into it, and return its descriptor, which holds the lock."""
    while True:
        try:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o660)
        except OSError as error:
            raise OSError(f"{path} cannot be opened: {error.strerror}; name another path") from error
        try:
            _lock(path, descriptor)
        except OSError:
            os.close(descriptor)
            raise
        held = os.fstat(descriptor)
        if _identity(path) == (held.st_dev, held.st_ino):
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)
            return descriptor
        os.close(descriptor)  # its owner removed it between our opening and our locking it


def _lock(path: Path, descriptor: int) -> None:
    """Lock an open file without waiting."""
    content = os.pread(descriptor, 32, 0).decode(errors="replace").strip()
    if content and not content.isdecimal():
        raise OSError(f"{path} is not a lock of this program; it is left alone: name another path")
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise OSError(
            f"already running, pid {content or 'not known'}; end it, or name other addresses in [endpoints]"
        ) from error
    except OSError as error:
        raise OSError(
            f"{path} cannot be locked: {error.strerror}: its file system may have no locks; "
            "name a folder of another, as /run or /tmp is"
        ) from error


def _listening(path: Path) -> socket.socket:
    """Return a socket that listens at `path`, in place of one that was left there."""
    if _identity(path) is not None:
        if not stat.S_ISSOCK(path.lstat().st_mode):
            raise OSError(f"{path} is there and not a socket; it is left alone: name another path")
        if not is_left_socket(path):
            raise OSError(f"{path} is the socket of another program that runs; it is left alone: name another path")
    made = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC)
    try:
        path.unlink(missing_ok=True)
        made.bind(str(path))
        made.listen(100)
    except OSError as error:
        made.close()
        raise OSError(f"{path} cannot be bound: {error.strerror or error}; name another path") from error
    return made


def _identity(path: Path) -> tuple[int, int] | None:
    """Return device and inode of what is at `path`, links not followed; None where nothing is, or none can be read."""
    try:
        found = path.lstat()
    except OSError:
        return None
    return found.st_dev, found.st_ino
