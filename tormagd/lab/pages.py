"""Generated pages and their pictures: tables in Markdown, and pictures that carry the digest of their figures."""

import hashlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

if TYPE_CHECKING:
    from matplotlib.figure import Figure

KEY = "Figures"


def stamp(figures: object) -> dict[str, str | None]:
    """Return the metadata of a PNG drawn from `figures`, which are plain data: their SHA-256 digest, under KEY.

    Nothing in it changes with time or version, so the same figures make the same file. Raises TypeError for what
    msgspec cannot encode.
    """
    return {KEY: hashlib.sha256(msgspec.json.encode(figures, order="sorted")).hexdigest(), "Software": None}


def figures_of(page: str) -> list[str]:
    """Return the lines of a generated page's tables as they stand, heads and rules too; empty for a page without
    tables."""
    return [line for line in page.splitlines() if line.startswith("|")]


def subplots(size: tuple[float, float], *grid: int, **options: Any) -> tuple["Figure", Any]:
    """Return a new matplotlib figure of `size`, inches, and its axes: one for a single cell, else an array of them.

    `grid`, rows and columns, and `options` go to `Figure.subplots`; without a grid it is one cell. Raises
    ModuleNotFoundError without matplotlib.
    """
    from matplotlib.figure import Figure  # not every installation draws

    figure = Figure(figsize=size, layout="constrained")
    return figure, figure.subplots(*grid, **options)


def write_page(path: Path, sections: Iterable[str], folder: Path, pictures: Mapping[str, "Figure"]) -> None:
    """Write a page to `path`, and its pictures into `folder`, as PNG files of their names in `pictures`, without an
    ending.

    `folder` is made where missing, that of `path` is not. Files of these names are replaced; pictures of earlier names
    stay. Pictures are stamped with the rows of the page's tables, and written before the page. Raises OSError.
    """
    page = "\n".join(section.rstrip() + "\n" for section in sections)
    folder.mkdir(parents=True, exist_ok=True)
    for name, figure in pictures.items():
        figure.savefig(folder / f"{name}.png", dpi=90, metadata=stamp(figures_of(page)))
    path.write_text(page, encoding="utf-8")


def table(columns: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Return a table in Markdown, with a line end behind each row; without rows its head alone.

    Cells are not escaped, and `|` begins another cell. That rows are as long as `columns` is not checked.
    """
    head = list(columns)
    lines = [head, ["---"] * len(head), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def percent(share: float) -> str:
    """Return a share as a percentage, to a tenth."""
    return f"{100 * share:.1f}%"
