"""Key files: CURVE key pairs (curve25519).

`NAME.key` holds a public key, `NAME.key_secret` both, in ZeroMQ's own format (ZPL), which every ZeroMQ library reads.
"""

import hashlib
import os
import re
import stat
import struct
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

import zmq
import zmq.auth
from zmq.utils import z85

from tormagd_client.endpoints import ConfigError
from tormagd_client.regular_file import require_regular

PUBLIC, SECRET = ".key", ".key_secret"
SERVER = "server"
MAX_KEY_FILE_BYTES = 4_096
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
_KEY_CHARACTERS = 40


class KeyPair(NamedTuple):
    """A public and a secret key, each as 40 characters of Z85."""

    public: bytes
    secret: bytes


def load_pair(path: Path) -> KeyPair:
    """Read the key pair in a `.key_secret` file.

    Raises ConfigError for an unreadable file, one that others can read or own, and keys that do not match.
    """
    information = regular(path)
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
    """Read the public key in a key file. Raises ConfigError."""
    regular(path)
    return _certificate(path)[0]


def fingerprint(public: bytes | str) -> str:
    """Return what people compare when a key has changed hands: 16 hexadecimal digits of its SHA-256."""
    return hashlib.sha256(z85.decode(public)).digest()[:8].hex(":", 2)


def generate(name: str, secret_in: Path, public_in: Path) -> tuple[Path, Path]:
    """Make a key pair, both files with mode 0600, and return the paths of its secret and its public file.

    Raises ConfigError if `name` is not allowed, or a file exists or cannot be made.
    """
    if not _NAME.fullmatch(name):
        raise ConfigError(
            f"name = {name[:80]!r}: allowed are 1..64 letters, digits, . _ and -, a letter or digit first"
        )
    secret_path, public_path = secret_in / f"{name}{SECRET}", public_in / f"{name}{PUBLIC}"
    try:
        for folder in (secret_in, public_in):
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        # a key is written in a hidden folder and named once it is whole; a hard link never overwrites
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
        there = error.filename2 or error.filename  # a link's second path, or what is in the place of a folder
        raise ConfigError(f"{there} exists: keys are never overwritten; take another name or DIR") from error
    except OSError as error:
        raise ConfigError(f"{error.filename2 or error.filename or secret_in}: {error.strerror}") from error
    return secret_path, public_path


def regular(path: Path) -> os.stat_result:
    """Return the status of a file that may hold a key. Raises ConfigError for another kind of file, or a large one."""
    try:
        return require_regular(path, MAX_KEY_FILE_BYTES)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from error


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


def main(arguments: list[str]) -> str:
    """Make a client's key pair from NAME and FOLDER, and return what to tell the user. Raises SystemExit on failure."""
    try:
        name, folder = arguments
        secret, public = generate(name, Path(folder), Path(folder))
        return f"{secret} stays here; {public} goes to the daemon: {fingerprint(load_public(public))}"
    except ConfigError as error:
        raise SystemExit(str(error)) from error
    except ValueError as error:
        raise SystemExit("usage: python -m tormagd_client.keys NAME FOLDER") from error


if __name__ == "__main__":
    print(main(sys.argv[1:]))
