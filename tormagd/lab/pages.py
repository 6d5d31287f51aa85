"""Generated pages and their pictures: tables in Markdown, and pictures that say which figures they were drawn from."""

import hashlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

if TYPE_CHECKING:
    from matplotlib.figure import Figure

KEY = "Figures"


def stamp(figures: object) -> dict[str, str | None]:
    """The metadata of a PNG drawn from `figures`, which are plain data: their digest, and nothing that changes with
    time or version, so that the same figures make the same file."""
    return {KEY: hashlib.sha256(msgspec.json.encode(figures, order="sorted")).hexdigest(), "Software": None}


def figures_of(page: str) -> list[str]:
    """The figures of a generated page: the rows of its tables, whatever else it says."""
    return [line for line in page.splitlines() if line.startswith("|")]


def subplots(size: tuple[float, float], *grid: int, **options: Any) -> tuple["Figure", Any]:
    """A figure of that size, inches, and its axes."""
    from matplotlib.figure import Figure  # not every installation draws

    figure = Figure(figsize=size, layout="constrained")
    return figure, figure.subplots(*grid, **options)


def write_page(path: Path, sections: Iterable[str], folder: Path, pictures: Mapping[str, "Figure"]) -> None:
    """Writes a page, and its pictures as PNG into `folder`, stamped with the rows of the page's tables."""
    page = "\n".join(section.rstrip() + "\n" for section in sections)
    folder.mkdir(parents=True, exist_ok=True)
    for name, figure in pictures.items():
        figure.savefig(folder / f"{name}.png", dpi=90, metadata=stamp(figures_of(page)))
    path.write_text(page, encoding="utf-8")


def table(columns: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A table in Markdown."""
    head = list(columns)
    lines = [head, ["---"] * len(head), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def percent(share: float) -> str:
    """To a tenth."""
    return f"{100 * share:.1f}%"
