"""Key files: CURVE key pairs (curve25519), and the folders of public keys that say who may do what.

`NAME.key` holds a public key, `NAME.key_secret` both, in ZeroMQ's own format (ZPL), which every ZeroMQ library reads.
"""

import hashlib
import os
import re
import stat
import struct
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

import zmq
import zmq.auth
from zmq.utils import z85

from tormagd.bounded_file import require_regular
from tormagd.config import ROLES, ConfigError, Endpoints

PUBLIC, SECRET = ".key", ".key_secret"
SERVER = "server"
"The name of the daemon's own pair."
MAX_KEY_FILE_BYTES = 4_096
MAX_KEYS = 256
"Public keys in the folder of one role."
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
_KEY_CHARACTERS = 40


class KeyPair(NamedTuple):
    """A public and a secret key, as their 40 characters of Z85."""

    public: bytes
    secret: bytes


class Listed(NamedTuple):
    """A key that is let in: its file's name, and what it may do."""

    name: str
    roles: frozenset[str]


Allowed = Mapping[str, Listed]
"Who is let in, by the 40 characters of the public key."


class KeyRing:
    """The daemon's own keys, and the lists of those that are let in. Raises ConfigError naming file and remedy."""

    def __init__(self, endpoints: Endpoints) -> None:
        curve = endpoints.curve
        if curve is None or not curve.server_secret:
            raise ConfigError("endpoints.curve.server_secret is missing: tormagctl keys generate DIR makes one")
        secret = Path(curve.server_secret)
        self.server = load_pair(secret)
        self._folders = {role: Path(getattr(curve, role) or secret.parent / role) for role in ROLES}
        self.allowed: Allowed = self.load_allowed()

    def load_allowed(self) -> Allowed:
        """The lists as they are in the folders now. Raises ConfigError; `allowed` stays as it is."""
        found: dict[str, Listed] = {}
        for role, folder in self._folders.items():
            for name, public in load_folder(folder):
                before = found.get(public)
                found[public] = Listed(name, (before.roles if before else frozenset()) | {role})
        return found


def load_pair(path: Path) -> KeyPair:
    """The pair in a `.key_secret` file that only its owner can read. Raises ConfigError."""
    information = _regular(path)
    if information.st_mode & 0o077:
        raise ConfigError(
            f"{path} can be read by others (mode {stat.S_IMODE(information.st_mode):04o}): a secret key is its owner's "
            f"only; chmod 600 {path}, and make new keys if anybody may have read it"
        )
    if information.st_uid not in (0, os.geteuid()):
        raise ConfigError(f"{path} belongs to user {information.st_uid}: allowed are this process's own and root")
    public, secret = _certificate(path)
    if secret is None:
        raise ConfigError(f"{path} holds no secret key: allowed is a file NAME{SECRET} of tormagctl keys generate")
    if not _is_key(secret) or zmq.curve_public(secret) != public:
        raise ConfigError(f"{path}: its public and its secret key do not belong together; make new keys")
    return KeyPair(public, secret)


def load_public(path: Path) -> bytes:
    """The public key in a file. Raises ConfigError."""
    _regular(path)
    return _certificate(path)[0]


def load_folder(folder: Path) -> Iterable[tuple[str, str]]:
    """Name and public key of every `NAME.key` in a folder. Raises ConfigError.

    Whoever can write there lets himself in, so nobody but its owner may.
    """
    try:
        information = folder.stat()
        paths = sorted(path for path in folder.iterdir() if path.suffix == PUBLIC)
    except OSError as error:
        raise ConfigError(
            f"{folder}: {error.strerror}: it is to hold the public keys of a role, none or more"
        ) from error
    if len(paths) > MAX_KEYS:
        raise ConfigError(f"{folder} holds {len(paths)} keys: allowed are {MAX_KEYS}")
    _refuse_writable(folder, information.st_mode)
    for path in paths:
        _refuse_writable(path, _regular(path).st_mode)
        yield path.stem, load_public(path).decode()


def fingerprint(public: bytes | str) -> str:
    """What people compare when a key has changed hands: 16 hexadecimal digits of SHA-256 over the key."""
    digest = hashlib.sha256(z85.decode(public)).hexdigest()[:16]
    return ":".join(digest[start : start + 4] for start in range(0, len(digest), 4))


def generate(name: str, secret_in: Path, public_in: Path) -> tuple[Path, Path]:
    """Makes a pair: the paths of its secret and of its public file, both 0600, in these folders (made where missing).

    Raises ConfigError where the name cannot be one, or a file is there already: nothing is ever overwritten.
    """
    if not _NAME.fullmatch(name):
        raise ConfigError(
            f"name = {name[:80]!r}: allowed are 1..64 letters, digits, . _ and -, a letter or digit first"
        )
    secret_path, public_path = secret_in / f"{name}{SECRET}", public_in / f"{name}{PUBLIC}"
    try:
        for folder in (secret_in, public_in):
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        # written where nobody else looks, and given its name only when it is whole; a link overwrites nothing
        with tempfile.TemporaryDirectory(dir=secret_in, prefix=".") as making:
            public_made, secret_made = zmq.auth.create_certificates(making, name)
            for made in (public_made, secret_made):
                Path(made).chmod(0o600)
            secret_path.hardlink_to(secret_made)
            try:
                public_path.hardlink_to(public_made)
            except OSError:
                secret_path.unlink()
                raise
    except FileExistsError as error:
        there = error.filename2 or error.filename  # a link's second path, or what stands where a folder is to be
        raise ConfigError(f"{there} exists: keys are never overwritten; take another name or DIR") from error
    except OSError as error:
        raise ConfigError(f"{error.filename2 or error.filename}: {error.strerror}") from error
    return secret_path, public_path


def _regular(path: Path) -> os.stat_result:
    try:
        return require_regular(path, MAX_KEY_FILE_BYTES)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from error


def _refuse_writable(path: Path, mode: int) -> None:
    if mode & 0o022:
        raise ConfigError(
            f"{path} can be written by others (mode {stat.S_IMODE(mode):04o}): they could let themselves in; "
            f"chmod go-w {path}"
        )


def _certificate(path: Path) -> KeyPair | tuple[bytes, None]:
    try:
        public, secret = zmq.auth.load_certificate(path)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from error
    except (ValueError, IndexError) as error:
        raise ConfigError(f"{path} holds no public key: allowed is a file of tormagctl keys generate") from error
    if not _is_key(public):
        raise ConfigError(f"{path}: its public key is none; it has to have {_KEY_CHARACTERS} characters of Z85")
    return (public, None) if secret is None else KeyPair(public, secret)


def _is_key(text: bytes) -> bool:
    try:
        return len(text) == _KEY_CHARACTERS and len(z85.decode(text)) == 32
    except (ValueError, KeyError, struct.error):
        return False
