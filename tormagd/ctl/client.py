"""One request to the daemon's control endpoint, and its answer, within a bounded time."""

import itertools
import os
import time
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self, TypeVar

import msgspec
import zmq

from tormagd import __version__
from tormagd.config import ConfigError, Curve
from tormagd.ctl.outcome import CommandError, Exit, usage_error
from tormagd.keys import PUBLIC, SECRET, KeyPair, load_pair, load_public
from tormagd.messages import VERSION, Description, MessageError, Reply, Request, Status, decode, encode

T = TypeVar("T", Status, Description)

FAULT_CODES = ("fault", "device_latched")
"Refusals that mean: the device is in FAULT."


class Keys(NamedTuple):
    """What a client shows, and the only daemon that it believes."""

    client: KeyPair
    server_public: bytes
    also_local: bool


class Client:
    """A connection to the control endpoint; a context manager. `keys` are shown where the address wants them."""

    def __init__(self, address: str, wait_s: float, keys: Keys | None = None) -> None:
        self._address, self._wait_s = address, wait_s
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.DEALER)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._ids = itertools.count(1)
        connect(self._socket, address, keys)

    def request(self, command: str, **args: Any) -> dict[str, Any]:
        """The result of `command`. Raises CommandError: UNREACHABLE without an answer in time, REFUSED or FAULT."""
        request_id = next(self._ids)
        self._socket.send(encode(Request(v=VERSION, id=request_id, command=command, args=args)))
        deadline_s = time.monotonic() + self._wait_s
        while (left_s := deadline_s - time.monotonic()) > 0.0:
            if not self._socket.poll(max(1, round(left_s * 1e3))):
                break
            reply = _reply(self._socket.recv_multipart()[-1])
            if reply.id not in (request_id, None):
                continue  # the late answer to a request that was given up
            if reply.error is not None:
                code = Exit.FAULT if reply.error.code in FAULT_CODES else Exit.REFUSED
                raise CommandError(code, reply.error.code, reply.error.message, reply.error.hint)
            return reply.result or {}
        raise unreachable(self._address, f"no answer within {self._wait_s:g} s")

    def status(self) -> Status:
        """What the daemon is doing. Raises CommandError as `request` and `understood` do."""
        return understood(self.request("status"))

    def describe(self) -> Description:
        """What the daemon runs. Raises CommandError as `request` does, also for an answer that is not understood."""
        return _known(self.request("describe"), Description)

    def close(self) -> None:
        """Close the connection without waiting for anything."""
        self._context.destroy(linger=0)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()


def keys_of(curve: Curve | None) -> Keys | None:
    """The client's keys in a configuration; None where it has none. Raises CommandError (USAGE): a file is no good."""
    if curve is None or not curve.client_secret:
        return None
    server_public = curve.server_public or curve.server_secret.removesuffix(SECRET) + PUBLIC
    if server_public == PUBLIC:
        raise usage_error(
            "the daemon's public key is not given", f"--server-key FILE: the server{PUBLIC} of the daemon's machine"
        )
    try:
        return Keys(load_pair(Path(curve.client_secret)), load_public(Path(server_public)), curve.also_local)
    except ConfigError as error:
        raise usage_error(str(error), "correct the file, or what --key and --server-key name") from error


def connect(socket: "zmq.Socket[bytes]", address: str, keys: Keys | None) -> None:
    """Connect `socket`, showing the keys at `tcp://`, and at `ipc://` where the configuration says so.

    Raises CommandError (USAGE) for an address that ZeroMQ cannot use.
    """
    if keys is not None and (address.startswith("tcp://") or keys.also_local):
        socket.curve_publickey, socket.curve_secretkey = keys.client
        socket.curve_serverkey = keys.server_public
    try:
        socket.connect(address)
    except zmq.ZMQError as error:
        raise usage_error(
            f"endpoint {address!r}: {error}",
            f"give an address such as ipc:///run/tormag/control (a path of at most {zmq.IPC_PATH_MAX_LEN} characters)",
        ) from error


def unreachable(address: str, what: str) -> CommandError:
    """Nobody answers at `address`: says why where that can be seen, and what to do."""
    message, hint = f"daemon not reachable at {address}: {what}", "is it running? systemctl status tormagd"
    if address.startswith("tcp://"):
        hint += (
            "; --key and --server-key have to be the pair that is listed there and that daemon's own: its tormagctl "
            "status and log name those that it refused"
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
    return CommandError(Exit.UNREACHABLE, "unreachable", message, hint)


def understood(result: dict[str, Any]) -> Status:
    """The answer to `status`; what a newer daemon says besides is passed over.

    Raises CommandError, naming the daemon's version, where something is missing or of another type.
    """
    return _known(result, Status)


def _known(result: dict[str, Any], kind: type[T]) -> T:
    try:
        return msgspec.convert(result, kind)
    except msgspec.ValidationError as error:
        raise CommandError(
            Exit.UNREACHABLE,
            "unintelligible",
            f"the {kind.__name__.lower()} of tormagd {result.get('version', 'of an unknown version')} is not what "
            f"tormagctl {__version__} knows: {error}",
            "install tormagd and tormagctl of the same version, and start the daemon again",
        ) from error


def _reply(data: bytes) -> Reply:
    try:
        return decode(data, Reply)
    except MessageError as error:
        raise CommandError(
            Exit.UNREACHABLE,
            "unintelligible",
            f"the answer is not one of tormagd's: {error}",
            "check the endpoint, and that tormagd and tormagctl are of the same version",
        ) from error
