"""The numbers within any value."""

import contextlib
from collections.abc import Iterator

from tormagd.ground.plain_values import plain


def leaves(thing: object, path: str = "") -> Iterator[tuple[str, float]]:
    """Yield every float of plain data, values and stages, with its place."""
    if isinstance(thing, float):
        yield path, thing
    elif isinstance(thing, dict):
        for name, each in thing.items():
            yield from leaves(each, f"{path}.{name}")
    elif isinstance(thing, list | tuple):
        for place, each in enumerate(thing):
            yield from leaves(each, f"{path}.{place}")
    elif hasattr(thing, "__dict__") or hasattr(thing, "__mypyc_attrs__"):
        with contextlib.suppress(TypeError):  # for what has no fields
            yield from leaves(plain(thing), path)
