"""What both clients share: addresses and keys, requests and their answers, setpoints."""

import itertools
import math
import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar, Generic, NamedTuple, Self, TypeVar

import msgspec
import zmq

from tormagd_client import __version__
from tormagd_client.endpoints import ConfigError, Curve, Endpoints, in_folder
from tormagd_client.errors import ClientError, InFaultError, RefusedError, SettingError, UnreachableError, unreachable
from tormagd_client.messages import (
    MAX_MESSAGE_BYTES,
    VERSION,
    ArmReport,
    Contact,
    Description,
    Explained,
    MessageError,
    Motion,
    Reply,
    Request,
    Setpoint,
    Status,
    Telemetry,
    Verdict,
    decode,
    encode,
)
from tormagd_client.printable import each_text, printable, require

T = TypeVar("T", Status, Description, ArmReport)
Told = TypeVar("Told", Telemetry, Motion, Verdict)
SocketT = TypeVar("SocketT", bound="zmq.Socket[Any]")

FAULT_CODES = ("fault", "device_latched")

SUBSCRIBED = b"\x01"
"First byte of what an XPUB socket receives when somebody subscribes; 0 when the last subscriber has gone."


class Keys(NamedTuple):
    """The client's key pair, and the public key of the only daemon that it believes."""

    public: bytes
    secret: bytes
    server_public: bytes
    also_local: bool


class Pending(NamedTuple):
    number: int
    command: str


def keys_of(curve: Curve | None) -> Keys | None:
    """Read the client's keys that a configuration names; None where it names none.

    Raises SettingError for an unusable file, or no key of the daemon.
    """
    if curve is None or not curve.client_secret:
        return None
    from tormagd_client.keys import PUBLIC, SECRET, load_pair, load_public  # takes a moment, and most have no keys

    server_public = curve.server_public or curve.server_secret.removesuffix(SECRET) + PUBLIC
    if server_public == PUBLIC:
        raise SettingError(
            "usage",
            "the daemon's public key is not given",
            f"endpoints.curve.server_public = FILE: the server{PUBLIC} of the daemon's machine",
        )
    try:
        pair = load_pair(Path(curve.client_secret))
        return Keys(pair.public, pair.secret, load_public(Path(server_public)), curve.also_local)
    except ConfigError as error:
        raise SettingError("usage", str(error), "correct the file, or what [endpoints.curve] names") from error


def connect(socket: "zmq.Socket[Any]", address: str, keys: Keys | None) -> None:
    """Connect `socket`, with the `keys` at `tcp://`, and at `ipc://` if they say so.

    Raises SettingError for an address that ZeroMQ cannot use.
    """
    if keys is not None and (address.startswith("tcp://") or keys.also_local):
        socket.curve_publickey, socket.curve_secretkey = keys.public, keys.secret
        socket.curve_serverkey = keys.server_public
    try:
        socket.connect(address)
    except zmq.ZMQError as error:
        raise SettingError(
            "usage",
            f"endpoint {address!r}: {error}",
            f"give an address such as ipc:///run/tormag/control (a path of at most {zmq.IPC_PATH_MAX_LEN} characters)",
        ) from error


def opened(socket: SocketT, address: str, keys: Keys | None, topic: bytes = b"") -> SocketT:
    """Set the bounds of a client's new socket, subscribe it to `topic` and connect it. Raises SettingError."""
    is_setpoints = socket.type == zmq.XPUB
    socket.setsockopt(zmq.LINGER, 200 if is_setpoints else 0)
    socket.setsockopt(zmq.IMMEDIATE, 1 if is_setpoints else 0)  # or it is not told who unsubscribes
    socket.setsockopt(zmq.MAXMSGSIZE, 16 * MAX_MESSAGE_BYTES)
    if socket.type == zmq.SUB:
        socket.subscribe(topic)
    connect(socket, address, keys)
    return socket


def asked(pending: Pending, args: dict[str, Any]) -> bytes:
    return encode(Request(v=VERSION, id=pending.number, command=pending.command, args=args))


def answered(data: bytes, pending: Pending) -> dict[str, Any] | None:
    """Return the result in an answer, or None if it answers another request.

    Raises RefusedError, InFaultError, or UnreachableError for what is no answer.
    """
    try:
        reply = decode(data, Reply)
        if reply.v != VERSION:
            raise MessageError(f"v = {reply.v}: allowed is {VERSION}")
        if (reply.error is None) != reply.ok or (reply.ok and (reply.result is None or reply.id is None)):
            raise MessageError("it says neither what was done nor why it was not")
    except MessageError as error:
        raise UnreachableError(
            "unintelligible",
            f"the answer is not one of tormagd's: {error}",
            "check the endpoint, and that tormagd and tormagctl are of the same version",
        ) from error
    if reply.id not in (pending.number, None):
        return None
    if reply.error is not None:
        raise refused(pending.command, reply.error.code, reply.error.message, reply.error.hint)
    return reply.result or {}


def understood(result: dict[str, Any], kind: type[T]) -> T:
    """Return the result of `status` or `describe` as its type, its texts made printable.

    Raises UnreachableError, naming the daemon's version, if a field is missing or of another type.
    """
    try:
        return msgspec.convert(each_text(result, printable), kind)
    except (msgspec.ValidationError, RecursionError) as error:
        raise UnreachableError(
            "unintelligible",
            f"the {kind.__name__.lower()} of tormagd {result.get('version', 'of an unknown version')} is not what "
            f"tormagctl {__version__} knows: {error}",
            "install tormagd and tormagctl of the same version, and start the daemon again",
        ) from error


def arm_report(status: dict[str, Any]) -> ArmReport:
    told = status.get("arm")
    if told is None:
        return ArmReport(given=(), is_over=True, error=Explained("gone", "the daemon was started anew", "arm again"))
    return understood(told, ArmReport)


def armed(report: ArmReport) -> tuple[str, ...]:
    """Return the commands that an `arm` has given. Raises RefusedError or InFaultError if the force does not follow."""
    if (error := report.error) is not None:
        raise refused("arm", error.code, error.cause, error.remedy)
    return report.given


def refused(command: str, code: str, message: str, hint: str) -> RefusedError:
    return (InFaultError if code in FAULT_CODES else RefusedError)(command, code, message, hint)


def _contact(fields: Mapping[str, float]) -> Contact:
    try:
        return Contact(**fields)
    except TypeError as error:
        allowed = f"{', '.join(Contact.__struct_fields__)}, numbers"
        raise ValueError(f"contact = {fields!r}: allowed are {allowed}") from error


OTHERS = "displacement_mm", "rate_mm_s", "preview_N", "preview_dt_ms"
"Fields of a setpoint that its publisher may state besides."


class Numbering:
    """Makes one publisher's setpoints, numbered from 0, in a session above every earlier one of its source."""

    def __init__(self, source: str) -> None:
        self.source, self.session = source, time.time_ns()
        self.sent = 0

    def setpoint(
        self,
        force_N: float,
        valid_for_ms: float,
        stamp_ns: int | None = None,
        *,
        withdraw_cf: float | None = None,
        contact: Contact | Mapping[str, float] | None = None,
        **fields: Any,
    ) -> bytes:
        """Return the next setpoint as bytes; `stamp_ns` is when the force is meant, None for now. Raises ValueError for
        a value that is not allowed, and TypeError for an unknown field; neither uses up a number.
        """
        given = {
            "v": VERSION,
            "source": self.source,
            "seq": self.sent,
            "session": self.session,
            "stamp_ns": time.time_ns() if stamp_ns is None else stamp_ns,
            "servo_cf": force_N,
            "valid_for_ms": valid_for_ms,
            "withdraw_cf": withdraw_cf,
            "contact": contact if contact is None or isinstance(contact, Contact) else _contact(contact),
        }
        if unknown := sorted(fields.keys() - set(OTHERS)):
            raise TypeError(f"{unknown[0]}: allowed are {', '.join(OTHERS)}")
        data = encode({name: value for name, value in (given | fields).items() if value is not None})
        decode(data, Setpoint)  # what the daemon would refuse is refused here
        self.sent += 1
        return data


class Connections(Generic[SocketT]):
    """Base of both clients: the daemon at `endpoints`, and the sockets to it, opened when needed."""

    _made: ClassVar[Callable[[], Any]]
    "Makes the ZeroMQ context of the sockets."

    def __init__(self, endpoints: Endpoints, wait_s: float = 1.0, source: str = "client") -> None:
        require(0.0 <= wait_s < math.inf, "wait_s", wait_s, "a finite number of seconds, 0 or more")
        require(isinstance(source, str), "source", source, "a text")
        self._endpoints, self._wait_s, self._process = endpoints, wait_s, os.getpid()
        self._keys = keys_of(endpoints.curve)
        self._numbering = Numbering(source)
        self._context = type(self)._made()
        self._ids = itertools.count(1)
        self._sockets: dict[tuple[int, bytes], SocketT] = {}
        self._is_taken = False

    @classmethod
    def local(cls, folder: str, wait_s: float = 1.0, source: str = "client") -> Self:
        """Return a client of this machine's daemon whose sockets are in `folder`. Raises ConfigError."""
        return cls(in_folder(folder), wait_s, source)

    def close(self) -> None:
        """Close the connections; pending setpoints get 0.2 s."""
        if self._process != os.getpid():  # the sockets are those of the process before a fork
            return
        self._context.destroy()

    def _socket(self, kind: int, address: str, topic: bytes = b"") -> SocketT:
        if self._context.closed or self._process != os.getpid():
            raise ClientError("closed", "this client was closed, or made in another process", "make one for each")
        if (kind, topic) not in self._sockets:
            self._sockets[kind, topic] = opened(self._context.socket(kind), address, self._keys, topic)
        return self._sockets[kind, topic]

    def _unanswered(self, wait_s: float) -> UnreachableError:
        return unreachable(self._endpoints.control, f"no answer within {wait_s:g} s")

    def _untaken(self) -> UnreachableError:
        return unreachable(self._endpoints.setpoint, f"nobody takes setpoints there within {self._wait_s:g} s")
