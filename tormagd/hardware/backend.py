"""The interface every backend offers, and how one is found.

A backend carries typed messages over one kind of wire. It does not pace, retry or interpret: the link does.
"""

import logging
from collections.abc import Callable, Sequence
from importlib import metadata
from typing import Protocol

from firmware_protocol.codec import Message
from tormagd.config import ConfigError, Device

ENTRY_POINTS = "tormagd.backends"

log = logging.getLogger(__name__)


class BackendError(OSError):
    """The device is gone, or cannot be opened: the text says what happened and what to do."""


class LinkStatistics(Protocol):
    """Counters of one open connection."""

    frames: int
    bytes: int
    corrupt: int
    lost: int
    repeated: int
    resynchronisations: int


class Backend(Protocol):
    """An open connection to one device."""

    @property
    def statistics(self) -> LinkStatistics:
        """Counters since the connection was opened."""

    def fileno(self) -> int:
        """The descriptor to watch for reading."""

    def receive(self) -> Sequence[Message]:
        """All valid messages that have arrived; never blocks. Raises BackendError when the device is gone."""

    def send(self, message: Message) -> None:
        """Hands one message to the wire; never blocks. Raises BackendError when the device is gone."""

    def close(self) -> None:
        """Gives the device back. Never raises."""


def opener(device: Device) -> Callable[[Device], Backend]:
    """The `open` function of the backend that `device.backend` names. Raises ConfigError naming the installed ones.

    A plugin that cannot be imported is reported and skipped, so that a broken third-party package stops nobody else.
    """
    found = {entry.name: entry for entry in metadata.entry_points(group=ENTRY_POINTS)}
    if device.backend not in found:
        raise ConfigError(f"device.backend = {device.backend!r}: installed are {', '.join(sorted(found)) or 'none'}")
    try:
        loaded: Callable[[Device], Backend] = found[device.backend].load()
    except (ImportError, AttributeError) as error:
        raise ConfigError(f"device.backend = {device.backend!r}: the plugin does not load: {error}") from error
    return loaded
