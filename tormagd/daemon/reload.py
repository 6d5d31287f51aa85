"""Reading the configuration again on SIGHUP: some keys change while control runs, the others are named."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import msgspec

from tormagd.config import Config
from tormagd_client.printable import require

LIVE = "realtime.watchdog_ms", "sources."
"Keys, or how they begin; from all others something was built at the start."


class Reread(NamedTuple):
    """The configuration after a reload, the keys taken over, and the keys that wait for a restart."""

    config: Config
    taken: tuple[str, ...]
    waiting: tuple[str, ...]


def reread(running: Config, read: Config) -> Reread:
    """Return `running` with the keys in LIVE taken from `read`."""
    timeout_ms, watchdog_ms = running.device.command_timeout_ms, read.realtime.watchdog_ms
    require(
        watchdog_ms > timeout_ms,
        "realtime.watchdog_ms",
        watchdog_ms,
        f"over device.command_timeout_ms = {timeout_ms:g}, which stays until a restart",
    )
    differing = tuple(_differing(msgspec.to_builtins(running), msgspec.to_builtins(read), ""))
    config = msgspec.structs.replace(
        running,
        sources=read.sources,
        realtime=msgspec.structs.replace(running.realtime, watchdog_ms=watchdog_ms),
    )
    taken = tuple(key for key in differing if key.startswith(LIVE))
    return Reread(config, taken, tuple(key for key in differing if not key.startswith(LIVE)))


def _differing(before: dict[str, Any], after: dict[str, Any], path: str) -> Iterator[str]:
    for name in sorted(before.keys() | after.keys()):
        old, new = before.get(name), after.get(name)
        if isinstance(old, dict) and isinstance(new, dict):
            yield from _differing(old, new, f"{path}{name}.")
        elif old != new:
            yield f"{path}{name}"
