"""SIGHUP: the configuration is read again. What can change while control runs does; what cannot is named."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import msgspec

from tormagd.config import Config

LIVE = frozenset({"sources.priority", "realtime.watchdog_ms"})
"Keys that nothing but the loop that looks at them knows. From all others something was built at the start."


class Reread(NamedTuple):
    """The configuration now in force, the keys that were taken over, and those that wait for a restart."""

    config: Config
    taken: tuple[str, ...]
    waiting: tuple[str, ...]


def reread(running: Config, read: Config) -> Reread:
    """The `running` configuration with what can change taken from the one that was `read`. Keys are paths, `a.b`."""
    differing = tuple(_differing(msgspec.to_builtins(running), msgspec.to_builtins(read), ""))
    config = msgspec.structs.replace(
        running,
        sources=read.sources,
        realtime=msgspec.structs.replace(running.realtime, watchdog_ms=read.realtime.watchdog_ms),
    )
    taken = tuple(key for key in differing if key in LIVE)
    return Reread(config, taken, tuple(key for key in differing if key not in LIVE))


def _differing(before: dict[str, Any], after: dict[str, Any], path: str) -> Iterator[str]:
    for name in sorted(before.keys() | after.keys()):
        old, new = before.get(name), after.get(name)
        if isinstance(old, dict) and isinstance(new, dict):
            yield from _differing(old, new, f"{path}{name}.")
        elif old != new:
            yield f"{path}{name}"
