"""The interface of a backend, and the choice of one among the installed plugins.

A backend carries typed messages over one kind of wire. `link.DeviceLink` paces, repeats and interprets them.
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from typing import Any, Generic, NamedTuple, Protocol, TypeAlias, TypeVar

from firmware_protocol.codec import Message
from tormagd.config import Device, Rates, checked
from tormagd.ground.files import did_you_mean
from tormagd.hardware.streams import CanStream, FrameStream
from tormagd_client.endpoints import ConfigError, Strict

ENTRY_POINTS = "tormagd.backends"
OptionsT = TypeVar("OptionsT", bound=Strict)

PLUGIN_ERRORS = (
    ImportError, AttributeError, NameError, TypeError, ValueError, LookupError, OSError, RuntimeError, SyntaxError,
)  # fmt: skip
"A foreign plugin's module may raise any of these while it is imported."
NO_PORT = "allowed is a serial port; this is none", "tormagctl ports lists them: name one in device.port"

log = logging.getLogger(__name__)


class BackendError(OSError):
    """The device is gone or cannot be opened."""

    def __init__(self, cause: str, remedy: str = "") -> None:
        super().__init__(cause)
        self.remedy = remedy


Stream: TypeAlias = FrameStream | CanStream
Sent: TypeAlias = bytes | tuple[int, bytes]
"One message on the wire, serial or CAN."


class Backend(Protocol):
    """An open connection to one device."""

    @property
    def stream(self) -> Stream:
        """Codec of both directions, with the frames of the newest read and write, and counters since the opening."""

    def receive(self) -> Sequence[Message]:
        """Return the valid messages that have arrived, without blocking. Raises BackendError if the device is gone."""

    def send(self, message: Message) -> None:
        """Hand one message to the wire, without blocking. Raises BackendError if the device is gone."""

    def close(self) -> None:
        """Close the connection, so that others may open the device. Never raises."""


def _accept(device: Device, options: Strict, rates: Rates) -> None:
    """Accept all settings."""


@dataclass(frozen=True)
class Driver(Generic[OptionsT]):
    """One kind of backend: the object that an entry point names."""

    options: type[OptionsT]
    open: Callable[[Device, OptionsT], Backend]
    "Raises BackendError."
    check: Callable[[Device, OptionsT, Rates], None] = _accept
    "Checks settings without any hardware. Raises ConfigError."


class Chosen(NamedTuple):
    """The backend that a configuration asks for, with its options bound."""

    options: Strict
    open: Callable[[], Backend]
    "Raises BackendError."


def installed() -> dict[str, str]:
    """Load every installed backend plugin; return why each does not load, or "", by name. Other exceptions than
    PLUGIN_ERRORS, such as SystemExit, pass through.
    """
    found = {}
    for entry in sorted(metadata.entry_points(group=ENTRY_POINTS), key=lambda entry: entry.name):
        found[entry.name] = ""
        try:
            _load(entry)
        except PLUGIN_ERRORS as error:
            found[entry.name] = f"{type(error).__name__}: {error}"
            log.warning("backend %s does not load, install it again: %s", entry.name, found[entry.name])
    return found


def choose(device: Device, rates: Rates) -> Chosen:
    """Import the plugin that `device.backend` names, check its settings, and return it ready to be opened.

    Raises ConfigError if it is not installed, does not load, or refuses `device.options` or `rates`.
    """
    found = {entry.name: entry for entry in metadata.entry_points(group=ENTRY_POINTS)}
    if device.backend not in found:
        installed_are = f"installed are {', '.join(sorted(found)) or 'none'}"
        raise ConfigError(f"device.backend = {device.backend!r}: {installed_are}{did_you_mean(device.backend, found)}")
    try:
        driver = _load(found[device.backend])
    except PLUGIN_ERRORS as error:
        raise ConfigError(
            f"device.backend = {device.backend!r}: the plugin does not load: {error}; install it again"
        ) from error
    options = checked(device.options, driver.options, "$.device.options")
    driver.check(device, options, rates)
    return Chosen(options, partial(driver.open, device, options))


def _load(entry: metadata.EntryPoint) -> Driver[Any]:
    loaded = entry.load()
    if not isinstance(loaded, Driver):
        raise TypeError(f"{entry.value} is {loaded!r:.80}: allowed is a {Driver.__module__}.{Driver.__name__}")
    return loaded
