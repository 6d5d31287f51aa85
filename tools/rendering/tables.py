"""Measurements, which are plain data, in lines for a person."""

from collections.abc import Iterator
from typing import Any

import numpy as np

Json = dict[str, Any]


def lines(found: Json, name: str) -> Iterator[str]:
    """A line for the figures of every table in it, behind the names that lead there."""
    tables = {key: value if isinstance(value, list) else [value] for key, value in found.items() if _is_table(value)}
    own = [f"{key.removesuffix('_N')} {amount(key, value)}" for key, value in found.items() if key not in tables]
    if own:
        yield f"{name}: {', '.join(own)}"
    for key, rows in tables.items():
        for row in rows:
            yield from lines(row, f"{name}, {key}")


def worst_lines(name: str, devices: dict[str, Json]) -> Iterator[str]:
    """Of each figure that devices have in common the greatest, whose it is, and the median."""
    sizes = {device: dict(_sizes(found)) for device, found in devices.items()}
    for figure in next(iter(sizes.values())):
        of_devices = {device: found[figure] for device, found in sizes.items() if figure in found}
        worst = max(of_devices, key=lambda device: of_devices[device])
        median = float(np.median(list(of_devices.values())))
        yield f"{name}{figure}: {amount(figure, of_devices[worst])} ({worst}), median {amount(figure, median)}"


def amount(key: str, value: object) -> str:
    """A value as its name says: forces, which end in `_N`, in mN."""
    if isinstance(value, list | tuple):
        return " ".join(amount(key, each) for each in value) or "none"
    if not isinstance(value, float):
        return str(value)
    return f"{1e3 * value:.1f} mN" if "_N" in key else f"{value:.4g}"


def _is_table(value: object) -> bool:
    return isinstance(value, dict) or (isinstance(value, list) and bool(value) and isinstance(value[0], dict))


def _sizes(found: object, name: str = "") -> Iterator[tuple[str, float]]:
    """Every number in plain data, without its sign."""
    if isinstance(found, dict | list | tuple):
        for key, value in found.items() if isinstance(found, dict) else enumerate(found, 1):
            yield from _sizes(value, f"{name}, {key}")
    elif isinstance(found, int | float):
        yield name, abs(found)
