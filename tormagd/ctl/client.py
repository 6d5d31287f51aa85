"""One request to the daemon's control endpoint, and its answer, within a bounded time."""

import itertools
import math
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
from tormagd.output import printable

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
        result = self.answer(self.ask(command, **args), self._wait_s)
        if result is None:
            raise unreachable(self._address, f"no answer within {self._wait_s:g} s")
        return result

    def ask(self, command: str, **args: Any) -> int:
        """Give `command` and do not wait; the number that `answer` knows it by."""
        request_id = next(self._ids)
        self._socket.send(encode(Request(v=VERSION, id=request_id, command=command, args=args)))
        return request_id

    def answer(self, request_id: int, wait_s: float = 0.0) -> dict[str, Any] | None:
        """The result of what was asked; None where it does not come within `wait_s`. Raises CommandError: REFUSED or
        FAULT."""
        deadline_s = time.monotonic() + wait_s
        while self._socket.poll(max(0, round((deadline_s - time.monotonic()) * 1e3))):
            reply = _reply(self._socket.recv_multipart()[-1])
            if reply.id not in (request_id, None):
                continue  # the late answer to a request that was given up
            if reply.error is not None:
                code = Exit.FAULT if reply.error.code in FAULT_CODES else Exit.REFUSED
                raise CommandError(code, reply.error.code, reply.error.message, reply.error.hint)
            return reply.result or {}
        return None

    def status(self, wait_s: float = math.inf) -> Status:
        """What the daemon is doing; an answer is waited for no longer than `wait_s` or what the client waits for any.
        Raises CommandError as `request` and `understood` do."""
        longest_s = min(wait_s, self._wait_s)
        result = self.answer(self.ask("status"), longest_s)
        if result is None:
            raise unreachable(self._address, f"no answer within {longest_s:g} s")
        return understood(result)

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

    Its texts are made printable: they are a person's to read. Raises CommandError, naming the daemon's version, where
    something is missing or of another type.
    """
    return _known(result, Status)


def _known(result: dict[str, Any], kind: type[T]) -> T:
    try:
        return msgspec.convert(_printable(result), kind)
    except (msgspec.ValidationError, RecursionError) as error:
        raise CommandError(
            Exit.UNREACHABLE,
            "unintelligible",
            f"the {kind.__name__.lower()} of tormagd {result.get('version', 'of an unknown version')} is not what "
            f"tormagctl {__version__} knows: {error}",
            "install tormagd and tormagctl of the same version, and start the daemon again",
        ) from error


def _printable(value: Any) -> Any:
    if isinstance(value, str):
        return printable(value)
    if isinstance(value, dict):
        return {_printable(key): _printable(inner) for key, inner in value.items()}
    return [_printable(inner) for inner in value] if isinstance(value, list) else value


def _reply(data: bytes) -> Reply:
    try:
        reply = decode(data, Reply)
        if reply.v != VERSION:
            raise MessageError(f"v = {reply.v}: allowed is {VERSION}")
        if (reply.error is None) != reply.ok or (reply.ok and (reply.result is None or reply.id is None)):
            raise MessageError("it says neither what was done nor why it was not")
        return reply
    except MessageError as error:
        raise CommandError(
            Exit.UNREACHABLE,
            "unintelligible",
            f"the answer is not one of tormagd's: {error}",
            "check the endpoint, and that tormagd and tormagctl are of the same version",
        ) from error
