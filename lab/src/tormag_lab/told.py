"""A command's result for a person: lines for single figures, tables for rows."""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any


def lines(result: Mapping[str, Any], path: str = "") -> Iterator[str]:
    """Yield the lines of text that tell a person what `--json` prints of `result`."""
    for key, value in result.items():
        name = f"{path} {key}".strip()
        if isinstance(value, Mapping) and any(isinstance(inner, Mapping | list) for inner in value.values()):
            yield from lines(value, name)
        elif isinstance(value, list) and value and isinstance(value[0], Mapping):
            yield name
            yield from table(value)
        else:
            yield f"{name:40s}{shown(value)}"


def table(rows: Iterable[Mapping[str, Any]]) -> Iterator[str]:
    flat = [dict(_figures(row)) for row in rows]
    names = list(dict.fromkeys(name for row in flat for name in row))
    cells = [names, *([shown(row.get(name, "")) for name in names] for row in flat)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    for line in cells:
        yield "  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True))


def _figures(row: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    for key, value in row.items():
        if isinstance(value, Mapping):
            yield from ((f"{key} {name}", inner) for name, inner in _figures(value))
        elif not isinstance(value, list):
            yield key, value


def shown(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {shown(inner)}" for name, inner in value.items())
    if isinstance(value, float):
        return f"{value:.4g}"
    return ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)
