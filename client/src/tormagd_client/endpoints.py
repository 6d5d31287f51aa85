"""Where a daemon is: ZeroMQ addresses, and key files for connections from elsewhere."""

import ipaddress
import os
import re

import msgspec

from tormagd_client.printable import require

DEFAULT_RUN_DIR = "/run/tormag"
LONGEST_IPC_PATH = 107  # bytes that the kernel takes of a socket's path
ENDPOINTS = ("setpoint", "telemetry", "control", "recording")
ROLES = ("publish", "operate", "observe")

_TCP = re.compile(r"tcp://(localhost|[0-9.]+):([0-9]{1,5})")


class ConfigError(ValueError):
    """A configuration that was refused: the message names the key, the value and what is allowed."""


class Strict(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A table of the configuration; unknown keys are refused."""


class Curve(Strict, frozen=True):
    """Key files. The daemon takes `server_secret` and a folder of public keys for each role, a client the last two.

    An empty folder key means the folder of the role's name beside `server_secret`.
    """

    server_secret: str = ""
    "The daemon's key pair, `server.key_secret`."
    publish: str = ""
    "Keys that may only send setpoints."
    operate: str = ""
    "Keys that may command and look."
    observe: str = ""
    "Keys that may look: telemetry, recording, `status`."
    also_local: bool = False
    "Whether `ipc://` and loopback also demand keys."
    client_secret: str = ""
    "The client's key pair."
    server_public: str = ""
    "The daemon's public key; by default the `.key` beside `server_secret`."


class Endpoints(Strict, frozen=True):
    """ZeroMQ addresses. Any but `ipc://` and loopback need CURVE keys."""

    setpoint: str = f"ipc://{DEFAULT_RUN_DIR}/setpoint"
    "Setpoints from publishers."
    telemetry: str = f"ipc://{DEFAULT_RUN_DIR}/telemetry"
    "Telemetry to subscribers."
    control: str = f"ipc://{DEFAULT_RUN_DIR}/control"
    "Commands."
    recording: str = f"ipc://{DEFAULT_RUN_DIR}/recording"
    "Every control tick, for the recorder."
    curve: Curve | None = None
    "Keys, for who connects from elsewhere."

    def is_guarded(self, name: str) -> bool:
        """Whether the endpoint `name` accepts only clients whose key is listed."""
        matched = _TCP.fullmatch(getattr(self, name))
        address = None if matched is None else _ipv4(matched[1])
        is_local = matched is None or (address is not None and address.is_loopback)
        return not is_local or (self.curve is not None and self.curve.also_local)


def require_usable(endpoints: Endpoints) -> None:
    """Raise ValueError for an address that cannot be used, is used twice, or needs keys that are not given."""
    taken: dict[str, str] = {}
    curve = endpoints.curve
    has_keys = curve is not None and bool(curve.server_secret or curve.client_secret)
    require(
        has_keys or curve is None or not curve.also_local,
        "endpoints.curve.also_local",
        True,
        "false without keys, which are server_secret or client_secret",
    )
    for name in ENDPOINTS:
        address = getattr(endpoints, name)
        place = _ipc_place(name, address) if address.startswith("ipc://") else _tcp_place(name, address, has_keys)
        require(
            place not in taken,
            f"endpoints.{name}",
            address,
            f"an address other than that of endpoints.{taken.get(place)}",
        )
        taken[place] = name


def in_folder(folder: str) -> Endpoints:
    """Return the endpoints of a daemon whose sockets are in `folder`. Raises ConfigError for an unusable or too long
    path.
    """
    try:
        placed = msgspec.convert({name: f"ipc://{folder}/{name}" for name in ENDPOINTS}, Endpoints)
        require_usable(placed)
    except ValueError as error:
        raise ConfigError(str(error)) from error
    return placed


def _ipc_place(name: str, address: str) -> str:
    path = address.removeprefix("ipc://")
    require(
        path not in ("", "@", "*")
        and path.isprintable()
        and not path.endswith("/")
        and len(path.encode()) <= LONGEST_IPC_PATH,
        f"endpoints.{name}",
        address,
        f"after ipc:// the path of a socket, or @ and a name, of at most {LONGEST_IPC_PATH} bytes",
    )
    return path if path.startswith("@") else os.path.realpath(path)


def _tcp_place(name: str, address: str, has_keys: bool) -> str:
    """Return host and port of a `tcp://` address; without keys only loopback is allowed."""
    matched = _TCP.fullmatch(address)
    host, port = matched.groups() if matched else ("", "0")
    found = _ipv4(host)
    require(
        found is not None and (has_keys or found.is_loopback) and 0 < int(port) < 65_536,
        f"endpoints.{name}",
        address,
        "ipc:// or tcp:// with an IPv4 address and a port of 1..65535"
        if has_keys
        else "ipc:// or a loopback tcp:// address with a port of 1..65535; others need CURVE keys in [endpoints.curve]",
    )
    return f"{found}:{int(port)}"


def _ipv4(host: str) -> ipaddress.IPv4Address | None:
    try:
        return ipaddress.IPv4Address("127.0.0.1" if host == "localhost" else host)
    except ValueError:
        return None
