"""The interface every backend offers, and how one is found.

A backend carries typed messages over one kind of wire. It does not pace, retry or interpret: the link does.
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
"""Each of this group is a `Driver`."""
OptionsT = TypeVar("OptionsT", bound=Strict)

PLUGIN_ERRORS = (
    ImportError, AttributeError, NameError, TypeError, ValueError, LookupError, OSError, RuntimeError, SyntaxError,
)  # fmt: skip
"""What a stranger's module may raise while it is imported."""

log = logging.getLogger(__name__)


class BackendError(OSError):
    """The device is gone, or cannot be opened. The text says what happened, `remedy` what to do if that is special."""

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
    """What the backend knew for a repetition; not the States it gives out that are no news, which the link counts."""
    resynchronisations: int
    unsent: int
    """Messages that the wire did not take at once."""
    refused: dict[str, str]
    """By message (or "frame", where it was none yet), why the newest one was refused: `{"State": "CRC-8"}`."""


Stream: TypeAlias = FrameStream | CanStream
"What a backend takes its bytes apart with."
Received: TypeAlias = bytes | list[tuple[int, bytes]]
"What came at once: a serial port's bytes, or a bus's frames, identifier and data each."
Sent: TypeAlias = bytes | tuple[int, bytes]
"What one message became."


class Backend(Protocol):
    """An open connection to one device. One that has a `stream: Stream` besides has its frames in the black box."""

    @property
    def statistics(self) -> LinkStatistics:
        """Counters since the connection was opened."""

    def receive(self) -> Sequence[Message]:
        """All valid messages that have arrived; never blocks. Raises BackendError when the device is gone."""

    def send(self, message: Message) -> None:
        """Hands one message to the wire; never blocks. Raises BackendError when the device is gone."""

    def close(self) -> None:
        """Gives the device back. Never raises."""


def _accept(device: Device, options: Strict, rates: Rates) -> None:
    """Nothing more to check."""


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
    """Every backend plugin by name, with the reason why it does not load, or "".

    A broken one is reported and skipped, so that a third party's package stops nobody else.
    """
    found = {}
    for entry in sorted(metadata.entry_points(group=ENTRY_POINTS), key=lambda entry: entry.name):
        try:
            _load(entry)
        except PLUGIN_ERRORS as error:
            log.warning("backend %s is skipped, it does not load: %s: %s", entry.name, type(error).__name__, error)
            found[entry.name] = f"{type(error).__name__}: {error}"
        else:
            found[entry.name] = ""
    return found


def choose(device: Device, rates: Rates) -> Chosen:
    """The backend that `device.backend` names, ready to be opened; only that plugin is imported.

    Raises ConfigError: unknown (naming the installed ones), broken, or not what `device` asks for.
    """
    found = {entry.name: entry for entry in metadata.entry_points(group=ENTRY_POINTS)}
    if device.backend not in found:
        installed_are = f"installed are {', '.join(sorted(found)) or 'none'}"
        raise ConfigError(f"device.backend = {device.backend!r}: {installed_are}{did_you_mean(device.backend, found)}")
    try:
        driver = _load(found[device.backend])
    except PLUGIN_ERRORS as error:
        raise ConfigError(f"device.backend = {device.backend!r}: the plugin does not load: {error}") from error
    options = checked(device.options, driver.options, "$.device.options")
    driver.check(device, options, rates)
    return Chosen(options, partial(driver.open, device, options))


def _load(entry: metadata.EntryPoint) -> Driver[Any]:
    loaded = entry.load()
    if not isinstance(loaded, Driver):
        raise TypeError(f"{entry.value} is {loaded!r:.80}: allowed is a {Driver.__module__}.{Driver.__name__}")
    return loaded
