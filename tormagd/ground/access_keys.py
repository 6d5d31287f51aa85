"""Who may do what at the daemon: its own key pair, and a folder of public keys for each role."""

import os
import stat
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

from tormagd_client.endpoints import ROLES, ConfigError, Endpoints
from tormagd_client.keys import PUBLIC, fingerprint, load_pair, load_public, regular

MAX_KEYS = 256


class Listed(NamedTuple):
    """A client's key that the daemon accepts: its file's name, its fingerprint, and the roles of its folders."""

    name: str
    fingerprint: str
    roles: frozenset[str]


Allowed = Mapping[str, Listed]
"Accepted keys by public key."


class KeyRing:
    """The daemon's own key pair, and the accepted public keys of each role."""

    def __init__(self, endpoints: Endpoints) -> None:
        curve = endpoints.curve
        if curve is None or not curve.server_secret:
            raise ConfigError("endpoints.curve.server_secret is missing: tormagctl keys generate DIR makes one")
        secret = Path(curve.server_secret)
        self.server = load_pair(secret)
        self._folders = {role: Path(getattr(curve, role) or secret.parent / role) for role in ROLES}
        self.allowed: Allowed = self.load_allowed()

    def load_allowed(self) -> Allowed:
        """Read the key folders of all roles again and return the accepted keys."""
        found: dict[str, Listed] = {}
        for role, folder in self._folders.items():
            for name, public in load_folder(folder):
                before = found.get(public)
                found[public] = Listed(name, fingerprint(public), (before.roles if before else frozenset()) | {role})
        return found


def load_folder(folder: Path) -> Iterable[tuple[str, str]]:
    """Yield name and public key of every `NAME.key` in `folder`, sorted by name."""
    try:
        information = folder.stat()
        paths = sorted(path for path in folder.iterdir() if path.suffix == PUBLIC)
    except OSError as error:
        raise ConfigError(
            f"{folder}: {error.strerror}: make it, for the public keys of a role, none or more"
        ) from error
    if len(paths) > MAX_KEYS:
        raise ConfigError(f"{folder} holds {len(paths)} keys: allowed are {MAX_KEYS}; take out those that nobody uses")
    _refuse_writable(folder, information.st_mode)
    for path in paths:
        _refuse_writable(path, regular(path).st_mode)
        yield path.stem, load_public(path).decode()


def require_own(folder: Path) -> None:
    """Raise ConfigError, with the remedy, where others could put something of theirs in the place of what is in
    `folder`."""
    found = folder.stat()
    if found.st_uid not in (0, os.geteuid()):
        raise ConfigError(
            f"{folder} belongs to user {found.st_uid}: allowed are this process's own and root; name another folder"
        )
    if not found.st_mode & stat.S_ISVTX:
        _refuse_writable(folder, found.st_mode)


def _refuse_writable(path: Path, mode: int) -> None:
    if mode & 0o022:
        raise ConfigError(
            f"{path} can be written by others (mode {stat.S_IMODE(mode):04o}): they could let themselves in; "
            f"chmod go-w {path}"
        )
