"""What can go wrong between a program and the daemon; each error says what happened, and what to do next."""

import os
from pathlib import Path

from tormagd_client import __version__
from tormagd_client.printable import printable


class ClientError(Exception):
    """A call that failed: a stable code, what happened, and what to do next."""

    def __init__(self, code: str, message: str, hint: str) -> None:
        super().__init__(printable(f"{message}; {hint}" if hint else message))
        self.code, self.message, self.hint = code, message, hint


class RefusedError(ClientError):
    def __init__(self, command: str, code: str, message: str, hint: str) -> None:
        super().__init__(code, message, hint)
        self.command = command

    def __str__(self) -> str:
        return f"{self.command}: {super().__str__()}"


class InFaultError(RefusedError):
    """The daemon refused a command because the device is in FAULT."""


class UnreachableError(ClientError):
    """Nobody answers, or the answer is not understood."""


class SettingError(ClientError):
    """An address or a key file cannot be used."""


def not_understood(what: str, why: Exception) -> UnreachableError:
    return UnreachableError(
        "unintelligible",
        f"the {what} that came is not what tormagctl {__version__} knows: {why}",
        "check the endpoint; install tormagd and tormagctl of the same version",
    )


def unreachable(address: str, what: str) -> UnreachableError:
    """Return the error that nobody answers at `address`, with the reason that the file system shows."""
    message, hint = f"daemon not reachable at {address}: {what}", "is it running? systemctl status tormagd"
    if address.startswith("tcp://"):
        hint += (
            "; is this the address in its [endpoints]? client_secret and server_public have to be of the pair that is "
            "listed there and that daemon's own: its tormagctl status and log name those that it refused"
        )
    if address.startswith("ipc:///"):
        path = Path(address.removeprefix("ipc://"))
        try:
            path.stat()
        except PermissionError:
            hint = (
                f"you may not enter {path.parent}: join the group tormag (sudo usermod -aG tormag $USER), log in again"
            )
        except OSError:
            hint = (
                f"there is no socket {path}: start the daemon (systemctl start tormagd), or give --config or "
                "--endpoint; one that runs although its directory was removed cannot be reached: restart it"
            )
        else:
            if not os.access(path, os.W_OK):
                hint = (
                    f"you may not write to {path}: join the group tormag (sudo usermod -aG tormag $USER), log in again"
                )
    return UnreachableError("unreachable", message, hint)
