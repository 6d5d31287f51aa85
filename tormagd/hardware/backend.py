"""The interface of a backend, and the choice of one among the installed plugins.

A backend carries typed messages over one kind of wire. It does not pace, retry or interpret: `link.DeviceLink` does.
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from typing import Any, Generic, NamedTuple, Protocol, TypeAlias, TypeVar

from firmware_protocol.codec import Message
from tormagd.config import Device, Rates, checked
from tormagd.hardware.can_stream import CanStream
from tormagd.hardware.frame_stream import FrameStream
from tormagd.named_file import did_you_mean
from tormagd_client.endpoints import ConfigError, Strict

ENTRY_POINTS = "tormagd.backends"
"""The group of entry points under which plugins register; each names a `Driver`."""
OptionsT = TypeVar("OptionsT", bound=Strict)

PLUGIN_ERRORS = (
    ImportError, AttributeError, NameError, TypeError, ValueError, LookupError, OSError, RuntimeError, SyntaxError,
)  # fmt: skip
"""What the module of a foreign plugin may raise while it is imported."""

log = logging.getLogger(__name__)


class BackendError(OSError):
    """The device is gone, or cannot be opened. The text says what happened."""

    def __init__(self, cause: str, remedy: str = "") -> None:
        super().__init__(cause)
        self.remedy = remedy


class LinkStatistics(Protocol):
    """Counters of one open connection."""

    frames: int
    bytes: int
    corrupt: int
    lost: int
    repeated: int
    """Frames that the backend itself took for repetitions. Repeated States that it hands on are counted by the link."""
    resynchronisations: int
    unsent: int
    """Messages that the wire did not take at once."""
    refused: dict[str, str]
    """Why the newest refused message was refused, by its name, or by "frame" for bytes that were no message yet."""


Stream: TypeAlias = FrameStream | CanStream
"What turns a backend's messages into the wire's bytes, and bytes into messages."
Received: TypeAlias = bytes | list[tuple[int, bytes]]
"What one read gave: a serial port's bytes, or a bus's frames, identifier and data each."
Sent: TypeAlias = bytes | tuple[int, bytes]
"What one message became on the wire: a serial frame's bytes, or a CAN frame's identifier and data."


class Backend(Protocol):
    """An open connection to one device. If it also has a `stream: Stream`, the black box keeps its frames."""

    @property
    def statistics(self) -> LinkStatistics:
        """Counters since the connection was opened."""

    def receive(self) -> Sequence[Message]:
        """Return the valid messages that have arrived; never block. Raises BackendError when the device is gone."""

    def send(self, message: Message) -> None:
        """Hand one message to the wire; never block. Raises BackendError when the device is gone."""

    def close(self) -> None:
        """Close the connection, so that others may open the device. Never raises."""


def _accept(device: Device, options: Strict, rates: Rates) -> None:
    """Accept all settings: a driver without a check of its own."""


@dataclass(frozen=True)
class Driver(Generic[OptionsT]):
    """One kind of backend, as its entry point gives it."""

    options: type[OptionsT]
    "What `[device.options]` may say; it is decoded before anything is opened."
    open: Callable[[Device, OptionsT], Backend]
    "Opens the device. Raises BackendError saying why not."
    check: Callable[[Device, OptionsT, Rates], None] = _accept
    "Refuses settings that cannot work, without any hardware. Raises ConfigError."


class Chosen(NamedTuple):
    """The backend that a configuration asks for, with all of its options."""

    options: Strict
    open: Callable[[], Backend]
    "Opens the device. Raises BackendError saying why not."


def installed() -> dict[str, str]:
    """Load every installed backend plugin; return by its name, sorted, why it does not load, "" where it does. Raises
    what a module raises besides PLUGIN_ERRORS, such as SystemExit."""
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
    """Import the backend plugin that `device.backend` names, check the settings, and return it ready to be opened.
    Raises ConfigError where no such plugin is installed, where it does not load, and where it refuses `device.options`
    or `rates`."""
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
    """Import the driver of an entry point."""
    loaded = entry.load()
    if not isinstance(loaded, Driver):
        raise TypeError(f"{entry.value} is {loaded!r:.80}: allowed is a {Driver.__module__}.{Driver.__name__}")
    return loaded
